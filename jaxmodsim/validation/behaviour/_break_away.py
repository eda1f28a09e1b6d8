"""Break-away force against force rate."""

import numpy as np

from ._experiment import Experiment
from ._laws import FC, FS, VS, LawCase
from ._pulled import after_slip, move
from ._result import FigureLine, LawMeasurement, Threshold

# Rates of the load [N/s].
RATES = np.geomspace(0.1, 100.0, 7)
# Largest load [N], and the velocity [m/s] from which on the mass slides.
_LOAD, _SLIDES = 1.7 * FS, 10.0 * VS


def _measure(case: LawCase) -> LawMeasurement:
    """Pull a mass harder and harder; the largest friction before it slides, at slow and at fast rates."""
    z0 = after_slip(case)
    forces = []
    for rate in RATES:
        run = move(case, _LOAD / rate, z0=z0, ramp=float(rate), dtmax=0.01 * _LOAD / rate)
        slides = run.v > _SLIDES
        end = int(np.argmax(slides)) if slides.any() else run.v.size
        forces.append(float(np.max(run.friction[: max(end, 1)])))
    lines = (FigureLine("", RATES, np.asarray(forces)),)
    if forces[0] < 0.1 * FC:
        return LawMeasurement(float("nan"), "Nothing sticks, so nothing breaks away.", lines)
    return LawMeasurement(
        (forces[0] - forces[-1]) / forces[0],
        f"Breaks away at {forces[0]:.3g} N under {RATES[0]:g} N/s and at {forces[-1]:.3g} N under {RATES[-1]:g} N/s.",
        lines,
    )


# A twentieth: what measurements of break-away forces resolve.
BREAK_AWAY = Experiment(
    "break-away",
    "Break-away force against the rate of the load, shortly after a slip",
    "fall of the break-away force from 0.1 N/s to 100 N/s, relative",
    "1",
    Threshold(0.05, at_most=False),
    ("force rate [N/s]", "break-away force [N]"),
    (0.9, 1.6),
    _measure,
    log_x=True,
)
