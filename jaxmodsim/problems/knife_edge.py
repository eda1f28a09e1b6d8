"""A blade on an inclined plane that cannot slip sideways, and moves across the plane on cycloids."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..mechanics import VelocityConstraint, rigid_body
from ..scene import Scene

# Mass [kg], moment of inertia [kg m^2], slope of the plane [rad], gravity [m/s^2].
PARAMS = {"m": 1.3, "I": 0.2, "slope": 0.4, "g": 9.81}


def _place(q: Array, p: dict[str, Array]) -> Array:
    return jnp.stack([q[0] * jnp.cos(p["slope"]), q[1], -q[0] * jnp.sin(p["slope"])])


def _sideways(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.cos(q[2]) * qd[1] - jnp.sin(q[2]) * qd[0]


_BLADE = rigid_body(lambda p: p["m"], lambda p: p["I"], _place, lambda q: q[2], lambda p: p["g"])


def scene(
    *,
    m: ArrayLike = PARAMS["m"],
    I: ArrayLike = PARAMS["I"],
    slope: ArrayLike = PARAMS["slope"],
    g: ArrayLike = PARAMS["g"],
) -> Scene:
    """Blade on a smooth inclined plane that turns freely and slides along its edge only.

    The coordinates are the position of its centre of mass and contact, x down the plane and y across [m], and the
    heading h [rad], with the edge in the direction (cos(h), sin(h)).

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `I`: moment of inertia about the normal of the plane [kg m^2], > 0.
    - `slope`: inclination of the plane [rad].
    - `g`: gravity [m/s^2].

    **Returns:**

    A `Scene` without effects. Its constraint `edge` has as multiplier the `force` [N] of the plane on the blade across
    the edge, positive to its left. `motion` has its exact motion.
    """
    edge = VelocityConstraint(_sideways, name="edge")
    return Scene(
        _BLADE,
        params={"m": m, "I": I, "slope": slope, "g": g},
        constraints=(edge,),
        coordinates=("x [m]", "y [m]", "heading [rad]"),
    )


def motion(
    t: Float[Array, "..."],
    *,
    turn: ArrayLike,
    speed: ArrayLike = 0.0,
    slope: ArrayLike = PARAMS["slope"],
    g: ArrayLike = PARAMS["g"],
) -> tuple[Float[Array, "... 3"], Float[Array, "... 3"]]:
    """Coordinates and velocities at the times `t` [s], after a start at the origin with the edge down the plane.

    The heading is w t. The acceleration along the edge is `b cos(w t)` with b = g sin(slope), so the speed is
    `v + (b/w) sin(w t)`, and `x = (b/(2 w^2)) sin(w t)^2 + (v/w) sin(w t)`,
    `y = (b/(2 w^2)) (w t - sin(w t) cos(w t)) + (v/w) (1 - cos(w t))`. From rest the path is a cycloid: the blade moves
    across the plane at the mean velocity `b/(2 w)`, and does not descend on average (A. M. Bloch, Nonholonomic
    Mechanics and Control, 2003, section 1.6).

    **Arguments:**

    - `t`: times [s].
    - `turn`: rate of the heading w [rad/s], not zero.
    - `speed`: initial speed v along the edge [m/s].
    - `slope`, `g`: as for `scene`.

    **Returns:**

    (q, qd), each of the shape of `t` with an additional last axis of size 3.
    """
    b, w = g * jnp.sin(jnp.asarray(slope)), jnp.asarray(turn)
    sine, cosine = jnp.sin(w * t), jnp.cos(w * t)
    x = b / (2.0 * w**2) * sine**2 + speed / w * sine
    y = b / (2.0 * w**2) * (w * t - sine * cosine) + speed / w * (1.0 - cosine)
    along = speed + b / w * sine
    return jnp.stack([x, y, w * t], axis=-1), jnp.stack([along * cosine, along * sine, w + 0.0 * t], axis=-1)


def acceleration(
    q: Float[Array, "3"], qd: Float[Array, "3"], *, slope: ArrayLike = PARAMS["slope"], g: ArrayLike = PARAMS["g"]
) -> Float[Array, "3"]:
    """Accelerations [m/s^2, rad/s^2] in closed form: `b cos(h)` along the edge and `u h'` across, h'' = 0.

    **Arguments:**

    - `q`, `qd`: (x, y, h) and their rates, shape `[3]`; the velocity u is along the edge.
    - `slope`, `g`: as for `scene`.

    **Returns:**

    The accelerations of (x, y, h), shape `[3]`.
    """
    sine, cosine = jnp.sin(q[2]), jnp.cos(q[2])
    u = cosine * qd[0] + sine * qd[1]
    along, across = g * jnp.sin(jnp.asarray(slope)) * cosine, u * qd[2]
    return jnp.stack([along * cosine - across * sine, along * sine + across * cosine, 0.0 * u])


def force(
    q: Float[Array, "3"],
    qd: Float[Array, "3"],
    *,
    m: ArrayLike = PARAMS["m"],
    slope: ArrayLike = PARAMS["slope"],
    g: ArrayLike = PARAMS["g"],
) -> Float[Array, ""]:
    """Force [N] of the plane across the edge, positive to its left: `m (u h' + g sin(slope) sin(h))`.

    Arguments as for `acceleration`, `m` [kg], > 0.

    **Returns:**

    The force, shape `[]`.
    """
    u = jnp.cos(q[2]) * qd[0] + jnp.sin(q[2]) * qd[1]
    return jnp.asarray(m) * (u * qd[2] + g * jnp.sin(jnp.asarray(slope)) * jnp.sin(q[2]))
