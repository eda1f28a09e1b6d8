"""The compiled part of a run."""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int, PyTree

from ..effects import Power
from ..scene import (
    Scene,
    State,
    check_scene,
    scene_drifts,
    scene_field,
    scene_guards,
    scene_modes,
    scene_overload,
    scene_power,
    scene_project,
    scene_stick,
    scene_switch,
)
from ..solvers import EventController, EventLog, EventSolver, EventState, FiniteSteps, Projected, Rodas5P
from ._outcome import MISSED_EVENT, SUCCESS, Ending, end_code, start_code

# Part of the absolute tolerance below which a slip velocity counts as none.
_REST = 1e-3
# Part of its limit by which a sticking element's force may exceed it at a saved time, for the error of dense output.
_OVERLOAD = 1e-2


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
    dtmax: Float[Array, ""] | None
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
    max_events: int
    hold_chatter: bool
    project: bool


# Energy [J] that went through a scene since t0, by the names of `scene_power`: supplied from outside, and absorbed.
Work: TypeAlias = dict[str, Power]


class Solved(NamedTuple):
    """What a run gives: saved times and states, the outcome, the end that was reached, and the numbers of steps."""

    t: Float[Array, " time"]
    # A `State`; in an audited run a pair of it and `Work`.
    y: Any
    # Of the set-valued friction elements, shape `[time, elements]`; None where there are none.
    mode: Any
    code: Int[Array, ""]
    # None where the end alone is kept, and so is in `t` and `y` already: every output of compiled code costs time.
    end: tuple[Float[Array, ""], State] | None
    stats: dict[str, Array]


def default_solver(scene: Scene, dof: int, fixed_step: bool) -> dfx.AbstractSolver:
    """Rodas5P where an effect of the scene is stiff, or runs by events on one coordinate; Tsit5 otherwise.

    Every step of a run with events looks at the guards, whatever the method. On one coordinate Rodas5P makes the fewest
    of those whose dense output keeps the tolerance, and is twice as fast as Tsit5 under vmap; on more of them its
    Jacobian costs more than that, most of all in compile time.
    """
    stiff = any(effect.stiff for effect in scene.effects)
    return Rodas5P(pivot=fixed_step) if stiff or (scene.exact and dof == 1) else dfx.Tsit5()


class _Flow(NamedTuple):
    """What is integrated: a `State`, or in an audited run a pair of it and `Work`."""

    audited: bool

    def start(self, y: State, t: Array, scene: Scene, mode: Any) -> Any:
        """What the run starts from."""
        return (y, jtu.tree_map(jnp.zeros_like, scene_power(t, y, scene, mode))) if self.audited else y

    def state(self, y: Any) -> State:
        """The state in what is integrated."""
        return y[0] if self.audited else y

    def replace(self, y: Any, state: State) -> Any:
        """With another state."""
        return (state, y[1]) if self.audited else state

    def rate(self, t: Any, y: Any, scene: Scene, mode: Any = None) -> Any:
        """Right-hand side."""
        if self.audited:
            return scene_field(t, y[0], scene, mode), scene_power(t, y[0], scene, mode)
        return scene_field(t, y, scene, mode)


# A step with events evaluates field and guards a dozen times. Traced as one function each, they are traced, linearised
# and transposed once.
_rate = partial(jax.jit, static_argnums=0)(_Flow.rate)
_guards = jax.jit(scene_guards)


class _Hybrid(NamedTuple):
    """The functions of a run, where it has modes in the form `EventSolver` takes."""

    flow: _Flow
    # Slip velocity [m/s] that counts as none.
    rest: Float[Array, ""]
    # What drifts with the error of integration and is put right after every step: off the constraints, out of stick.
    projects: bool
    sticks: bool

    def rate(self, t: Any, s: EventState, scene: Scene) -> EventState:
        return s.rate(_rate(self.flow, t, s.y, scene, s.mode))

    def guards(self, t: Any, s: EventState, scene: Scene) -> Array:
        return _guards(t, self.flow.state(s.y), scene, s.mode, self.rest)

    def reset(self, t: Any, s: EventState, scene: Scene, fired: Array) -> EventState:
        state, mode = scene_switch(t, self.flow.state(s.y), scene, s.mode, fired)
        return s._replace(y=self.flow.replace(s.y, state), mode=mode)

    def hold(self, t: Any, s: EventState, scene: Scene, fired: Array) -> EventState:
        return self.stick(t, s._replace(mode=jnp.where(fired, 0.0, s.mode)), scene)

    def stick(self, t: Any, s: EventState, scene: Scene) -> EventState:
        state = scene_stick(t, self.flow.state(s.y), scene, s.mode)
        return s._replace(y=self.flow.replace(s.y, state))

    def project(self, t: Any, y: Any, scene: Scene) -> Any:
        return self.flow.replace(y, scene_project(t, self.flow.state(y), scene)) if self.projects else y

    def settle(self, t: Any, s: EventState, scene: Scene) -> EventState:
        s = s._replace(y=self.project(t, s.y, scene))
        return self.stick(t, s, scene) if self.sticks else s


def _controller(problem: Problem) -> dfx.AbstractStepSizeController:
    if problem.dt is not None:
        return FiniteSteps()
    span = jnp.maximum(jnp.abs(problem.t0), jnp.abs(problem.t1))
    dtmin = float(jnp.finfo(span.dtype).eps) * span
    return dfx.PIDController(problem.rtol, problem.atol, dtmin=dtmin, dtmax=problem.dtmax, force_dtmin=False)


