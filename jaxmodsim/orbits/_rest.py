"""The equations of an equilibrium, their derivatives, and Newton's iteration for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics import errors, rates
from ..scene import Scene, State, from_dynamics, replace_elements
from ._return_map import OrbitError, pack, unpack

_ITERATIONS, _HALVINGS = 50, 8
# Steps in the scales of the unknowns: where the iteration ends, and where it has converged if it comes no further.
_GOAL, _ENOUGH = 1e-14, 1e-9
# Singular values below this part of the largest one are no directions.
_RANK = 1e-11


class RestProblem(eqx.Module):
    """What has to be at rest.

    - `mode`: modes of slip of the friction elements, zero of those that stick, and zeros of contacts, which are open;
      None where there are none.
    - `ends`: direction in which the friction force of each row that sticks is at its limit; zero of the others.
    - `parameter`: a number of the scene that is one of the unknowns; None where there is none.
    """

    scene: Scene
    mode: Float[Array, " modes"] | None
    ends: Float[Array, " rows"]
    parameter: str | None = eqx.field(static=True)

    def with_value(self, value: Array | float) -> Scene:
        """The scene with another value of the parameter."""
        return self.scene if self.parameter is None else replace_elements(self.scene, {self.parameter: value})


class RestEquations(NamedTuple):
    """Left-hand sides at a state, all of which vanish at an equilibrium, and what tells whether the modes hold.

    - `rate`: of the state, in the end of a set with friction at its limits, shape `[n]`.
    - `held`: errors and rates of constraints, shape `[c]`.
    - `slip`: slip velocities of the friction elements with modes; `gaps`: of contacts [m].
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
        # Accelerations where the elements that stick are at their limits: zero where the limits are what holds them.
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
        made = rest_equations(problem, problem.with_value(unknowns[-1]), unknowns[:-1], t, dof)
        return jnp.concatenate([made.rate, made.held]), made

    return jax.jacfwd(at, has_aux=True)(unknowns)


@dataclass(frozen=True)
class RestPoint:
    """A state and a value of the parameter, and the equations there.

    - `residual`: shape `[n + c]`; `by`: its derivatives by state and parameter, shape `[n + c, n + 1]`.
    """

    x: np.ndarray
    value: float
    residual: np.ndarray
    by: np.ndarray

    @property
    def unknowns(self) -> np.ndarray:
        """What the columns of `by` belong to."""
        return np.append(self.x, self.value)

    @property
    def basis(self) -> np.ndarray:
        """The directions of the state within the constraints, shape `[n, k]`."""
        n = len(self.x)
        if len(self.by) == n:
            return np.eye(n)
        _, sizes, rows = np.linalg.svd(self.by[n:, :n])
        return rows[np.count_nonzero(sizes > _RANK * sizes[0]) :].T

    @property
    def rows(self) -> np.ndarray:
        """What of the equations counts: rates within the constraints, and the constraints, shape `[k + c, n + c]`."""
        n, held = len(self.x), np.eye(len(self.by) - len(self.x))
        return np.block([[self.basis.T, np.zeros((self.basis.shape[1], len(held)))], [np.zeros((len(held), n)), held]])

    def scaled(self, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives by the unknowns in their scales, and residuals, of what counts, with rows of one size."""
        by, residual = self.rows @ self.by * scale, self.rows @ self.residual
        size = np.maximum(np.max(np.abs(by), axis=1), 1e-300)
        return by / size[:, None], residual / size

    @property
    def linearised(self) -> np.ndarray:
        """The rates' derivatives by the state within the constraints, shape `[k, k]`."""
        n = len(self.x)
        return self.basis.T @ self.by[:n, :n] @ self.basis


def rest_at(problem: RestProblem, x: np.ndarray, value: float, dof: int, t: float = 0.0) -> RestPoint:
    """The equations at these unknowns.

    **Raises:**

    - `OrbitError` where they are not finite, or the modes are not those of the problem.
    """
    by, made = jax.device_get(_evaluated(problem, jnp.asarray([*x, value]), jnp.asarray(t), dof))
    residual = np.concatenate([made.rate, made.held])
    if not (np.isfinite(by).all() and np.isfinite(residual).all()):
        raise OrbitError("The equations of motion are not finite there.")
    return RestPoint(x, value, residual, by)


# Rows that are added to the equations: their residual and derivatives at a point.
_Extra = Callable[[RestPoint], tuple[float, np.ndarray]]


def solve_rest(
    problem: RestProblem, x: np.ndarray, value: float, dof: int, scale: np.ndarray, extra: _Extra | None = None
) -> tuple[RestPoint, int]:
    """Newton's iteration; with `extra` the parameter is one of the unknowns. Returns the number of iterations too.

    **Raises:**

    - `OrbitError` where it does not converge, ends where the modes are others, or there is a family of equilibria.
    """
    point, last = rest_at(problem, x, value, dof), np.inf
    for i in range(_ITERATIONS):
        step = _step(point, scale, extra)
        size = float(np.max(np.abs(step / scale)))
        if size < _GOAL or (size < _ENOUGH and size > 0.5 * last):
            _refuse_other_modes(problem, point, dof)
            return point, i
        before, last = _size(point, scale, extra), size
        start = point.unknowns
        for halving in range(_HALVINGS):
            unknowns = start + step * 0.5**halving
            unknowns[dof : 2 * dof] = 0.0  # exactly, for modes go by it
            point = rest_at(problem, unknowns[:-1], float(unknowns[-1]), dof)
            if size < _ENOUGH or _size(point, scale, extra) < before:
                break
    raise OrbitError(
        f"No convergence to an equilibrium in {_ITERATIONS} iterations; the last step was {last:.3g} of its size. Begin"
        " nearer to it."
    )


def _size(point: RestPoint, scale: np.ndarray, extra: _Extra | None) -> float:
    more = 0.0 if extra is None else extra(point)[0]
    return float(np.linalg.norm([*point.scaled(scale)[1], more]))


def _step(point: RestPoint, scale: np.ndarray, extra: _Extra | None) -> np.ndarray:
    by, residual = point.scaled(scale)
    if extra is None:
        by = by[:, :-1]
    else:
        more, row = extra(point)
        by, residual = np.vstack([by, row]), np.append(residual, more)
    step, _, rank, _ = np.linalg.lstsq(by, -residual, rcond=_RANK)
    if extra is None and rank < by.shape[1] and np.max(np.abs(residual)) < _ENOUGH:
        raise OrbitError(
            "The equilibrium is not alone but one of a family: nothing in the scene says where it is. So it is with a"
            " coordinate without a spring, and with a bristle that stands still, as of LuGre on a surface at rest; give"
            " the surface a velocity, or take the set-valued law, whose sets of equilibria have ends."
        )
    return scale * (np.append(step, 0.0) if extra is None else step)


def _refuse_other_modes(problem: RestProblem, point: RestPoint, dof: int) -> None:
    _, made = _evaluated(problem, jnp.asarray(point.unknowns), jnp.zeros(()), dof)
    if problem.mode is not None and made.slip.shape[0]:
        mode = problem.mode[: made.slip.shape[0]]
        if bool(jnp.any(jnp.sign(mode) != jnp.sign(made.slip))):
            raise OrbitError("A friction element begins to stick, or to slip the other way: its surface is at rest.")
    if bool(jnp.any(made.gaps <= 0)):
        raise OrbitError("A contact is closed there, and equilibria are sought with contacts open.")
