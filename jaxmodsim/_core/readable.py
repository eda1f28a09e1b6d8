"""Objects that print as a short table, also in notebooks."""

import math
from functools import singledispatch
from html import escape
from typing import NamedTuple

import numpy as np

from .arrays import is_known

# Lines of a printed table.
_MOST_ROWS = 22


class Table(NamedTuple):
    """A printed table: a title, columns with headers, and notes below."""

    title: str
    head: tuple[str, ...]
    rows: list[tuple[str, ...]]
    notes: tuple[str, ...] = ()

    def shortened(self) -> "Table":
        """The table with at most as many rows as fit on a screen, and a note on the number of omitted rows."""
        omitted = len(self.rows) - _MOST_ROWS
        if omitted <= 0:
            return self
        return self._replace(rows=self.rows[:_MOST_ROWS], notes=(f"... and {omitted} more", *self.notes))

    def text(self) -> str:
        """The table as text with aligned columns."""
        widths = [max(map(len, column)) for column in zip(self.head, *self.rows, strict=True)] if self.rows else []
        lines = [self.head, *self.rows] if self.rows else []
        aligned = ["  ".join([f"{x:{n}}" for x, n in zip(line, widths, strict=True)]).rstrip() for line in lines]
        return "\n".join([self.title, *(f"  {line}" for line in aligned), *self.notes])

    def html(self) -> str:
        """The table as HTML."""
        head = "".join(f"<th style='text-align:left'>{escape(x)}</th>" for x in self.head)
        rows = ["".join(f"<td style='text-align:left'>{escape(x)}</td>" for x in row) for row in self.rows]
        body = f"<table><tr>{head}</tr>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>" if rows else ""
        return f"<b>{escape(self.title)}</b>{body}{'<br>'.join(map(escape, self.notes))}"


@singledispatch
def table_of(thing: object) -> Table:
    """The table that `thing` prints; the subpackage of its type registers it."""
    return Table(type(thing).__name__, (), [])


class AbstractReadable:
    """An object that prints its `table_of`, also in a notebook."""

    def __str__(self) -> str:
        """The table as text."""
        return table_of(self).shortened().text()

    def _repr_html_(self) -> str:
        return table_of(self).shortened().html()


def short(x: object) -> str:
    """Short text for a number or an array of numbers."""
    if not is_known(x):
        return "traced"
    if not hasattr(x, "dtype"):
        return str(x)
    array = np.asarray(x)
    if array.ndim == 0 or array.size <= 4:
        return str(np.vectorize(lambda value: f"{value:.6g}", otypes=[object])(array).tolist()).replace("'", "")
    if array.dtype.kind not in "fiu":
        return f"shape {array.shape}"
    return f"shape {array.shape}, {array.min():.4g} to {array.max():.4g}"


def interval_text(low: float, high: float) -> str:
    """Both ends of an interval, to two significant digits of its half-width."""
    half = 0.5 * (high - low)
    if not 0 < half < math.inf:
        return f"{low:.5g} to {high:.5g}"
    last = math.floor(math.log10(float(f"{half:.1e}"))) - 1  # place of the last digit

    def text(x: float) -> str:
        x = round(x, -last) + 0.0  # no negative zero
        digits = math.floor(math.log10(max(abs(x), 10.0**last))) - last + 1
        return f"{x:#.{min(digits, 16)}g}".removesuffix(".")

    return f"{text(low)} to {text(high)}"
