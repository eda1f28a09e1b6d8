"""Recorded results, and the layouts of tables."""

import json
import math
import operator
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

OURS = "jaxmodsim"
_COMPARISONS = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}
Value = float | str | None


@dataclass(frozen=True)
class Recorded:
    """A recorded result."""

    name: str
    smoke: bool
    provenance: dict[str, Any]
    settings: dict[str, Any]
    not_run: dict[str, str]
    rows: list[dict[str, Any]]
    known: dict[tuple[Any, ...], dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> "Recorded":
        """Read a file."""
        found = cls(**json.loads(path.read_text()))
        found.known.update({tuple(row[key] for key in ("case", "peer", "quantity", "at")): row for row in found.rows})
        return found

    def get(self, quantity: str, *, peer: str = OURS, at: Any = "", case: str = "", key: str = "value") -> Value:
        """A value, or None."""
        return self.known.get((case or self.name, peer, quantity, at), {}).get(key)

    def number(self, quantity: str, **where: Any) -> float:
        """A number, or NaN."""
        value = self.get(quantity, **where)
        return float(value) if isinstance(value, int | float) else math.nan

    def all_of(self, quantity: str, key: str, **where: Any) -> list[Any]:
        """Distinct values of a key such as `at` in the rows of a quantity, in order."""
        rows = (row for row in self.rows if row["quantity"] == quantity)
        return list(dict.fromkeys(row[key] for row in rows if all(row[k] == v for k, v in where.items())))


@dataclass(frozen=True)
class Table:
    """The layout of a table: rows of the result, pivoted.

    - `caption`: names settings in braces, as `str.format` does.
    - `quantities`: those that are shown.
    - `lines`, `columns`: keys of rows, of `case`, `peer`, `quantity` and `at`, that name a line and a column.
    - `where`: what else the rows must have, such as `{"at": "chosen"}`, or one of a tuple.
    - `shown`: the key of their values, such as the shortest time.
    """

    caption: str
    quantities: tuple[str, ...]
    lines: tuple[str, ...] = ("peer",)
    columns: tuple[str, ...] = ("quantity",)
    where: dict[str, Any] = field(default_factory=dict)
    shown: str = "value"

    def cells(self, found: Recorded) -> list[list[str]]:
        """Heading, and the lines."""
        kept = [
            row | {"value": row.get(self.shown, row["value"])}
            for quantity in self.quantities
            for row in found.rows
            if row["quantity"] == quantity and all(_in(row[key], value) for key, value in self.where.items())
        ]
        columns: dict[tuple[str, ...], list[dict[str, Any]]] = {}
        for row in kept:
            columns.setdefault(tuple(row[key] for key in self.columns), []).append(row)
        # In the order of the result, not of the quantities.
        wanted = {tuple(row[key] for key in self.lines) for row in kept}
        every = dict.fromkeys(tuple(row[key] for key in self.lines) for row in found.rows)
        names = [name for name in every if name in wanted]
        table = [[f"{_name(name)}" for name in self.lines]]
        lines = {name: [_name(each) for each in name] for name in names}
        for name, rows in columns.items():
            scale, unit = _scale(rows)
            heading = ", ".join(_name(x) for x in name if x != "")
            table[0].append(f"{heading} [{unit}]" if unit not in ("", "1") else heading)
            values = {tuple(row[key] for key in self.lines): _text(row["value"], scale) for row in rows}
            for line, cells in lines.items():
                cells.append(values.get(line, "-"))
        return table + list(lines.values())


def _in(value: Any, wanted: Any) -> bool:
    return value in wanted if isinstance(wanted, tuple) else value == wanted


def _name(value: Any) -> str:
    """A key or a setting as text."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _scale(rows: list[dict[str, Any]]) -> tuple[float, str]:
    """Readable factor and unit for the times of a column."""
    numbers = [abs(row["value"]) for row in rows if isinstance(row["value"], float) and row["value"]]
    if rows[0]["unit"] != "s" or not numbers:
        return 1.0, rows[0]["unit"]
    return next((scale, unit) for least, scale, unit in _TIMES if min(numbers) >= least)


_TIMES = ((0.1, 1.0, "s"), (1e-4, 1e3, "ms"), (1e-7, 1e6, "us"), (0.0, 1e9, "ns"))


def _text(value: Value, scale: float) -> str:
    if isinstance(value, str):
        return "failed" if value.startswith("failed") else value
    return "-" if value is None else str(value) if isinstance(value, int) else f"{scale * value:.3g}"


@dataclass(frozen=True)
class Targets:
    """A table of targets; `of` gives label, target such as `>= 8` or "", and value of each."""

    caption: str
    rows: Callable[[Recorded], list[tuple[str, str, float]]]

    def cells(self, found: Recorded) -> list[list[str]]:
        """Heading, and the lines, without the targets: of interest to users."""
        return [["ratio or quantity", "measured"], *([label, _plain(value)] for label, _, value in self.rows(found))]

    def verdicts(self, found: Recorded) -> list[list[str]]:
        """The same with the targets, and whether each is met."""
        return [["ratio or quantity", "target", "measured", "met"]] + [
            [label, target, _plain(value), _verdict(target, value)] for label, target, value in self.rows(found)
        ]


def _verdict(target: str, value: float) -> str:
    if not target:
        return ""
    if math.isnan(value):
        return "not measured"
    if " to " in target:
        low, high = target.split(" to ")
        return "yes" if float(low) <= value <= float(high) else "no"
    comparison, limit = target.split()
    return "yes" if _COMPARISONS[comparison](value, float(limit)) else "no"


def _plain(value: float) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:,.3g}" if abs(value) < 1e4 else f"{value:,.0f}"


def machine_line(provenance: dict[str, Any]) -> str:
    """A line with processor, versions, date and commit."""
    versions = ", ".join(f"{name} {version}" for name, version in provenance["versions"].items())
    state = "" if provenance["clean"] else " with uncommitted changes"
    return (
        f"{provenance['cpu']}, {provenance['cores']} cores, Python {provenance['python']}, {versions};"
        f" {provenance['date']}, commit {provenance['commit'][:10] or 'unknown'}{state}."
    )
