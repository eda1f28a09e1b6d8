"""Stacked blocks, the lower one pulled ever harder: first both slide, then the upper one stays behind."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxmodsim.friction import Coulomb
from jaxmodsim.scene import AppliedForce, Friction, Scene

# Masses of the lower and the upper block [kg], coefficients of friction on the floor and between the blocks, rate of
# the pull [N/s], gravity [m/s^2].
PARAMS = {"m1": 2.0, "m2": 1.0, "mu1": 0.2, "mu2": 0.3, "rate": 5.0, "g": 9.81}


class Slips(NamedTuple):
    """When [s] the blocks begin to slide on the floor, `floor`, and on each other, `between`."""

    floor: Float[Array, ""]
    between: Float[Array, ""]


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m1"] * qd[0] ** 2 + 0.5 * p["m2"] * qd[1] ** 2


def _pull(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.stack([p["rate"] * t, 0.0 * t])


def _on_floor(q: Array) -> Array:
    return q[0]


def _between(q: Array) -> Array:
    return q[1] - q[0]


def scene(
    *,
    m1: ArrayLike = PARAMS["m1"],
    m2: ArrayLike = PARAMS["m2"],
    mu1: ArrayLike = PARAMS["mu1"],
    mu2: ArrayLike = PARAMS["mu2"],
    rate: ArrayLike = PARAMS["rate"],
    g: ArrayLike = PARAMS["g"],
) -> Scene:
    """Blocks at the places `q` [m], the lower one first, under the pull `rate t` [N] on the lower one.

    **Arguments:**

    - `m1`, `m2`: masses of the lower and the upper block [kg], > 0.
    - `mu1`, `mu2`: coefficients of Coulomb friction on the floor and between the blocks, >= 0.
    - `rate`: rate of the pull [N/s], > 0.
    - `g`: gravity [m/s^2], > 0.

    **Returns:**

    A `Scene` with the effects `pull`, `floor` and `between`. Begin at rest.
    """
    m1, m2, mu1, mu2, g = (jnp.asarray(x, float) for x in (m1, m2, mu1, mu2, g))
    return Scene(
        _lagrangian,
        params={"m1": m1, "m2": m2, "rate": rate},
        effects=(
            AppliedForce(_pull, name="pull"),
            Friction(Coulomb(mu1 * (m1 + m2) * g), along=_on_floor, name="floor"),
            Friction(Coulomb(mu2 * m2 * g), along=_between, name="between"),
        ),
        coordinates=("lower [m]", "upper [m]"),
    )


def slips(
    *,
    m1: ArrayLike = PARAMS["m1"],
    m2: ArrayLike = PARAMS["m2"],
    mu1: ArrayLike = PARAMS["mu1"],
    mu2: ArrayLike = PARAMS["mu2"],
    rate: ArrayLike = PARAMS["rate"],
    g: ArrayLike = PARAMS["g"],
) -> Slips:
    """When the blocks begin to slide: at the pulls `mu1 (m1 + m2) g` and `(mu1 + mu2) (m1 + m2) g`.

    The upper block can be accelerated by `mu2 g` and no more.
    """
    weight = (jnp.asarray(m1) + m2) * g
    return Slips(weight * mu1 / rate, weight * (jnp.asarray(mu1) + mu2) / rate)


def motion(
    t: ArrayLike,
    *,
    m1: ArrayLike = PARAMS["m1"],
    m2: ArrayLike = PARAMS["m2"],
    mu1: ArrayLike = PARAMS["mu1"],
    mu2: ArrayLike = PARAMS["mu2"],
    rate: ArrayLike = PARAMS["rate"],
    g: ArrayLike = PARAMS["g"],
) -> Float[Array, "2"]:
    """Places [m] at the time `t` [s] from rest at zero.

    Together the blocks have the acceleration `rate (t - floor)/(m1 + m2)`; after `between` the upper one keeps `mu2 g`,
    and the lower one gains `rate/m1` a second.
    """
    numbers = {"m1": m1, "m2": m2, "mu1": mu1, "mu2": mu2, "rate": rate, "g": g}
    floor, between = slips(**numbers)
    together = jnp.asarray(rate) / (jnp.asarray(m1) + m2)
    first = jnp.clip(t, floor, between) - floor
    then = jnp.maximum(t - between, 0.0)
    # Place and velocity where the blocks part, or now; the acceleration there is mu2 g.
    x, v = together * first**3 / 6.0, together * first**2 / 2.0
    both = x + v * then + 0.5 * jnp.asarray(mu2) * g * then**2
    return jnp.stack([both + jnp.asarray(rate) / m1 * then**3 / 6.0, both])
