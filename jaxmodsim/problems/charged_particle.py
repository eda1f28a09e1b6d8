"""A charged particle in constant fields, with a magnetic force that depends on the velocity and does no work."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..mechanics import point_mass
from ..scene import Scene

# Mass [kg], charge [C], magnetic field along z [T], electric field (x, y, z) [V/m].
PARAMS = {"m": 0.7, "charge": -1.1, "B": 2.3, "E": (0.4, -0.3, 0.2)}


def _fields(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    """`charge (A . v + E . x)`, with the vector potential A = B (-y, x, 0)/2."""
    magnetic = 0.5 * p["B"] * (q[0] * qd[1] - q[1] * qd[0])
    return p["charge"] * (magnetic + jnp.sum(p["E"] * q))


_LAGRANGIAN = point_mass(lambda p: p["m"], lambda q: q, lambda p: 0.0 * p["m"]) + _fields


def scene(
    *,
    m: ArrayLike = PARAMS["m"],
    charge: ArrayLike = PARAMS["charge"],
    B: ArrayLike = PARAMS["B"],
    E: ArrayLike | tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Scene:
    """Charged point mass in a uniform magnetic field along z and a uniform electric field.

    The coordinates are (x, y, z) [m]. There is no gravity.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `charge`: [C].
    - `B`: magnetic field along z [T].
    - `E`: electric field [V/m], shape `[3]`.

    **Returns:**

    A `Scene` without effects. `motion` has its exact motion.

    **Raises:**

    - `ValueError` if E has the wrong shape.
    """
    field = jnp.asarray(E, float)
    if field.shape != (3,):
        raise ValueError(f"E must be a vector (x, y, z) [V/m], shape (3,), but it has the shape {field.shape}.")
    return Scene(
        _LAGRANGIAN, params={"m": m, "charge": charge, "B": B, "E": field}, coordinates=("x [m]", "y [m]", "z [m]")
    )


def acceleration(
    q: Float[Array, "3"],
    qd: Float[Array, "3"],
    *,
    m: ArrayLike = PARAMS["m"],
    charge: ArrayLike = PARAMS["charge"],
    B: ArrayLike = PARAMS["B"],
    E: ArrayLike | tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Float[Array, "3"]:
    """Accelerations [m/s^2] by the Lorentz force: `m v' = charge (E + v x B)`.

    Arguments as for `scene`, with velocities `qd` [m/s]. The position `q` [m] is unused.

    **Returns:**

    The accelerations, shape `[3]`.
    """
    bent = B * jnp.stack([qd[1], -qd[0], jnp.zeros_like(qd[2])])
    return jnp.asarray(charge) * (jnp.asarray(E, qd.dtype) + bent) / m


def motion(
    t: Float[Array, "..."],
    q0: Float[Array, "3"],
    qd0: Float[Array, "3"],
    *,
    m: ArrayLike = PARAMS["m"],
    charge: ArrayLike = PARAMS["charge"],
    B: ArrayLike = PARAMS["B"],
    E: ArrayLike | tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[Float[Array, "... 3"], Float[Array, "... 3"]]:
    """Positions [m] and velocities [m/s] at the times `t` [s], in closed form.

    With the cyclotron frequency w = charge B/m and u = x + i y, `u' = d + (u0' - d) exp(-i w t)`: the particle circles
    a centre that drifts at `d = (Ey - i Ex)/B`. Along z the acceleration is uniform.

    **Arguments:**

    - `t`: times [s].
    - `q0`, `qd0`: position and velocity at t = 0, shape `[3]`.
    - `m`, `charge`, `B`, `E`: as for `scene`; charge and B not zero.

    **Returns:**

    Positions and velocities, shape `[..., 3]` each.
    """
    push, w = jnp.asarray(E, float), charge * jnp.asarray(B) / m
    drift = (push[1] - 1j * push[0]) / B
    u, v = q0[0] + 1j * q0[1], qd0[0] + 1j * qd0[1]
    turned = jnp.exp(-1j * w * t)
    place = u + drift * t + (v - drift) * (1.0 - turned) / (1j * w)
    velocity = drift + (v - drift) * turned
    lift = charge * push[2] / m
    z, speed = q0[2] + qd0[2] * t + 0.5 * lift * t**2, qd0[2] + lift * t
    q = jnp.stack([place.real, place.imag, z], axis=-1)
    return q, jnp.stack([velocity.real, velocity.imag, speed + 0.0 * t], axis=-1)
