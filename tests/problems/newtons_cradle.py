"""Newton's cradle: balls in a row that hang side by side, by Newton's law of impact."""

from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxmodsim.mechanics import Contact
from jaxmodsim.scene import Scene

# Mass of a ball [kg], length of the threads [m], gravity [m/s^2], coefficient of restitution.
PARAMS = {"m": 0.1, "l": 0.2, "g": 9.81, "e": 1.0}


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * (jnp.sum(qd**2) - p["g"] / p["l"] * jnp.sum(q**2))


def _gap(t: Array, q: Array, p: dict[str, Array], *, i: int) -> Array:
    return q[i + 1] - q[i] + p["gap"]


# Functions of a scene count by identity.
_GAPS = tuple(partial(_gap, i=i) for i in range(6))


def scene(
    balls: int = 3,
    *,
    gap: ArrayLike = 0.0,
    m: ArrayLike = PARAMS["m"],
    l: ArrayLike = PARAMS["l"],
    g: ArrayLike = PARAMS["g"],
    e: ArrayLike = PARAMS["e"],
) -> Scene:
    """Pendulums of small angles; the coordinates are the displacements [m] from where each hangs at rest.

    **Arguments:**

    - `balls`: how many, 2 to 7.
    - `gap`: distance between neighbours at rest [m], >= 0: they touch where it is zero.
    - `m`: mass of a ball [kg], > 0.
    - `l`: length of the threads [m], > 0.
    - `g`: gravity [m/s^2], > 0.
    - `e`: coefficient of restitution, 0 to 1.

    **Raises:**

    - `ValueError` for another number of balls.
    """
    if not 2 <= balls <= len(_GAPS) + 1:
        raise ValueError(f"balls must be 2 to {len(_GAPS) + 1}, but {balls} was given.")
    contacts = tuple(Contact(_GAPS[i], restitution=e, name=f"pair_{i + 1}") for i in range(balls - 1))
    return Scene(_lagrangian, params={"m": m, "l": l, "g": g, "gap": gap}, constraints=contacts)


def velocities_after(balls: int, v: ArrayLike, *, touching: bool, e: ArrayLike = PARAMS["e"]) -> Float[Array, " balls"]:
    """Velocities [m/s] after the first ball has struck the others, at rest, at `v`.

    Balls with gaps strike one after the other, before they swing: each goes on at `(1 - e)/2` of the speed it was
    struck with, and the next takes `(1 + e)/2` of it. Of balls that touch, Newton's law of impact makes all but the
    first go on as one body at `(1 + e) v/balls`: the gaps between them were closed before, and stay so. What is seen in
    the experiment is the former; the law cannot tell how an impulse runs through bodies that touch.

    **Arguments:**

    - `balls`: how many, >= 2.
    - `v`: speed of the first [m/s].
    - `touching`: whether the gaps are closed before.
    - `e`: coefficient of restitution, 0 to 1; with gaps 1, or the balls strike again.
    """
    e = jnp.asarray(e)
    if touching:
        together = (1.0 + e) * v / balls
        return jnp.full(balls, together).at[0].set(together - e * v)
    passed = v * ((1.0 + e) / 2.0) ** jnp.arange(balls)
    return jnp.append(passed[:-1] * (1.0 - e) / 2.0, passed[-1])
