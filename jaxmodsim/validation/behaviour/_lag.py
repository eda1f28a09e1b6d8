"""Frictional lag."""

import numpy as np

from ._drive import SAMPLES, respond
from ._experiment import Experiment
from ._laws import FC, VS, LawCase
from ._outcome import Finding, Limit, Line

# Velocity oscillates about its mean without changing sign, in Stribeck velocities; angular frequencies [1/s].
_MEAN, _SWING = 1.5, 1.2
_FREQUENCIES = (1.0, 10.0, 25.0)
_PERIODS = 4


def _loop(case: LawCase, frequency: float) -> tuple[np.ndarray, np.ndarray]:
    """Velocity [m/s] and force [N] over the last period."""
    n = SAMPLES // _PERIODS
    dt = 2.0 * np.pi / frequency / n
    v = VS * (_MEAN - _SWING * np.cos(frequency * dt * (np.arange(SAMPLES) + 0.5)))
    return v[-n:], respond(case.law, v, np.full(SAMPLES, dt)).force[-n:]


def _measure(case: LawCase) -> Finding:
    """Oscillate the velocity and hold friction at rising against friction at falling velocity."""
    loops = {frequency: _loop(case, frequency) for frequency in _FREQUENCIES}
    v, force = loops[_FREQUENCIES[-1]]
    half = v.size // 2
    # Samples lie symmetrically about the turning points, so those of the way down mirror those of the way up.
    difference = float(np.mean(force[:half] - force[half:][::-1]))
    lines = [Line(f"{frequency:g} rad/s", 1e3 * v, force) for frequency, (v, force) in loops.items()]
    steady = Line("steady curve", 1e3 * v[:half], case.steady(v[:half]), reference=True)
    return Finding(
        difference / FC,
        f"At {_FREQUENCIES[-1]:g} rad/s friction is larger by this part of Fc while the velocity rises than while it"
        " falls.",
        (steady, *lines),
    )


# A hundredth of the Coulomb force: the loop is then as wide as a line of the figure.
LAG = Experiment(
    "lag",
    "Frictional lag: friction against a velocity that oscillates without changing sign",
    "friction at rising less at falling velocity over Fc",
    "1",
    Limit(0.01, at_most=False),
    ("slip velocity [mm/s]", "friction force [N]"),
    (0.9, 1.6),
    _measure,
)
