"""Objects that print as a short table, and show it in a notebook."""

from functools import singledispatch
from html import escape
from typing import NamedTuple

import jax.core
import numpy as np

# Lines of a printed table.
_MOST_ROWS = 22


class Table(NamedTuple):
    """What an object prints: a title, columns with their heads, and sentences below."""

    title: str
    head: tuple[str, ...]
    rows: list[tuple[str, ...]]
    notes: tuple[str, ...] = ()

    def shortened(self) -> "Table":
        """With as many rows as a screen holds, and a note of how many are left out."""
        left = len(self.rows) - _MOST_ROWS
        if left <= 0:
            return self
        return self._replace(rows=self.rows[:_MOST_ROWS], notes=(f"... and {left} more", *self.notes))

    def text(self) -> str:
        """Aligned columns."""
        widths = [max(map(len, column)) for column in zip(self.head, *self.rows, strict=True)] if self.rows else []
        lines = [self.head, *self.rows] if self.rows else []
        aligned = ["  ".join([f"{x:{n}}" for x, n in zip(line, widths, strict=True)]).rstrip() for line in lines]
        return "\n".join([self.title, *(f"  {line}" for line in aligned), *self.notes])

    def html(self) -> str:
        """A table of HTML."""
        head = "".join(f"<th style='text-align:left'>{escape(x)}</th>" for x in self.head)
        rows = ["".join(f"<td style='text-align:left'>{escape(x)}</td>" for x in row) for row in self.rows]
        body = f"<table><tr>{head}</tr>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>" if rows else ""
        return f"<b>{escape(self.title)}</b>{body}{'<br>'.join(map(escape, self.notes))}"


@singledispatch
def table_of(thing: object) -> Table:
    """What `thing` prints; registered by the room that knows it."""
    return Table(type(thing).__name__, (), [])


class AbstractReadable:
    """What prints by `table_of`, and shows the same in a notebook."""

    def __str__(self) -> str:
        """The table as text."""
        return table_of(self).shortened().text()

    def _repr_html_(self) -> str:
        return table_of(self).shortened().html()


def short(x: object) -> str:
    """A number, or an array of them, in a few characters."""
    if isinstance(x, jax.core.Tracer) or not hasattr(x, "dtype"):
        return "traced" if isinstance(x, jax.core.Tracer) else str(x)
    array = np.asarray(x)
    if array.ndim == 0 or array.size <= 4:
        return str(np.vectorize(lambda value: f"{value:.6g}", otypes=[object])(array).tolist()).replace("'", "")
    if array.dtype.kind not in "fiu":
        return f"shape {array.shape}"
    return f"shape {array.shape}, {array.min():.4g} to {array.max():.4g}"
