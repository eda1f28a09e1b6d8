"""README.md, CONTRIBUTING.md and the pages under docs/: links, size, and figures that the README takes from tables."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from bench import render
from bench.cases import CASES
from bench.tables import REPORTS

from .helpers import law_table, snippets

ROOT = Path(__file__).parents[1]
PAGES = [*render.pages(), ROOT / "CONTRIBUTING.md"]
README = (ROOT / "README.md").read_text()
_CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"\]\(([^)\s]+)\)")

DOCS = ROOT / "docs"
PAGES_WITH_CODE = [page for page in PAGES if page.is_relative_to(DOCS) and snippets.snippets(page.read_text())]

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def anchors(page: Path) -> set[str]:
    """Anchors of the headings of a page, as GitHub and mkdocs make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\s-]", "", heading).strip().lower().replace(" ", "-") for heading in headings}


def broken_links(page: Path) -> list[str]:
    """Relative links and figures of a page that lead nowhere."""
    found = []
    for link in _LINK.findall(_CODE.sub("", page.read_text())):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            found.append(link)
    return found


@each_page
def test_links_and_figures_exist(page: Path) -> None:
    assert not broken_links(page)


def test_broken_links_are_seen(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A (b) c\n[x](#a-b-c) [x](#a) ![x](no.png) [x](page.md#d) `[x](y)` [x](https://z.org)\n")
    assert broken_links(page) == ["#a", "no.png", "page.md#d"]


def test_the_index_lists_every_page() -> None:
    linked = set(re.findall(r"\]\(([\w/]+\.md)\)", (DOCS / "index.md").read_text()))
    pages = [*DOCS.glob("*.md"), *DOCS.glob("howto/*.md")]
    assert linked == {path.relative_to(DOCS).as_posix() for path in pages} - {"index.md"}


def test_the_gallery_lists_every_example() -> None:
    linked = re.findall(r"\]\(\.\./(examples/\w+\.py)\)", (ROOT / "docs" / "gallery.md").read_text())
    assert sorted(linked) == sorted(f"examples/{path.name}" for path in (ROOT / "examples").glob("*.py"))


def test_notebooks_are_listed_and_short() -> None:
    notebooks = {path.name: path.read_text() for path in (ROOT / "examples" / "notebooks").glob("*.py")}
    linked = re.findall(r"\]\(\.\./examples/notebooks/(\w+\.py)\)", (ROOT / "docs" / "notebooks.md").read_text())
    assert sorted(linked) == sorted(notebooks)
    install = '# %%\n# %pip install -q "jaxmodsim[notebook]"\n\n'
    assert all(text.split("# %%\n", 1)[1].startswith(install[5:]) for text in notebooks.values())
    assert max(len(text.replace(install, "").splitlines()) for text in notebooks.values()) < 80
    assert not [name for name, text in notebooks.items() if "pyplot" in text]


def test_the_site_has_every_page() -> None:
    navigation = re.findall(r"[\w/]+\.md", (ROOT / "mkdocs.yml").read_text())
    assert {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")} <= set(navigation)
    rooms = {path.parent.name for path in (ROOT / "jaxmodsim").glob("*/__init__.py")} - {"_core", "cli"}
    assert {f"api/{room}.md" for room in rooms} <= set(navigation)


def test_every_figure_is_shown() -> None:
    shown = {Path(link).name for page in PAGES for link in _LINK.findall(page.read_text())}
    assert {path.name for path in (ROOT / "docs" / "figures").iterdir()} <= shown


def test_the_table_of_laws_is_what_the_laws_say() -> None:
    """Written by `python -m tests.helpers.law_table`."""
    assert law_table.PAGE.read_text() == law_table.with_table(law_table.PAGE.read_text())


def test_the_readme_is_short() -> None:
    assert len(README.encode()) <= 6000


@pytest.mark.parametrize(
    ("name", "count"),
    [("README.md", 10), ("docs/index.md", 10), ("docs/limits.md", 4)],
    ids=["readme", "front", "limits"],
)
def test_figures_of_a_list_are_those_of_the_tables(name: str, count: int) -> None:
    """Bold figures of a list item stand in tables of the pages that the item links to."""
    page = ROOT / name
    checked = 0
    for item in re.findall(r"^- .*?(?=^- |^$)", page.read_text(), re.DOTALL | re.MULTILINE):
        figures = re.findall(r"\*\*([\d.,e-]+)\*\*", item)
        if not figures:
            continue
        linked = [(page.parent / link.partition("#")[0]).read_text() for link in _LINK.findall(item)]
        rows = [row for text in linked for row in text.splitlines() if row.startswith("|")]
        cells = {cell.strip() for row in rows for cell in row.split("|")}
        assert set(figures) <= cells, f"no table has {sorted(set(figures) - cells)}"
        checked += len(figures)
    assert checked == count


def test_figures_of_the_claims_are_those_of_the_tables() -> None:
    """Bold figures of a claim stand in a table of the page that its row links to; what else it names is there."""
    claims = re.findall(r"^\| .+", (ROOT / "docs" / "claims.md").read_text(), re.MULTILINE)[1:]
    assert len(claims) > 10
    for claim in claims:
        tables = [(ROOT / "docs" / link).read_text() for link in _LINK.findall(claim)]
        cells = {
            cell.strip()
            for text in tables
            for row in text.splitlines()
            if row.startswith("|")
            for cell in row.split("|")
        }
        assert set(re.findall(r"\*\*([\d.,e-]+)\*\*", claim)) <= cells, claim
        assert all((ROOT / path).exists() for path in re.findall(r"`(tests/[\w/.]+)`", claim)), claim
        assert all(
            (ROOT / "bench" / "results" / f"{name}.json").exists() for name in re.findall(r"bench `(\w+)`", claim)
        )


def test_figures_of_the_paper_are_those_of_the_tables() -> None:
    """Numbers with a decimal point stand in the tables of the pages."""
    rows = [row for page in PAGES for row in page.read_text().splitlines() if row.startswith("|")]
    cells = {cell.strip() for row in rows for cell in row.split("|")}
    paper = (ROOT / "paper" / "paper.md").read_text()
    figures = set(re.findall(r"\b\d+\.\d+(?:e-\d+)?\b", paper))
    assert len(figures) > 5
    assert figures <= cells
    keys = set(re.findall(r"^@\w+\{(\w+),", (ROOT / "paper" / "paper.bib").read_text(), re.MULTILINE))
    assert keys == {key for group in re.findall(r"\[(@[^\]]+)\]", paper) for key in re.findall(r"@(\w+)", group)}


@pytest.mark.parametrize("page", PAGES_WITH_CODE, ids=lambda page: page.name)
def test_the_code_of_a_page_prints_what_the_page_shows(page: Path) -> None:
    """Written by `python -m tests.helpers.snippets PAGE`."""
    assert snippets.printed_by(page) == [snippet.printed for snippet in snippets.snippets(page.read_text())]


@each_page
def test_every_block_of_code_runs_or_says_why_not(page: Path) -> None:
    text = page.read_text()
    not_run = len(re.findall(r"^ *\*Not run in the tests: .+\*\n\n *```python\n", text, re.MULTILINE))
    assert text.count("```python\n") == len(snippets.snippets(text)) + not_run


def test_the_code_of_the_readme_runs(tmp_path: Path) -> None:
    (code,) = re.findall(r"^```python\n(.*?)^```", README, re.DOTALL | re.MULTILINE)
    script = tmp_path / "page.py"
    script.write_text(code + 'assert run.result.ok and run.q.shape == (1001, 1) and "friction" in run.forces\n')
    subprocess.run([sys.executable, str(script)], cwd=ROOT, check=True)


@pytest.mark.quick
def test_benches_named_by_the_command_line_exist() -> None:
    studies = {path.stem for path in (ROOT / "bench" / "studies").glob("[!_]*.py")}
    assert set(REPORTS) == studies | set(CASES)


@pytest.mark.quick
@pytest.mark.parametrize(
    ("file", "pattern"),
    [("CITATION.cff", r"^version: (.+)$"), ("CHANGELOG.md", r"^## (\S+)")],
    ids=["citation", "changes"],
)
def test_the_version_is_that_of_the_package(file: str, pattern: str) -> None:
    found = re.findall(pattern, (ROOT / file).read_text(), re.MULTILINE)
    assert found[0] == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
