"""The test bench: a box on a table under a rising force, with one friction model after the other."""

from ._ramp import RampResult as RampResult
from ._ramp import RampRun as RampRun
from ._ramp import ramp_cases as ramp_cases
from ._ramp import run_ramp as run_ramp
from ._ramp import stick_sweep as stick_sweep
