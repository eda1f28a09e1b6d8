"""Command lines, tables and SPECs at random: exit code 0, 1 or 2, one sentence on what is wrong, never a traceback.

`pytest tests/cli/test_fuzz_command_line.py --hypothesis-profile=deep` draws many more examples than the suite does.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jaxtyping
import numpy as np
import pytest
from hypothesis import strategies as st

from jaxmodsim.cli import _fit, _sweep

from ..helpers.fuzz import fuzz
from .test_sweep_command import BELT, MODEL, ROOT

Command = Callable[..., tuple[int, str, str]]

# Nothing is computed here: what a command makes of what was typed is all done before.
PLANNED = "planned"


class Planned(ValueError):
    """Everything was read and found in order."""


def planned(*arguments: Any, **named: Any) -> Any:
    del arguments, named
    raise Planned(PLANNED)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a record, a SPEC and a model that are in order."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "good.csv").write_text(csv())
    (folder / "belt.toml").write_text(BELT)
    (folder / "root.toml").write_text(ROOT)
    (folder / "model.py").write_text(MODEL)
    (folder / "folder").mkdir()
    (folder / "bytes.csv").write_bytes(bytes(range(256)))
    return folder


@pytest.fixture
def run(run_command: Command, place: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    monkeypatch.setattr(_fit, "fit_with_progress", planned)
    monkeypatch.setattr(_fit, "compare", planned)
    monkeypatch.setattr(_sweep, "sweep", planned)
    monkeypatch.chdir(place)
    return run_command


def csv(samples: int = 40) -> str:
    t = np.linspace(0.0, 1.0, samples)
    rows = zip(t, np.sin(3 * t), np.cos(3 * t), strict=True)
    return "t,q,u\n" + "".join(f"{a:.6f},{b:.6f},{c:.6f}\n" for a, b, c in rows)


def check_ending(ending: tuple[int, str, str]) -> None:
    """An exit code that says how it went, and for what went wrong a sentence."""
    code, out, errors = ending
    assert code in (0, 1, 2), ending
    assert "Traceback" not in errors, errors
    if code == 2:
        assert errors.strip() or out.strip(), ending  # without a command that is the help
    if errors.startswith("jaxmodsim: "):
        # One line, of words.
        assert errors.count("\n") == 1, errors
        assert len(errors.split()) >= (2 if PLANNED in errors else 4), errors


FIT_OPTIONS = (
    "--time", "--position", "--force", "--units", "--drop", "--max-steps", "--laws", "--free", "--start", "--fix",
    "--limit", "--held-out", "--folds", "--loss", "--initializer", "--starts", "--substeps", "--report", "--next",
    "--max-force", "--max-speed", "--max-travel", "--duration", "--out",
)  # fmt: skip
SWEEP_OPTIONS = ("--out", "--figure", "--chunk", "--dry-run", "--help")
WORDS = (
    "t", "q", "u", "m", "Fc", "coulomb", "lugre", "stribeck", "all", "coulomb,lugre", "m=1", "m=", "=1", "m=nan", "m=:",
    "m=1:0", "m=0:", "time=ms", "position=deg", "force=mA", "force=0", "nan,repeated", "+delay.u",
    "m=-1:1e400", "friction.Fc=1", "friction.Fc=-1", "friction.width=0", "q0", "q0[0]", "q0[9]",
    "delay.u", "squares", "huber", "staged", "regression", "0", "1", "-1", "2", "3.5", "nan", "inf", "1e400", "", " ",
    "--", "-", "good.csv", "none.csv", "folder", "bytes.csv", "folder/none.csv", "good.csv/a", "a.png", "a.pdf", "a,b",
    "[", "[bold]", "\\", "'", "é", "\u2028", "x" * 300, "belt.toml", "root.toml", "model.py", "None", "True",
)  # fmt: skip


def words(options: tuple[str, ...]) -> st.SearchStrategy[list[str]]:
    """Options with values that may be theirs, and may not."""
    return st.lists(st.sampled_from(options) | st.sampled_from(WORDS), max_size=6)


@pytest.mark.parametrize(
    ("command", "share"), [(("fit", "good.csv"), 0.03), (("sweep", "root.toml", "--dry-run"), 0.03), ((), 0.01)]
)
def test_any_command_line(run: Command, command: tuple[str, ...], share: float) -> None:
    options = {"fit": FIT_OPTIONS, "sweep": SWEEP_OPTIONS}.get(command[0] if command else "", ("--help", "--version"))

    @fuzz(share, words(options))
    def check(more: list[str]) -> None:
        check_ending(run(*command, *more))

    check()


CELLS = st.sampled_from(["", "nan", "inf", "1e400", "text", "1,5", "-", "0", "1e-320", '"', "True", "1j", "2020-01-01"])
COLUMNS = ["t", "q", "u"]


@st.composite
def tables(draw: st.DrawFn) -> bytes:
    """A table in order, with a few things wrong."""
    lines = csv(draw(st.sampled_from([0, 1, 2, 3, 5, 40]))).splitlines()
    kinds = st.sampled_from(["cell", "line", "head", "cut", "repeat", "separator", "fields"])
    for kind in draw(st.lists(kinds, max_size=3)):
        i = draw(st.integers(0, max(len(lines) - 1, 0)))
        if not lines:
            break
        if kind == "cell":
            cells = lines[i].split(",")
            cells[draw(st.integers(0, len(cells) - 1))] = draw(CELLS)
            lines[i] = ",".join(cells)
        elif kind == "line":
            lines[i] = draw(st.sampled_from(["", "#", "\x00", "a,b,c,d,e,f", '"']))
        elif kind == "head":
            lines[0] = draw(st.sampled_from(["", "t,t,t", "q,u", "T,Q,U", "t;q;u", " t , q , u ", "0,0,0", "t,q,u,"]))
        elif kind == "cut":
            lines = lines[: i + 1]
        elif kind == "repeat":
            lines = lines + lines
        elif kind == "separator":
            lines = [line.replace(",", draw(st.sampled_from([";", "\t", " "]))) for line in lines]
        else:
            lines[i] += ",1,2"
    text = draw(st.sampled_from(["\n", "\r\n", "\r"])).join(lines)
    raw = text.encode(draw(st.sampled_from(["utf-8", "utf-8", "utf-8-sig", "utf-16", "latin-1"])))
    place = draw(st.integers(0, max(len(raw), 1)))
    return raw[:place] + draw(st.sampled_from([b"", b"", b"", b"\xff\xfe", b"\x00" * 9])) + raw[place:]


def test_any_table(run: Command, place: Path) -> None:
    @fuzz(0.04, st.one_of(tables(), st.binary(max_size=60)))
    def check(content: bytes) -> None:
        (place / "drawn.csv").write_bytes(content)
        ending = run("fit", "drawn.csv")
        check_ending(ending)
        assert re.search(rf"drawn|{PLANNED}", ending[2]), ending[2]

    check()


@st.composite
def specs(draw: st.DrawFn) -> bytes:
    """A SPEC with lines left out, doubled, and values changed."""
    lines = draw(st.sampled_from([BELT, ROOT])).splitlines()
    values = ["1", "-1", "0", "1e400", "nan", "inf", "true", '"text"', "[]", "{}", "[[]]", "[1, 'a']", "2020-01-01", ""]
    for _ in range(draw(st.integers(1, 3))):
        i = draw(st.integers(0, len(lines) - 1))
        kind = draw(st.sampled_from(["value", "value", "value", "leave", "double", "key", "number"]))
        key, equals, value = lines[i].partition("=")
        if kind == "value" and equals:
            lines[i] = f"{key}= {draw(st.sampled_from(values))}"
        elif kind == "leave":
            lines[i] = ""
        elif kind == "double":
            lines.insert(i, lines[i])
        elif kind == "key":
            lines[i] = f"{draw(st.sampled_from(['a', 'm', 't1', 'law', '[over]', '']))} ={value}"
        else:
            digits = [j for j, letter in enumerate(lines[i]) if letter.isdigit()]
            if digits:
                j = draw(st.sampled_from(digits))
                lines[i] = lines[i][:j] + draw(st.sampled_from(["-1", "1e999", "nan", "'", "0"])) + lines[i][j + 1 :]
    raw = "\n".join(lines).encode()
    windows, marked = raw.replace(b"\n", b"\r\n"), b"\xef\xbb\xbf" + raw
    return draw(st.sampled_from([raw, raw, windows, marked, raw[: len(raw) // 2]]))


def test_any_spec(run: Command, place: Path) -> None:
    @fuzz(0.06, st.one_of(specs(), specs(), st.binary(max_size=60)))
    def check(content: bytes) -> None:
        (place / "drawn.toml").write_bytes(content)
        check_ending(run("sweep", "drawn.toml", "--dry-run"))

    check()
