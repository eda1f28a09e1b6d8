"""The linear systems of an implicit step of a scene, from the structure of mechanics."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._core.arrays import PerDof, Scalar, fusion_barrier, opaque_one
from .._core.lu import Scalar as Entry
from .._core.lu import factor_lu, product
from .._core.scalarise import columns_of, in_scalars
from ..mechanics import inverse_dynamics
from ._dynamics import State
from ._scene import Scene


def has_linear_solver(scene: Scene) -> bool:
    """Whether `linear_solver` supports the scene: no constraints, switches or friction by accelerations.

    **Returns:**

    A `bool`.
    """
    depends = scene.event_driven or scene.reaction_loaded or scene.switches
    return not (depends or scene.constraints or any(each.karnopp for each in scene.friction.values()))


def linear_solver(
    t: Scalar, y: State, qdd: PerDof, scene: Scene, *, shift: Scalar, pivot: bool
) -> Callable[[State], State]:
    """Solver of `(shift I - J) x = rhs`, J the Jacobian of the vector field at a state with the accelerations `qdd`.

    J is not formed. The rows of the accelerations are those of inverse dynamics, `R(q, qd, qdd, z) = 0` (implicit
    function theorem), so that no derivative goes through the mass matrix and its factors. Coordinates, whose rates are
    the velocities, are eliminated: with `x_q = (rhs_q + x_qd)/shift` there remain

        dR(x_qd/shift, x_qd, shift x_qd, x_z) = -dR(rhs_q/shift, 0, -rhs_qd, 0)
        shift x_z - dz'(x_qd/shift, x_qd, x_z) = rhs_z + dz'(rhs_q/shift, 0, 0)

    where dR and dz' are the derivatives along their arguments. `factor_lu` eliminates the states of effects first; each
    depends on itself alone, so that the matrix of the velocities alone is full.

    **Arguments:**

    - `t`, `y`: time and state.
    - `qdd`: accelerations there, shape `[dof]`.
    - `scene`: one of which `has_linear_solver` is true.
    - `shift`: reciprocal of a time [1/s].
    - `pivot`: whether the elimination swaps rows; see `factor_lu`.

    **Returns:**

    A function from the right-hand side to the solution, both of the structure of `y`, differentiable in all numbers.
    """
    z, as_states = ravel_pytree(y.z)
    n, unit, period = y.q.shape[0], opaque_one(y.q[0]), 1.0 / shift

    def balance(q: Array, qd: Array, qdd: Array, z: Array) -> tuple[Array, Array]:
        return _balance(t, State(q, qd, as_states(z)), qdd, scene)

    _, along = jax.linearize(lambda *at: in_scalars(balance, *at, seed=y.q), y.q, y.qd, qdd, z)

    def states(x: Sequence[Array]) -> Array:
        return jnp.stack(x) if x else z

    def left(*x: Array) -> tuple[Array, Array]:
        x_qd, x_z = jnp.stack(x[:n]), states(x[n:])
        residual, rate = along(period * x_qd, x_qd, shift * x_qd, x_z)
        return residual, shift * x_z - rate

    def right(*rhs: Array) -> tuple[Array, Array]:
        rhs_q, rhs_qd, rhs_z = jnp.stack(rhs[:n]), jnp.stack(rhs[n : 2 * n]), states(rhs[2 * n :])
        residual, rate = along(period * rhs_q, jnp.zeros_like(qdd), -rhs_qd, jnp.zeros_like(z))
        return -residual, rhs_z + rate

    def rows(linear: Callable[..., tuple[Array, Array]], *like: Array) -> list[tuple[Entry, ...]]:
        # With a barrier: otherwise every use of an entry computes it, 58 us instead of 5 for a step of three links.
        columns = columns_of(lambda *x: [*jnp.concatenate(fusion_barrier(linear(*x), unit))], unit, *like)
        return list(zip(*columns, strict=True))

    solve, known = factor_lu(rows(left, *y.qd, *z), pivot=pivot), rows(right, *y.q, *y.qd, *z)

    def solution(rhs: State) -> State:
        given = [*rhs.q, *rhs.qd, *ravel_pytree(rhs.z)[0]]
        x = solve([product(row, given) for row in known])
        qd = jnp.stack(x[:n])
        return State(period * (rhs.q + qd), qd, as_states(states(x[n:])))

    return solution


def _balance(t: Scalar, y: State, qdd: PerDof, scene: Scene) -> tuple[PerDof, Float[Array, " entries"]]:
    """Generalised force that the accelerations `qdd` lack, and the rates of the states of the effects."""
    q, qd = y.q, y.qd
    scene = scene.bind_state(t, q, qd)
    missing, rates = inverse_dynamics(scene.lagrangian, t, q, qd, qdd, scene.params), {}
    for name, effect in zip(scene.names, scene.effects, strict=True):
        action = effect.act(t, q, qd, y.z.get(name), scene.params)
        missing = missing - action.generalised
        if name in y.z:
            rates[name] = action.rate
    return missing, ravel_pytree(rates)[0]
