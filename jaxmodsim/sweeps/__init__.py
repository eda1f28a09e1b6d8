"""Many runs: grids and samples of numbers, on all cores, devices and machines at hand."""

from ._observe import Derivative as Derivative
from ._progress import SweepProgress as SweepProgress
from ._samples import Span as Span
from ._samples import latin_hypercube as latin_hypercube
from ._samples import sobol as sobol
from ._sweep import sweep as sweep
