"""Laws as components of the Modelica Standard Library and of MuJoCo."""

import math
from xml.sax.saxutils import quoteattr

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core.functions import need_values
from ..friction import AbstractForceLaw, AbstractLaw, AbstractSetValuedLaw, Geared

# Number of speeds at which the table is compared with the law, spaced logarithmically over so many decades, and evenly.
_POINTS, _DECADES = 6000, 12
# Used fraction of the tolerance; the rest allows for errors between those speeds.
_SHARE = 0.9
# The hardest setting of MuJoCo's dry friction; the default creeps a thousand times faster.
_HARD = "0.9999 0.9999 0.001"

Table = Float[np.ndarray, "row width"]


def to_modelica(
    law: AbstractLaw, v_max: float, *, name: str = "friction", rtol: float = 1e-3, rotary: bool = False
) -> str:
    """Declare the friction component of the Modelica Standard Library for a law.

    `SupportFriction` (translational) and `BearingFriction` (rotational) are set-valued laws, simulated exactly by
    events. They have a table of the sliding force over the speed, interpolated linearly, and the static limit as a
    multiple (`peak`) of the first force of the table. The rows of the table follow the curvature of the law.

    `Geared` becomes a `LossyGear` of ratio 1, whose efficiencies and bearing friction over the speed are the same law.
    The component computes the transmitted torque itself, so `torque` is not exported.

    **Arguments:**

    - `law`: `Coulomb`, `Stribeck` or another set-valued law, the same in both directions, or `Viscous`; for a rotary
      axis also `Geared`, without stiction and with back-driving coefficients below one.
    - `v_max`: speed up to which the table follows the law [m/s or rad/s], > 0; the component extends its last segment.
    - `name`: name of the component, a Modelica identifier.
    - `rtol`: largest relative error of the interpolated force, > 0 and < 1.
    - `rotary`: whether the axis is rotary.

    **Returns:**

    One declaration, for a model of the library's versions 3 and 4.

    **Raises:**

    - `ValueError` if the component does not support the law, with the reason and the remedy; for a law by `scaled_by`;
      if a number is out of range or the name is not an identifier.

    **Example:**

    ```python
    print(jms.to_modelica(jms.Coulomb(Fc=5.0, Fs=8.0), v_max=1.0))
    ```

    ```text
    Modelica.Mechanics.Translational.Components.SupportFriction friction(f_pos=[0, 5; 1, 5], peak=1.6);
    ```
    """
    if not isinstance(law, AbstractLaw):
        raise ValueError(f"to_modelica needs a law, but {law!r} was given.")
    if not isinstance(law, Geared):
        need_values(law, "to_modelica")
    if not 0 < v_max < math.inf or not 0 < rtol < 1:
        raise ValueError(f"to_modelica needs v_max > 0 [m/s] and 0 < rtol < 1; given: {v_max=}, {rtol=}.")
    if not (name.isidentifier() and name.isascii()):
        raise ValueError(f"to_modelica: name must be an identifier such as 'friction1', but {name!r} was given.")
    speeds = np.concatenate(
        [[0.0], np.geomspace(v_max * 10.0**-_DECADES, v_max, _POINTS), np.linspace(0.0, v_max, _POINTS)[1:-1]]
    )
    speeds = np.unique(speeds)
    if isinstance(law, Geared):
        table = _lossy_gear(law, speeds, rtol, rotary)
        return f"Modelica.Mechanics.Rotational.Components.LossyGear {name}(ratio=1, lossTable=[{table}]);"
    forward, limit = _both_ways(law, speeds)
    level = forward[0]
    peak = max(limit / level, 1.0) if level > 0 else 1.0
    rows = _written(_table(speeds, forward[:, None], rtol))
    kind, table = ("Rotational", "tau_pos") if rotary else ("Translational", "f_pos")
    component = "BearingFriction" if rotary else "SupportFriction"
    return f"Modelica.Mechanics.{kind}.Components.{component} {name}({table}=[{rows}], peak={peak:.10g});"


