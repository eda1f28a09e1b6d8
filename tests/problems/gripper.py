"""A gripper that catches a falling object between two fingers, and holds it."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxmodsim.friction import Coulomb
from jaxmodsim.mechanics import Contact
from jaxmodsim.scene import AppliedForce, Friction, Scene

# Masses of the object and of a finger [kg], grip force of a finger [N], way of a finger [m], speed of the object at the
# start [m/s], coefficient of friction, gravity [m/s^2].
PARAMS = {"m": 0.2, "finger": 0.05, "grip": 8.0, "d": 0.01, "v0": 1.0, "mu": 0.4, "g": 9.81}


class Catch(NamedTuple):
    """How the object is caught.

    - `strikes`: when the fingers strike it [s].
    - `speed`: of the object after that [m/s], downwards.
    - `stops`: when it is held [s]; infinite where friction is too weak, `2 mu grip <= m g`.
    - `depth`: how far it has fallen until then [m].
    """

    strikes: Float[Array, ""]
    speed: Float[Array, ""]
    stops: Float[Array, ""]
    depth: Float[Array, ""]


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return p["finger"] * qd[0] ** 2 + 0.5 * p["m"] * qd[1] ** 2 + p["m"] * p["g"] * q[1]


def _grip(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.stack([-2.0 * p["grip"], 0.0 * p["grip"]])


def _gap(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[0]


def _down(q: Array) -> Array:
    return q[1]


def scene(
    *,
    m: ArrayLike = PARAMS["m"],
    finger: ArrayLike = PARAMS["finger"],
    grip: ArrayLike = PARAMS["grip"],
    mu: ArrayLike = PARAMS["mu"],
    g: ArrayLike = PARAMS["g"],
) -> Scene:
    """Two fingers that close symmetrically on an object that falls between them.

    The coordinates are the distance of either finger from the object and the depth to which the object has fallen [m].
    Begin at `[d, 0]` with the velocities `[0, v0]`.

    **Arguments:**

    - `m`, `finger`: masses of the object and of one finger [kg], > 0.
    - `grip`: force of one finger [N], > 0.
    - `mu`: coefficient of Coulomb friction, >= 0.
    - `g`: gravity [m/s^2], > 0.

    **Returns:**

    A `Scene` with the contact `fingers`, whose multiplier is the sum of both normal forces [N], and the effect
    `friction` on the object, that of both fingers.
    """
    return Scene(
        _lagrangian,
        params={"m": m, "finger": finger, "grip": grip, "g": g},
        effects=(AppliedForce(_grip, name="grip"), Friction(Coulomb(mu), along=_down, normal_force="fingers")),
        constraints=(Contact(_gap, name="fingers"),),
        coordinates=("opening [m]", "depth [m]"),
    )


def catch(
    *,
    m: ArrayLike = PARAMS["m"],
    finger: ArrayLike = PARAMS["finger"],
    grip: ArrayLike = PARAMS["grip"],
    d: ArrayLike = PARAMS["d"],
    v0: ArrayLike = PARAMS["v0"],
    mu: ArrayLike = PARAMS["mu"],
    g: ArrayLike = PARAMS["g"],
) -> Catch:
    """When and where the object comes to rest.

    The impulses that stop the fingers are those of the grip until then, and brake the object by mu times as much, by
    Coulomb's law for impulses: in the end as if the fingers had held it from the start, with `2 mu grip - m g`.

    **Arguments:**

    - `d`: way of a finger to the object [m], > 0.
    - `v0`: speed of the object at the start [m/s], downwards, >= 0.
    - the others as for `scene`.
    """
    m, grip, d = jnp.asarray(m, float), jnp.asarray(grip, float), jnp.asarray(d, float)
    strikes = jnp.sqrt(2.0 * d * finger / grip)
    braking = 2.0 * mu * grip / m - g
    speed = jnp.maximum(v0 - braking * strikes, 0.0)
    holds = braking > 0
    lasts = speed / jnp.where(holds, braking, 1.0)
    fallen = v0 * strikes + 0.5 * g * strikes**2
    return Catch(
        strikes,
        speed,
        jnp.where(holds, strikes + lasts, jnp.inf),
        jnp.where(holds, fallen + 0.5 * speed * lasts, jnp.inf),
    )
