"""What the page of mistakes says is what one reads."""

import logging
import re
from pathlib import Path
from typing import Any

import jax
import pytest

from jaxmodsim._core import speed

PAGE = (Path(__file__).parents[1] / "docs" / "mistakes.md").read_text()
ROWS = re.findall(r"^\| `(.+)` \| (.+) \|$", PAGE, re.MULTILINE)
NAMES: dict[str, Any] = {}


@pytest.fixture(autouse=True)
def loud(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "jaxmodsim")
    speed.warn_about_single_precision.cache_clear()
    if not NAMES:
        block = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)
        assert block is not None
        exec(block[1], NAMES)


def test_the_page_lists_at_least_twenty_mistakes() -> None:
    assert len(ROWS) >= 20


@pytest.mark.parametrize(("written", "read"), ROWS, ids=range(len(ROWS)))
def test_what_one_reads(written: str, read: str, caplog: pytest.LogCaptureFixture) -> None:
    said = ""
    try:
        eval(written, NAMES)
    except Exception as error:
        said = str(error)
    assert read in said + caplog.text


def test_a_line_of_the_user_is_named(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("def energy(t, q, qd, p):\n    return np.dot(qd, qd)\n")
    names = dict(NAMES)
    exec(compile(file.read_text(), str(file), "exec"), names)
    with pytest.raises(ValueError, match=re.escape(f"at {file}:2 (`return np.dot(qd, qd)`)")):
        names["run"](names["energy"])


def test_a_long_compilation_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    speed.advise_about_compilation.cache_clear()
    speed.warn_about_compilation(2.9, ())
    assert not caplog.records
    speed.warn_about_compilation(3.1, ())
    assert caplog.messages[0] == "Compiling this scene took 3.1 s."
    assert '("jax_compilation_cache_dir", "/path/of/a/folder")' in caplog.messages[1]
    # The second scene has its time, without the advice.
    speed.warn_about_compilation(4.0, ())
    assert caplog.messages[2:] == ["Compiling this scene took 4.0 s."]


def test_whoever_keeps_programs_is_not_told_how(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    speed.advise_about_compilation.cache_clear()
    before = jax.config.values["jax_compilation_cache_dir"]
    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path))
        speed.warn_about_compilation(3.1, ())
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    assert "compiles again. logging" in caplog.text
