"""Many runs: grids and samples of numbers, on all cores, devices and machines at hand."""

from ._observe import Derivative as Derivative
from ._outline import Outline as Outline
from ._outline import outline as outline
from ._progress import SweepProgress as SweepProgress
from ._progress import progress_bar as progress_bar
from ._sweep import sweep as sweep
