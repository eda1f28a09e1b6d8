"""The equations of an equilibrium with their derivatives, and Newton's iteration for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics import errors, rates
from ..scene import Scene, State, from_dynamics, replace_elements
from ._newton import Condition, all_derivatives, all_residuals
from ._return_map import OrbitError, pack, unpack

_ITERATIONS, _HALVINGS = 50, 8
# Steps in the scales of the unknowns: the iteration ends at the first, and has converged at the second if it stalls.
_GOAL, _ENOUGH = 1e-14, 1e-9
# Relative size of singular values that count as zero.
_RANK = 1e-11


class RestProblem(eqx.Module):
    """The problem of an equilibrium.

    - `mode`: modes of the friction elements, zero in stick, and zeros for contacts, which are open; None for a scene
      without modes.
    - `ends`: direction of the limiting friction force of each row in stick; zero for the others.
    - `parameter`: name of a number of the scene that is an unknown, or None.
    """

    scene: Scene
    mode: Float[Array, " modes"] | None
    ends: Float[Array, " rows"]
    parameter: str | None = eqx.field(static=True)

    def with_value(self, value: Array | float) -> Scene:
        """The scene with another value of the parameter."""
        return self.scene if self.parameter is None else replace_elements(self.scene, {self.parameter: value})


class RestEquations(NamedTuple):
    """Residuals at a state, which vanish at an equilibrium, and the quantities that confirm the modes.

    - `rate`: of the state, with friction at its limits in stick, shape `[n]`.
    - `held`: errors and rates of constraints, shape `[c]`.
    - `slip`: slip velocities of the friction elements with modes. `gaps`: of contacts [m].
    """

    rate: Float[Array, " n"]
    held: Float[Array, " c"]
    slip: Float[Array, " rows"]
    gaps: Float[Array, " contacts"]


def rest_equations(problem: RestProblem, scene: Scene, x: Array, t: Array, dof: int) -> RestEquations:
    """The equations at a state."""
    scene = scene.bind_time(t)
    y, n = unpack(scene, x, dof), problem.ends.shape[0]

    def at(d) -> tuple[State, Array]:
        if not n:
            return d.rate, jnp.zeros(0, x.dtype)
        limit = jnp.where(problem.ends > 0, d.friction.upper[:n], d.friction.lower[:n])
        # Accelerations with the elements in stick at their limits: zero if the limits balance all other forces.
        excess = jnp.where(problem.ends != 0, d.friction.force[:n] - problem.ends * limit, 0.0)
        qdd = d.rate.qd + jnp.sum(d.friction_elements.minv_jt[:n] * excess[:, None], axis=0)
        return d.rate._replace(qd=qdd), d.friction_elements.v[:n]

    rate, slip = from_dynamics(at, t, y, scene, problem.mode)
    held, gaps = jnp.zeros(0, x.dtype), jnp.zeros(0, x.dtype)
    if scene.bilateral:
        position, velocity = errors(scene.bilateral, t, scene.params), rates(scene.bilateral, t, y.q, scene.params)
        held = jnp.concatenate([position(y.q), velocity(y.qd)])
    if scene.contacts:
        gaps = jnp.concatenate([each.error(t, y.q, scene.params) for each in scene.contacts.values()])
    return RestEquations(pack(rate), held, slip, gaps)


@eqx.filter_jit
def _evaluated(problem: RestProblem, unknowns: Array, t: Array, dof: int) -> tuple[Array, RestEquations]:
    def at(unknowns: Array) -> tuple[Array, RestEquations]:
        equations = rest_equations(problem, problem.with_value(unknowns[-1]), unknowns[:-1], t, dof)
        return jnp.concatenate([equations.rate, equations.held]), equations

    return jax.jacfwd(at, has_aux=True)(unknowns)


@dataclass(frozen=True)
class RestPoint:
    """The equations at a state and a value of the parameter.

    - `residual`: shape `[n + c]`. `by`: its derivatives by state and parameter, shape `[n + c, n + 1]`.
    """

    x: np.ndarray
    value: float
    residual: np.ndarray
    by: np.ndarray

    @property
    def unknowns(self) -> np.ndarray:
        """State and parameter, in the order of the columns of `by`."""
        return np.append(self.x, self.value)

    @property
    def basis(self) -> np.ndarray:
        """Basis of the states within the constraints, shape `[n, k]`."""
        n = len(self.x)
        if len(self.by) == n:
            return np.eye(n)
        _, sizes, rows = np.linalg.svd(self.by[n:, :n])
        return rows[np.count_nonzero(sizes > _RANK * sizes[0]) :].T

    @property
    def rows(self) -> np.ndarray:
        """Projector of the equations on rates within the constraints, and the constraints, shape `[k + c, n + c]`."""
        n, held = len(self.x), np.eye(len(self.by) - len(self.x))
        return np.block([[self.basis.T, np.zeros((self.basis.shape[1], len(held)))], [np.zeros((len(held), n)), held]])

    def scaled(self, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the projected equations by the scaled unknowns, and residuals, with rows of unit size."""
        by, residual = self.rows @ self.by * scale, self.rows @ self.residual
        size = np.maximum(np.max(np.abs(by), axis=1), 1e-300)
        return by / size[:, None], residual / size

    @property
    def linearised(self) -> np.ndarray:
        """Derivatives of the rates by the state, within the constraints, shape `[k, k]`."""
        n = len(self.x)
        return self.basis.T @ self.by[:n, :n] @ self.basis


