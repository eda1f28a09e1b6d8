"""Foucault's pendulum: the plane of its swings turns as the ground turns beneath it."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..scene import Scene

# Mass [kg], length [m], gravity [m/s^2], turning of the Earth [rad/s] and latitude [rad]: the Pantheon, Paris.
PARAMS = {"m": 28.0, "l": 67.0, "g": 9.81, "Omega": 7.2921159e-5, "latitude": 0.8527}


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    spin = p["Omega"] * jnp.sin(p["latitude"])
    turning = spin * (q[0] * qd[1] - q[1] * qd[0])
    swing = 0.5 * p["g"] / p["l"] * (q[0] ** 2 + q[1] ** 2)
    return p["m"] * (0.5 * (qd[0] ** 2 + qd[1] ** 2) + turning - swing)


def scene(
    *,
    m: ArrayLike = PARAMS["m"],
    l: ArrayLike = PARAMS["l"],
    g: ArrayLike = PARAMS["g"],
    Omega: ArrayLike = PARAMS["Omega"],
    latitude: ArrayLike = PARAMS["latitude"],
) -> Scene:
    """Small swings of a pendulum on a turning Earth, by a Lagrangian with a term linear in the velocities.

    `L = m (x'^2 + y'^2)/2 + m Omega sin(latitude) (x y' - y x') - m g (x^2 + y^2)/(2 l)`: the coordinates are the
    deflections to the east and to the north [m]. What is quadratic in Omega, the centrifugal force, is part of gravity.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `l`: length [m], > 0.
    - `g`: gravity [m/s^2], > 0.
    - `Omega`: rate at which the Earth turns [rad/s].
    - `latitude`: [rad], positive in the north.

    **Returns:**

    A `Scene` without effects. Its exact motion: `motion`; in angles, the plane of the swings turns at `precession`.
    """
    return Scene(
        _lagrangian,
        params={"m": m, "l": l, "g": g, "Omega": Omega, "latitude": latitude},
        coordinates=("east [m]", "north [m]"),
    )


def precession(*, Omega: ArrayLike = PARAMS["Omega"], latitude: ArrayLike = PARAMS["latitude"]) -> Float[Array, ""]:
    """Rate [rad/s] at which the plane of the swings turns, from east to north: `-Omega sin(latitude)`."""
    return -jnp.asarray(Omega) * jnp.sin(jnp.asarray(latitude))


def motion(
    t: Float[Array, "..."],
    q0: Float[Array, "2"],
    qd0: Float[Array, "2"],
    *,
    l: ArrayLike = PARAMS["l"],
    g: ArrayLike = PARAMS["g"],
    Omega: ArrayLike = PARAMS["Omega"],
    latitude: ArrayLike = PARAMS["latitude"],
) -> Float[Array, "... 2"]:
    """Deflections [m] at the times `t` [s], in closed form.

    In a frame that turns at the precession p about the vertical the motion is that of a spring, with
    `n^2 = g/l + p^2`. So, with u = x + i y: `u = exp(i p t) (u0 cos(n t) + (u0' - i p u0) sin(n t)/n)`.

    **Arguments:**

    - `t`: times [s].
    - `q0`, `qd0`: deflections [m] and velocities [m/s] at t = 0.
    - `l`, `g`, `Omega`, `latitude`: as for `scene`.
    """
    p = precession(Omega=Omega, latitude=latitude)
    n = jnp.sqrt(g / jnp.asarray(l) + p**2)
    u, v = q0[0] + 1j * q0[1], qd0[0] + 1j * qd0[1]
    turned = jnp.exp(1j * p * t) * (u * jnp.cos(n * t) + (v - 1j * p * u) * jnp.sin(n * t) / n)
    return jnp.stack([turned.real, turned.imag], axis=-1)


def acceleration(
    q: Float[Array, "2"],
    qd: Float[Array, "2"],
    *,
    l: ArrayLike = PARAMS["l"],
    g: ArrayLike = PARAMS["g"],
    Omega: ArrayLike = PARAMS["Omega"],
    latitude: ArrayLike = PARAMS["latitude"],
) -> Float[Array, "2"]:
    """Accelerations [m/s^2]: `x'' = -(g/l) x + 2 s y'`, `y'' = -(g/l) y - 2 s x'`, s = Omega sin(latitude).

    Arguments as for `scene`, `q` and `qd` of shape `[2]`.
    """
    s, stiffness = jnp.asarray(Omega) * jnp.sin(jnp.asarray(latitude)), jnp.asarray(g) / l
    return 2.0 * s * jnp.stack([qd[1], -qd[0]]) - stiffness * q
