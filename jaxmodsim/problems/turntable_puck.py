"""A puck on a turntable that spins up: dry friction in the plane lets it go at a speed in closed form."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..friction import Coulomb
from ..scene import Friction, Scene

# Mass [kg], angular acceleration [rad/s^2], gravity [m/s^2], radius of the puck [m], coefficient of friction.
PARAMS = {"m": 0.5, "alpha": 0.8, "g": 9.81, "r0": 0.5, "mu": 0.3}


class BreakAway(NamedTuple):
    """When the puck begins to slip.

    - `t`: time [s].
    - `angle`: of the turntable since t = 0 [rad].
    - `direction`: of the slip, from the radius, against the rotation [rad].
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
    """Puck on a turntable at the speed `alpha t`, in coordinates that turn with it.

    **Arguments:**

    - `law`: friction law per newton of load; by default `Coulomb(mu)` of `PARAMS`.
    - `ellipse`: friction across over friction along the first coordinate; see `Friction`.

    **Returns:**

    A `Scene` with the position [m] on the turntable for coordinates and the effect `friction`. Begin at rest at
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
    """Where the load in stick, `m r sqrt(w^4 + alpha^2)` of centrifugal and Euler acceleration, reaches `mu m g`.

    **Arguments:**

    - `mu`: static coefficient of friction, > alpha r0/g: otherwise the puck slips from the start, and t is NaN.
    - `alpha`: angular acceleration [rad/s^2], > 0.
    - `r0`: radius of the puck [m], > 0.
    - `g`: gravity [m/s^2], > 0.
    """
    w = ((jnp.asarray(mu) * g / r0) ** 2 - jnp.asarray(alpha) ** 2) ** 0.25
    return BreakAway(w / alpha, 0.5 * w * w / alpha, jnp.arctan2(jnp.asarray(alpha), w * w))
