"""All hard cases, and their table in docs/hard_cases.md: `python -m tests.hard.catalogue` writes it."""

from dataclasses import replace
from pathlib import Path

import jax

from . import (
    at_rest,
    contacts,
    geometry,
    gradients,
    many_events,
    numbers,
    orbits,
    plane,
    reversal,
    scale,
    settling,
    shaken,
    stiffness,
)
from .case import HardCase

PAGE = Path(__file__).parents[2] / "docs" / "hard_cases.md"
BEGIN, END = "<!-- hard cases -->\n", "<!-- /hard cases -->\n"

_MODULES = (
    *(stiffness, reversal, shaken, many_events, contacts, settling, orbits),
    *(plane, geometry, scale, numbers, gradients, at_rest),
)

# Families of hard cases, in the order in which they run.
FAMILIES = tuple(module.FAMILY for module in _MODULES)
# Of these the runs themselves take minutes: begun first, they do not hold up the end.
LONG = ("periods_1000000", "cycles_100000", "dead_points", "redundant_constraints")


def hard_cases() -> dict[str, HardCase]:
    """All hard cases by name, family after family.

    ```python
    case = hard_cases()["bristle_stiff"]
    report = check(case)
    report.ok, [finding.sentence for finding in report.findings]
    ```
    """
    return {case.name: replace(case, family=module.FAMILY) for module in _MODULES for case in module.cases()}


def case_table() -> str:
    """Markdown: one row for each case."""
    rows = ["| family | case | why it is hard |", "|---|---|---|"]
    for case in hard_cases().values():
        why = case.why.replace("|", r"\|").replace("*", r"\*").replace("<", "&lt;")
        rows.append(f"| {case.family} | `{case.name}` | {why} |")
    return "".join(f"{row}\n" for row in rows)


def with_table(page: str) -> str:
    """The page with the table between its comments."""
    before, rest = page.split(BEGIN)
    return f"{before}{BEGIN}\n{case_table()}\n{END}{rest.split(END)[1]}"


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    PAGE.write_text(with_table(PAGE.read_text()))
