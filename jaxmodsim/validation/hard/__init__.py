"""Cases in which simulations go wrong, each with the reason, the right answer, and a check of it."""

from ._case import HardCase as HardCase
from ._case import SceneTask as SceneTask
from ._check import TRANSFORMS as TRANSFORMS
from ._check import CaseReport as CaseReport
from ._check import check as check
from ._run import FAMILIES as FAMILIES
from ._run import check_many as check_many
from ._run import choose as choose
from ._run import hard_cases as hard_cases
from ._steps import largest_steps as largest_steps