def _both_ways(law: AbstractLaw, speeds: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], float]:
    """Sliding force [N], the same in both directions, and the static limit."""
    lacks = law.modelica()
    if lacks or not isinstance(law, AbstractSetValuedLaw | AbstractForceLaw):
        raise ValueError(f"to_modelica: Modelica's friction components have no {lacks or type(law).__name__}.")
    forward, backward = _forces(law, speeds), -_forces(law, -speeds)
    limits = [forward[0], backward[0]]
    if isinstance(law, AbstractSetValuedLaw):
        limits = [float(law.static_limit(jnp.asarray(side))) for side in (1.0, -1.0)]
    if not np.allclose([limits[0], *forward], [limits[1], *backward], rtol=1e-6, atol=0.0):
        raise ValueError(
            "to_modelica: Modelica's friction components do not support friction that depends on the direction: export"
            " the law of one direction, or the mean of both."
        )
    level, limit = forward[0], float(limits[0])
    # Stribeck's level is Fc + (Fs - Fc), which rounding can put above Fs.
    below = limit < level and not np.isclose(limit, level, rtol=1e-6, atol=0.0)
    if not np.isfinite(forward).all() or below or (level == 0 and limit > 0):
        raise ValueError(
            "to_modelica: the static limit must be at least the sliding force at v = 0, which must be > 0 if the limit"
            f" is, and all forces finite, but the limit is {limit:g} N and the sliding force {level:g} N."
        )
    return forward, limit


def _lossy_gear(law: Geared, speeds: Float[np.ndarray, " n"], rtol: float, rotary: bool) -> str:
    """Rows of speed, efficiencies for driving and back-driving, and bearing friction in either case.

    With the torque u on the motor side, the component loses `(1 - eta1) u + tau1` when driving and
    `(1 - 1/eta2) u + tau2` when driven back. This is `F0 + mu |u - F|` for `eta1 = 1/(1 + mu_drive)`,
    `tau1 = eta1 F0`, `eta2 = 1 - mu_back`, `tau2 = F0/eta2`.
    """
    parts = [law.law, law.drive, law.drive if law.back is None else law.back]
    for part in parts:
        need_values(part, "to_modelica")
    (idle, rest), (drive, drive_rest), (back, back_rest) = (_both_ways(part, speeds) for part in parts)
    held, slides = np.array([rest, drive_rest, back_rest]), np.array([idle[0], drive[0], back[0]])
    if not rotary or not np.allclose(held, slides, rtol=1e-6, atol=0.0) or np.max(back) >= 1.0:
        raise ValueError(
            "to_modelica: LossyGear needs rotary=True, no stiction (Fs = Fc) and no self-locking (back-driving"
            f" coefficients below 1), but {rotary=}, the static limits are {held}, the sliding forces {slides} and the"
            f" back-driving coefficients up to {np.max(back):g}."
        )
    drives, driven = 1.0 / (1.0 + drive), 1.0 - back
    return _written(_table(speeds, np.stack([drives, driven, drives * idle, idle / driven], axis=1), rtol))


