"""Compiled programs that the command line keeps on disk."""

from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache

from jaxmodsim.cli import _cache

_NAMES = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs", "jax_enable_compilation_cache")


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Of a user who has configured nothing; afterwards JAX is as before."""
    before = {name: jax.config.values[name] for name in _NAMES}
    for name in _NAMES:
        monkeypatch.setenv(name.upper(), "")  # what the command sets is taken back
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
