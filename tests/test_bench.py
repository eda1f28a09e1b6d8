"""The suite of benches: what it runs, what it records, and the tables of the documentation."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bench import render
from bench.layout import Recorded, Table, Targets
from bench.tables import REPORTS

ROOT = Path(__file__).parents[1]
RESULTS = sorted((ROOT / "bench" / "results").glob("*.json"))

# In the place of `bench/one.py`: writes a result, as clean as its name says.
ONE = """
import json, sys, time
from pathlib import Path
name, out = sys.argv[1], Path(sys.argv[2])
if name == "long":
    print("begun", flush=True)
    time.sleep(60)
(out / f"{name}.json").write_text(json.dumps({"provenance": {"clean": name != "dirty"}}))
(out / f"{name}.png").write_text("new")
print("arguments", name, *sys.argv[3:])
sys.exit(3 if name == "bad" else 0)
"""
TABLES = """
from types import SimpleNamespace
REPORTS = {name: SimpleNamespace(says=f"Runs {name}.") for name in ("good", "bad", "dirty", "long")}
"""


@pytest.fixture
def suite(tmp_path):
    """A suite of small benches, run as a user does; gives its exit code and all it printed."""
    folder = tmp_path / "bench"
    (folder / "results").mkdir(parents=True)
    (tmp_path / "docs" / "figures").mkdir(parents=True)
    (folder / "results" / "bad.json").write_text("old")
    (folder / "__main__.py").write_text((ROOT / "bench" / "__main__.py").read_text())
    (folder / "__init__.py").touch()
    (folder / "render.py").write_text("print('rendered')\n")
    (folder / "one.py").write_text(ONE)
    (folder / "tables.py").write_text(TABLES)

    def run(*arguments: str) -> tuple[int, str]:
        done = subprocess.run(
            [sys.executable, "bench", *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        return done.returncode, done.stdout + done.stderr

    run.folder = folder  # pyright: ignore[reportFunctionMemberAccess]
    return run


def test_results_of_what_ended_well_are_recorded_and_a_failure_shows(suite):
    code, text = suite("good", "bad")
    assert code == 1
    assert "rendered" in text
    results = suite.folder / "results"
    assert (results / "good.json").exists()
    assert (suite.folder.parent / "docs" / "figures" / "good.png").exists()
    assert (results / "bad.json").read_text() == "old"
    assert "good                     exit code 0" in text
    assert "bad                      exit code 3" in text


def test_nothing_is_recorded_with_uncommitted_changes(suite):
    code, text = suite("dirty")
    assert code == 0
    assert "dirty is not recorded because of uncommitted changes" in text
    assert [path.name for path in (suite.folder / "results").iterdir()] == ["bad.json"]


def test_small_runs_two_at_a_time_leave_nothing(suite, tmp_path):
    code, text = suite("good", "--smoke", "--jobs", "2")
    assert (code, "rendered" in text, "arguments good --smoke" in text) == (0, False, True)
    assert not (suite.folder / "results" / "good.json").exists()
    assert suite("dirty", "--out", str(tmp_path / "apart"))[0] == 0
    assert (tmp_path / "apart" / "dirty.json").exists()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [(("--jobs", "2"), "--jobs needs"), (("zz",), "no bench begins with 'zz'; there are: good, bad")],
)
def test_usage_errors(suite, arguments, text):
    code, printed = suite(*arguments)
    assert code == 2
    assert text in " ".join(printed.replace("│", " ").split())


def test_list_runs_nothing(suite):
    code, text = suite("--list")
    assert (code, "Runs good." in text, "arguments" in text) == (0, True, False)


def test_an_interrupt_leaves_finished_results(suite):
    # A suite started in the background ignores SIGINT, and so would its children.
    restored = "signal.signal(signal.SIGINT, signal.default_int_handler)"
    run = f"import runpy, signal; {restored}; runpy.run_path('bench', run_name='__main__')"
    command = [sys.executable, "-c", run, "good", "long"]
    with subprocess.Popen(command, cwd=suite.folder.parent, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if "begun" in line:
                break
        time.sleep(0.2)  # the suite waits for the bench
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
        assert process.wait() == 130
    assert "rendered" not in rest
    assert "long                     not finished" in rest
    assert (suite.folder / "results" / "good.json").exists()


def test_every_bench_has_a_result_a_layout_and_a_line_in_the_pages():
    studies = {path.stem for path in (ROOT / "bench" / "studies").glob("[a-z]*.py")}
    cases = (ROOT / "bench" / "cases.py").read_text()
    assert {path.stem for path in RESULTS} == set(REPORTS)
    assert all(name in studies or f'"{name}"' in cases for name in REPORTS)
    assert studies <= set(REPORTS)
    page = (ROOT / "docs" / "benchmarks.md").read_text()
    assert all(f"`{name}`" in page and f"({report.page}.md" in page for name, report in REPORTS.items())
    assert all(report.says.endswith(".") for report in REPORTS.values())


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_results_are_tidy(path):
    found = Recorded.read(path)
    assert not found.smoke
    for row in found.rows:
        assert {"case", "peer", "quantity", "at", "value", "unit"} <= set(row)
        assert isinstance(row["value"], str | int | float)
        assert not isinstance(row["value"], str) or not row["value"].startswith("failed: ImportError")
    assert len(found.known) == len(found.rows)


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_results_come_from_clean_commits(path):
    assert Recorded.read(path).provenance["clean"]


@pytest.fixture
def recorded(tmp_path):
    """A small result, in its file."""
    row = {"case": "a", "peer": "jaxmodsim", "quantity": "run", "at": "", "unit": "s"}
    rows = [row | {"value": 2e-3}, row | {"peer": "x|y", "value": 3e-3}, row | {"peer": "z", "value": "failed: why"}]
    rows.append(row | {"quantity": "steps", "unit": "1", "value": 7})
    machine = {"cpu": "C", "cores": 2, "python": "3", "versions": {"jax": "1"}, "date": "now", "commit": ""}
    machine["clean"] = True
    content = {"name": "coverage", "smoke": False, "provenance": machine, "settings": {"repeats": 3}, "rows": rows}
    path = tmp_path / "coverage.json"
    path.write_text(json.dumps(content | {"not_run": {"w": "no module"}}))
    return path


def test_tables_pivot_rows(recorded):
    found = Recorded.read(recorded)
    table = Table("", ("run", "steps")).cells(found)
    assert table == [
        ["peer", "run [ms]", "steps"], ["jaxmodsim", "2", "7"], ["x|y", "3", "-"], ["z", "failed", "-"]
    ]  # fmt: skip
    assert Table("", ("run",), ("case",), ("peer",), {"peer": ("z", "x|y")}).cells(found)[1] == ["a", "3", "failed"]
    targets = Targets("", lambda r: [("a", ">= 2", r.number("steps", case="a")), ("b", "< 1", r.number("no"))])
    assert targets.verdicts(found)[1:] == [["a", ">= 2", "7", "yes"], ["b", "< 1", "-", "not measured"]]
    assert targets.cells(found)[1:] == [["a", "7"], ["b", "-"]]


def test_tables_are_rendered_into_their_blocks(recorded, tmp_path, monkeypatch):
    report = REPORTS["coverage"]
    monkeypatch.setitem(REPORTS, "coverage", type(report)("", "", (Table("{repeats} times.", ("run",)),)))
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- bench:coverage -->\nold\n<!-- /bench -->\nafter\n")
    rendered = render.render(page, tmp_path)
    assert "| x\\|y | 3 |" in rendered
    assert "*3 times. C, 2 cores, Python 3, jax 1; now, commit unknown. Not run: w (no module).*" in rendered
    assert "old" not in rendered
    page.write_text(rendered)
    assert render.render(page, tmp_path) == rendered
    targets = Targets("Ratios.", lambda r: [("a", ">= 2", 7.0)])
    monkeypatch.setitem(REPORTS, "coverage", type(report)("", "", (Table("Times.", ("run",)), targets)))
    page.write_text("<!-- bench:coverage -->\n<!-- /bench -->\n<!-- bench:coverage targets -->\n<!-- /bench -->\n")
    shown, asked = render.render(page, tmp_path).split("<!-- bench:coverage targets -->")
    assert "Times." in shown
    assert "Times." not in asked
    assert "| a | 7 |" in shown
    assert "| a | >= 2 | 7 | yes |" in asked
    page.write_text(rendered)
    recorded.write_text(recorded.read_text().replace('"smoke": false', '"smoke": true'))
    with pytest.raises(SystemExit, match="comes from a smoke run"):
        render.render(page, tmp_path)
    page.write_text(rendered.replace("coverage", "two"))
    with pytest.raises(SystemExit, match=r"page\.md asks for bench:two.*no two\.json"):
        render.render(page, tmp_path)
    page.write_text("<!-- bench:one -->\n")
    with pytest.raises(SystemExit, match=r"page\.md has 1 comments that open a block and 0"):
        render.render(page, tmp_path)
