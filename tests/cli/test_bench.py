"""The suite of benches: what it runs, what it keeps, and the tables of the documentation."""

import json
import runpy
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bench import render
from jaxmodsim.cli import _bench

ROOT = Path(__file__).parents[2]

GOOD = """'''Runs well.'''
import sys
from pathlib import Path
out = Path(sys.argv[sys.argv.index("--out") + 1])
out.mkdir()
(out / "good.json").write_text("new")
print("arguments", *sys.argv[1:-2])
"""
BAD = GOOD.replace("good", "bad") + "sys.exit(3)\n"
LONG = "import time\nprint('begun', flush=True)\ntime.sleep(60)\n"


@pytest.fixture
def suite(tmp_path):
    """A suite of small scripts, run as a user does; gives its exit code and all it printed."""
    folder = tmp_path / "bench"
    (folder / "results").mkdir(parents=True)
    (folder / "results" / "bad.json").write_text("old")
    (folder / "__main__.py").write_text((ROOT / "bench" / "__main__.py").read_text())
    (folder / "__init__.py").touch()
    (folder / "render.py").write_text("print('rendered')\n")
    (folder / "a0_good.py").write_text(GOOD)
    (folder / "b0_bad.py").write_text(BAD)

    def run(*arguments: str) -> tuple[int, str]:
        done = subprocess.run(
            [sys.executable, "bench", *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        return done.returncode, done.stdout + done.stderr

    run.folder = folder  # pyright: ignore[reportFunctionMemberAccess]
    return run


def test_results_of_what_ended_well_are_kept_and_a_failure_shows(suite):
    code, text = suite()
    assert code == 1
    assert "rendered" in text
    results = suite.folder / "results"
    assert (results / "good.json").read_text() == "new"
    assert (results / "bad.json").read_text() == "old"
    rows = {line.split()[0]: line.split()[1] for line in text.splitlines() if line.strip().startswith(("a0", "b0"))}
    assert rows == {"a0_good": "0", "b0_bad": "3"}


def test_small_runs_two_at_a_time_leave_nothing(suite, tmp_path):
    code, text = suite("a0", "--smoke", "--jobs", "2")
    assert (code, "rendered" in text, "arguments --smoke" in text) == (0, False, True)
    assert not (suite.folder / "results" / "good.json").exists()
    assert suite("a0", "--out", str(tmp_path / "apart"))[0] == 0
    assert (tmp_path / "apart" / "good.json").exists()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [(("--jobs", "2"), "--jobs needs"), (("zz",), "no bench is called 'zz'; there are a0_good")],
)
def test_usage_errors(suite, arguments, text):
    code, printed = suite(*arguments)
    assert code == 2
    assert text in " ".join(printed.replace("│", " ").split())


def test_list_runs_nothing(suite):
    code, text = suite("--list")
    assert (code, "Runs well." in text, "arguments" in text) == (0, True, False)


def test_an_interrupt_leaves_finished_results(suite):
    (suite.folder / "c0_long.py").write_text(LONG)
    command = [sys.executable, "bench", "a0", "c0"]
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
    assert [line.split()[1:] for line in rest.splitlines() if line.startswith(" c0_long")] == [["not", "finished", "-"]]
    assert (suite.folder / "results" / "good.json").read_text() == "new"


def test_the_command_says_where_it_looked(run_command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(_bench, "__file__", str(tmp_path / "site-packages" / "jaxmodsim" / "cli" / "_bench.py"))
    code, _, errors = run_command("bench")
    assert code == 2
    assert f"there is no folder bench in {tmp_path} or {tmp_path / 'site-packages'}" in errors


def test_the_command_runs_the_suite_of_the_clone(suite, run_command, monkeypatch):
    monkeypatch.chdir(suite.folder.parent)
    assert run_command("bench", "b0", "--smoke")[0] == 1
    assert run_command("bench", "a0", "--list")[0] == 0


def test_every_bench_says_what_it_is():
    known = runpy.run_path(str(ROOT / "bench" / "__main__.py"))["every_run"]()
    assert len(known) >= 17
    assert all(run.says.endswith((".", ":")) for run in known)


def test_tables_are_rendered_into_their_blocks(tmp_path):
    table = {"columns": ["a", "b"], "rows": [["x|y", 1]], "caption": "what"}
    (tmp_path / "one.json").write_text(json.dumps({"tables": [table]}))
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- bench:one -->\nold\n<!-- /bench -->\nafter\n")
    rendered = render.render(page, tmp_path)
    assert "| x\\|y | 1 |" in rendered
    assert "*what*" in rendered
    assert "old" not in rendered
    page.write_text(rendered)
    assert render.render(page, tmp_path) == rendered
    page.write_text(rendered.replace("one", "two"))
    with pytest.raises(SystemExit, match=r"page\.md asks for bench:two.*no two\.json"):
        render.render(page, tmp_path)
    page.write_text("<!-- bench:one -->\n")
    with pytest.raises(SystemExit, match=r"page\.md has 1 comments that open a block and 0"):
        render.render(page, tmp_path)
