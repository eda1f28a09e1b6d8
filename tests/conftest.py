import ctypes
import gc
import io
import logging
import os
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from importlib.metadata import version
from pathlib import Path
from typing import Any, no_type_check

import jax
import jaxtyping
import pytest
from xdist.scheduler import LoadScopeScheduling

from .helpers import deep, fuzz

# Nearly all of the time goes into tracing and compiling, hardly any into running. Code that LLVM has not optimized, and
# XLA's older way to emit fused loops, straight as LLVM code and in one piece, are compiled soonest. XLA ends the
# process over an option that it does not know: only where it was tried. What needs the last digits asks for
# `optimized`.
# For the way that users have: XLA_FLAGS=--xla_cpu_use_fusion_emitters=true JAX_DISABLE_MOST_OPTIMIZATIONS=0.
_OPTION, _FLAGS = "xla_cpu_use_fusion_emitters", os.environ.get("XLA_FLAGS", "")
if version("jaxlib").startswith("0.10.") and _OPTION not in _FLAGS:
    os.environ["XLA_FLAGS"] = f"{_FLAGS} --{_OPTION}=false --xla_cpu_parallel_codegen_split_count=1".strip()
if "JAX_DISABLE_MOST_OPTIMIZATIONS" not in os.environ:
    jax.config.update("jax_disable_most_optimizations", True)

_checked = jaxtyping.jaxtyped


def _checked_where_made_once(**arguments: Any) -> Callable[[Any], Any]:
    """Type checks for functions of modules and classes, not for those that a call makes.

    A check is code generated and compiled for each function, for one that a call makes again at each call: that took a
    tenth of all time.
    """
    check = _checked(**arguments)
    return lambda each: each if "<locals>" in getattr(each, "__qualname__", "") else check(each)


jaxtyping.jaxtyped = _checked_where_made_once  # what the import hook looks up at each function

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
fuzz.register()
logging.getLogger("jaxmodsim").setLevel(logging.ERROR)  # what compiles slowly here says nothing of the package

# Programs keep millions of objects that never become garbage. Looking at all of them again and again costs a tenth of
# the time.
gc.set_threshold(50_000, 20, 100)


# A compiled program takes several maps of memory, of which Linux gives a process no more than 65 530; with the next one
# XLA ends the process. What programs were traced from takes gigabytes.
_SELF, _MOST_MAPS, _MOST_BYTES = Path("/proc/self"), 30_000, 3 * 2**30


def drop_programs() -> None:
    """Drop what was compiled and traced, where it takes too much memory."""
    if _SELF.exists():
        maps = (_SELF / "maps").read_bytes().count(b"\n")
        resident = int((_SELF / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        if maps > _MOST_MAPS or resident > _MOST_BYTES:
            jax.clear_caches()
            gc.unfreeze()
            gc.collect()
            ctypes.CDLL(None).malloc_trim(0)  # glibc keeps freed memory otherwise


@pytest.fixture(scope="module", autouse=True)
def what_other_modules_made_is_left_alone() -> None:
    drop_programs()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def no_checks_for_each_scalar() -> None:
    """Check types of what takes arrays apart where it is called, not again for every scalar.

    Of all calls whose types would be checked nine in ten are such, and most of their types are `Any`.
    """
    from jaxmodsim._core import scalarise as _scalarise

    for each in vars(_scalarise).values():
        if getattr(each, "__module__", None) == _scalarise.__name__ and each.__name__ not in (
            "in_scalars",
            "columns_of",
        ):
            no_type_check(each)


# Tests of a module share what they have compiled and computed, so a module stays in one process. Those of these modules
# share nothing: they are given out one by one, and last, which keeps all processes busy to the end.
_APART = {
    *("every_case", "test_belt", "test_constraints", "test_contact", "test_gauss"),
    *("test_implicit_friction", "test_stick_slip"),
}


class ByModule(LoadScopeScheduling):
    def _split_scope(self, nodeid: str) -> str:
        module = nodeid.split("::")[0]
        return nodeid if Path(module).stem in _APART else module


def pytest_configure(config: pytest.Config) -> None:
    if folder := os.environ.get("PROCESSOR_TIMES"):
        config.pluginmanager.register(deep.ProcessorTimes(Path(folder)))


@pytest.hookimpl(tryfirst=True)  # before `-m` selects
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    listed = deep.listed()
    for item in items:
        if deep.is_listed(item.nodeid, listed):
            item.add_marker(pytest.mark.deep)


@pytest.hookimpl(optionalhook=True)  # there is no such hook without processes
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> ByModule:
    return ByModule(config, log)


@pytest.fixture(scope="module")
def run_command():
    """Run a command line in this process; gives its exit code, output and errors."""
    from jaxmodsim.cli import _app  # what needs no command line does not load it

    def run(*arguments: str) -> tuple[int, str, str]:
        out, errors = io.StringIO(), io.StringIO()
        with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(errors):
            # The tests have started JAX already, in double precision.
            patch.setattr(_app, "_start", lambda *_files: None)
            patch.setattr(sys, "argv", ["jaxmodsim", *arguments])
            with pytest.raises(SystemExit) as ending:
                _app.run()
        return int(ending.value.code or 0), out.getvalue(), errors.getvalue()

    return run
