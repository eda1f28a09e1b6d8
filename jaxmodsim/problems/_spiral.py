"""A bead on a spherical spiral, with or without viscous drag."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..effects import AppliedForce
from ..numerics import Number, parameter
from ..scene import Scene


class SphericalSpiral(eqx.Module):
    """The curve phi = arccot(a theta) on a sphere about the origin, as a function of theta.

    **Arguments:**

    - `R`: radius [m], > 0.
    - `a`: turns are the closer the smaller it is [1/rad], any finite number.
    """

    R: Number = parameter("R", "m", lower=0.0, strict=True)
    a: Number = parameter("a", "1/rad")

    def __call__(self, q: Float[Array, "1"]) -> Float[Array, "3"]:
        """Position (x, y, z) [m] at q = [theta] [rad]; phi is the angle from the +z axis."""
        theta = q[0]
        slope = self.a * theta
        sine = 1.0 / jnp.sqrt(1.0 + slope**2)
        return self.R * jnp.stack([sine * jnp.cos(theta), sine * jnp.sin(theta), sine * slope])


class _Lagrangian(eqx.Module):
    curve: SphericalSpiral

    def __call__(self, t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
        del t
        position, velocity = jax.jvp(self.curve, (q,), (qd,))
        return 0.5 * p["m"] * jnp.sum(velocity**2) - p["m"] * p["g"] * position[2]


class _Drag(eqx.Module):
    curve: SphericalSpiral

    def __call__(self, t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
        del t
        return -p["k"] * jax.jvp(self.curve, (q,), (qd,))[1]


def spiral_bead(
    *, m: ArrayLike = 1.0, R: ArrayLike = 1.0, a: ArrayLike = 0.5, g: ArrayLike = 9.81, k: ArrayLike | None = None
) -> Scene:
    """Bead on the spiral phi = arccot(a theta) on a sphere, gravity along -z.

    R and a sit in the scene once for each function that uses the curve. To differentiate by them, build the scene
    inside the differentiated function.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `R`: radius of the sphere [m], > 0.
    - `a`: parameter of the spiral [1/rad], see `SphericalSpiral`.
    - `g`: gravity [m/s^2].
    - `k`: coefficient of viscous drag [N s/m], >= 0; None for no drag.

    **Returns:**

    A `Scene` with the coordinate theta [rad] and, with `k`, the effect `drag`, a Cartesian force -k v [N] at the bead.
    Its exact acceleration: `spiral_bead_acceleration`.
    """
    curve = SphericalSpiral(R, a)
    params: dict[str, Any] = {"m": m, "g": g}
    if k is None:
        return Scene(_Lagrangian(curve), params=params)
    return Scene(
        _Lagrangian(curve), params={**params, "k": k}, effects=(AppliedForce(_Drag(curve), at=curve, name="drag"),)
    )


def spiral_bead_acceleration(
    q: Float[Array, "1"],
    qd: Float[Array, "1"],
    *,
    m: ArrayLike = 1.0,
    R: ArrayLike = 1.0,
    a: ArrayLike = 0.5,
    g: ArrayLike = 9.81,
    k: ArrayLike = 0.0,
) -> Float[Array, "1"]:
    """Acceleration theta'' [rad/s^2] of the bead in closed form, shape `[1]`.

    With u = a^2 theta^2: `theta'' = a^2 theta (1 + 2 a^2 + u) / ((1 + u)(1 + a^2 + u)) theta'^2
    - (g/R) a sqrt(1 + u)/(1 + a^2 + u) - (k/m) theta'` (NTNU course TTK4130, exercise 9, problem 1).

    **Arguments:**

    - `q`, `qd`: theta [rad] and its rate [rad/s], shape `[1]`.
    - `m`, `R`, `a`, `g`, `k`: as for `spiral_bead`.
    """
    theta, rate, a2 = q[0], qd[0], jnp.square(jnp.asarray(a))
    u = a2 * theta**2
    along = 1.0 + a2 + u
    turning = a2 * theta * (1.0 + 2.0 * a2 + u) / ((1.0 + u) * along) * rate**2
    falling = g / R * a * jnp.sqrt(1.0 + u) / along
    return jnp.reshape(turning - falling - k / m * rate, (1,))
