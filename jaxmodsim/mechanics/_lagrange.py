"""Equations of motion from a Lagrangian, by automatic differentiation; energies and canonical momenta."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._core.arrays import PerDof, Scalar
from .._core.cholesky import MAX_UNROLLED_CHOLESKY, solve_positive_definite
from .._core.scalarise import in_scalars

Lagrangian: TypeAlias = Callable[[Any, Array, Array, Any], Array]


class MotionEquations(NamedTuple):
    """The Euler-Lagrange equations at one state, `mass @ qdd = load + Q`.

    - `mass`: mass matrix d2L/dqd2, shape `[dof, dof]` [kg for lengths, kg m^2 for angles].
    - `load`: `dL/dq - d2L/dqd dq qd - d2L/dqd dt`, shape `[dof]` [N or N m]: the forces in the
      Lagrangian (gravity, springs, centrifugal and Coriolis terms).
    """

    mass: Float[Array, "dof dof"]
    load: PerDof


def motion_equations(lagrangian: Lagrangian, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> MotionEquations:
    """Mass matrix and load of `d/dt dL/dqd - dL/dq = Q` at one state.

    The momentum dL/dqd is linearized once. Its derivative along (1, qd, 0) is the bias, and those along the unit
    velocities are the mass matrix, so the Hessian with respect to q is never formed. Up to 12 coordinates the
    evaluation is in scalars (`in_scalars`), unless the Lagrangian is too large; otherwise in arrays.

    **Arguments:**

    - `lagrangian`: `L(t, q, qd, params)`, a scalar [J].
    - `t`: time [s].
    - `q`, `qd`: generalised coordinates and velocities, shape `[dof]`.
    - `params`: parameters of the Lagrangian.

    **Returns:**

    `MotionEquations`.
    """
    equations = partial(_differentiate, lagrangian)
    if q.shape[0] > MAX_UNROLLED_CHOLESKY:
        return equations(t, q, qd, params)
    return in_scalars(equations, t, q, qd, params, seed=q)


def _momentum(
    lagrangian: Lagrangian, params: PyTree
) -> Callable[[Array, Array, Array], tuple[Float[Array, " dof"], Float[Array, " dof"]]]:
    """Function of t, q and qd that returns dL/dqd and dL/dq."""
    return lambda t, q, qd: jax.grad(lagrangian, argnums=(2, 1))(t, q, qd, params)


def inverse_dynamics(
    lagrangian: Lagrangian, t: Scalar, q: PerDof, qd: PerDof, qdd: PerDof, params: PyTree
) -> Float[Array, " dof"]:
    """Generalised force `d/dt dL/dqd - dL/dq` under which the accelerations are `qdd`.

    **Returns:**

    The force [N or N m], shape `[dof]`.
    """
    _, rate, by_q = jax.jvp(_momentum(lagrangian, params), (t, q, qd), (jnp.ones_like(t), qd, qdd), has_aux=True)
    return rate - by_q


def _differentiate(lagrangian: Lagrangian, t: Array, q: Array, qd: Array, params: PyTree) -> MotionEquations:
    _, push, by_q = jax.linearize(_momentum(lagrangian, params), t, q, qd, has_aux=True)
    zero_t, zero = jnp.zeros_like(t), jnp.zeros_like(q)
    if q.shape[0] == 1:
        mass = push(zero_t, zero, jnp.ones_like(qd))[None]
    else:
        mass = jax.vmap(lambda unit: push(zero_t, zero, unit), out_axes=1)(jnp.eye(q.shape[0], dtype=qd.dtype))
    return MotionEquations(mass, by_q - push(jnp.ones_like(t), qd, zero))


def acceleration(
    lagrangian: Lagrangian, t: Scalar, q: PerDof, qd: PerDof, params: PyTree, force: PerDof | float = 0.0
) -> PerDof:
    """Accelerations under a generalised force; see `motion_equations`.

    **Returns:**

    The accelerations `qdd`, shape `[dof]`, under `force` [N or N m].
    """
    equations = motion_equations(lagrangian, t, q, qd, params)
    return solve_positive_definite(equations.mass, equations.load + force)


def energies(lagrangian: Lagrangian, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> tuple[Scalar, Scalar]:
    """Kinetic and potential energy [J] of a Lagrangian.

    **Returns:**

    `(T, V)`: `T = qd @ mass @ qd / 2`, and `V` is the remainder of the energy function `qd @ dL/dqd - L`. In moving
    coordinates (a rotating frame), `V` contains the centrifugal potential, and the sum is the Jacobi integral.
    """
    momentum = jax.grad(lagrangian, argnums=2)(t, q, qd, params)
    mass = motion_equations(lagrangian, t, q, qd, params).mass
    kinetic = 0.5 * jnp.sum(qd * jnp.sum(mass * qd[None, :], axis=1))
    return kinetic, jnp.sum(qd * momentum) - lagrangian(t, q, qd, params) - kinetic


def momentum(lagrangian: Lagrangian, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> PerDof:
    """Canonical momenta `dL/dqd`.

    **Returns:**

    The momenta [kg m/s for lengths, kg m^2/s for angles], shape `[dof]`.
    """
    return jax.grad(lagrangian, argnums=2)(t, q, qd, params)


def velocity(lagrangian: Lagrangian, t: Scalar, q: PerDof, p: PerDof, params: PyTree) -> PerDof:
    """Velocities for the momenta `p`, if the Lagrangian is quadratic in the velocities.

    **Returns:**

    The velocities, shape `[dof]`.
    """
    still = jnp.zeros_like(p)
    mass = motion_equations(lagrangian, t, q, still, params).mass
    return solve_positive_definite(mass, p - momentum(lagrangian, t, q, still, params))


def quadratic(lagrangian: Lagrangian, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Array:
    """Whether the mass matrix is the same at rest, at `qd` and at other velocities, to half of the digits.

    **Returns:**

    A boolean, shape `[]`.
    """
    at = [motion_equations(lagrangian, t, q, v, params).mass for v in (jnp.zeros_like(qd), qd, qd + 1.0)]
    largest = jnp.max(jnp.abs(at[0]))
    change = jnp.maximum(jnp.max(jnp.abs(at[1] - at[0])), jnp.max(jnp.abs(at[2] - at[0])))
    return change <= float(jnp.finfo(qd.dtype).eps) ** 0.5 * largest
