"""Ensembles on the device that JAX finds: many runs of the Lorenz system, and of the LuGre test bench, at once.

The Lorenz system is that of C. Utkarsh et al., "Automated translation and accelerated solving of differential equations
on multiple GPU platforms", Computer Methods in Applied Mechanics and Engineering 419:116591, 2024: from (1, 0, 0) over
one second with sigma = 10, beta = 8/3 and rho from 0 to 21, by Tsit5 of diffrax. Single precision has coarser
tolerances. On a GPU: `pip install "jax[cuda13]"`, then `python -m bench ensemble`.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.integrate import solve_ivp

from bench.record import Result, timed
from bench.tasks import TESTBENCH

LORENZ, BOX = "Lorenz system", "LuGre test bench"
RHO = 21.0
# Relative tolerances, by case and precision.
RTOL = {LORENZ: {"float64": 1e-8, "float32": 1e-6}, BOX: {"float64": 1e-4, "float32": 1e-4}}
# Number of runs in a call on a CPU and on a GPU, and number of runs with error measures.
RUNS = {"cpu": 2**13, "gpu": 2**23}
JUDGED = 16


def main(smoke: bool, out: Path) -> Result:
    """Measure the time of all runs in one call, in both precisions, and their errors."""
    del out
    device = jax.devices()[0]
    count = 64 if smoke else RUNS.get(device.platform, RUNS["gpu"])
    name = "the processor" if device.platform == "cpu" else device.device_kind
    result = Result("ensemble", ("diffrax",), {"device": name, "runs": count})
    makers = {LORENZ: (_lorenz, np.linspace(0.0, RHO, count)), BOX: (_box, TESTBENCH.sets(count))}
    exact = {LORENZ: np.array([_lorenz_end(rho) for rho in makers[LORENZ][1][:: count // JUDGED]])}
    exact[BOX] = TESTBENCH.exact_ends(makers[BOX][1][:: count // JUDGED])
    calls: dict[tuple[str, str], Callable[[], Array]] = {}
    for case, (run, sets) in makers.items():
        for kind, rtol in RTOL[case].items():
            many = jax.vmap(partial(run, rtol=rtol))
            if device.platform == "cpu":
                many = partial(jax.lax.map, partial(run, rtol=rtol), batch_size=64)
            numbers = jax.device_put(jnp.asarray(sets, kind))
            calls[case, kind] = partial(_ready, jax.jit(many), numbers)
    for (case, kind), found in timed(calls, 2 if smoke else 7, limit_s=60.0).items():
        about = {"case": case, "at": kind}
        result.add_time("time of all", found, **about)
        if "failed" in found:
            continue
        result.add("runs a second", count / found["median_s"], "1/s", **about)
        ends = np.asarray(calls[case, kind](), float)[:: count // JUDGED]
        result.add("error", float(np.max(np.abs(ends - exact[case]) / np.maximum(np.abs(exact[case]), 1.0))), **about)
    return result


def _ready(function: Callable[[Array], Array], numbers: Array) -> Array:
    return jax.block_until_ready(function(numbers))


def _lorenz_field(_t: Array, y: tuple[Array, Array, Array], rho: Array) -> tuple[Array, Array, Array]:
    a, b, c = y
    return 10.0 * (b - a), a * (rho - c) - b, a * b - c * (8.0 / 3.0)


def _lorenz(rho: Array, rtol: float) -> Array:
    """The final third coordinate."""
    one, tolerance = jnp.ones_like(rho), jnp.asarray(rtol, rho.dtype)
    solution = dfx.diffeqsolve(
        *(dfx.ODETerm(_lorenz_field), dfx.Tsit5(), 0.0 * one, one, None, (one, 0.0 * one, 0.0 * one), rho),
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        adjoint=dfx.ForwardMode(),
        throw=False,
    )
    assert solution.ys is not None
    return solution.ys[2][-1]


def _lorenz_end(rho: float) -> float:
    end = solve_ivp(
        lambda t, y: _lorenz_field(t, tuple(y), rho), (0.0, 1.0), [1.0, 0.0, 0.0], "DOP853", rtol=1e-13, atol=1e-13
    )
    return float(end.y[2, -1])


def _box(numbers: Array, rtol: float) -> Array:
    """The final velocity [m/s]."""
    return TESTBENCH.simulate(numbers, jnp.asarray(rtol, numbers.dtype), throw=False).qd[-1, 0]
