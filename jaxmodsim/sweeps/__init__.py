"""Many runs: grids and samples of numbers, on all cores, devices and machines."""

from ._run import Derivative as Derivative
from ._samples import latin_hypercube as latin_hypercube
from ._samples import sobol as sobol
from ._sensitivity import GlobalSensitivity as GlobalSensitivity
from ._sensitivity import Indices as Indices
from ._sensitivity import global_sensitivity as global_sensitivity
from ._sweep import SweepPlan as SweepPlan
from ._sweep import SweepProgress as SweepProgress
from ._sweep import SweepProgressText as SweepProgressText
from ._sweep import plan_sweep as plan_sweep
from ._sweep import sweep as sweep
