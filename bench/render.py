"""Render the tables of recorded results, with the layouts of `tables.py`, into the pages that name them.

README.md and the pages under docs/ say where the tables of `bench/results/NAME.json` go:

    <!-- bench:NAME -->
    <!-- /bench -->

and `<!-- bench:NAME targets -->` where its targets go, with the verdict on each.

    python bench/render.py            writes the pages
    python bench/render.py --check    changes nothing, exits with 1 if a page is out of date
"""

import argparse
import re
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(ROOT))  # for `bench`, where this file is run as a script

from bench.layout import Recorded, Targets, machine_line  # noqa: E402
from bench.tables import REPORTS  # noqa: E402

_BLOCK = re.compile(r"(<!-- bench:([\w-]+)( targets)? -->\n)(.*?)(<!-- /bench -->)", re.DOTALL)
_NUMBER = re.compile(r"-?[\d,.]+(e[-+]?\d+)?|-|")


def report(found: Recorded, targets: bool = False) -> str:
    """All tables of a result in Markdown, or those of its targets; the last caption says where they were made."""
    shown = [each for each in REPORTS[found.name].tables if isinstance(each, Targets) or not targets]
    parts = []
    for number, table in enumerate(shown):
        caption = table.caption.format(**{name.replace(" ", "_"): value for name, value in found.settings.items()})
        if number + 1 == len(shown):
            missing = "; ".join(f"{name} ({why})" for name, why in found.not_run.items())
            caption += f" {machine_line(found.provenance)}" + (f" Not run: {missing}." if missing else "")
        cells = table.verdicts(found) if targets and isinstance(table, Targets) else table.cells(found)
        parts.append(f"{_markdown(cells)}\n*{caption.strip()}*\n")
    return "\n".join(parts)


def _markdown(lines: list[list[str]]) -> str:
    """Columns of numbers are aligned to the right."""
    heading, *rows = lines
    rules = ["---:" if all(map(_NUMBER.fullmatch, column)) else "---" for column in zip(*rows, strict=True)]
    escaped = [[text.replace("|", "\\|") for text in row] for row in rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in (heading, rules, *escaped))


def pages() -> list[Path]:
    """README.md and the pages under docs/."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def render(page: Path, results: Path) -> str:
    """Text of `page`, with each marked block replaced by the tables of its result."""
    text = page.read_text()

    def block(match: re.Match[str]) -> str:
        path = results / f"{match[2]}.json"
        if not path.exists():
            sys.exit(f"{page.name} asks for bench:{match[2]}, but there is no {path.name} among the results.")
        found = Recorded.read(path)
        if found.smoke:
            sys.exit(f"{path.name} comes from a smoke run, which measures nothing.")
        return f"{match[1]}\n{report(found, bool(match[3]))}\n{match[5]}"

    opened, closed = text.count("<!-- bench:"), text.count("<!-- /bench -->")
    if not opened == closed == len(_BLOCK.findall(text)):
        sys.exit(f"{page.name} has {opened} comments that open a block and {closed} that close one; they must pair.")
    return _BLOCK.sub(block, text)


def main() -> None:
    """Render, or check."""
    parser = argparse.ArgumentParser(description="Put the tables of the results into the README and the docs.")
    parser.add_argument("--check", action="store_true", help="only say whether the pages are up to date")
    check = parser.parse_args().check
    # All pages are rendered before the first is written, so that an error leaves them unchanged.
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


if __name__ == "__main__":
    main()
