"""The spherical pendulum: a point mass that slides without friction on a sphere."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..scene import Scene


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    del t
    phi, speed_phi, speed_theta = q[0], qd[0], jnp.sin(q[0]) * qd[1]
    kinetic = 0.5 * p["m"] * p["R"] ** 2 * (speed_phi**2 + speed_theta**2)
    return kinetic - p["m"] * p["g"] * p["R"] * jnp.cos(phi)


def spherical_pendulum(*, m: ArrayLike = 1.0, R: ArrayLike = 1.0, g: ArrayLike = 9.81) -> Scene:
    """Point mass on a sphere about the origin, gravity along -z.

    The coordinates are (phi, theta) [rad], phi from the +z axis and theta about it: `x = R sin(phi) cos(theta)`,
    `y = R sin(phi) sin(theta)`, `z = R cos(phi)`. The mass matrix is singular at the poles, phi = 0 and pi.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `R`: radius [m], > 0.
    - `g`: gravity [m/s^2].

    **Returns:**

    A `Scene` without effects; its exact accelerations: `spherical_pendulum_acceleration`.
    """
    return Scene(_lagrangian, params={"m": m, "R": R, "g": g})


def spherical_pendulum_acceleration(
    q: Float[Array, "2"], qd: Float[Array, "2"], *, R: ArrayLike = 1.0, g: ArrayLike = 9.81
) -> Float[Array, "2"]:
    """Accelerations of the spherical pendulum, in closed form; the mass drops out.

    `phi'' = sin(phi) cos(phi) theta'^2 + (g/R) sin(phi)`, `theta'' = -2 cot(phi) phi' theta'` (NTNU course TTK4130,
    exercise 9, problem 1).

    **Arguments:**

    - `q`: (phi, theta) [rad], shape `[2]`, 0 < phi < pi.
    - `qd`: their rates [rad/s], shape `[2]`.
    - `R`: radius [m], > 0.
    - `g`: gravity [m/s^2].

    **Returns:**

    (phi'', theta'') [rad/s^2], shape `[2]`.
    """
    sine, cosine = jnp.sin(q[0]), jnp.cos(q[0])
    return jnp.stack([sine * cosine * qd[1] ** 2 + g / R * sine, -2.0 * cosine / sine * qd[0] * qd[1]])


def spherical_pendulum_reaction(
    q: Float[Array, "2"], qd: Float[Array, "2"], *, m: ArrayLike = 1.0, R: ArrayLike = 1.0, g: ArrayLike = 9.81
) -> Float[Array, ""]:
    """Radial force of constraint [N] of the sphere on the mass, positive outwards.

    `m (g cos(phi) - R phi'^2 - R sin(phi)^2 theta'^2)`; the tangential components vanish. Arguments as for
    `spherical_pendulum`, coordinates and rates as for `spherical_pendulum_acceleration`.
    """
    return jnp.asarray(m) * (g * jnp.cos(q[0]) - R * qd[0] ** 2 - R * (jnp.sin(q[0]) * qd[1]) ** 2)
