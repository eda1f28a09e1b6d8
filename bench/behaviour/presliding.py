"""Presliding: friction as a function of displacement, and its memory of turning points."""

import numpy as np

from bench.behaviour.drive import NEEDS_LOAD, SAMPLES, needs_load, path, respond
from bench.behaviour.experiment import DEFLECTION, VS, Experiment, FigureLine, LawCase, LawMeasurement, Threshold

# Velocity of the motion [m/s], so small that friction depends on displacement alone.
_SLOW = 0.01 * VS
_LEG = 512
# Turning points of the inner loop, in amplitudes; the outer loop turns at +-1.
_INNER = (0.8, -0.4)
# A loop is elastic if it dissipates less than this fraction of force range times distance.
_ELASTIC = 0.01


def _cycles(case: LawCase, inner: bool) -> tuple[np.ndarray, np.ndarray]:
    """Displacement [m] and force [N] of a loop of ten legs, and a last leg with or without an inner loop.

    The last leg rises from -1 to 0.8, returns to -0.4, rises to 0.8 again and continues to 1, or rises directly to 1.
    On the outer loop both have the same samples. The remaining samples fill the drive.
    """
    low, high = -DEFLECTION, DEFLECTION
    turn, back = _INNER[0] * DEFLECTION, _INNER[1] * DEFLECTION
    outer = path(0.0, *(high, low) * 5, samples=_LEG)
    last = [path(low, turn, samples=_LEG)]
    if inner:
        last.append(path(turn, back, turn, samples=_LEG))
    last.append(path(turn, high, samples=_LEG))
    x = np.concatenate([outer, *last])
    rest = SAMPLES - x.size
    x = np.concatenate([x, path(high, high + rest * DEFLECTION / _LEG, samples=rest)])
    dx = np.diff(x, prepend=0.0)
    return x, respond(case.law, np.sign(dx) * _SLOW, np.abs(dx) / _SLOW).force


def _loss(x: np.ndarray, force: np.ndarray) -> float:
    """Energy [J] dissipated in the last full cycle."""
    last = slice(8 * _LEG - 1, 10 * _LEG)
    x, force = x[last], force[last]
    return float(np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(x)))


def _presliding(case: LawCase) -> LawMeasurement:
    """Cycle over the break-away deflection, and measure the first step after a turn."""
    if needs_load(case.law, _SLOW):
        return LawMeasurement(float("nan"), NEEDS_LOAD)
    x, force = _cycles(case, inner=False)
    outer = slice(8 * _LEG - 1, 10 * _LEG)
    turn = 9 * _LEG
    swing = float(np.ptp(force[outer]))
    jump = abs(float(force[turn] - force[turn - 1])) / swing if swing > 0 else float("nan")
    return LawMeasurement(
        jump,
        f"After a turn the force changes by this part of its swing within {2e9 * DEFLECTION / _LEG:.0f} nm;"
        f" the loop loses {1e6 * _loss(x, force):.3g} uJ.",
        (FigureLine("", 1e6 * x[: 10 * _LEG], force[: 10 * _LEG]),),
    )


def _memory(case: LawCase) -> LawMeasurement:
    """Insert an inner loop, and measure the change of the outer loop after it."""
    if needs_load(case.law, _SLOW):
        return LawMeasurement(float("nan"), NEEDS_LOAD)
    (x_inner, with_inner), (x, without) = _cycles(case, inner=True), _cycles(case, inner=False)
    swing = float(np.ptp(without[8 * _LEG : 10 * _LEG]))
    start = 11 * _LEG
    # From the point at which the inner loop closes to the next turn.
    rest_with, rest_without = with_inner[start + 2 * _LEG - 1 :][: _LEG + 1], without[start - 1 :][: _LEG + 1]
    lines = (
        FigureLine("without inner loop", 1e6 * x[8 * _LEG : 10 * _LEG], without[8 * _LEG : 10 * _LEG], reference=True),
        FigureLine("with inner loop", 1e6 * x_inner[10 * _LEG : 14 * _LEG], with_inner[10 * _LEG : 14 * _LEG]),
    )
    if not PRESLIDING.threshold.keeps(_presliding(case).number):
        return LawMeasurement(float("nan"), "There is no presliding, and no memory of it.", lines)
    if _loss(x, without) < _ELASTIC * swing * 2.0 * DEFLECTION:
        return LawMeasurement(float("nan"), "Presliding is elastic, without hysteresis.", lines)
    return LawMeasurement(
        float(np.max(np.abs(rest_with - rest_without))) / swing,
        "Change of the outer loop after an inner loop, relative to the range of the force.",
        lines,
    )


# The threshold is a tenth of the force range in one sample, a 256th of the distance: the stiffness of a spring 25 times
# stiffer than the contact.
PRESLIDING = Experiment(
    "presliding",
    "Presliding: friction against displacement, cycled over the break-away deflection",
    "jump of the force at a turn over its swing",
    "1",
    Threshold(0.1, at_most=True),
    ("displacement [um]", "friction force [N]"),
    (-1.7, 1.7),
    _presliding,
)
# The threshold is 1/200 of the force range: between elements that yield over a fiftieth of their limit, and laws with
# one state.
MEMORY = Experiment(
    "memory",
    "Non-local memory: an inner loop in the presliding hysteresis, and the outer loop after it",
    "change of the outer loop by an inner one over its swing",
    "1",
    Threshold(0.005, at_most=True),
    ("displacement [um]", "friction force [N]"),
    (-1.7, 1.7),
    _memory,
)
