"""Compiled programs that the command line keeps on disk."""

import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache

from jaxmodsim.cli import _cache

_SHORTEST, _SMALLEST = "jax_persistent_cache_min_compile_time_secs", "jax_persistent_cache_min_entry_size_bytes"
_NAMES = ("jax_compilation_cache_dir", _SHORTEST, _SMALLEST, "jax_enable_compilation_cache")


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Of a user who has configured nothing; afterwards JAX is as before."""
    before = {name: jax.config.values[name] for name in _NAMES}
    for name in _NAMES:
        monkeypatch.setenv(name.upper(), "")  # what the command sets is taken back
        monkeypatch.delenv(name.upper())
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr("sys.platform", "linux")
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    yield tmp_path
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def compile_anew() -> float:
    """The same program from a new function, which JAX compiles or takes from the cache on disk."""
    compilation_cache.reset_cache()
    return float(jax.jit(lambda x: 3.0 * x + 0.25)(2.0))


def kept(folder: Path) -> list[Path]:
    return sorted(folder.glob("*-cache"))


def test_programs_are_kept_read_reported_and_deleted(
    home: Path, run_command: Callable[..., tuple[int, str, str]]
) -> None:
    folder = home / ".cache" / "jaxmodsim"
    assert f"{folder}: 0 compiled programs" in run_command("cache")[1]
    _cache.use_cache()
    assert compile_anew() == 6.25
    programs = kept(folder)
    assert programs
    assert compile_anew() == 6.25
    assert kept(folder) == programs
    # That it is read shows where it cannot be, which stops nothing.
    for path in programs:
        path.write_bytes(b"not a program")
    with pytest.warns(UserWarning, match="Error reading persistent compilation cache"):
        assert compile_anew() == 6.25
    assert f"deleted {len(programs)} compiled programs" in run_command("cache", "--clear")[1]
    assert not kept(folder)
    assert compile_anew() == 6.25
    assert kept(folder)


@pytest.mark.usefixtures("home")
def test_the_check_says_what_a_second_process_finds(
    run_command: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    code, text, _ = run_command("cache", "--check")
    first, second = (line.split() for line in text.splitlines() if line.split()[:1] in (["first"], ["second"]))
    assert code == 0
    assert first[1] == second[2] == "0"
    assert first[2] == second[1] != "0"
    assert float(second[3]) > 0.0


def test_the_check_of_a_folder_that_cannot_be_written(
    home: Path, run_command: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("subprocess.run", None)  # it runs nothing
    (home / ".cache").write_text("a file where the folder should be")
    code, text, errors = run_command("cache", "--check")
    assert (code, "The cache is off" in text) == (1, True)
    assert "compiled programs are not kept" in errors


@pytest.mark.parametrize(
    ("setting", "text"), [(_SHORTEST, "less than JAX_PERSISTENT_CACHE_MIN"), (_SMALLEST, "They are smaller than")]
)
@pytest.mark.usefixtures("home")
def test_thresholds_of_jax_are_told_from_its_log(
    setting: str, text: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(setting.upper(), "1000000000")
    _cache.use_cache()
    jax.config.update(_SMALLEST, int(os.environ.get(_SMALLEST.upper(), 0)))  # a new process reads it by itself
    caplog.set_level(logging.DEBUG, "jax._src")
    assert compile_anew() == 6.25
    assert text in _cache.reason(caplog.text)


def test_programs_that_cannot_be_written_or_read_or_are_rejected_are_told_from_the_log(home: Path) -> None:
    folder = home / ".cache" / "jaxmodsim"
    _cache.use_cache()
    assert compile_anew() == 6.25
    for path in kept(folder):
        path.unlink()
        path.mkdir()  # can neither be read nor written
    with pytest.warns(UserWarning, match="persistent compilation cache") as warned:
        assert compile_anew() == 6.25
    assert "They cannot be read" in _cache.reason(str(warned[0].message))
    # As XLA says it; JAX then warns of an error in reading, too.
    rejected = "Loading XLA:CPU AOT result. Target machine feature +prefer-no-gather is not supported on the host."
    assert "names processor features" not in _cache.reason("")
    assert "they name processor features" in _cache.reason(f"{rejected} Error reading persistent compilation cache")
    assert _cache.reason("") == "JAX logs no reason."


def test_without_a_folder_that_can_be_written_commands_go_on(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (home / ".cache").write_text("a file where the folder should be")
    _cache.use_cache()
    assert "compiled programs are not kept for the next command" in capsys.readouterr().err
    assert compile_anew() == 6.25


def test_it_can_be_turned_off_and_put_elsewhere(home: Path) -> None:
    jax.config.update("jax_compilation_cache_dir", str(home / "elsewhere"))
    assert _cache.cache_folder() == home / "elsewhere"
    jax.config.update("jax_enable_compilation_cache", False)
    _cache.use_cache()
    assert compile_anew() == 6.25
    assert not list(home.iterdir())


@pytest.mark.usefixtures("home")
@pytest.mark.parametrize(
    ("platform", "variables", "folder"),
    [
        ("linux", {"XDG_CACHE_HOME": "/caches"}, "/caches/jaxmodsim"),
        ("linux", {"XDG_CACHE_HOME": "", "HOME": "/home/a"}, "/home/a/.cache/jaxmodsim"),
        ("darwin", {"HOME": "/Users/a"}, "/Users/a/Library/Caches/jaxmodsim"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local/jaxmodsim"),
    ],
)
def test_the_folder_is_where_the_system_keeps_caches(
    monkeypatch: pytest.MonkeyPatch, platform: str, variables: dict[str, str], folder: str
) -> None:
    monkeypatch.setattr("sys.platform", platform)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert _cache.cache_folder() == Path(folder)
