"""The table of friction laws in docs/laws.md, from what the laws say: `python -m tests.helpers.law_table` writes it."""

import dataclasses
from pathlib import Path

from jaxmodsim.friction import laws

PAGE = Path(__file__).parents[2] / "docs" / "laws.md"
BEGIN, END = "<!-- laws -->\n", "<!-- /laws -->\n"


def law_table() -> str:
    """Markdown: one row for each registered law."""
    rows = ["| friction law | what it is | force | how it runs |", "|---|---|---|---|"]
    for name, law in laws().items():
        arguments = ", ".join(field.name for field in dataclasses.fields(law) if field.init)
        equations = ", ".join(f"`{line}`" for line in law.equations).replace("|", r"\|")
        rows.append(f"| `{name}({arguments})` | {law.description} | {equations} | {law.execution} |")
    return "".join(f"{row}\n" for row in rows)


def with_table(page: str) -> str:
    """The page with the table between its comments."""
    before, rest = page.split(BEGIN)
    return f"{before}{BEGIN}\n{law_table()}\n{END}{rest.split(END)[1]}"


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
