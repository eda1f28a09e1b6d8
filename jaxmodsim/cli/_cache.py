"""Compiled programs, kept from one command to the next by JAX's persistent compilation cache."""

import os
import sys
from pathlib import Path

import jax

from ._output import say

_SHORTEST = "jax_persistent_cache_min_compile_time_secs"


def cache_folder() -> Path:
    """Folder of the cache: the one JAX has been given, or `jaxmodsim` in the folder of the user's caches."""
    if given := jax.config.values["jax_compilation_cache_dir"]:
        return Path(given)
    if sys.platform == "win32":
        caches = os.environ.get("LOCALAPPDATA") or "~/AppData/Local"
    elif sys.platform == "darwin":
        caches = "~/Library/Caches"
    else:
        caches = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(caches).expanduser() / "jaxmodsim"


def use_cache() -> None:
    """Let this process, and those it starts, keep what they compile in the folder and take from there what is there.

    Where the folder cannot be written the command goes on without, and says so on stderr.
    """
    if not jax.config.values["jax_enable_compilation_cache"]:
        return
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(f"{folder} cannot be written")
    except (OSError, RuntimeError) as error:  # RuntimeError where the user has no home folder
        sys.stderr.write(f"jaxmodsim: compiled programs are not kept for the next command: {error}\n")
        jax.config.update("jax_enable_compilation_cache", False)
        return
    # JAX leaves out what compiles in less than a second, which is most of what a command compiles.
    for name, value in {"jax_compilation_cache_dir": str(folder), _SHORTEST: 0.0}.items():
        jax.config.update(name, value)
        os.environ[name.upper()] = str(value)


def report_cache(clear: bool) -> None:
    """Say what the cache holds; with `clear` delete that first."""
    folder = cache_folder()
    programs = [(path, path.stat().st_size) for path in folder.glob("*-cache")]
    held = f"{len(programs)} compiled programs, {sum(size for _, size in programs) / 1e6:.3g} MB"
    if clear:
        for path, _ in programs:
            path.unlink(missing_ok=True)
        say(f"{folder}: deleted {held}.")
    else:
        say(f"{folder}: {held}. --clear deletes them; JAX_ENABLE_COMPILATION_CACHE=false keeps none.")
