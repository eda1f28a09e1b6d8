"""The compiled part of a run."""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int, PyTree

from ..scene import Scene, State, check_scene, scene_field, scene_power
from ..solvers import FiniteSteps, Rodas5P
from ._outcome import SUCCESS, end_code, start_code


class Problem(NamedTuple):
    """All numbers of a run."""

    scene: Scene
    q0: Float[Array, " dof"]
    qd0: Float[Array, " dof"]
    # Initial own states of effects that do not start at rest.
    z0: dict[str, PyTree]
    t0: Float[Array, ""]
    t1: Float[Array, ""]
    ts: Float[Array, " time"] | None
    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    dt: Float[Array, ""] | None
    # Array leaves of the solver and the adjoint, if they have any.
    plugins: PyTree


def initial_state(problem: Problem) -> State:
    """State at t0: effects whose state is not given start at rest."""
    return State(problem.q0, problem.qd0, problem.scene.state0() | problem.z0)


@dataclass(frozen=True)
class Options:
    """All choices of a run that are compiled in."""

    solver: Any
    adjoint: Any
    max_steps: int


class Work(NamedTuple):
    """Energy [J] that went through a scene since t0: supplied from outside, and absorbed by friction."""

    supplied: Float[Array, "..."]
    absorbed: Float[Array, "..."]


class Solved(NamedTuple):
    """What a run gives: saved times and states, the outcome, the end that was reached, and the numbers of steps."""

    t: Float[Array, " time"]
    # A `State`; in an audited run a pair of it and `Work`.
    y: Any
    code: Int[Array, ""]
    # None where the end alone is kept, and so is in `t` and `y` already: every output of compiled code costs time.
    end: tuple[Float[Array, ""], State] | None
    stats: dict[str, Array]


def default_solver(scene: Scene, fixed_step: bool) -> dfx.AbstractSolver:
    """Rodas5P where an effect of the scene is stiff, Tsit5 otherwise."""
    return Rodas5P(pivot=fixed_step) if any(effect.stiff for effect in scene.effects) else dfx.Tsit5()


def _flow(t: Any, y: State, scene: Scene) -> State:
    return scene_field(t, y, scene)


def _audited_flow(t: Any, y: tuple[State, Work], scene: Scene) -> tuple[State, Work]:
    return scene_field(t, y[0], scene), Work(*scene_power(t, y[0], scene))


def _integrate(problem: Problem, options: Options, field: Any, y0: PyTree, state_of: Any) -> Solved:
    """Run diffrax on `field`."""
    scene = problem.scene
    initial = initial_state(problem)
    check_scene(scene, initial)
    solver = (
        default_solver(scene, problem.dt is not None)
        if options.solver is None
        else eqx.combine(options.solver, problem.plugins[0])
    )
    adjoint = (
        dfx.RecursiveCheckpointAdjoint()
        if options.adjoint is None
        else eqx.combine(options.adjoint, problem.plugins[1])
    )
    if problem.dt is None:
        span = jnp.maximum(jnp.abs(problem.t0), jnp.abs(problem.t1))
        controller = dfx.PIDController(
            problem.rtol, problem.atol, dtmin=float(jnp.finfo(span.dtype).eps) * span, force_dtmin=False
        )
    else:
        controller = FiniteSteps()
    start = start_code(scene, problem.t0, initial, scene_field(problem.t0, initial, scene))
    # A run that cannot start does not try to: it ends at t0, where diffrax wants its saving times, too.
    starts = start == SUCCESS
    ts = None if problem.ts is None else jnp.where(starts, problem.ts, problem.t0)
    end = dfx.SubSaveAt(t1=True)
    saveat = dfx.SaveAt(subs=(end, end if ts is None else dfx.SubSaveAt(ts=ts)))
    solution = dfx.diffeqsolve(
        dfx.ODETerm(field),
        solver,
        problem.t0,
        jnp.where(starts, problem.t1, problem.t0),
        problem.dt,
        y0,
        args=scene,
        saveat=saveat,
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=options.max_steps,
        throw=False,
    )
    assert solution.ts is not None
    assert solution.ys is not None
    t_end, last = solution.ts[0][0], jtu.tree_map(lambda x: x[0], solution.ys[0])
    end_state = state_of(last)
    finish = end_code(scene, t_end, end_state, scene_field(t_end, end_state, scene), solution.result)
    code = jnp.where(starts, finish, start)
    t, y = solution.ts[1], solution.ys[1]
    if problem.ts is not None:
        reached = starts | (problem.ts <= problem.t0)
        t = jnp.where(reached, t, jnp.inf)
        y = jtu.tree_map(lambda x: jnp.where(jnp.expand_dims(reached, tuple(range(1, x.ndim))), x, jnp.inf), y)
    stats = {name: solution.stats[name] for name in ("num_steps", "num_rejected_steps")}
    return Solved(t, y, code, None if problem.ts is None else (t_end, end_state), stats)


@partial(jax.jit, static_argnames=("options",))
def solve(problem: Problem, options: Options) -> Solved:
    """Run a scene."""
    return _integrate(problem, options, _flow, initial_state(problem), lambda y: y)


@partial(jax.jit, static_argnames=("options",))
def solve_audited(problem: Problem, options: Options) -> Work:
    """Run a scene again with the integrals of power beside it; returns the work at the saved times."""
    zero = jnp.zeros_like(problem.t0)
    y0 = (initial_state(problem), Work(zero, zero))
    return _integrate(problem, options, _audited_flow, y0, lambda y: y[0]).y[1]
