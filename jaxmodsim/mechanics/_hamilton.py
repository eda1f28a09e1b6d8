"""Momenta in place of velocities."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._core.cholesky import solve_positive_definite
from ._lagrange import Lagrangian, motion_equations


def momentum(
    lagrangian: Lagrangian, t: Float[Array, ""], q: Float[Array, " dof"], qd: Float[Array, " dof"], params: PyTree
) -> Float[Array, " dof"]:
    """Canonical momenta `dL/dqd`, shape `[dof]` [kg m/s for lengths, kg m^2/s for angles]."""
    return jax.grad(lagrangian, argnums=2)(t, q, qd, params)


def velocity(
    lagrangian: Lagrangian, t: Float[Array, ""], q: Float[Array, " dof"], p: Float[Array, " dof"], params: PyTree
) -> Float[Array, " dof"]:
    """Velocities that belong to the momenta `p`, of a Lagrangian that is quadratic in the velocities."""
    still = jnp.zeros_like(p)
    mass = motion_equations(lagrangian, t, q, still, params).mass
    return solve_positive_definite(mass, p - momentum(lagrangian, t, q, still, params))


def quadratic(
    lagrangian: Lagrangian, t: Float[Array, ""], q: Float[Array, " dof"], qd: Float[Array, " dof"], params: PyTree
) -> Array:
    """Whether the mass matrix is the same at `qd` as at rest and at other velocities, to half of the digits."""
    at = [motion_equations(lagrangian, t, q, v, params).mass for v in (jnp.zeros_like(qd), qd, qd + 1.0)]
    largest = jnp.max(jnp.abs(at[0]))
    change = jnp.maximum(jnp.max(jnp.abs(at[1] - at[0])), jnp.max(jnp.abs(at[2] - at[0])))
    return change <= float(jnp.finfo(qd.dtype).eps) ** 0.5 * largest
