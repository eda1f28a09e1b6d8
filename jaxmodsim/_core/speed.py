"""Cores at hand, and the one opt-in that changes how XLA compiles."""

import logging
import os
from functools import cache

import jax
from jax._src import xla_bridge

_OPTION = "xla_cpu_small_while_loop_byte_threshold"


def tune_cpu(while_loop_bytes: int = 1_000_000) -> None:
    """Compile small loops as one function each on CPU: 2 to 8 times faster runs, for the whole process.

    XLA runs a loop whose buffers exceed a threshold (1 kB by default, which most loops with a Jacobian or an adjoint
    do) as many small kernels with a dispatch between them. This raises the threshold, by adding to the environment
    variable `XLA_FLAGS`. The price is compile time for large unrolled loops. It also turns off JAX's asynchronous
    dispatch on CPU (`jax_cpu_enable_async_dispatch`), whose hand-over to another thread costs more than a short
    run takes. Nothing in the library calls this for you, except the command line.

    **Arguments:**

    - `while_loop_bytes`: loops with buffers up to this size are compiled as one function [bytes], > 0.

    **Raises:**

    - `RuntimeError` if JAX has computed something already, as the option would come too late.
    - `ValueError` if `while_loop_bytes` is not a positive integer.
    """
    if isinstance(while_loop_bytes, bool) or not isinstance(while_loop_bytes, int) or while_loop_bytes < 1:
        raise ValueError(f"while_loop_bytes must be a positive integer, but {while_loop_bytes!r} was given.")
    if xla_bridge.backends_are_initialized():
        raise RuntimeError(
            "tune_cpu comes too late: JAX has already started its backend. Call it before the first computation,"
            " and before any jnp.array is made."
        )
    flags = os.environ.get("XLA_FLAGS", "")
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    if _OPTION not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_backend_extra_options={_OPTION}={while_loop_bytes}".strip()


@cache
def recommend_tuning() -> None:
    """Log once, where XLA runs on CPU without the option, what makes runs faster."""
    if jax.default_backend() == "cpu" and _OPTION not in os.environ.get("XLA_FLAGS", ""):
        logging.getLogger("jaxmodsim").warning(
            "Runs on CPU are 2 to 8 times faster after jaxmodsim.tune_cpu(), called before JAX computes anything."
        )


def cores() -> int:
    """Cores that this thread may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
