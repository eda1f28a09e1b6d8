"""Static characteristic: friction in steady slip."""

import numpy as np

from ._drive import SAMPLES, respond
from ._experiment import Experiment
from ._laws import DEFLECTION, FC, VS, LawCase
from ._outcome import Finding, Limit, Line

_SPEEDS, _HELD = 64, 32
# Every speed is held for a way of many deflections, and for longer than any lag of the laws.
_WAY, _TIME = 40.0 * DEFLECTION, 1.0


def _measure(case: LawCase) -> Finding:
    """Slide at speeds that rise and fall again, in steps, forward and then backward."""
    speeds = np.geomspace(0.2 * VS, 100.0 * VS, _SPEEDS)
    sweep = np.concatenate([speeds, speeds[::-1]])
    held = np.concatenate([sweep, -sweep])
    v = np.repeat(held, _HELD)
    force = respond(case.law, v, (_WAY / np.abs(v) + _TIME) / _HELD).force
    assert v.size == SAMPLES
    steady = force.reshape(-1, _HELD)[:, -1]
    expected = case.steady(held)
    up, down, forth, back = steady.reshape(4, _SPEEDS)
    lines = (
        Line("steady curve", speeds, expected[:_SPEEDS], reference=True),
        Line("", speeds, expected[2 * _SPEEDS : 3 * _SPEEDS], reference=True),
        Line("rising speed", speeds, up),
        Line("falling speed", speeds[::-1], down),
        Line("rising speed", speeds, forth),
        Line("falling speed", speeds[::-1], back),
    )
    fall = up[0] - up.min()
    dip = f"falls by {fall:.2g} N and" if fall > 0.05 * FC else "does not fall and"
    return Finding(
        float(np.max(np.abs(steady - expected)) / FC),
        f"Steady friction {dip} lies within this part of Fc about the closed form, whether speed rises or falls.",
        lines,
    )


# A hundredth of the Coulomb force: a fiftieth of the fall from stiction, and more than any width or corner explains.
CHARACTERISTIC = Experiment(
    "characteristic",
    "Static characteristic: steady friction at rising and falling speed, forward and backward",
    "largest deviation from the steady curve over Fc",
    "1",
    Limit(0.01, at_most=True),
    ("speed [m/s]", "friction force [N]"),
    (-2.1, 2.1),
    _measure,
    log_x=True,
)