def rest_at(problem: RestProblem, x: np.ndarray, value: float, dof: int, t: float = 0.0) -> RestPoint:
    """Evaluate the equations.

    **Raises:**

    - `OrbitError` if they are not finite.
    """
    by, equations = jax.device_get(_evaluated(problem, jnp.asarray([*x, value]), jnp.asarray(t), dof))
    residual = np.concatenate([equations.rate, equations.held])
    if not (np.isfinite(by).all() and np.isfinite(residual).all()):
        raise OrbitError("The equations of motion are not finite at this state.")
    return RestPoint(x, value, residual, by)


def solve_rest(
    problem: RestProblem, x: np.ndarray, value: float, dof: int, scale: np.ndarray, conditions: Sequence[Condition] = ()
) -> tuple[RestPoint, int]:
    """Solve the equations. With a condition the parameter is an unknown. Returns the number of iterations too.

    **Raises:**

    - `OrbitError` if the iteration does not converge, if the modes differ at its end, or for a family of equilibria.
    """
    point, last = rest_at(problem, x, value, dof), np.inf
    for i in range(_ITERATIONS):
        step = _step(point, scale, conditions)
        size = float(np.max(np.abs(step / scale)))
        if size < _GOAL or (size < _ENOUGH and size > 0.5 * last):
            _refuse_other_modes(problem, point, dof)
            return point, i
        before, last = _size(point, scale, conditions), size
        start = point.unknowns
        for halving in range(_HALVINGS):
            unknowns = start + step * 0.5**halving
            unknowns[dof : 2 * dof] = 0.0  # exact zeros, because modes depend on them
            point = rest_at(problem, unknowns[:-1], float(unknowns[-1]), dof)
            if size < _ENOUGH or _size(point, scale, conditions) < before:
                break
    raise OrbitError(
        f"No convergence to an equilibrium in {_ITERATIONS} iterations: the last relative step is {last:.3g}. Begin"
        " nearer to the equilibrium."
    )


def _size(point: RestPoint, scale: np.ndarray, conditions: Sequence[Condition]) -> float:
    return float(np.linalg.norm(all_residuals(point, scale, conditions)))


def _step(point: RestPoint, scale: np.ndarray, conditions: Sequence[Condition]) -> np.ndarray:
    by, residual = (of(point, scale, conditions) for of in (all_derivatives, all_residuals))
    by = by if conditions else by[:, :-1]
    step, _, rank, _ = np.linalg.lstsq(by, -residual, rcond=_RANK)
    if not conditions and rank < by.shape[1] and np.max(np.abs(residual)) < _ENOUGH:
        raise OrbitError(
            "The equilibrium is one of a family: the scene does not determine its place. Examples are a coordinate"
            " without a spring, and a bristle at rest, as of LuGre on a surface at rest. Give the surface a velocity,"
            " or use a set-valued law, whose set of equilibria has ends."
        )
    return scale * (step if conditions else np.append(step, 0.0))


def _refuse_other_modes(problem: RestProblem, point: RestPoint, dof: int) -> None:
    _, equations = _evaluated(problem, jnp.asarray(point.unknowns), jnp.zeros(()), dof)
    if problem.mode is not None and equations.slip.shape[0]:
        mode = problem.mode[: equations.slip.shape[0]]
        if bool(jnp.any(jnp.sign(mode) != jnp.sign(equations.slip))):
            raise OrbitError("A friction element begins to stick, or to slip the other way: its surface is at rest.")
    if bool(jnp.any(equations.gaps <= 0)):
        raise OrbitError("A contact is closed at the equilibrium, but equilibrium supports open contacts alone.")
