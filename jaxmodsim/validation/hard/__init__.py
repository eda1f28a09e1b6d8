"""Cases in which simulations go wrong, each with the reason, the right answer, and a check of it."""

from ._case import Answer as Answer
from ._case import HardCase as HardCase
from ._case import MeasuredNumber as MeasuredNumber
from ._case import RefusedCalls as RefusedCalls
from ._case import SceneTask as SceneTask
from ._check import DTYPES as DTYPES
from ._check import TRANSFORMS as TRANSFORMS
from ._check import CaseReport as CaseReport
from ._check import CheckFinding as CheckFinding
from ._check import check as check
from ._many_events import Contradictory as Contradictory
from ._run import FAMILIES as FAMILIES
from ._run import check_many as check_many
from ._run import choose as choose
from ._run import hard_cases as hard_cases
from ._steps import EXPLICIT as EXPLICIT
from ._steps import formulations as formulations
from ._steps import largest_step as largest_step
from ._steps import theory as theory
