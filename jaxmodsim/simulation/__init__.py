"""Runs of scenes."""

from ._accuracy import evaluations_per_step as evaluations_per_step
from ._initial_state import project_initial_state as project_initial_state
from ._observe import named_series as named_series
from ._observe import named_unit as named_unit
from ._outcome import MAX_STEPS as MAX_STEPS
from ._outcome import SimulationError as SimulationError
from ._outcome import outcome_messages as outcome_messages
from ._peak import peak_of as peak_of
from ._run_request import run_request as run_request
from ._simulate import simulate as simulate
from ._solve import default_solver as default_solver
from ._to_accuracy import simulate_to_accuracy as simulate_to_accuracy
from ._trajectory import Events as Events
from ._trajectory import Trajectory as Trajectory
