"""Stick-slip of a mass that is pulled through a spring."""

import numpy as np

from ._experiment import Experiment
from ._laws import LawCase
from ._outcome import Finding, Limit, Line
from ._pulled import move

# Stiffness [N/m], velocity of the spring's end [m/s] and duration [s].
_K, _PULL, _T1 = 2.0, 0.1, 40.0
# Velocity that counts as rest, as part of the pull: above the creep of smooth laws and Karnopp's band, and an
# undamped oscillation that touches zero stays below it for 2 % of its period. A mean over so many samples to either
# side, of 10 ms, which the vibration of the mass on its contact does not disturb.
_REST, _SPAN = 2e-3, 5


def _measure(case: LawCase) -> Finding:
    """Pull, and look at the second half of the run for times of rest."""
    run = move(case, _T1, k=_K, pull=_PULL, dtmax=0.1)
    late = run.t >= 0.5 * _T1
    ahead, behind = np.roll(run.q, -_SPAN), np.roll(run.q, _SPAN)
    rests = np.abs(ahead - behind) < _REST * _PULL * 2 * _SPAN * (run.t[1] - run.t[0])
    late &= run.t <= run.t[-_SPAN - 1]
    share = float(np.mean(rests[late]))
    spring = _K * (_PULL * run.t - run.q)
    starts = run.t[1:][~rests[1:] & rests[:-1] & late[1:]]
    period = f"period {np.mean(np.diff(starts)):.3g} s, " if starts.size > 1 else ""
    return Finding(
        share,
        f"In the second half of the run the mass rests for this part of the time: {period}spring force from"
        f" {spring[late].min():.3g} N to {spring[late].max():.3g} N.",
        (Line("end of the spring", run.t, _PULL * run.t, reference=True), Line("mass", run.t, run.q)),
    )


# A tenth of the time at rest: five times of what an oscillation without stick can have.
STICK_SLIP = Experiment(
    "stick-slip",
    "Stick-slip: a mass of 1 kg pulled through a spring of 2 N/m at 0.1 m/s",
    "time at rest over time",
    "1",
    Limit(0.1, at_most=False),
    ("time [s]", "position [m]"),
    (0.0, 4.2),
    _measure,
)
