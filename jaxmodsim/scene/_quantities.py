"""Names and units of the series of a run: coordinates, velocities, forces."""

import math
import re
from dataclasses import replace

import jax
import jax.numpy as jnp

from .._core.arguments import axis_unit
from .._core.arrays import is_known
from .._core.parameters import Range
from ._coordinates import Quantity, read_label
from ._scene import Scene
from .forces._effect import AbstractEffect
from .forces._friction import Friction

_STATE = re.compile(r"(q|qd)\[(\d+)\]")
_COMPONENT = re.compile(r"(.+)\[(\d+)\]")
_FORCES = {"m": "N", "rad": "N m", "m or rad": "N or N m", "": ""}


def quantity_of(scene: Scene, series: str) -> Quantity:
    """Name and unit of `q[0]`, `qd[0]`, or of the force of an effect (`friction`, `pull[0]`).

    The velocity of `x [m]` is `x_dot [m/s]`. A coordinate without a name is `q[0]`, in "m or rad". Forces whose unit
    depends on that, and friction along a displacement other than a sum or difference of coordinates, are in "N or N m".
    Other names have no unit.

    **Returns:**

    A `Quantity` of name and unit.
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
    """The series by its name in functions and by its own name, as in `q[1] (theta)`.

    **Returns:**

    The text.
    """
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
    if isinstance(effect, Friction):
        unit = slip_unit(scene, effect)
    else:
        unit = "m" if getattr(effect, "at", None) is not None else _coordinate(scene, index).unit
    return _FORCES.get(unit, f"J/{unit}")


def slip_unit(scene: Scene, friction: Friction) -> str:
    """Unit of the displacement that friction acts along: that of its coordinates if it is their sum or difference."""
    units = [read_label(text).unit for text in scene.coordinates]
    if friction.along is None or not units:
        return units[0] if units else "m or rad"
    q, params, along = jnp.linspace(0.3, 0.7, len(units)), scene.bind_time(jnp.zeros(())).params, friction.along
    if jax.eval_shape(along, q, params).shape != ():
        return "m"
    slopes = jax.jacfwd(along)(q, params)
    if not is_known(slopes):
        return "m or rad"
    within = {unit for unit, slope in zip(units, slopes, strict=True) if slope != 0}
    return (
        within.pop() if len(within) == 1 and bool(jnp.isin(slopes, jnp.asarray([-1.0, 0.0, 1.0])).all()) else "m or rad"
    )


def in_units_of(scene: Scene, effect: AbstractEffect, allowed: Range) -> Range:
    """The range of a number of an effect: in N m and rad for friction about an axis, per newton under a load."""
    if not isinstance(effect, Friction):
        return allowed
    if effect.normal_force is not None:
        return replace(allowed, unit=f"{allowed.unit} per N") if allowed.unit.startswith("N") else allowed
    return replace(allowed, unit=axis_unit(allowed.unit, slip_unit(scene, effect) == "rad"))
