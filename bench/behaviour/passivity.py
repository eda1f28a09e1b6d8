"""Passivity: energy dissipated in closed cycles."""

from typing import NamedTuple

import numpy as np

from bench.behaviour.drive import NEEDS_LOAD, SAMPLES, needs_load, respond
from bench.behaviour.experiment import DEFLECTION, VS, Experiment, FigureLine, LawCase, LawMeasurement, Threshold

_PERIODS = 4
_HALF = SAMPLES // (2 * _PERIODS)


class Cycle(NamedTuple):
    """Slip velocity [m/s] and durations of the samples [s] over half a period; the other half has the opposite sign."""

    v: np.ndarray
    dt: np.ndarray


def sines() -> list[Cycle]:
    """Sines with amplitudes from 0.01 to 100 deflections, at three frequencies."""
    phase = np.pi * (np.arange(_HALF) + 0.5) / _HALF
    return [
        Cycle(2.0 * np.pi * f * a * DEFLECTION * np.sin(phase), np.full(_HALF, 0.5 / f / _HALF))
        for f in (1.0, 10.0, 100.0)
        for a in (0.01, 0.1, 0.5, 1.0, 3.0, 10.0, 100.0)
    ]


def random_cycles(count: int = 20) -> list[Cycle]:
    """Sums of ten odd harmonics with random amplitudes and phases, from presliding to slip."""
    rng, phase = np.random.default_rng(0), np.pi * (np.arange(_HALF) + 0.5) / _HALF
    odd = np.arange(1, 21, 2)
    cycles = []
    for _ in range(count):
        weights, shift = rng.standard_normal(odd.size), rng.uniform(0.0, 2.0 * np.pi, odd.size)
        shape = np.sin(odd * phase[:, None] + shift) @ weights
        size, f = DEFLECTION * 10.0 ** rng.uniform(-1.0, 2.0), 10.0 ** rng.uniform(0.0, 2.0)
        cycles.append(Cycle(2.0 * np.pi * f * size * shape / np.sqrt(odd.size), np.full(_HALF, 0.5 / f / _HALF)))
    return cycles


def pulses() -> list[Cycle]:
    """Slow slip that loads the bristles, with fast pulses that are too short for relaxation.

    In such cycles a law whose damping is too large for its viscous part returns more energy than it has absorbed.
    """
    slow, fast = 14, 2
    cycles = []
    for v in (20.0 * VS, 100.0 * VS, 500.0 * VS):
        for way in (0.003, 0.03):
            speeds = np.tile(np.repeat([0.3 * VS, v], [slow, fast]), _HALF // (slow + fast))
            ways = np.tile(np.repeat([10.0 * way / slow, way / fast], [slow, fast]), _HALF // (slow + fast))
            cycles.append(Cycle(speeds, ways * DEFLECTION / speeds))
    return cycles


def balance(case: LawCase, cycle: Cycle) -> tuple[float, np.ndarray]:
    """Ratio of dissipated energy to absolute work in the last period, and the dissipation along it."""
    v = np.tile(np.concatenate([cycle.v, -cycle.v]), _PERIODS)
    dt = np.tile(cycle.dt, 2 * _PERIODS)
    run = respond(case.law, v, dt)
    last = slice(SAMPLES - 2 * _HALF, SAMPLES)
    taken = np.cumsum(run.work[last]) - (run.stored[last] - run.stored[last.start - 1])
    turned = float(np.sum(np.abs(run.work[last])))
    return float(taken[-1]) / turned, taken / turned


def _measure(case: LawCase) -> LawMeasurement:
    """Drive closed cycles of all kinds, and measure the smallest dissipation."""
    if needs_load(case.law, 0.0):
        return LawMeasurement(float("nan"), NEEDS_LOAD)
    families = {"sines": sines(), "random": random_cycles(), "pulses": pulses()}
    lines, least = [], {}
    for family, cycles in families.items():
        balances = [balance(case, cycle) for cycle in cycles]
        share, taken = min(balances, key=lambda each: each[0])
        least[family] = share
        lines.append(FigureLine(family, np.linspace(0.0, 1.0, taken.size), taken))
    return LawMeasurement(
        min(least.values()),
        "The least dissipation of a closed cycle, over the energy turned over in it: "
        + ", ".join(f"{name} {share:.2g}" for name, share in least.items())
        + ".",
        tuple(lines),
    )


# The threshold allows for rounding and the trapezoidal rule; laws that are not passive are far below it.
PASSIVITY = Experiment(
    "passivity",
    "Passivity: energy dissipated in the closed cycle that dissipates least, of sines, random motions and pulses",
    "least dissipation of a closed cycle over the energy turned over",
    "1",
    Threshold(-1e-4, at_most=False),
    ("part of the period", "dissipated / turned over"),
    (-0.6, 1.1),
    _measure,
)
