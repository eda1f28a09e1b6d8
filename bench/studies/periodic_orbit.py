"""Periodic orbits by shooting, beside simulations until they have settled: error and time for the same number.

The period of the belt oscillator, and the amplitude of Den Hartog's oscillator with dry friction; both in closed form.
"""

import math
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxmodsim as jms
from bench.record import Result, timed
from jaxmodsim.problems import belt_oscillator

# Settling [s] and tolerance; frequency [rad/s] and friction force [N] at mass, stiffness and force amplitude one.
SETTLE, RTOL, W, FC = 20.0, 1e-10, 0.7, 0.2
V, U = 1.0 / (1.0 - W**2), math.sin(math.pi / W) / (W * (1.0 + math.cos(math.pi / W)))
AMPLITUDE = math.sqrt(V**2 - (FC * U) ** 2)
BELT, DEN_HARTOG = "period of the belt oscillator", "amplitude of Den Hartog's oscillator"

# A way to the number.
Way = Callable[[], float]


def main(smoke: bool, out: Path) -> Result:
    """Relative error and time of each way to the two numbers."""
    del out
    result = Result("periodic_orbit", ("diffrax",), {"rtol": RTOL, "W": W, "Fc": FC, "settle": SETTLE})
    periods = (20,) if smoke else (20, 50, 100, 200)
    exact = {BELT: float(belt_oscillator.cycle(**belt_oscillator.PARAMS).period), DEN_HARTOG: AMPLITUDE}
    ways: dict[tuple[str, str, str], Way] = {
        (BELT, "jaxmodsim", f"{SETTLE:g} s"): _belt_orbit,
        (BELT, "simulation", f"{SETTLE:g} s"): _belt_run,
        (DEN_HARTOG, "jaxmodsim", "20 periods"): _den_hartog_orbit,
    }
    ways |= {(DEN_HARTOG, "simulation", f"{count} periods"): _den_hartog_run(count) for count in periods}
    for (case, peer, at), way in ways.items():
        result.add("error", abs(way() / exact[case] - 1.0), case=case, peer=peer, at=at)
    for (case, peer, at), found in timed(ways, 2 if smoke else 10).items():
        result.add_time("run", found, case=case, peer=peer, at=at)
    return result


_BELT = belt_oscillator.scene()


def _belt_orbit() -> float:
    return float(jms.periodic_orbit(_BELT, ([0.0], [0.0]), settle=SETTLE, rtol=RTOL, atol=1e-2 * RTOL).period)


def _belt_run() -> float:
    """Between the last two times at which it breaks away."""
    run = jms.simulate(_BELT, [0.0], [0.0], SETTLE, rtol=RTOL, atol=1e-2 * RTOL)
    times = np.asarray(run.events.t)
    slips = times[np.isfinite(times) & (np.asarray(run.events.before) == 0)]
    return float(slips[-1] - slips[-2])


def _spring(_t: Array, q: Array, qd: Array, _p: dict[str, Array]) -> Array:
    return 0.5 * qd[0] ** 2 - 0.5 * q[0] ** 2


def _swing(t: Array, _q: Array, _qd: Array, p: dict[str, Array]) -> Array:
    return jnp.array([jnp.cos(p["W"] * t)])


def _period(p: dict[str, Array]) -> Array:
    return 2.0 * jnp.pi / p["W"]


_FORCED = jms.Scene(_spring, params={"W": W}, effects=(jms.AppliedForce(_swing), jms.Friction(jms.Coulomb(FC))))


def _den_hartog_orbit() -> float:
    orbit = jms.periodic_orbit(_FORCED, ([0.0], [0.0]), period=_period, rtol=RTOL, atol=1e-2 * RTOL)
    return float(orbit.amplitude[0])


def _den_hartog_run(count: int) -> Way:
    """Deflection at the end of that many periods, at the time of a turning point by the closed form."""
    end = (2.0 * math.pi * count + math.atan2(-FC * U, AMPLITUDE)) / W

    def way() -> float:
        run = jms.simulate(
            _FORCED, [0.0], [0.0], end, rtol=RTOL, atol=1e-2 * RTOL, max_steps=100_000, max_events=4 * count + 100
        )
        return float(run.q[-1, 0])

    return way
