"""Pendulums in Cartesian coordinates with a constraint, in a plane and in space, without the poles of angles."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..mechanics import Constraint, point_mass
from ..scene import Scene


def _in_plane(q: Array) -> Array:
    return jnp.stack([q[0], 0.0 * q[0], q[1]])


def _in_space(q: Array) -> Array:
    return q


def _stretch(t: Array, x: Array, p: dict[str, Array]) -> Array:
    return jnp.sqrt(jnp.sum(x**2)) - p["l"]


_PLANE_BOB = point_mass(lambda p: p["m"], _in_plane, lambda p: p["g"])
_SPACE_BOB = point_mass(lambda p: p["m"], _in_space, lambda p: p["g"])


def scene(*, m: ArrayLike = 1.0, l: ArrayLike = 1.0, g: ArrayLike = 9.81) -> Scene:
    """Point mass on a massless rod, with coordinates (x, z) [m] from the pivot in a vertical plane, z upwards.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `l`: length of the rod [m], > 0.
    - `g`: gravity [m/s^2].

    **Returns:**

    A `Scene` with the constraint `rod`, `sqrt(x^2 + z^2) = l`. Its multiplier is the force of the rod on the mass [N],
    positive outwards: minus the `tension`. `acceleration` has its exact accelerations.
    """
    rod = Constraint(_stretch, at=_in_plane, name="rod")
    return Scene(_PLANE_BOB, params={"m": m, "l": l, "g": g}, constraints=(rod,), coordinates=("x [m]", "z [m]"))


def cartesian_spherical_pendulum(*, m: ArrayLike = 1.0, l: ArrayLike = 1.0, g: ArrayLike = 9.81) -> Scene:
    """The spherical pendulum with coordinates (x, y, z) [m] from the pivot, z upwards.

    It passes the top and the bottom, at which the angles of `spherical_pendulum` are singular. Arguments and results as
    for `scene`; the multiplier is `spherical_pendulum.reaction`.

    **Returns:**

    A `Scene` with three coordinates [m] and the constraint `rod`.
    """
    rod = Constraint(_stretch, at=_in_space, name="rod")
    return Scene(
        _SPACE_BOB, params={"m": m, "l": l, "g": g}, constraints=(rod,), coordinates=("x [m]", "y [m]", "z [m]")
    )


def tension(
    q: Float[Array, " dim"], qd: Float[Array, " dim"], *, m: ArrayLike = 1.0, l: ArrayLike = 1.0, g: ArrayLike = 9.81
) -> Float[Array, ""]:
    """Tension of the rod [N], positive if it pulls the mass inwards: `m (v^2 - g z)/l`.

    In a plane, with the angle f from straight down, the tension is `m (l f'^2 + g cos(f))`.

    **Arguments:**

    - `q`, `qd`: position [m] and velocity [m/s], (x, z) or (x, y, z), with |q| = l and q . qd = 0.
    - `m`, `l`, `g`: as for `scene`.

    **Returns:**

    The tension, shape `[]`.
    """
    return jnp.asarray(m) * (jnp.sum(qd**2) - g * q[-1]) / l


def acceleration(
    q: Float[Array, " dim"], qd: Float[Array, " dim"], *, l: ArrayLike = 1.0, g: ArrayLike = 9.81
) -> Float[Array, " dim"]:
    """Accelerations [m/s^2] by Newton's law, from gravity and the tension; they do not depend on the mass.

    Arguments as for `tension`.

    **Returns:**

    The accelerations, of the shape of `q`.
    """
    pull = tension(q, qd, m=1.0, l=l, g=g) / l
    return jnp.asarray(-pull * q).at[-1].add(-jnp.asarray(g, q.dtype))
