"""Models of one axis: mass, offset and friction, with start values from the record itself."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._core.parameters import ranges_of
from ...friction import AbstractLaw, Coulomb, Viscous, asymmetric, laws
from ...scene import AbstractEffect, AppliedForce, Friction, Scene, replace_numbers
from ..data._record import Record
from ..data._signals import MOVING, differentiate, smooth, smooth_span, without_outliers

# Share of the variance of a force below which a regression explains it well enough to detect a wrong sign.
_EXPLAINED = 0.5
# Friction as a share of the root mean square of the force, if the regression gives no positive number.
_FRICTION_SHARE = 0.1


def _axis_lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    del t, q
    return 0.5 * p["m"] * qd[0] ** 2


def _drive(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    del t, q, qd
    return jnp.reshape(p["u"] - p["offset"], (1,))


@dataclass(frozen=True)
class AxisEstimate:
    """First estimates of an axis.

    - `m`: mass [kg]. `Fv`, `Fc`: viscous [N s/m] and Coulomb friction [N]. `offset`: constant force [N].
    - `top`: largest speed [m/s]. `start`: first time of the record [s].
    """

    m: float
    Fv: float
    Fc: float
    offset: float
    top: float
    start: float = 0.0


def estimate_axis(record: Record) -> AxisEstimate:
    """Start values of a fit, by linear regression of the force on acceleration, velocity and its sign.

    Positions are smoothed before they are differentiated.

    **Arguments:**

    - `record`: of one position [m or rad], with the input `u` [N or N m].

    **Returns:**

    An `AxisEstimate`.

    **Raises:**

    - `ValueError` naming the record, if the position or the force never changes, or if the force has the wrong sign:
      mass and friction would be negative.
    """
    for column, what in ((record.measured, "position"), (record.inputs["u"], "force")):
        if np.ptp(column) == 0.0:
            raise ValueError(
                f"{record.name}: the {what} never changes (it is {column[0]:g} throughout), so nothing can be fitted:"
                " mass and friction show in the motion under a force that changes. Is it the right column?"
            )
    motion, span = differentiate(record.t, without_outliers(record.measured)), smooth_span(len(record.t))
    v, a, u = (x[motion.inside] for x in (motion.v, motion.a, smooth(record.inputs["u"], span)))
    top = float(np.max(np.abs(v)))
    moving = np.abs(v) > MOVING * top
    columns = np.column_stack([a, v, np.sign(v), np.ones_like(v)])[moving]
    m, Fv, Fc, offset = weights = np.linalg.lstsq(columns, u[moving], rcond=None)[0]
    dissipated = Fv * float(np.mean(v**2)) + Fc * float(np.mean(np.abs(v)))
    left = float(np.sum((u[moving] - columns @ weights) ** 2))
    if m < 0 and dissipated < 0 and left < _EXPLAINED * (len(columns) - 4) * np.var(u[moving]):
        raise ValueError(
            f"{record.name}: the force goes against the motion: the mass (or moment of inertia) would be {m:.3g}, and"
            f" friction would drive with {-dissipated:.3g} W. Force and position have opposite directions: change the"
            " sign of one of them (on the command line, --units force=-1)."
        )
    scale = float(np.sqrt(np.mean(u**2))) or 1.0
    return AxisEstimate(
        m if m > 0 else scale / max(float(np.max(np.abs(a))), 1e-12),
        Fv if Fv > 0 else _FRICTION_SHARE * scale / top,
        Fc if Fc > 0 else _FRICTION_SHARE * scale,
        float(offset),
        top,
        float(record.t[0]),
    )


@dataclass(frozen=True)
class AxisModel:
    """A model of an axis, `m q'' = u - offset + forces of its effects`.

    **Arguments:**

    - `effects`: the effects beside the drive, with start values from an estimate of the axis.
    - `free`: names of the numbers that are fitted.
    - `description`: for tables.
    - `params`: further entries of the scene's params that the effects read, by name, from an estimate of the axis.
    """

    effects: Callable[[AxisEstimate], tuple[AbstractEffect, ...]]
    free: tuple[str, ...]
    description: str
    params: Callable[[AxisEstimate], dict[str, float]] | None = None


# Models of more than one friction element.
_COMBINATIONS = {
    "coulomb": AxisModel(
        lambda estimate: (
            Friction(Coulomb(estimate.Fc), name="dry"),
            Friction(Viscous(estimate.Fv), name="viscous"),
        ),
        ("m", "offset", "dry.Fc", "viscous.Fv"),
        "Coulomb friction and viscous friction",
    ),
    "asymmetric": AxisModel(
        lambda estimate: (
            Friction(asymmetric(Coulomb(estimate.Fc), Fc=estimate.Fc), name="dry"),
            Friction(asymmetric(Viscous(estimate.Fv), Fv=estimate.Fv), name="viscous"),
        ),
        ("m", "dry.forward.Fc", "dry.backward.Fc", "viscous.forward.Fv", "viscous.backward.Fv"),
        "Coulomb and viscous friction, each with a value for either direction; a constant offset is part"
        " of the difference of the Coulomb forces, and is held at zero",
    ),
}


def axis_models() -> dict[str, AxisModel]:
    """Models of an axis by name: combinations of simple laws, and each registered law with start values for a fit.

    **Returns:**

    The models by name.
    """
    models = {name.lower(): _one_law(law) for name, law in laws().items()}
    return _COMBINATIONS | {name: model for name, model in models.items() if model is not None}


def _one_law(kind: type[AbstractLaw]) -> AxisModel | None:
    """The axis with one friction law; None for a law without start values."""
    example = kind.fit_start(1.0, 1.0, 1.0, 1.0)
    if example is None:
        return None

    def effects(estimate: AxisEstimate) -> tuple[AbstractEffect, ...]:
        law: Any = kind.fit_start(estimate.m, estimate.Fc, estimate.Fv, estimate.top)
        return (Friction(law, name="friction"),)

    numbers = [f"friction.{name}" for name, allowed in ranges_of(example).items() if not allowed.execution]
    return AxisModel(effects, ("m", "offset", *numbers), f"{kind.__name__}: {kind.description}")


def axis_scene(
    model: AxisModel,
    estimate: AxisEstimate,
    start: Mapping[str, float] | None = None,
    fixed: Mapping[str, float] | None = None,
) -> Scene:
    """Scene of an axis, `m q'' = u - offset - friction`, ready to be fitted.

    **Arguments:**

    - `model`: one of `axis_models()`.
    - `estimate`: start values, from `estimate_axis`.
    - `start`, `fixed`: other values by the names of `jaxmodsim.scene.scene_numbers`.

    **Returns:**

    A `Scene` whose `params` are `m` [kg], `offset` [N], the input `u` [N], and those of the model.
    """
    offset = estimate.offset if "offset" in model.free else 0.0
    params = {"m": estimate.m, "offset": offset, "u": 0.0, **(model.params(estimate) if model.params else {})}
    effects = (AppliedForce(_drive, name="drive"), *model.effects(estimate))
    scene = Scene(_axis_lagrangian, params=params, effects=effects)
    numbers = {**(start or {}), **(fixed or {})}
    return replace_numbers(scene, {name: jnp.asarray(x, float) for name, x in numbers.items()})
