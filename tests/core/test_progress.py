"""What a user reads while something goes on."""

import io
import re
from contextlib import redirect_stderr, redirect_stdout
from typing import Any

import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim._core import progress
from jaxmodsim._core.progress import candidate_words, minutes, progress_line, reported
from jaxmodsim.sweeps import SweepProgress, SweepProgressText

from ..helpers.sprung import sprung

TIME = r"\d+:\d\d"


class Terminal(io.StringIO):
    """A stream that is one."""

    def isatty(self) -> bool:
        return True

    def lines(self) -> list[str]:
        """All that stood on it, one text after the other."""
        return [text.rstrip() for text in re.split(r"[\r\n]", self.getvalue()) if text.strip()]


def test_a_line_begins_with_compiling_and_ends_with_the_last_report() -> None:
    with redirect_stdout(Terminal()) as terminal, progress_line("fit") as show:
        show("iteration 1")
        show("iteration 2")
    lines = terminal.lines()
    assert re.fullmatch(rf"fit {TIME}: compiling", lines[0])
    assert re.fullmatch(rf"fit {TIME}: iteration 2", lines[-1])
    assert terminal.getvalue().endswith("\n")
    assert terminal.getvalue().count("\n") == 1


def test_the_time_goes_on_while_nothing_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "_EVERY", 0.01)
    with redirect_stdout(Terminal()) as terminal, progress_line("fit") as show:
        seen = len(terminal.lines())
        while len(terminal.lines()) < seen + 3:
            pass
        show("iteration 1")


def test_a_line_that_never_reported_is_gone() -> None:
    with redirect_stdout(Terminal()) as terminal, pytest.raises(ValueError, match="wrong"), progress_line("fit"):
        raise ValueError("wrong")
    assert terminal.getvalue().endswith(" \r")


def test_a_line_is_no_wider_than_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    with redirect_stdout(Terminal()) as terminal, progress_line("fit") as show:
        show("x" * 100)
    assert max(map(len, terminal.lines())) == 39


def test_a_file_gets_a_line_at_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "_EVERY_IN_FILE", 0.01)
    with redirect_stderr(io.StringIO()) as file, redirect_stdout(io.StringIO()) as out, progress_line("sweep") as show:
        while file.getvalue().count("\n") < 2:
            pass
        show("4 of 9 runs")
        seen = file.getvalue().count("4 of 9 runs")
        while file.getvalue().count("4 of 9 runs") < seen + 2:
            pass
    lines = file.getvalue().splitlines()
    assert re.fullmatch(rf"sweep {TIME}: compiling", lines[0])
    assert all(re.fullmatch(rf"sweep {TIME}: (compiling|4 of 9 runs)", line) for line in lines)
    assert lines[-1].endswith("4 of 9 runs")
    assert out.getvalue() == ""


def test_a_short_computation_writes_only_its_last_text_to_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_line("fit") as show:
        show("iteration 1")
        show("iteration 2")
    found = capsys.readouterr()
    assert re.fullmatch(rf"fit {TIME}: iteration 2\n", found.err)
    assert found.out == ""
    with progress_line("fit"):
        pass
    assert capsys.readouterr() == ("", "")


def test_words() -> None:
    words = SweepProgressText()
    assert words(SweepProgress(0, 20_000, 0)) == "compiling"
    # The time of the first chunk, which compiles, says nothing about the others.
    assert words(SweepProgress(5000, 20_000, 2)) == "5,000 of 20,000 runs, 2 failed"
    going = words(SweepProgress(5010, 20_000, 3))
    assert re.fullmatch(rf"5,010 of 20,000 runs, 3 failed, [\d,]+/s, {TIME} left", going)
    assert words(SweepProgress(20_000, 20_000, 1002, "Why.")) == "20,000 of 20,000 runs, 1,002 failed, most with: Why."
    assert SweepProgressText()(SweepProgress(10, 40, 0)) == "10 of 40 runs already stored, compiling"
    assert SweepProgressText()(SweepProgress(40, 40, 3)) == "40 of 40 runs already stored, 3 failed"
    assert candidate_words("LuGre", 1, 3, 0.00123456) == "LuGre, fold 2 held out, iteration 3: RMSE 0.001235"
    assert [minutes(x) for x in (0.2, 59.6, 3599.0, 3725.0)] == ["0:00", "1:00", "59:59", "1:02:05"]


def test_what_is_no_progress_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    wrong: Any = "yes"
    with pytest.raises(ValueError, match="must be True, False or a function, but 'yes'"), reported(wrong, "fit", str):
        pass


def test_a_sweep_shows_how_it_goes() -> None:
    with redirect_stdout(Terminal()) as terminal:
        jms.sweep(lambda a: jnp.sqrt(a), {"a": np.linspace(-1.0, 8.0, 10)}, chunk=4, progress=True)
    lines = terminal.lines()
    assert re.fullmatch(rf"sweep {TIME}: compiling", lines[0])
    assert re.fullmatch(rf"sweep {TIME}: 10 of 10 runs, 1 failed, most with: The function gave NaN\.", lines[-1])
    assert any(re.match(rf"sweep {TIME}: \d of 10 runs, ", line) for line in lines)


def test_a_fit_shows_how_it_goes() -> None:
    t = np.linspace(0.0, 1.0, 101)
    record = jms.Record(t, 1.0 - np.cos(2.0 * t), {"u": np.ones_like(t)})
    scene = sprung(1.0, 0.5, 1.5)
    with redirect_stdout(Terminal()) as terminal:
        jms.fit(scene, record, ("m",), q0=[0.0], max_steps=2, progress=True)
    lines = terminal.lines()
    assert re.fullmatch(rf"fit {TIME}: compiling", lines[0])
    assert re.fullmatch(rf"fit {TIME}: iteration 2: RMSE \S+, m \S+", lines[-1])
