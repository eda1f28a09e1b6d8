"""Scenes: what is in them, and the vector field that follows."""

from ._field import Reaction as Reaction
from ._field import check_scene as check_scene
from ._field import scene_canonical as scene_canonical
from ._field import scene_drifts as scene_drifts
from ._field import scene_energies as scene_energies
from ._field import scene_field as scene_field
from ._field import scene_forces as scene_forces
from ._field import scene_guards as scene_guards
from ._field import scene_margins as scene_margins
from ._field import scene_mass as scene_mass
from ._field import scene_misfit as scene_misfit
from ._field import scene_modes as scene_modes
from ._field import scene_overload as scene_overload
from ._field import scene_power as scene_power
from ._field import scene_project as scene_project
from ._field import scene_reactions as scene_reactions
from ._field import scene_stick as scene_stick
from ._field import scene_switch as scene_switch
from ._implicit import check_step as check_step
from ._implicit import scene_step as scene_step
from ._names import replace_numbers as replace_numbers
from ._names import scene_numbers as scene_numbers
from ._names import scene_ranges as scene_ranges
from ._resolve import State as State
from ._scene import Scene as Scene