def _plugins(problem: Problem, options: Options) -> tuple[Any, Any]:
    """Solver and adjoint: those that were given, or the defaults."""
    solver = default_solver(problem.scene, problem.q0.shape[0], problem.dt is not None)
    adjoint = dfx.RecursiveCheckpointAdjoint()
    if options.solver is not None:
        solver = eqx.combine(options.solver, problem.plugins[0])
    if options.adjoint is not None:
        adjoint = eqx.combine(options.adjoint, problem.plugins[1])
    return solver, adjoint


def _integrate(problem: Problem, options: Options, flow: _Flow, log: int | None) -> tuple[Solved, EventLog | None]:
    """Run diffrax; with modes only where the scene has them, with a log of that many events where one is wanted."""
    scene, exact = problem.scene, bool(problem.scene.exact)
    projects, sticks = bool(scene.constraints) and options.project, exact and scene_drifts(scene)
    initial, mode = initial_state(problem), None
    check_scene(scene, initial)
    solver, adjoint = _plugins(problem, options)
    given = initial
    if projects:
        initial = scene_project(problem.t0, initial, scene)
    if exact:
        initial, mode = scene_modes(problem.t0, initial, scene, _REST * problem.atol)
    start = start_code(scene, problem.t0, given, scene_field(problem.t0, initial, scene, mode), mode)
    # A run that cannot start does not try to: it ends at t0, where diffrax wants its saving times, too.
    starts = start == SUCCESS
    ts = None if problem.ts is None else jnp.where(starts, problem.ts, problem.t0)
    y0, controller = flow.start(initial, problem.t0, scene, mode), _controller(problem)
    hybrid = _Hybrid(flow, _REST * problem.atol, projects, sticks)
    if exact:
        solver = EventSolver(
            solver,
            hybrid.guards,
            hybrid.reset,
            hold=hybrid.hold if options.hold_chatter else None,
            project=hybrid.settle if projects or sticks else None,
            insist=True,
            max_events=options.max_events if log is None else min(log, options.max_events),
            log=log is not None,
        )
        y0 = solver.start(problem.t0, y0, mode, scene)
        controller = EventController(controller)
    elif projects:
        solver = Projected(solver, hybrid.project)

    def keep(t: Any, s: Any, scene: Scene) -> Any:
        # Between the ends of steps the state comes from dense output, which obeys neither constraints nor stick.
        return (hybrid.settle(t, s, scene).y, s.mode) if exact else (hybrid.project(t, s, scene), None)

    def keep_end(t: Any, s: Any, scene: Scene) -> Any:
        return keep(t, s, scene), ((s.events, s.trouble, s.fired), s.log) if exact else None

    saveat = dfx.SaveAt(
        subs=(
            dfx.SubSaveAt(t1=True, fn=keep_end),
            dfx.SubSaveAt(t1=True, fn=keep) if ts is None else dfx.SubSaveAt(ts=ts, fn=keep),
        )
    )
    solution = dfx.diffeqsolve(
        dfx.ODETerm(hybrid.rate if exact else flow.rate if not scene.constraints else partial(_rate, flow)),
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
    stats = {name: solution.stats[name] for name in ("num_steps", "num_rejected_steps")}
    (last, mode), events = jtu.tree_map(lambda x: x[0], solution.ys[0])
    t_end, end_state, ending, history = solution.ts[0][0], flow.state(last), None, None
    if exact:
        (count, trouble, fired), history = events
        ending, stats["num_events"] = Ending(trouble, fired), count
    rate = scene_field(t_end, end_state, scene, mode)
    span = jnp.maximum(jnp.abs(problem.t0), jnp.abs(problem.t1))
    ahead = float(jnp.finfo(span.dtype).eps) ** 0.5 * span if problem.dt is None else problem.dt
    ended = end_code(scene, t_end, end_state, rate, mode, solution.result, ending, ahead)
    code = jnp.where(starts, ended, start)
    t, (y, modes) = solution.ts[1], solution.ys[1]
    if problem.ts is not None:
        reached = starts | (problem.ts <= problem.t0)
        t = jnp.where(reached, t, jnp.inf)
        y, modes = jtu.tree_map(
            lambda x: jnp.where(jnp.expand_dims(reached, tuple(range(1, x.ndim))), x, jnp.inf), (y, modes)
        )
        if exact and not options.hold_chatter:
            missed = _passed_a_limit(scene, t, flow.state(y), modes)
            code = jnp.where((code == SUCCESS) & missed, MISSED_EVENT, code)
    return Solved(t, y, modes, code, None if problem.ts is None else (t_end, end_state), stats), history


def _passed_a_limit(scene: Scene, t: Array, y: State, modes: Array) -> Array:
    """Whether an element sticks at a saved time under a load beyond its limit: then an event was stepped over."""

    def beyond(t: Array, y: State, mode: Array) -> Array:
        return jnp.any(scene_overload(t, y, scene, mode) > _OVERLOAD) & jnp.isfinite(t)

    return jnp.any(jax.vmap(beyond)(*jax.lax.stop_gradient((t, y, modes))))


@partial(jax.jit, static_argnames=("options",))
def solve(problem: Problem, options: Options) -> Solved:
    """Run a scene."""
    return _integrate(problem, options, _Flow(audited=False), None)[0]


@partial(jax.jit, static_argnames=("options",))
def solve_audited(problem: Problem, options: Options) -> Work:
    """Run a scene again with the integrals of power beside it; returns the work at the saved times."""
    return _integrate(problem, options, _Flow(audited=True), None)[0].y[1]


@partial(jax.jit, static_argnames=("options", "size"))
def solve_logged(problem: Problem, options: Options, size: int) -> EventLog:
    """Run a scene again with a log of `size` events beside it."""
    log = _integrate(problem, options, _Flow(audited=False), size)[1]
    assert log is not None
    return log
