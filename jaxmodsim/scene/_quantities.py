"""Names and units of what a run holds: coordinates, velocities, forces."""

import math
import re
from dataclasses import replace

from .._core.parameters import Range
from ._coordinates import Quantity, read_label
from ._scene import Scene
from .forces._applied_force import AppliedForce
from .forces._effect import AbstractEffect
from .forces._friction import Friction

_STATE = re.compile(r"(q|qd)\[(\d+)\]")
_COMPONENT = re.compile(r"(.+)\[(\d+)\]")
_FORCES = {"m": "N", "rad": "N m", "m or rad": "N or N m", "": ""}
# Units of friction along an angle, by those along a displacement.
_ABOUT_AN_AXIS = {
    "N": "N m", "N/m": "N m/rad", "N s/m": "N m s/rad", "N/s": "N m/s", "m": "rad", "m/s": "rad/s",
}  # fmt: skip


def quantity_of(scene: Scene, series: str) -> Quantity:
    """What `q[0]`, `qd[0]`, or the force of an effect (`friction`, `pull[0]`) is called, with its unit.

    The velocity of `x [m]` is `x_dot [m/s]`. Coordinates without names keep `q[0]`, as "m or rad"; so do forces whose
    unit depends on that, and friction along some other displacement than a coordinate, as "N or N m". A name that is
    none of these has no unit.
    """
    state, component = _STATE.fullmatch(series), _COMPONENT.fullmatch(series)
    if state is not None and int(state[2]) < (len(scene.coordinates) or math.inf):
        return _velocity(scene, int(state[2])) if state[1] == "qd" else _coordinate(scene, int(state[2]))
    effect, index = series, 0
    if effect not in scene.names and component is not None:
        effect, index = component[1], int(component[2])
    if effect not in scene.names:
        return Quantity(series, "")
    return Quantity(series, _force_unit(scene, scene.effects[scene.names.index(effect)], index))


def describe_series(scene: Scene, series: str) -> str:
    """The series as functions know it, and what it is called, as in `q[1] (theta)`."""
    name = quantity_of(scene, series).name
    return series if name == series else f"{series} ({name})"


def _coordinate(scene: Scene, i: int) -> Quantity:
    return read_label(scene.coordinates[i]) if scene.coordinates else Quantity(f"q[{i}]", "m or rad")


def _velocity(scene: Scene, i: int) -> Quantity:
    if not scene.coordinates:
        return Quantity(f"qd[{i}]", "m/s or rad/s")
    name, unit = _coordinate(scene, i)
    return Quantity(f"{name}_dot", f"{unit}/s" if unit else "")


def _force_unit(scene: Scene, effect: AbstractEffect, index: int) -> str:
    units = [_coordinate(scene, i).unit for i in range(max(len(scene.coordinates), index + 1))]
    if isinstance(effect, AppliedForce):
        return "N" if effect.at is not None else _FORCES.get(units[index], f"J/{units[index]}")
    if len(units) == 1 and isinstance(effect, Friction) and effect.along is None:
        return _FORCES.get(units[0], f"J/{units[0]}")
    return "N" if set(units) == {"m"} else "N or N m"


def in_units_of(scene: Scene, effect: AbstractEffect, allowed: Range) -> Range:
    """The range of a number of an effect: in N m and rad for friction about an axis."""
    about = isinstance(effect, Friction) and effect.along is None and effect.normal_force is None
    if not about or [read_label(text).unit for text in scene.coordinates] != ["rad"]:
        return allowed
    return replace(allowed, unit=_ABOUT_AN_AXIS.get(allowed.unit, allowed.unit))
