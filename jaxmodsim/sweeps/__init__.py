"""Many runs: grids and samples of numbers, on all cores, devices and machines at hand."""

from ._observe import Derivative as Derivative
from ._progress import SweepProgress as SweepProgress
from ._sweep import sweep as sweep