def _forces(law: AbstractSetValuedLaw | AbstractForceLaw, v: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Sliding force [N]; at rest its limit for small positive speeds."""
    if isinstance(law, AbstractForceLaw):
        return np.asarray(jax.vmap(law.force)(jnp.asarray(v)), float)
    side = np.where(np.signbit(v), -1.0, 1.0)
    return side * np.asarray(jax.vmap(law.sliding_force)(jnp.asarray(v)), float) + np.asarray(
        jax.vmap(law.viscous_force)(jnp.asarray(v)), float
    )


def _table(v: Float[np.ndarray, " n"], values: Float[np.ndarray, "n column"], rtol: float) -> Table:
    """Rows (v, values), as far apart as linear interpolation between them stays within the tolerance."""
    rows, last = [0], v.size - 1
    while rows[-1] < last:
        start = rows[-1]
        # Bisection: the tolerance holds up to `near`, and not up to `far`.
        near, far = start + 1, start + 2
        while far < last and _straight(v, values, start, far, rtol):
            near, far = far, start + 2 * (far - start)
        far = min(far, last + 1)
        if far > last and _straight(v, values, start, last, rtol):
            near = last
        while far - near > 1:
            middle = (near + far) // 2
            near, far = (middle, far) if _straight(v, values, start, middle, rtol) else (near, middle)
        rows.append(near)
    return np.concatenate([v[rows, None], values[rows]], axis=1)


def _straight(
    v: Float[np.ndarray, " n"], values: Float[np.ndarray, "n column"], i: int, j: int, rtol: float
) -> Bool[np.ndarray, ""] | np.bool_:
    """Whether linear interpolation between two rows is within the tolerance."""
    between = slice(i, j + 1)
    line = values[i] + (values[j] - values[i]) * ((v[between, None] - v[i]) / (v[j] - v[i]))
    return np.all(np.abs(line - values[between]) <= _SHARE * rtol * np.abs(values[between]))


def _written(table: Table) -> str:
    return "; ".join(", ".join(f"{x:.10g}" for x in row) for row in table)


def to_mujoco(law: AbstractLaw, joint: str = "joint") -> str:
    """MJCF, the XML of MuJoCo, for a law on a hinge or slide joint.

    `Viscous`, `Coulomb` without stiction and `Stribeck` with Fs = Fc become an element `joint`, whose attributes belong
    on the joint of that name. `LuGre` and `Dahl` become an element `actuator` for the model: a motor without input or
    current, which has the same LuGre friction (MuJoCo 4.0 or later). For a mass under a force ramp, MuJoCo agrees with
    `simulate` to first order in its step.

    MuJoCo's dry friction is a soft constraint: a sticking joint creeps in proportion to the load. `solimpfriction` sets
    the hardest constraint, and is optional.

    **Arguments:**

    - `law`: the law.
    - `joint`: name of the joint in the model.

    **Returns:**

    One XML element.

    **Raises:**

    - `ValueError` if MuJoCo does not support the law, with the reason and the remedy; for a law by `scaled_by`.

    **Example:**

    ```python
    print(jms.to_mujoco(jms.Coulomb(Fc=1.5), joint="slide"))
    ```

    ```text
    <joint name="slide" frictionloss="1.5" solimpfriction="0.9999 0.9999 0.001"/>
    ```
    """
    if not isinstance(law, AbstractLaw):
        raise ValueError(f"to_mujoco needs a law, but {law!r} was given.")
    need_values(law, "to_mujoco")
    numbers = law.mujoco()
    if isinstance(numbers, str):
        raise ValueError(f"to_mujoco: MuJoCo has no {numbers}.")
    return _motor(joint, **numbers) if "lugre" in numbers else _joint(joint, **numbers)


def _joint(name: str, **numbers: Array) -> str:
    values = {key: float(value) for key, value in numbers.items()}
    attributes = [f'{key}="{value!r}"' for key, value in values.items()]
    if values.get("frictionloss"):
        attributes.append(f'solimpfriction="{_HARD}"')
    return f"<joint name={quoteattr(name)} {' '.join(attributes)}/>"


def _motor(joint: str, damping: float | Array, lugre: tuple[float | Array, ...]) -> str:
    bristle = " ".join(repr(float(x)) for x in lugre)
    return (
        "<actuator>\n"
        f'  <dcmotor name={quoteattr(joint + "_friction")} joint={quoteattr(joint)} input="none"'
        f' resistance="1" motorconst="0"\n'
        f'           damping="{float(damping)!r}" lugre="{bristle}"/>\n'
        "</actuator>"
    )
