"""Creep under a small vibration below break-away."""

import numpy as np

from ._experiment import Experiment
from ._laws import DEFLECTION, Specimen
from ._outcome import Finding, Limit, Line
from ._pulled import move

# Mean load [N], vibration [N] at the frequency [Hz], duration [s]; the load stays below the Coulomb force of 1 N.
_LOAD, _SHAKE, _FREQUENCY, _T1 = 0.4, 0.2, 5.0, 10.0
_SETTLED = 1.0


def _measure(specimen: Specimen) -> Finding:
    """Load a mass at rest and see how far it is from its place of the second 1 at the second 10."""
    run = move(
        specimen, _T1, load=_LOAD, shake=_SHAKE, frequency=_FREQUENCY, dtmax=0.1 / _FREQUENCY
    )
    # Both times are whole numbers of periods.
    start = int(np.argmin(np.abs(run.t - _SETTLED)))
    drift = 1e6 * float(abs(run.q[-1] - run.q[start]))
    return Finding(
        drift,
        f"Drifts by this way in {_T1 - _SETTLED:g} s under {_LOAD:g} N and a vibration of {_SHAKE:g} N.",
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
    _measure,
)
