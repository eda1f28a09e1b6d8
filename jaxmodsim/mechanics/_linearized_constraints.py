"""Multipliers of constraints, and the way back onto them.

With the velocity constraints `w(t, q, qd) = 0` of all constraints together and `J = dw/dqd`, accelerations `a` without
them become `qdd = a + M^-1 J^T lambda`, where `J M^-1 J^T lambda = -(J a + bias)`. Redundant constraints leave that
matrix singular: the motion is unique, and of all multipliers the smallest are taken.
"""

from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._core.cholesky import factor_positive_definite
from .._core.semidefinite import solve_balanced
from ._constraint import AbstractConstraint

# Newton steps of a projection; the error of a step of integration is squared in each.
_NEWTON = 2

Constraints = Sequence[AbstractConstraint]


class LinearizedConstraints(NamedTuple):
    """All constraints of a mechanism at one state; m equations.

    - `rows`: J, shape `[m, dof]`.
    - `bias`: rate of w where qdd = 0, with the stabilising terms, shape `[m]`.
    - `reach`: rows `M^-1 J_k`, the accelerations of unit multipliers, shape `[m, dof]`.
    - `matrix`: `J M^-1 J^T`, shape `[m, m]`.
    """

    rows: Float[Array, "m dof"]
    bias: Float[Array, " m"]
    minv_jt: Float[Array, "m dof"]
    matrix: Float[Array, "m m"]

    def multipliers(self, qdd: Float[Array, " dof"]) -> Float[Array, " m"]:
        """Multipliers that make accelerations `qdd` admissible."""
        return -solve_balanced(self.matrix, _times(self.rows, qdd) + self.bias)

    def multiplier_response(self, qdd: Float[Array, " dof"]) -> Float[Array, " m"]:
        """What multipliers change if the accelerations without constraints change by `qdd`."""
        return -solve_balanced(self.matrix, _times(self.rows, qdd))

    def apply_force(self, multipliers: Float[Array, " m"]) -> Float[Array, " dof"]:
        """Accelerations that multipliers make."""
        return jnp.sum(self.minv_jt * multipliers[:, None], axis=0)

    def force(self, multipliers: Float[Array, " m"]) -> Float[Array, " dof"]:
        """Generalised force of multipliers."""
        return jnp.sum(self.rows * multipliers[:, None], axis=0)


def linearize_constraints(
    constraints: Constraints,
    t: Float[Array, ""],
    q: Float[Array, " dof"],
    qd: Float[Array, " dof"],
    params: PyTree,
    mass: Float[Array, "dof dof"],
) -> LinearizedConstraints:
    """The constraints at one state of a mechanism with the mass matrix `mass`."""

    def along(t: Array, q: Array) -> Array:
        return rates(constraints, t, q, params)(qd)

    rows = _jacobian(rates(constraints, t, q, params), qd)
    w, bias = jax.jvp(along, (t, q), (jnp.ones_like(t), qd))
    for each, part in zip(constraints, parts(constraints, t, q, qd, params), strict=True):
        error, rate = each.error(t, q, params), each.stabilise.astype(q.dtype)
        damped = rate * w[part] if error is None else 2.0 * rate * w[part] + rate**2 * error
        bias = bias.at[part].add(damped)
    reach, matrix = _reach(rows, mass)
    return LinearizedConstraints(rows, bias, reach, matrix)


def parts(
    constraints: Constraints,
    t: Float[Array, ""],
    q: Float[Array, " dof"],
    qd: Float[Array, " dof"],
    params: PyTree,
) -> list[slice]:
    """Where the equations of each constraint stand among those of all."""
    ends = list(accumulate(jax.eval_shape(each.rate, t, q, qd, params).shape[0] for each in constraints))
    return [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]


def errors(
    constraints: Constraints, t: Float[Array, ""], params: PyTree
) -> Callable[[Float[Array, " dof"]], Float[Array, " h"]]:
    """All that holonomic constraints say about the coordinates, as a function of these; h = 0 where there are none."""

    def at(q: Array) -> Array:
        found = [each.error(t, q, params) for each in constraints]
        return jnp.concatenate([jnp.zeros(0, q.dtype), *(error for error in found if error is not None)])

    return at


def rates(
    constraints: Constraints, t: Float[Array, ""], q: Float[Array, " dof"], params: PyTree
) -> Callable[[Float[Array, " dof"]], Float[Array, " m"]]:
    """All that constraints say about the velocities, as a function of these."""

    def at(qd: Array) -> Array:
        return jnp.concatenate([each.rate(t, q, qd, params) for each in constraints])

    return at


def project_position(
    constraints: Constraints,
    t: Float[Array, ""],
    q: Float[Array, " dof"],
    params: PyTree,
    mass: Float[Array, "dof dof"],
) -> Float[Array, " dof"]:
    """Coordinates moved onto the holonomic constraints, the shortest way in the metric of the masses.

    Two Newton steps, with the mass matrix held.
    """
    error = errors(constraints, t, params)
    if error(q).shape == (0,):
        return q
    for _ in range(_NEWTON):
        reach, matrix = _reach(_jacobian(error, q), mass)
        q = q - jnp.sum(reach * solve_balanced(matrix, error(q))[:, None], axis=0)
    return q


def project_velocity(
    constraints: Constraints,
    t: Float[Array, ""],
    q: Float[Array, " dof"],
    qd: Float[Array, " dof"],
    params: PyTree,
    mass: Float[Array, "dof dof"],
) -> Float[Array, " dof"]:
    """Velocities moved onto the constraints, by the smallest impulses that do."""
    rate = rates(constraints, t, q, params)
    reach, matrix = _reach(_jacobian(rate, qd), mass)
    return qd - jnp.sum(reach * solve_balanced(matrix, rate(qd))[:, None], axis=0)


def _jacobian(fn: object, x: Float[Array, " dof"]) -> Float[Array, "m dof"]:
    """Jacobian by rows: there are never more independent constraints than coordinates."""
    return jax.jacrev(fn)(x)  # pyright: ignore[reportArgumentType]


def _reach(rows: Float[Array, "m dof"], mass: Float[Array, "dof dof"]) -> tuple[Array, Array]:
    """Accelerations of unit multipliers, and what they do to each constraint."""
    reach = factor_positive_definite(mass)(rows.T).T
    return reach, jnp.sum(rows[:, None, :] * reach[None, :, :], axis=2)


def _times(rows: Float[Array, "m dof"], vector: Float[Array, " dof"]) -> Float[Array, " m"]:
    return jnp.sum(rows * vector[None, :], axis=1)
