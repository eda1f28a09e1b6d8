"""A bead on a spherical spiral, optionally with viscous drag and dry friction."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._core.parameters import Number, parameter
from ..friction import Coulomb
from ..mechanics import point_mass
from ..scene import AbstractEffect, AppliedForce, Friction, Scene


class SphericalSpiral(eqx.Module):
    """The curve phi = arccot(a theta) on a sphere about the origin, as a function of theta.

    **Arguments:**

    - `R`: radius [m], > 0.
    - `a`: parameter of the spiral [1/rad], any finite number; small values give close turns.
    """

    R: Number = parameter("R", "m", lower=0.0, strict=True)
    a: Number = parameter("a", "1/rad")

    def __call__(self, q: Float[Array, "1"]) -> Float[Array, "3"]:
        """Position (x, y, z) [m] at q = [theta] [rad]; phi is the angle from the +z axis."""
        return _spiral(q, {"R": self.R, "a": self.a})


def _spiral(q: Array, p: dict[str, Array]) -> Array:
    theta = q[0]
    slope = p["a"] * theta
    sine = 1.0 / jnp.sqrt(1.0 + slope**2)
    return p["R"] * jnp.stack([sine * jnp.cos(theta), sine * jnp.sin(theta), sine * slope])


def _drag(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return -p["k"] * jax.jvp(lambda q: _spiral(q, p), (q,), (qd,))[1]


_BEAD = point_mass(lambda p: p["m"], _spiral, lambda p: p["g"])


def scene(
    *,
    m: ArrayLike = 1.0,
    R: ArrayLike = 1.0,
    a: ArrayLike = 0.5,
    g: ArrayLike = 9.81,
    k: ArrayLike | None = None,
    mu: ArrayLike | None = None,
) -> Scene:
    """Bead on the spiral phi = arccot(a theta) on a sphere, gravity along -z.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `R`: radius of the sphere [m], > 0.
    - `a`: parameter of the spiral [1/rad], see `SphericalSpiral`.
    - `g`: gravity [m/s^2].
    - `k`: coefficient of viscous drag [N s/m], >= 0; None for no drag.
    - `mu`: coefficient of Coulomb friction, >= 0, along the path, under the force of the wire on the bead; None for no
      friction.

    **Returns:**

    A `Scene` with the coordinate theta [rad] and, with `k`, the effect `drag`, a Cartesian force -k v [N] at the bead;
    with `mu`, the effect `friction`, whose law holds `mu`. All other numbers are in its `params`. Its exact
    acceleration: `acceleration`.
    """
    params: dict[str, ArrayLike] = {"m": m, "R": R, "a": a, "g": g}
    effects: tuple[AbstractEffect, ...] = ()
    if k is not None:
        params["k"] = k
        effects = (AppliedForce(_drag, at=_spiral, name="drag"),)
    if mu is not None:
        effects = (*effects, Friction(Coulomb(mu), along=_spiral, normal_force=_BEAD.normal_force))
    return Scene(_BEAD, params=params, effects=effects, coordinates=("theta [rad]",))


def normal_force(
    q: Float[Array, "1"],
    qd: Float[Array, "1"],
    *,
    m: ArrayLike = 1.0,
    R: ArrayLike = 1.0,
    a: ArrayLike = 0.5,
    g: ArrayLike = 9.81,
) -> Float[Array, ""]:
    """Magnitude [N] of the force of the wire on the bead across the path, in closed form.

    Newton's law is used in the spherical frame (r, phi, theta), with `sin(phi) = 1/sqrt(1 + u)` and u = a^2 theta^2.
    Since theta'' acts along the path, it may be zero, so `phi' = -a/(1 + u) theta'` and
    `phi'' = 2 a^3 theta/(1 + u)^2 theta'^2`. The force has the components

    - `f_r = m (g cos(phi) - R phi'^2 - R sin(phi)^2 theta'^2)`,
    - `f_phi = m (R phi'' - R sin(phi) cos(phi) theta'^2 - g sin(phi))`,
    - `f_theta = 2 m R cos(phi) phi' theta'`,

    less the part of `(f_phi, f_theta)` along the tangent (phi', sin(phi) theta').

    **Arguments:**

    - `q`, `qd`: theta [rad] and its rate [rad/s], shape `[1]`.
    - `m`, `R`, `a`, `g`: as for `scene`.

    **Returns:**

    The magnitude, shape `[]`.
    """
    theta, rate, a = q[0], qd[0], jnp.asarray(a)
    opened = 1.0 + (a * theta) ** 2
    sine = 1.0 / jnp.sqrt(opened)
    cosine, slope, bend = a * theta * sine, -a / opened, 2.0 * a**3 * theta / opened**2
    radial = g * cosine - R * (slope**2 + sine**2) * rate**2
    down = R * (bend - sine * cosine) * rate**2 - g * sine
    around = 2.0 * R * cosine * slope * rate**2
    across = (down * sine - around * slope) / jnp.sqrt(slope**2 + sine**2)
    return jnp.asarray(m) * jnp.sqrt(radial**2 + across**2)


def acceleration(
    q: Float[Array, "1"],
    qd: Float[Array, "1"],
    *,
    m: ArrayLike = 1.0,
    R: ArrayLike = 1.0,
    a: ArrayLike = 0.5,
    g: ArrayLike = 9.81,
    k: ArrayLike = 0.0,
    mu: ArrayLike = 0.0,
) -> Float[Array, "1"]:
    """Acceleration theta'' [rad/s^2] of the moving bead in closed form, shape `[1]`.

    With u = a^2 theta^2: `theta'' = a^2 theta (1 + 2 a^2 + u) / ((1 + u)(1 + a^2 + u)) theta'^2
    - (g/R) a sqrt(1 + u)/(1 + a^2 + u) - (k/m) theta'` (NTNU course TTK4130, exercise 9, problem 1).
    Friction subtracts `mu N/(m s) sign(theta')`, with N from `normal_force` and the length of the path per radian
    `s = R sqrt(1 + a^2 + u)/(1 + u)`.

    **Arguments:**

    - `q`, `qd`: theta [rad] and its rate [rad/s], shape `[1]`.
    - `m`, `R`, `a`, `g`, `k`, `mu`: as for `scene`.

    **Returns:**

    The acceleration, shape `[1]`.
    """
    theta, rate, a2 = q[0], qd[0], jnp.square(jnp.asarray(a))
    u = a2 * theta**2
    along = 1.0 + a2 + u
    turning = a2 * theta * (1.0 + 2.0 * a2 + u) / ((1.0 + u) * along) * rate**2
    falling = g / R * a * jnp.sqrt(1.0 + u) / along
    rubbing = mu * normal_force(q, qd, m=1.0, R=R, a=a, g=g) * (1.0 + u) / (R * jnp.sqrt(along))
    return jnp.reshape(turning - falling - k / m * rate - rubbing * jnp.sign(rate), (1,))
