"""Foucault's pendulum, whose plane of oscillation turns with the rotation of the Earth."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..scene import Scene

# Mass [kg], length [m], gravity [m/s^2], rotation rate of the Earth [rad/s] and latitude [rad]: the Pantheon, Paris.
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
    """Small oscillations of a pendulum on the rotating Earth, with a Lagrangian that is linear in Omega.

    `L = m (x'^2 + y'^2)/2 + m Omega sin(latitude) (x y' - y x') - m g (x^2 + y^2)/(2 l)`. The coordinates are the
    deflections to the east and to the north [m]. The centrifugal force, quadratic in Omega, is part of gravity.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `l`: length [m], > 0.
    - `g`: gravity [m/s^2], > 0.
    - `Omega`: rotation rate of the Earth [rad/s].
    - `latitude`: [rad], positive north of the equator.

    **Returns:**

    A `Scene` without effects. `motion` has its exact motion, and `precession` the rate of its plane of oscillation.
    """
    return Scene(
        _lagrangian,
        params={"m": m, "l": l, "g": g, "Omega": Omega, "latitude": latitude},
        coordinates=("east [m]", "north [m]"),
    )


def precession(*, Omega: ArrayLike = PARAMS["Omega"], latitude: ArrayLike = PARAMS["latitude"]) -> Float[Array, ""]:
    """Rotation rate [rad/s] of the plane of oscillation, from east to north: `-Omega sin(latitude)`.

    **Returns:**

    The rate, shape `[]`.
    """
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

    In a frame that rotates about the vertical at the precession p the motion is that of a spring with
    `n^2 = g/l + p^2`. With u = x + i y: `u = exp(i p t) (u0 cos(n t) + (u0' - i p u0) sin(n t)/n)`.

    **Arguments:**

    - `t`: times [s].
    - `q0`, `qd0`: deflections [m] and velocities [m/s] at t = 0.
    - `l`, `g`, `Omega`, `latitude`: as for `scene`.

    **Returns:**

    The deflections (x, y), shape `[..., 2]`.
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

    **Returns:**

    The accelerations, shape `[2]`.
    """
    s, stiffness = jnp.asarray(Omega) * jnp.sin(jnp.asarray(latitude)), jnp.asarray(g) / l
    return 2.0 * s * jnp.stack([qd[1], -qd[0]]) - stiffness * q
