"""The return map of a scene, its derivatives, and the equations of an orbit."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..scene import Scene, State, replace_elements
from ..simulation import RunRequest, outcome_messages, simulate

# Period [s] from the parameters of the scene.
PeriodFn: TypeAlias = Callable[[PyTree], Array | float]
# A function of q and qd that is zero where an orbit begins.
Section: TypeAlias = Callable[[Array, Array], Array | float]

MAX_STEPS, MAX_EVENTS = 65536, 4096


class OrbitError(RuntimeError):
    """No periodic orbit, or not one alone; the message says why, and what to do."""


class OrbitProblem(eqx.Module):
    """What has to return to itself.

    - `phase`: time at which forced orbits begin, in periods.
    - `period`: of a forced orbit, from the parameters of the scene; None where the period is unknown.
    - `parameter`: a number of the scene that is one of the unknowns; None where there is none.
    - `normal`, `anchor`: the plane in which an orbit of unknown period begins: `normal . (x - anchor) = 0`. With a
      `section` that takes its place.
    """

    scene: Scene
    phase: Float[Array, ""]
    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    normal: Float[Array, " n"]
    anchor: Float[Array, " n"]
    period: PeriodFn | None = eqx.field(static=True)
    section: Section | None = eqx.field(static=True)
    parameter: str | None = eqx.field(static=True)

    @property
    def autonomous(self) -> bool:
        """Whether the period is unknown."""
        return self.period is None

    def with_value(self, value: Array | float) -> Scene:
        """The scene with another value of the parameter."""
        return self.scene if self.parameter is None else replace_elements(self.scene, {self.parameter: value})

    def period_of(self, scene: Scene, unknown: Array) -> Array:
        """Period [s]."""
        return unknown if self.period is None else jnp.asarray(self.period(scene.params), unknown.dtype)

    def plane(self, x: Array, dof: int) -> Array:
        """Zero where an orbit of unknown period may begin."""
        if self.section is not None:
            return jnp.asarray(self.section(x[:dof], x[dof : 2 * dof]), x.dtype)
        return jnp.sum(self.normal * (x - self.anchor))


def pack(state: State) -> Float[Array, " n"]:
    """Coordinates, velocities and own states of effects in one vector."""
    return ravel_pytree(tuple(state))[0]


def unpack(scene: Scene, x: Array, dof: int) -> State:
    """The state in such a vector."""
    shape = tuple(State(x[:dof], x[:dof], scene.initial_state(x[:dof])))
    return State(*ravel_pytree(shape)[1](x))


class Returned(NamedTuple):
    """The state after a period, and derivatives.

    - `x`: after a period, shape `[n]`; `by`: its derivatives by start, unknown period and parameter, `[n, n + 2]`.
    - `plane`, `plane_by`: of `OrbitProblem.plane`.
    - `code`: how the run ended.
    """

    x: Float[Array, " n"]
    by: Float[Array, "n unknowns"]
    plane: Float[Array, ""]
    plane_by: Float[Array, " n"]
    code: Array


def end_state(
    problem: OrbitProblem,
    scene: Scene,
    x: Array,
    period: Array,
    dof: int,
    adjoint: dfx.AbstractAdjoint | None = None,
    max_steps: int = RunRequest.max_steps,
) -> tuple[Float[Array, " n"], Array]:
    """State a period after x, and how the run ended."""
    y = unpack(scene, x, dof)
    run = simulate(
        *(scene, y.q, y.qd, (problem.phase + 1.0) * period),
        t0=problem.phase * period,
        z0=y.z,
        rtol=problem.rtol,
        atol=problem.atol,
        adjoint=adjoint,
        max_steps=max_steps,
        max_events=MAX_EVENTS,
        throw=False,
    )
    return pack(jtu.tree_map(lambda a: a[-1], State(run.q, run.qd, run.z))), run.result.code


@eqx.filter_jit
def _returned(problem: OrbitProblem, unknowns: Array, dof: int) -> Returned:
    n = unknowns.shape[0] - 2

    def map_(unknowns: Array) -> tuple[Array, tuple[Array, Array]]:
        scene = problem.with_value(unknowns[-1])
        period = problem.period_of(scene, unknowns[n])
        x, code = end_state(problem, scene, unknowns[:n], period, dof, dfx.ForwardMode(), MAX_STEPS)
        return x, (x, code)

    by, (x, code) = jax.jacfwd(map_, has_aux=True)(unknowns)
    plane, plane_by = jax.value_and_grad(problem.plane)(unknowns[:n], dof)
    return Returned(x, by, plane, plane_by, code)


class ShotOrbit(NamedTuple):
    """A start, a period [s] and a value of the parameter, and what becomes of them in a period.

    - `residual`: of the equations, `[n]`, or `[n + 1]` with the plane; `by`: their derivatives by start, period (of
      unknown period alone) and parameter.
    - `failure`: how the run ended early; "" where it did not.
    """

    x: np.ndarray
    period: float
    value: float
    map_by: np.ndarray
    residual: np.ndarray
    by: np.ndarray
    failure: str

    @property
    def monodromy(self) -> np.ndarray:
        """Derivative of the state after a period by the state before it, `[n, n]`."""
        return self.map_by[:, : len(self.x)]

    @property
    def flow(self) -> np.ndarray:
        """Rate of the state at the start, `[n]`; of unknown period."""
        return self.map_by[:, len(self.x)]

    @property
    def unknowns(self) -> np.ndarray:
        """What the columns of `by` belong to."""
        period = [self.period] if self.by.shape[1] == len(self.x) + 2 else []
        return np.array([*self.x, *period, self.value])


def evaluate(problem: OrbitProblem, x: np.ndarray, period: float, value: float, dof: int) -> ShotOrbit:
    """The equations of an orbit at these unknowns."""
    n = len(x)
    made = jax.device_get(_returned(problem, jnp.asarray([*x, period, value]), dof))
    by, residual = made.by - np.eye(n, n + 2), made.x - x
    if problem.autonomous:
        by = np.vstack([by, [*made.plane_by, 0.0, 0.0]])
        residual = np.append(residual, made.plane)
    else:
        by = np.delete(by, n, axis=1)
        period = float(problem.period_of(problem.with_value(value), jnp.asarray(period)))
    failure = "" if made.code == 0 else outcome_messages(problem.scene, dof)[int(made.code)]
    if not failure and not (np.isfinite(by).all() and np.isfinite(residual).all()):
        failure = "The run or its derivatives are not finite."
    return ShotOrbit(x, period, value, made.by, residual, by, failure)
