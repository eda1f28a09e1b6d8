"""The option that tunes XLA on CPU, warnings about speed and precision, and the number of cores."""

import logging
import os
from collections.abc import Iterable
from functools import cache

import jax

from .arguments import as_whole
from .compat import backend_has_started

_LOG = logging.getLogger("jaxmodsim")
# Compilation time above which a warning appears [s].
_LONG = 3.0
# Identities of compiled functions by the identity of their code, which functions from the same loop share.
_COMPILED: dict[int, set[int]] = {}
_TOO_OFTEN = 3
_KEEP = (
    " To reuse the compiled program in other processes, begin them with"
    ' jax.config.update("jax_compilation_cache_dir", "/path/of/a/folder") and'
    ' jax.config.update("jax_persistent_cache_min_compile_time_secs", 0).'
)

_OPTION = "xla_cpu_small_while_loop_byte_threshold"


def tune_cpu(while_loop_bytes: int = 1_000_000) -> None:
    """Compile small loops as one function each on CPU, which makes batches of runs up to 4 times faster.

    XLA runs a loop with buffers above a threshold (1 kB by default) as many small kernels with a dispatch between them.
    This function raises the threshold for the whole process, by the environment variable `XLA_FLAGS`. Single runs and
    their derivatives are one kernel anyway; loops in `jax.vmap`, and loops around runs, are not. Large unrolled loops
    then take longer to compile. The function also disables JAX's asynchronous dispatch on CPU
    (`jax_cpu_enable_async_dispatch`), because a thread hand-off takes as long as a short run. Only the command line
    calls this function by itself.

    **Arguments:**

    - `while_loop_bytes`: loops with buffers up to this size are compiled as one function [bytes], > 0.

    **Raises:**

    - `RuntimeError` if JAX has already computed something, since the option then has no effect. A second call does
      nothing, nor does a call in a process that inherits `XLA_FLAGS` with the option, such as a dask worker.
    - `ValueError` if `while_loop_bytes` is not a positive integer.

    **Example:**

    *Not run in the tests: JAX has already started there.*

    ```python
    import jaxmodsim as jms

    jms.tune_cpu()  # before the first array of JAX
    ```
    """
    while_loop_bytes = as_whole(while_loop_bytes, name="while_loop_bytes")
    flags = os.environ.get("XLA_FLAGS", "")
    if backend_has_started():
        if _OPTION in flags:
            return
        raise RuntimeError(
            "tune_cpu has no effect, because JAX has already started its backend. Call it before the first computation"
            " and before the first jnp.array."
        )
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    if _OPTION not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_backend_extra_options={_OPTION}={while_loop_bytes}".strip()


@cache
def recommend_tuning() -> None:
    """Recommend `tune_cpu` once if XLA runs on CPU without it."""
    if jax.default_backend() == "cpu" and _OPTION not in os.environ.get("XLA_FLAGS", ""):
        _LOG.warning(
            "Batches of runs on CPU are up to 4 times faster, and short runs return sooner, after jaxmodsim.tune_cpu(),"
            " called before JAX computes anything."
        )


@cache
def warn_about_single_precision() -> None:
    """Warn once that single precision cannot meet the requested tolerance."""
    _LOG.warning(
        "rtol is below 1e-6 in float32, which holds seven digits: the steps keep 8e-6. For smaller errors call"
        ' jax.config.update("jax_enable_x64", True) first, and pass q0 in float64.'
    )


@cache
def warn_about_rounding() -> None:
    """Warn once that the rounding of all steps in single precision exceeds the tolerance."""
    _LOG.warning(
        "A run in float32 takes so many steps that their rounding, about 6e-8 sqrt(steps) of the state, exceeds rtol."
        ' For smaller errors call jax.config.update("jax_enable_x64", True) first, and pass q0 and the numbers of the'
        " scene in float64. For fewer steps pass a larger rtol, such as 1e-4 for a stiff bristle (LuGre)."
    )


@cache
def warn_about_fixed_steps(solver: str, dt: float, most: float) -> None:
    """Warn once that the fixed steps of a differentiated run are too long for an explicit solver."""
    _LOG.warning(
        "This run is differentiated over fixed steps of dt=%.3g s, too long for the fastest motion of the scene: errors"
        " of the derivative may grow with %s, even if the motion looks correct. Pass dt <= %.2g s, an implicit solver"
        " such as jaxmodsim.Rodas5P(), or tolerances instead of dt.",
        dt,
        solver,
        most,
    )


@cache
def advise_about_compilation() -> None:
    """Say once what compiles again, and how to keep programs."""
    _LOG.warning(
        "Further runs of a scene start at once, also with other numbers. Another structure, another solver, or another"
        " length of `ts` compiles again.%s logging.getLogger('jaxmodsim').setLevel('ERROR') disables such messages.",
        "" if jax.config.values["jax_compilation_cache_dir"] else _KEEP,
    )


def warn_about_compilation(seconds: float, functions: Iterable[object]) -> None:
    """Warn about a long compilation, and about a function that is compiled repeatedly because each one is new.

    **Arguments:**

    - `seconds`: time of the compilation.
    - `functions`: functions of the compiled scene.
    """
    if seconds > _LONG:
        _LOG.warning("Compiling this scene took %.1f s.", seconds)
        advise_about_compilation()
    for each in functions:
        code = getattr(each, "__code__", None)
        if code is None:
            continue
        seen = _COMPILED.setdefault(id(code), set())
        seen.add(id(each))  # compiled functions stay alive, so no other object gets this identity
        if len(seen) == _TOO_OFTEN:
            _LOG.warning(
                "The function of %s:%d was compiled for the third time, each time as a new function. Define it once,"
                " outside the loop, and pass changing numbers by the params of the scene.",
                code.co_filename,
                code.co_firstlineno,
            )


def cores() -> int:
    """Number of cores available to this thread."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
