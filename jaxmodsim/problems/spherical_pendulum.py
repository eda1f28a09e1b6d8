"""The spherical pendulum: a point mass that slides without friction on a sphere."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..scene import Scene


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    phi, speed_phi, speed_theta = q[0], qd[0], jnp.sin(q[0]) * qd[1]
    kinetic = 0.5 * p["m"] * p["R"] ** 2 * (speed_phi**2 + speed_theta**2)
    return kinetic - p["m"] * p["g"] * p["R"] * jnp.cos(phi)


def scene(*, m: ArrayLike = 1.0, R: ArrayLike = 1.0, g: ArrayLike = 9.81) -> Scene:
    """Point mass on a sphere about the origin, gravity along -z.

    The coordinates are (phi, theta) [rad], phi from the +z axis and theta about it: `x = R sin(phi) cos(theta)`,
    `y = R sin(phi) sin(theta)`, `z = R cos(phi)`. The mass matrix is singular at the poles, phi = 0 and pi.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `R`: radius [m], > 0.
    - `g`: gravity [m/s^2].

    **Returns:**

    A `Scene` without effects. `acceleration` has its exact accelerations.
    """
    return Scene(_lagrangian, params={"m": m, "R": R, "g": g}, coordinates=("phi [rad]", "theta [rad]"))


def acceleration(
    q: Float[Array, "2"], qd: Float[Array, "2"], *, R: ArrayLike = 1.0, g: ArrayLike = 9.81
) -> Float[Array, "2"]:
    """Accelerations of the spherical pendulum in closed form; they do not depend on the mass.

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


def reaction(
    q: Float[Array, "2"], qd: Float[Array, "2"], *, m: ArrayLike = 1.0, R: ArrayLike = 1.0, g: ArrayLike = 9.81
) -> Float[Array, ""]:
    """Radial constraint force [N] of the sphere on the mass, positive outwards.

    The force is `m (g cos(phi) - R phi'^2 - R sin(phi)^2 theta'^2)`; its tangential components vanish. Arguments as for
    `scene`, coordinates and rates as for `acceleration`.

    **Returns:**

    The force, shape `[]`.
    """
    return jnp.asarray(m) * (g * jnp.cos(q[0]) - R * qd[0] ** 2 - R * (jnp.sin(q[0]) * qd[1]) ** 2)


def motion(
    t: Float[np.ndarray, "..."] | float, phi: float, turn: float, *, R: float = 1.0, g: float = 9.81
) -> Float[np.ndarray, "..."]:
    """Angle phi [rad] at the times `t` [s], from a turning point at t = 0, in closed form; NumPy, float64.

    Let u = cos(phi), c = g/R and `l = sin(phi)^2 theta'` [1/s]. Energy and angular momentum give
    `u'^2 = 2 c (u - a) (u - b) (u - w)`. The root `a` is the initial u. With `s = l^2/(2 c (1 - a^2))` the other roots
    obey `x^2 - s x - 1 - a s = 0`; the larger one, w, exceeds 1. If the start is the upper turning point (a > b),
    `u = b + (a - b) cn(n t)^2/dn(n t)^2`, else `u = a + (b - a) sn(n t)^2`. With the smaller and the larger of a and b,
    a' and b', `n = sqrt(c (w - a')/2)`, and the parameter of Jacobi's functions is `(b' - a')/(w - a')` (E. T.
    Whittaker, A Treatise on the Analytical Dynamics of Particles and Rigid Bodies, section 55).

    **Arguments:**

    - `t`: times [s].
    - `phi`: angle from the +z axis at t = 0 [rad], with phi' = 0; 0 < phi < pi.
    - `turn`: theta' at t = 0 [rad/s], not zero.
    - `R`: radius [m], > 0.
    - `g`: gravity [m/s^2], > 0.

    **Returns:**

    The angle, of the shape of `t`.
    """
    from scipy.special import ellipj  # slow to import

    start, c = np.cos(phi), g / R
    share = (turn * np.sin(phi)) ** 2 / (2.0 * c)
    root = np.sqrt(0.25 * share**2 + 1.0 + start * share)
    other, beyond = 0.5 * share - root, 0.5 * share + root
    low, high = min(start, other), max(start, other)
    sn, cn, dn, _ = ellipj(np.sqrt(0.5 * c * (beyond - low)) * np.asarray(t), (high - low) / (beyond - low))
    swung = (cn / dn) ** 2 if start > other else sn**2
    return np.asarray(np.arccos(low + (high - low) * swung))
