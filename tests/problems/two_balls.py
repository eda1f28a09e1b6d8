"""Two balls on a line, one of which strikes the other."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxmodsim.mechanics import Contact
from jaxmodsim.scene import Scene

# Masses [kg], diameter [m], coefficient of restitution.
PARAMS = {"m1": 1.0, "m2": 1.0, "d": 0.1, "e": 1.0}


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m1"] * qd[0] ** 2 + 0.5 * p["m2"] * qd[1] ** 2


def _gap(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[1] - q[0] - p["d"]


def scene(
    *,
    m1: ArrayLike = PARAMS["m1"],
    m2: ArrayLike = PARAMS["m2"],
    d: ArrayLike = PARAMS["d"],
    e: ArrayLike = PARAMS["e"],
) -> Scene:
    """Balls with their centres at `q[0] < q[1]` [m]; their contact is called `balls`.

    **Arguments:**

    - `m1`, `m2`: masses [kg], > 0.
    - `d`: diameter [m], > 0.
    - `e`: coefficient of restitution, 0 to 1.
    """
    contact = Contact(_gap, restitution=e, name="balls")
    return Scene(_lagrangian, params={"m1": m1, "m2": m2, "d": d}, constraints=(contact,))


def motion(
    t: ArrayLike,
    q0: Float[Array, "2"],
    qd0: Float[Array, "2"],
    *,
    m1: ArrayLike = PARAMS["m1"],
    m2: ArrayLike = PARAMS["m2"],
    d: ArrayLike = PARAMS["d"],
    e: ArrayLike = PARAMS["e"],
) -> Float[Array, "2"]:
    """Places [m] at the time `t` [s], which is after the impact.

    By conservation of momentum and Newton's law of impact. Equal balls with e = 1 exchange their velocities, so that
    each ends where the other would, less or more the diameter: the derivatives of the places by those at the start are
    `[[0, 1], [1, 0]]`.

    **Arguments:**

    - `q0`, `qd0`: places and velocities at t = 0, the first ball approaching the second.
    - `m1`, `m2`, `d`, `e`: as for `scene`.
    """
    m1, m2 = jnp.asarray(m1), jnp.asarray(m2)
    closing = qd0[0] - qd0[1]
    strikes = (q0[1] - q0[0] - d) / closing
    impulse = (1.0 + e) * m1 * m2 / (m1 + m2) * closing
    change = jnp.stack([-impulse / m1, impulse / m2])
    return q0 + qd0 * t + change * (t - strikes)
