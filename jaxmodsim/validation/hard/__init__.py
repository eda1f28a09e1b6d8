"""Cases in which simulations go wrong, each with the reason, the right answer, and a check of it."""

from ._case import Answer as Answer
from ._case import HardCase as HardCase
from ._case import Measured as Measured
from ._case import Motion as Motion
from ._case import Program as Program
from ._case import Refused as Refused
from ._cases import FAMILIES as FAMILIES
from ._cases import hard_cases as hard_cases
from ._check import DTYPES as DTYPES
from ._check import WAYS as WAYS
from ._check import Finding as Finding
from ._check import Verdict as Verdict
from ._check import check as check
from ._many_events import Contradictory as Contradictory
from ._run import check_many as check_many
from ._run import choose as choose
from ._steps import EXPLICIT as EXPLICIT
from ._steps import formulations as formulations
from ._steps import largest_step as largest_step
from ._steps import theory as theory
