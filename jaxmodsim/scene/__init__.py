"""Scenes, their parts, and their vector fields."""

from . import _readable as _readable  # registers their tables
from ._check_scene import check_scene as check_scene
from ._coordinates import Quantity as Quantity
from ._dynamics import ConstraintReaction as ConstraintReaction
from ._dynamics import State as State
from ._dynamics import forward_dynamics as forward_dynamics
from ._dynamics import from_dynamics as from_dynamics
from ._dynamics import state_names as state_names
from ._dynamics import vector_field as vector_field
from ._event_driven import mode_numbers as mode_numbers
from ._implicit import check_step as check_step
from ._implicit import scene_step as scene_step
from ._linear_solver import has_linear_solver as has_linear_solver
from ._linear_solver import linear_solver as linear_solver
from ._names import elements as elements
from ._names import read_element as read_element
from ._names import replace_elements as replace_elements
from ._names import replace_numbers as replace_numbers
from ._names import scene_numbers as scene_numbers
from ._names import scene_ranges as scene_ranges
from ._names import scene_units as scene_units
from ._quantities import describe_series as describe_series
from ._quantities import quantity_of as quantity_of
from ._robot import read_robot as read_robot
from ._scene import Scene as Scene
from ._signal import Signal as Signal
from ._signal import sample_times as sample_times
from ._signal import signals_of as signals_of
from ._switching import start as start
from ._switching import switch as switch
from .forces._applied_force import AppliedForce as AppliedForce
from .forces._effect import AbstractEffect as AbstractEffect
from .forces._effect import Action as Action
from .forces._effect import Power as Power
from .forces._friction import Friction as Friction
from .forces._switch import Switch as Switch
