"""Cores at hand, and the one opt-in that changes how XLA compiles."""

import logging
import os
from collections.abc import Iterable
from functools import cache

import jax

from .compat import backend_has_started

_LOG = logging.getLogger("jaxmodsim")
# Compiling that takes longer is said [s].
_LONG = 3.0
# Identities of the functions that were compiled, by the identity of their code, which those that a loop makes share.
_COMPILED: dict[int, set[int]] = {}
_TOO_OFTEN = 3
_KEEP = (
    " To start at once in the next process, too, begin it with"
    ' jax.config.update("jax_compilation_cache_dir", "/path/of/a/folder") and'
    ' jax.config.update("jax_persistent_cache_min_compile_time_secs", 0).'
)

_OPTION = "xla_cpu_small_while_loop_byte_threshold"


def tune_cpu(while_loop_bytes: int = 1_000_000) -> None:
    """Compile small loops as one function each on CPU: batches of runs up to 4 times faster, for the whole process.

    XLA runs a loop whose buffers exceed a threshold (1 kB by default) as many small kernels with a dispatch between
    them. This raises the threshold, by adding to the environment variable `XLA_FLAGS`. A run by itself, and its
    derivatives, are one kernel anyway; loops in `jax.vmap`, and loops around runs, are not. The price is compile time
    for large unrolled loops. It also turns off JAX's asynchronous dispatch on CPU (`jax_cpu_enable_async_dispatch`),
    whose hand-over to another thread costs as much as a short run takes. Nothing in the library calls this for you,
    except the command line.

    **Arguments:**

    - `while_loop_bytes`: loops with buffers up to this size are compiled as one function [bytes], > 0.

    **Raises:**

    - `RuntimeError` if JAX has computed something already, as the option would come too late. A second call does
      nothing, nor does a call in a process that inherits `XLA_FLAGS` with the option, such as a worker of dask.
    - `ValueError` if `while_loop_bytes` is not a positive integer.
    """
    if isinstance(while_loop_bytes, bool) or not isinstance(while_loop_bytes, int) or while_loop_bytes < 1:
        raise ValueError(f"while_loop_bytes must be a positive integer, but {while_loop_bytes!r} was given.")
    flags = os.environ.get("XLA_FLAGS", "")
    if backend_has_started():
        if _OPTION in flags:
            return
        raise RuntimeError(
            "tune_cpu comes too late: JAX has already started its backend. Call it before the first computation,"
            " and before any jnp.array is made."
        )
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    if _OPTION not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_backend_extra_options={_OPTION}={while_loop_bytes}".strip()


@cache
def recommend_tuning() -> None:
    """Log once, where XLA runs on CPU without the option, what makes runs faster."""
    if jax.default_backend() == "cpu" and _OPTION not in os.environ.get("XLA_FLAGS", ""):
        _LOG.warning(
            "Batches of runs on CPU are up to 4 times faster, and short runs return sooner, after jaxmodsim.tune_cpu(),"
            " called before JAX computes anything."
        )


@cache
def remark_on_single_precision() -> None:
    """Log once that single precision cannot meet the tolerance that was asked for."""
    _LOG.warning(
        "rtol is below 1e-6 in float32, which holds seven digits: rounding decides. Call"
        ' jax.config.update("jax_enable_x64", True) first, and give q0 in float64.'
    )


@cache
def remark_on_rounding() -> None:
    """Log once that the steps of a run in single precision are so many that their rounding exceeds its tolerance."""
    _LOG.warning(
        "A run in float32 makes so many steps that their rounding, about 6e-8 sqrt(steps) of the state, exceeds rtol."
        ' For smaller errors call jax.config.update("jax_enable_x64", True) first, and give q0 and the numbers of the'
        " scene in float64; for fewer steps pass a larger rtol, such as 1e-4 for a stiff bristle (LuGre)."
    )


@cache
def remark_on_fixed_steps(solver: str, dt: float, most: float) -> None:
    """Log once that the fixed steps of a run that is differentiated are too long for an explicit solver."""
    _LOG.warning(
        "This run is differentiated over fixed steps of dt=%.3g s, too long for the fastest motion of the scene: errors"
        " of the derivative may grow with %s, though the motion looks right. Pass dt <= %.2g s, an implicit solver such"
        " as jaxmodsim.Rodas5P(), or tolerances in place of dt.",
        dt,
        solver,
        most,
    )


def remark_on_compilation(seconds: float, functions: Iterable[object]) -> None:
    """Log a compilation that took long, and a function that is compiled again and again because it is made anew.

    **Arguments:**

    - `seconds`: how long it took.
    - `functions`: those of the scene that was compiled.
    """
    if seconds > _LONG:
        _LOG.warning(
            "Compiling this scene took %.1f s. Further runs of it start at once, with other numbers too. Another"
            " structure of the scene, another solver, and `ts` of another length or none compile anew.%s"
            " logging.getLogger('jaxmodsim').setLevel('ERROR') turns off such messages.",
            seconds,
            "" if jax.config.values["jax_compilation_cache_dir"] else _KEEP,
        )
    for each in functions:
        code = getattr(each, "__code__", None)
        if code is None:
            continue
        seen = _COMPILED.setdefault(id(code), set())
        seen.add(id(each))  # what was compiled is kept, so nothing else gets its identity
        if len(seen) == _TOO_OFTEN:
            _LOG.warning(
                "The function of %s:%d was compiled for the third time, as a new function each time: define it once,"
                " outside of the loop, and pass what changes by the params of the scene.",
                code.co_filename,
                code.co_firstlineno,
            )


def cores() -> int:
    """Cores that this thread may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
