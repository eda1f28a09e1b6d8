"""Put the tables of the results into the pages, between the comments that name them.

A result `bench/results/NAME.json` holds its tables ready, as
`{"table": {"columns": [...], "rows": [[...]]}, "caption": "..."}`, or several as
`{"tables": [{"columns": ..., "rows": ..., "caption": ...}, ...]}`. README.md and docs/*.md say where they go:

    <!-- bench:NAME -->
    <!-- /bench -->

    python bench/render.py            writes the pages
    python bench/render.py --check    changes nothing, exits with 1 if a page is out of date
"""

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
ROOT = HERE.parent
_BLOCK = re.compile(r"(<!-- bench:([\w-]+) -->\n)(.*?)(<!-- /bench -->)", re.DOTALL)


def main() -> None:
    """Render, or check."""
    parser = argparse.ArgumentParser(description="Put the tables of the results into README.md and docs/*.md.")
    parser.add_argument("--check", action="store_true", help="only say whether the pages are up to date")
    check = parser.parse_args().check
    # All before the first is written: an error leaves every page as it was.
    rendered = {page: render(page, HERE / "results") for page in pages()}
    outdated = [page for page, text in rendered.items() if page.read_text() != text]
    names = ", ".join(page.relative_to(ROOT).as_posix() for page in outdated)
    if not outdated:
        print("The pages are up to date.")
    elif check:
        sys.exit(f"Out of date: {names}. Run python bench/render.py.")
    else:
        for page in outdated:
            page.write_text(rendered[page])
        print(f"written: {names}")


def pages() -> list[Path]:
    """README.md and the pages under docs/."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def render(page: Path, results: Path) -> str:
    """Text of `page` with every marked block replaced by the tables of the result it names."""
    text = page.read_text()

    def block(found: re.Match[str]) -> str:
        path = results / f"{found[2]}.json"
        if not path.exists():
            sys.exit(f"{page.name} asks for bench:{found[2]}, but there is no {path.name} among the results.")
        content = json.loads(path.read_text())
        if content.get("smoke"):
            sys.exit(f"{path.name} comes from a smoke run, which measures nothing.")
        return f"{found[1]}\n{tables_of(content)}\n{found[4]}"

    opened, closed = text.count("<!-- bench:"), text.count("<!-- /bench -->")
    if not opened == closed == len(_BLOCK.findall(text)):
        sys.exit(f"{page.name} has {opened} comments that open a block and {closed} that close one; they must pair.")
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
