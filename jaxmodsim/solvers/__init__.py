"""Plug-ins for diffrax."""

from ._controllers import FiniteSteps as FiniteSteps
from ._controllers import StepsTo as StepsTo
from ._error_checks import without_error_checks as without_error_checks
from ._first_step import first_step as first_step
from ._first_step import trial_step as trial_step
from ._gauss import Gauss as Gauss
from ._implicit_friction import ImplicitFriction as ImplicitFriction
from ._projected import Projected as Projected
from ._rodas5p import RODAS5P as RODAS5P
from ._rodas5p import Rodas5P as Rodas5P
from ._rosenbrock import RosenbrockTableau as RosenbrockTableau
from ._rosenbrock import rosenbrock_step as rosenbrock_step
from ._stored_steps import StoredSteps as StoredSteps
from .events._controller import EventController as EventController
from .events._guard_scan import instant as instant
from .events._samples import SampledJumps as SampledJumps
from .events._solver import EventSolver as EventSolver
from .events._state import ACCUMULATION as ACCUMULATION
from .events._state import TOO_MANY as TOO_MANY
from .events._state import EventLog as EventLog
from .events._state import EventState as EventState
