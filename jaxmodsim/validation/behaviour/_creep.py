"""Creep under a small vibration below break-away."""

from ._experiment import Experiment
from ._laws import DEFLECTION, LawCase
from ._outcome import Finding, Limit, Line
from ._pulled import move

# Mean load [N], vibration [N] at the frequency [Hz], duration [s]; the load stays below the Coulomb force of 1 N.
_LOAD, _SHAKE, _FREQUENCY, _T1 = 0.4, 0.2, 5.0, 10.0
# Spans of time [s], whole periods each, between whose mean positions the mass drifts.
_EARLY, _LATE = (1.0, 2.0), (9.0, 10.0)


def _measure(case: LawCase) -> Finding:
    """Load a mass at rest, and see how far it goes once the load has come."""
    run = move(case, _T1, load=_LOAD, shake=_SHAKE, frequency=_FREQUENCY, dtmax=0.1 / _FREQUENCY)
    early, late = (run.q[(run.t > start) & (run.t <= end)].mean() for start, end in (_EARLY, _LATE))
    drift = 1e6 * float(abs(late - early))
    return Finding(
        drift,
        f"Drifts by this way in {_LATE[0] - _EARLY[0]:g} s under {_LOAD:g} N and a vibration of {_SHAKE:g} N.",
        (Line("", run.t, 1e6 * run.q),),
    )


# A hundredth of the break-away deflection.
CREEP = Experiment(
    "creep",
    "Creep: a mass under 0.4 N and a vibration of 0.2 N at 5 Hz, below break-away",
    "drift",
    "um",
    Limit(1e4 * DEFLECTION, at_most=True),
    ("time [s]", "displacement [um]"),
    (-5.0, 225.0),
    _measure,
)
