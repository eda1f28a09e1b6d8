"""A ball on a vibrating table: its bounces of the period of the table have a closed form."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxmodsim.mechanics import Contact
from jaxmodsim.problems.bouncing_ball import falling
from jaxmodsim.scene import Scene

# Numbers for which there is a bounce a period; stable it is for A below 0.90 mm.
PARAMS = {"m": 0.1, "g": 9.81, "A": 1e-3, "omega": 120.0, "e": 0.6}


def _gap(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[0] - p["A"] * jnp.sin(p["omega"] * t)


def scene(
    *,
    m: ArrayLike = PARAMS["m"],
    g: ArrayLike = PARAMS["g"],
    A: ArrayLike = PARAMS["A"],
    omega: ArrayLike = PARAMS["omega"],
    e: ArrayLike = PARAMS["e"],
) -> Scene:
    """A ball at the height `q[0]` [m] over a table at `A sin(omega t)`.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `g`: gravity [m/s^2], > 0.
    - `A`, `omega`: amplitude [m] and angular frequency [rad/s] of the table, > 0.
    - `e`: coefficient of restitution, 0 to 1.
    """
    contact = Contact(_gap, restitution=e, name="table")
    return Scene(falling, params={"m": m, "g": g, "A": A, "omega": omega}, constraints=(contact,))


def bounce_phase(
    *,
    g: ArrayLike = PARAMS["g"],
    A: ArrayLike = PARAMS["A"],
    omega: ArrayLike = PARAMS["omega"],
    e: ArrayLike = PARAMS["e"],
) -> Float[Array, ""]:
    """Phase [rad] of the table, 0 to pi/2, at which a ball strikes it once a period, again and again.

    The ball leaves with `g T/2` and comes back with `-g T/2` after the period `T = 2 pi/omega`, and Newton's law of
    impact for the velocities relative to the table gives `cos(phase) = pi g (1 - e)/((1 + e) A omega^2)`; NaN where
    that is above one. Arguments as for `scene`.
    """
    return jnp.arccos(jnp.pi * g * (1.0 - e) / ((1.0 + e) * A * jnp.square(omega)))
