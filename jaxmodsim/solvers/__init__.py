"""Plug-ins for diffrax."""

from ._controllers import FiniteSteps as FiniteSteps
from ._controllers import StepsTo as StepsTo
from ._event_controller import EventController as EventController
from ._event_solver import EventSolver as EventSolver
from ._event_state import ACCUMULATION as ACCUMULATION
from ._event_state import TOO_MANY as TOO_MANY
from ._event_state import EventLog as EventLog
from ._event_state import EventState as EventState
from ._first_step import first_step as first_step
from ._gauss import Gauss as Gauss
from ._implicit_friction import ImplicitFriction as ImplicitFriction
from ._projected import Projected as Projected
from ._rodas5p import RODAS5P as RODAS5P
from ._rodas5p import Rodas5P as Rodas5P
