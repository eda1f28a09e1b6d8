"""A block that rocks from edge to edge on a rough floor."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxmodsim.friction import Coulomb
from jaxmodsim.mechanics import Contact
from jaxmodsim.scene import Friction, Scene

# Mass [kg], half width and half height [m], coefficient of friction, gravity [m/s^2].
PARAMS = {"m": 2.0, "b": 0.05, "h": 0.5, "mu": 0.8, "g": 9.81}


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    inertia = p["m"] * (p["b"] ** 2 + p["h"] ** 2) / 3.0
    return 0.5 * p["m"] * (qd[0] ** 2 + qd[1] ** 2) + 0.5 * inertia * qd[2] ** 2 - p["m"] * p["g"] * q[1]


def _left(q: Array, p: dict[str, Array]) -> Array:
    return jnp.stack([q[0], q[1]]) - _turned(q[2], p["b"], p["h"])


def _right(q: Array, p: dict[str, Array]) -> Array:
    return jnp.stack([q[0], q[1]]) + _turned(q[2], p["b"], -p["h"])


def _turned(angle: Array, x: Array, y: Array) -> Array:
    """A vector of the block, turned clockwise by the angle."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * x + s * y, c * y - s * x])


def _left_along(q: Array, p: dict[str, Array]) -> Array:
    return _left(q, p)[0]


def _right_along(q: Array, p: dict[str, Array]) -> Array:
    return _right(q, p)[0]


def _height(t: Array, x: Array, p: dict[str, Array]) -> Array:
    return x[1]


def scene(
    *,
    m: ArrayLike = PARAMS["m"],
    b: ArrayLike = PARAMS["b"],
    h: ArrayLike = PARAMS["h"],
    mu: ArrayLike = PARAMS["mu"],
    g: ArrayLike = PARAMS["g"],
) -> Scene:
    """A uniform block over a floor, which its lower edges, `left` and `right`, strike without a bounce.

    The coordinates are the place (x, y) of its centre [m], y upwards from the floor, and the angle f [rad] by which it
    leans to the right. States on an edge: `state`.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `b`, `h`: half of its width and of its height [m], > 0.
    - `mu`: coefficient of friction at the edges; they do not slip where it is large enough.
    - `g`: gravity [m/s^2], > 0.
    """
    left, right = (Contact(_height, at=at, name=name) for at, name in ((_left, "left"), (_right, "right")))
    friction = (
        Friction(Coulomb(mu), along=_left_along, normal_force="left", name="left_friction"),
        Friction(Coulomb(mu), along=_right_along, normal_force="right", name="right_friction"),
    )
    params = {"m": m, "b": b, "h": h, "g": g}
    names = ("x [m]", "y [m]", "angle [rad]")
    return Scene(_lagrangian, params=params, effects=friction, constraints=(left, right), coordinates=names)


def state(
    angle: float, *, b: float = PARAMS["b"], h: float = PARAMS["h"]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Coordinates and velocities of the block at rest on its right edge, at x = b, leaning by `angle` [rad], >= 0."""
    edge = _right(jnp.asarray([0.0, 0.0, angle]), {"b": jnp.asarray(b), "h": jnp.asarray(h)})
    return jnp.stack([b - edge[0], -edge[1], jnp.asarray(angle, edge.dtype)]), jnp.zeros(3)


def speed_ratio(*, b: ArrayLike = PARAMS["b"], h: ArrayLike = PARAMS["h"]) -> Float[Array, ""]:
    """Angular velocity after the block has come down on its other edge, over that before: `1 - 3/2 sin(alpha)^2`.

    The angular momentum about that edge is kept; alpha is the angle with `tan(alpha) = b/h`. (G. W. Housner, The
    behavior of inverted pendulum structures during earthquakes, Bulletin of the Seismological Society of America
    53:403, 1963, equation 8 with the inertia of a block.)
    """
    b, h = jnp.asarray(b), jnp.asarray(h)
    return 1.0 - 1.5 * b**2 / (b**2 + h**2)


def quarter_period(
    angle: ArrayLike, *, b: ArrayLike = PARAMS["b"], h: ArrayLike = PARAMS["h"], g: ArrayLike = PARAMS["g"]
) -> Float[Array, ""]:
    """Time [s] from rest at `angle` [rad] until the other edge strikes: `arccosh(1/(1 - angle/alpha))/p`.

    With `p^2 = 3 g/(4 R)`, R half of the diagonal; for slender blocks, as it has alpha - angle in the place of its sine
    (Housner 1963, equation 5).
    """
    b, h = jnp.asarray(b), jnp.asarray(h)
    alpha = jnp.arctan2(b, h)
    return jnp.arccosh(1.0 / (1.0 - angle / alpha)) / jnp.sqrt(0.75 * g / jnp.hypot(b, h))
