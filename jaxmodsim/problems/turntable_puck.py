"""A puck on an accelerating turntable, with dry friction in the plane and a break-away speed in closed form."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..friction import Coulomb
from ..scene import Friction, Scene

# Mass [kg], angular acceleration [rad/s^2], gravity [m/s^2], initial radius of the puck [m], friction coefficient.
PARAMS = {"m": 0.5, "alpha": 0.8, "g": 9.81, "r0": 0.5, "mu": 0.3}


class BreakAway(NamedTuple):
    """The beginning of slip.

    - `t`: time [s].
    - `angle`: rotation of the turntable since t = 0 [rad].
    - `direction`: angle of the slip from the radius, against the rotation [rad].
    """

    t: Float[Array, "..."]
    angle: Float[Array, "..."]
    direction: Float[Array, "..."]


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    v = qd + p["alpha"] * t * jnp.stack([-q[1], q[0]])
    return 0.5 * p["m"] * jnp.sum(v * v)


def _place(q: Array) -> Array:
    return q


def _load(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return p["m"] * p["g"]


def scene(law: object = None, *, ellipse: ArrayLike | None = None) -> Scene:
    """Puck on a turntable at the angular velocity `alpha t`, in coordinates that rotate with it.

    **Arguments:**

    - `law`: friction law per newton of load; None for `Coulomb(mu)` with `PARAMS`.
    - `ellipse`: ratio of friction across to friction along the first coordinate; see `Friction`.

    **Returns:**

    A `Scene` with the position on the turntable [m] as coordinates and the effect `friction`. Start at rest at
    `[r0, 0]`.
    """
    friction = Friction(
        Coulomb(PARAMS["mu"]) if law is None else law, along=_place, normal_force=_load, ellipse=ellipse
    )
    params = {name: PARAMS[name] for name in ("m", "alpha", "g")}
    return Scene(_lagrangian, params=params, effects=(friction,), coordinates=("x [m]", "y [m]"))


def break_away(
    mu: ArrayLike = PARAMS["mu"],
    alpha: ArrayLike = PARAMS["alpha"],
    r0: ArrayLike = PARAMS["r0"],
    g: ArrayLike = PARAMS["g"],
) -> BreakAway:
    """The time at which the inertial force in stick, `m r sqrt(w^4 + alpha^2)`, reaches `mu m g`.

    **Arguments:**

    - `mu`: coefficient of static friction, > alpha r0/g. Otherwise the puck slips from the start, and t is NaN.
    - `alpha`: angular acceleration [rad/s^2], > 0.
    - `r0`: distance of the puck from the axis [m], > 0.
    - `g`: gravity [m/s^2], > 0.

    **Returns:**

    A `BreakAway`.
    """
    w = ((jnp.asarray(mu) * g / r0) ** 2 - jnp.asarray(alpha) ** 2) ** 0.25
    return BreakAway(w / alpha, 0.5 * w * w / alpha, jnp.arctan2(jnp.asarray(alpha), w * w))
