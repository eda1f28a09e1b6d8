"""JAX's persistent compilation cache, which keeps compiled programs from one command to the next."""

import os
import subprocess
import sys
from pathlib import Path

import jax

from ._output import frame_of, say, show_table

_SHORTEST = "jax_persistent_cache_min_compile_time_secs"

# A script with its first run. JAX logs for each program whether the cache has it, and why it does not store it.
_FIRST_RUN = """
import time
began = time.perf_counter(), time.process_time()
import logging
import jax
import jaxmodsim as jms
logging.basicConfig()
for name in ("compiler", "compilation_cache"):
    logging.getLogger(f"jax._src.{name}").setLevel("DEBUG")
jms.tune_cpu()
jax.config.update("jax_enable_x64", True)
belt = jms.Friction(jms.Coulomb(Fc=5.0, Fs=8.0), belt_velocity=0.1)
scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2 - 50.0 * q[0] ** 2, {}, [belt])
jms.simulate(scene, [0.0], [0.0], 2.0)
print(time.perf_counter() - began[0], time.process_time() - began[1])
"""
_HIT, _MISS = "Persistent compilation cache hit", "PERSISTENT COMPILATION CACHE MISS"
# Causes of misses by texts in the log.
_REASONS = {
    "Loading XLA:CPU AOT result": "XLA rejects them: they name processor features that this machine lacks. If they come"
    " from another machine, delete them with jaxmodsim cache --clear. If not, XLA misreads this processor: try another"
    " version of jaxlib.",
    "Error reading": "They cannot be read: delete them with jaxmodsim cache --clear.",
    "Error writing": "They cannot be written: free space on the disk, or name another folder by"
    " JAX_COMPILATION_CACHE_DIR.",
    "because it took <": "They compile in less than JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS: set it to 0.",
    "is less than threshold": "They are smaller than JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES: set it to 0.",
}


def cache_folder() -> Path:
    """Folder of the cache: that of JAX's configuration, or `jaxmodsim` in the user's cache folder."""
    if configured := jax.config.values["jax_compilation_cache_dir"]:
        return Path(configured)
    if sys.platform == "win32":
        caches = os.environ.get("LOCALAPPDATA") or "~/AppData/Local"
    elif sys.platform == "darwin":
        caches = "~/Library/Caches"
    else:
        caches = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(caches).expanduser() / "jaxmodsim"


def use_cache() -> None:
    """Enable the cache for this process and those it starts.

    If the folder cannot be written, the command runs without a cache and prints a message to stderr.
    """
    if not jax.config.values["jax_enable_compilation_cache"]:
        return
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(f"{folder} cannot be written")
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home folder
        sys.stderr.write(f"jaxmodsim: compiled programs are not kept for the next command: {error}\n")
        jax.config.update("jax_enable_compilation_cache", False)
        return
    # JAX's default stores no program that compiles in less than a second, which is most of them.
    shortest = float(os.environ.get(_SHORTEST.upper(), 0.0))
    for name, value in {"jax_compilation_cache_dir": str(folder), _SHORTEST: shortest}.items():
        jax.config.update(name, value)
        os.environ[name.upper()] = str(value)


def report_cache(clear: bool) -> None:
    """Print the content of the cache; with `clear`, delete it."""
    folder = cache_folder()
    programs = [(path, path.stat().st_size) for path in folder.glob("*-cache")]
    held = f"{len(programs)} compiled programs, {sum(size for _, size in programs) / 1e6:.3g} MB"
    if clear:
        for path, _ in programs:
            path.unlink(missing_ok=True)
        say(f"{folder}: deleted {held}.")
    else:
        say(f"{folder}: {held}. --clear deletes them; JAX_ENABLE_COMPILATION_CACHE=false disables the cache.")


def check_cache() -> bool:
    """Run a small scene in two new processes and print their use of the cache; True if the second one used it."""
    use_cache()
    if not jax.config.values["jax_enable_compilation_cache"]:
        say("The cache is off: JAX_ENABLE_COMPILATION_CACHE is false, or its folder cannot be written.")
        return False
    rows, log = [], ""
    for process in ("first", "second"):
        done = subprocess.run([sys.executable, "-c", _FIRST_RUN], capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"the scene does not run in a new process: {done.stderr.strip().splitlines()[-1]}")
        log = done.stderr
        wall, cpu = map(float, done.stdout.split())
        rows.append((process, log.count(_HIT), log.count(_MISS), wall, cpu))
    columns = ("process", "programs from the cache", "compiled", "import and first run [s]", "processor time [s]")
    show_table(frame_of(rows, *columns), f"Compiled programs in {cache_folder()}")
    hits = rows[-1][1]
    if not hits:
        say(f"The second process found no programs of the first. {reason(log)}")
    return hits > 0


def reason(log: str) -> str:
    """The cause of misses, from the log of JAX and XLA."""
    return next((reason for text, reason in _REASONS.items() if text in log), "JAX logs no reason.")
