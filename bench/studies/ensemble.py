"""Ensembles on one device: many runs at once of the Lorenz system, the LuGre test bench and a belt with stick-slip.

The Lorenz system is that of C. Utkarsh et al., "Automated translation and accelerated solving of differential equations
on multiple GPU platforms", Computer Methods in Applied Mechanics and Engineering 419:116591, 2024: from (1, 0, 0) over
one second with sigma = 10, beta = 8/3 and rho from 0 to 21, by Tsit5 of diffrax. Single precision has coarser
tolerances. `ensemble_gpu` does the same on a GPU.
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
from bench.tasks import TESTBENCH, Belt

LORENZ, BOX, BELT = "Lorenz system", "LuGre test bench", "Coulomb belt"
RHO = 21.0
# The first 12 events of the belt.
STICK_SLIP = Belt(t1=6.0)
# Relative tolerances, by case and precision.
RTOL = {
    LORENZ: {"float64": 1e-8, "float32": 1e-6},
    BOX: {"float64": 1e-4, "float32": 1e-4},
    BELT: {"float64": 1e-6, "float32": 1e-5},
}
# Number of runs in a call on a CPU and on a GPU, and number of runs with error measures.
RUNS = {"cpu": dict.fromkeys(RTOL, 2**13), "gpu": {LORENZ: 2**23, BOX: 2**23, BELT: 2**20}}
JUDGED = 16


def main(smoke: bool, out: Path) -> Result:
    """Measure on the processor, whether or not there is a GPU."""
    del out
    return measure_on(jax.devices("cpu")[0], "ensemble", smoke)


def measure_on(device: jax.Device, name: str, smoke: bool) -> Result:
    """Measure the time of all runs of a case in one call, in both precisions, and their errors."""
    counts = dict.fromkeys(RTOL, 64) if smoke else RUNS[device.platform]
    title = "the processor" if device.platform == "cpu" else device.device_kind
    result = Result(name, ("diffrax",), {"device": title})
    sets = {
        LORENZ: np.linspace(0.0, RHO, counts[LORENZ]),
        BOX: TESTBENCH.sets(counts[BOX]),
        BELT: STICK_SLIP.sets(counts[BELT]),
    }
    judged = {case: each[:: counts[case] // JUDGED] for case, each in sets.items()}
    exact = {
        LORENZ: np.array([_lorenz_end(rho) for rho in judged[LORENZ]]),
        BOX: TESTBENCH.exact_ends(judged[BOX]),
        BELT: STICK_SLIP.exact_ends(judged[BELT]),
    }
    calls: dict[tuple[str, str], Callable[[], Array]] = {}
    with jax.default_device(device):
        for case, run in {LORENZ: _lorenz, BOX: _box, BELT: _belt}.items():
            for kind, rtol in RTOL[case].items():
                many = jax.vmap(partial(run, rtol=rtol))
                if device.platform == "cpu":
                    many = partial(jax.lax.map, partial(run, rtol=rtol), batch_size=64)
                numbers = jax.device_put(jnp.asarray(sets[case], kind), device)
                calls[case, kind] = partial(_ready, jax.jit(many), numbers)
        for (case, kind), found in timed(calls, 2 if smoke else 7, limit_s=60.0).items():
            about = {"case": case, "at": kind}
            result.add("runs", counts[case], **about)
            result.add_time("time of all", found, **about)
            if "failed" in found:
                continue
            result.add("first call", found["first_s"], "s", **about)
            result.add("runs a second", counts[case] / found["median_s"], "1/s", **about)
            ends = np.asarray(calls[case, kind](), float)[:: counts[case] // JUDGED]
            error = np.max(np.abs(ends - exact[case]) / np.maximum(np.abs(exact[case]), 1.0))
            result.add("error", float(error), **about)
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


def _belt(numbers: Array, rtol: float) -> Array:
    """The final position [m]."""
    return STICK_SLIP.simulate(numbers, rtol, throw=False).q[-1, 0]
