"""Many runs: grids and samples of numbers, on all cores, devices and machines at hand."""

from ._estimates import Estimate as Estimate
from ._global import GlobalSensitivity as GlobalSensitivity
from ._indices import global_sensitivity as global_sensitivity
from ._observe import Derivative as Derivative
from ._plan import SweepPlan as SweepPlan
from ._plan import plan_sweep as plan_sweep
from ._progress import SweepProgress as SweepProgress
from ._progress import SweepWords as SweepWords
from ._samples import latin_hypercube as latin_hypercube
from ._samples import sobol as sobol
from ._sweep import sweep as sweep
