"""Periodic orbits by shooting and by simulation until settled: errors and times of the same quantity.

The quantities are the period of the belt oscillator, and the amplitude of Den Hartog's oscillator with dry friction.
Both have closed forms.
"""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxmodsim as jms
from bench.record import Result, timed
from jaxmodsim.problems import belt_oscillator

# Settling [s] and tolerance; frequency [rad/s] at mass, stiffness and force amplitude one, and two friction forces [N]:
# with the smaller one free oscillations decay slowly.
SETTLE, RTOL, W, FORCES = 20.0, 1e-10, 0.7, (0.2, 0.02)
BELT = "period of the belt oscillator"

# A method.
Way = Callable[[], float]


def main(smoke: bool, out: Path) -> Result:
    """Measure relative error and time of each method."""
    del out
    result = Result("periodic_orbit", ("diffrax",), {"rtol": RTOL, "W": W})
    exact = {BELT: float(belt_oscillator.cycle(**belt_oscillator.PARAMS).period)}
    ways: dict[tuple[str, str, str], Way] = {
        (BELT, "jaxmodsim", f"{SETTLE:g} s"): _belt_orbit,
        (BELT, "simulation", f"{SETTLE:g} s"): _belt_run,
    }
    for Fc in FORCES:
        case = f"amplitude of Den Hartog's oscillator, Fc = {Fc:g} N"
        exact[case], phase = _den_hartog(Fc)
        friction = jms.Friction(jms.Coulomb(Fc))
        scene = jms.Scene(_spring, params={"W": W}, effects=(jms.AppliedForce(_swing), friction))
        ways[case, "jaxmodsim", "20 periods"] = partial(_den_hartog_orbit, scene)
        for count in (20,) if smoke else (20, 50, 200, 1000):
            end = (2.0 * math.pi * count + phase) / W
            ways[case, "simulation", f"{count} periods"] = partial(_den_hartog_run, scene, end)
    for (case, peer, at), way in ways.items():
        result.add("error", abs(way() / exact[case] - 1.0), case=case, peer=peer, at=at)
    for (case, peer, at), found in timed(ways, 2 if smoke else 10).items():
        result.add_time("run", found, case=case, peer=peer, at=at)
    return result


def _den_hartog(Fc: float) -> tuple[float, float]:
    """Amplitude [m], and the phase of the force at the turning point [rad]."""
    V, U = 1.0 / (1.0 - W**2), math.sin(math.pi / W) / (W * (1.0 + math.cos(math.pi / W)))
    amplitude = math.sqrt(V**2 - (Fc * U) ** 2)
    return amplitude, math.atan2(-Fc * U, amplitude)


_BELT = belt_oscillator.scene()


def _belt_orbit() -> float:
    return float(jms.periodic_orbit(_BELT, ([0.0], [0.0]), settle=SETTLE, rtol=RTOL, atol=1e-2 * RTOL).period)


def _belt_run() -> float:
    """Time between the last two break-away events."""
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


def _den_hartog_orbit(scene: jms.Scene) -> float:
    orbit = jms.periodic_orbit(scene, ([0.0], [0.0]), period=_period, rtol=RTOL, atol=1e-2 * RTOL)
    return float(orbit.amplitude[0])


def _den_hartog_run(scene: jms.Scene, end: float) -> float:
    """Final deflection, at the time of a turning point by the closed form."""
    options = {"rtol": RTOL, "atol": 1e-2 * RTOL, "max_steps": 1_000_000, "max_events": 5000}
    return float(jms.simulate(scene, [0.0], [0.0], end, **options).q[-1, 0])
