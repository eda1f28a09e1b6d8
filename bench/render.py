"""Put the tables of the results into the README, between the comments that name them.

A result `bench/results/NAME.json` holds its tables ready, as
`{"table": {"columns": [...], "rows": [[...]]}, "caption": "..."}`, or several as
`{"tables": [{"columns": ..., "rows": ..., "caption": ...}, ...]}`. The README says where they go:

    <!-- bench:NAME -->
    <!-- /bench -->

    python bench/render.py            writes the README
    python bench/render.py --check    changes nothing, exits with 1 if the README is out of date
"""

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
_BLOCK = re.compile(r"(<!-- bench:([\w-]+) -->\n)(.*?)(<!-- /bench -->)", re.DOTALL)


def main() -> None:
    """Render, or check."""
    parser = argparse.ArgumentParser(description="Put the tables of the results into the README.")
    parser.add_argument("--check", action="store_true", help="only say whether the README is up to date")
    parser.add_argument("--readme", type=Path, default=HERE.parent / "README.md")
    parser.add_argument("--results", type=Path, default=HERE / "results")
    options = parser.parse_args()
    before = options.readme.read_text()
    after = render(before, options.results)
    if before == after:
        print("The README is up to date.")
    elif options.check:
        sys.exit("The README is out of date: run python bench/render.py.")
    else:
        options.readme.write_text(after)
        print(f"written: {options.readme}")


def render(text: str, results: Path) -> str:
    """`text` with every marked block replaced by the tables of the result it names."""

    def block(found: re.Match[str]) -> str:
        path = results / f"{found[2]}.json"
        if not path.exists():
            sys.exit(f"The README asks for bench:{found[2]}, but there is no {path.name} among the results.")
        content = json.loads(path.read_text())
        if content.get("smoke"):
            sys.exit(f"{path.name} comes from a smoke run, which measures nothing.")
        return f"{found[1]}\n{tables_of(content)}\n{found[4]}"

    opened, closed = text.count("<!-- bench:"), text.count("<!-- /bench -->")
    if not opened == closed == len(_BLOCK.findall(text)):
        sys.exit(f"The README has {opened} comments that open a block and {closed} that close one; they must pair.")
    return _BLOCK.sub(block, text)


def tables_of(content: dict[str, Any]) -> str:
    """All tables of a result in markdown, each followed by its caption."""
    tables = content.get("tables") or [content["table"] | {"caption": content.get("caption", "")}]
    return "\n".join(f"{markdown(table)}\n{_caption(table)}" for table in tables)


def _caption(table: dict[str, Any]) -> str:
    return f"*{table['caption']}*\n" if table.get("caption") else ""


def markdown(table: dict[str, Any]) -> str:
    """One table; the first column is text and the others are aligned to the right."""
    columns = [str(cell) for cell in table["columns"]]
    lines = [columns, ["---", *("---:" for _ in columns[1:])]]
    for row in table["rows"]:
        if len(row) != len(columns):
            sys.exit(f"A row has {len(row)} cells under {len(columns)} columns: {row}")
        lines.append([str(cell).replace("|", "\\|") for cell in row])
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


if __name__ == "__main__":
    main()
