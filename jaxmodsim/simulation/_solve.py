"""The compiled part of a run."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._core.compat import programs_of
from .._core.one_kernel import in_one_kernel
from .._core.safe import constant
from ..scene import Scene, State, check_scene, has_linear_solver, sample_times, signals_of, vector_field
from ..solvers import (
    EventController,
    EventLog,
    EventSolver,
    EventState,
    FiniteSteps,
    Gauss,
    ImplicitFriction,
    Projected,
    Rodas5P,
    SampledJumps,
    StepsTo,
    StoredSteps,
    first_step,
    trial_step,
    without_error_checks,
)
from ._integrated_system import AugmentedState, Instant, IntegratedSystem, RunFunctions, Work, project
from ._outcome import ILL_POSED, MISSED_EVENT, SUCCESS, Ending, describe_failure, end_code, start_code
from ._run_request import TIGHTEST, RunRequest

# Speed of rest, as a part of the absolute tolerance.
_REST = 1e-3
# Admissible excess of a sticking element's force over its limit at a saved time, due to the error of dense output.
_OVERLOAD = 1e-2

# Gains of the step size control, proportional and integral: diffrax's own, and those for Rosenbrock methods. Of 16
# pairs, on LuGre's box, the 1995 set on a spring and the spherical pendulum, at tolerances of 1e-4 to 1e-8, these gave
# about half of the error in as many steps, with a third fewer rejections. Runs with events use diffrax's gains, as
# steps grow more slowly with the others (belt oscillator, 1e-8: 468 instead of 423 steps).
_GAINS = (0.0, 1.0)
_ROSENBROCK_GAINS = (0.25, 0.5)
# Number of coordinates and states of effects up to which their linear systems are unrolled; see `_structured`.
_MOST_UNKNOWNS = 24


class Nodes(NamedTuple):
    """A series at t0 and at the ends of all steps: times, infinite if unused, values, and rates or None."""

    t: Float[Array, " nodes"]
    x: Float[Array, " nodes"]
    rate: Float[Array, " nodes"] | None


class RunOutput(NamedTuple):
    """Output of a run: saved times and states, the outcome, the end, and the numbers of steps.

    If requested also a log of events, the work at the saved times and a series; else None.
    """

    t: Float[Array, " time"]
    y: State
    # Modes, shape `[time, modes]`; None without modes.
    mode: Array | None
    code: Int[Array, ""]
    # None if the end alone is saved, which is then in `t` and `y`: every output of compiled code costs time.
    end: tuple[Float[Array, ""], State] | None
    stats: dict[str, Array]
    log: EventLog | None
    work: Work | None
    nodes: Nodes | None

    def failure(self, scene: Scene) -> str:
        """The sentence of an early end with known values; empty if the run reached t1."""
        if int(self.code) == SUCCESS:
            return ""
        t, y = self.end or (self.t[-1], jtu.tree_map(lambda x: x[-1], self.y))
        scene, t, y = jax.lax.stop_gradient((scene, t, y))
        return describe_failure(scene, float(t), y, int(self.code))


def default_solver(scene: Scene, dof: int, fixed_step: bool) -> dfx.AbstractSolver:
    """Rodas5P if the scene is stiff, or runs by events on one coordinate or in the plane; Tsit5 otherwise.

    Every step of a run with events evaluates the guards, for any method. On one coordinate Rodas5P makes the fewest
    steps of the methods whose dense output keeps the tolerance, and is twice as fast as Tsit5 under vmap. On several
    coordinates its Jacobian costs more than that, above all in compile time. Exact friction in the plane is stiff for
    slow slip, whose direction follows that of the load.

    **Returns:**

    The solver; with `fixed_step`, Rodas5P swaps rows.
    """
    stiff = scene.stiff or sum(scene.mode_widths(dof)) > len(scene.mode_names)
    return Rodas5P(pivot=fixed_step) if stiff or (scene.mode_names and dof == 1) else dfx.Tsit5()


def _structured(request: RunRequest) -> bool:
    """Whether `linear_solver` solves the systems of `Rodas5P`, from the structure of mechanics.

    A step of 2, 3 and 6 links with LuGre joints takes 2.4, 4.8 and 9.3 us with it, and 2.4, 5.6 and 37 us with the
    Jacobian (two shared cores, float64). On one coordinate 1.4 and 1.2 us.
    """
    unknowns = sum(np.size(x) for x in jtu.tree_leaves((request.q0, request.scene.initial_state(request.q0))))
    return request.q0.shape[0] > 1 and unknowns <= _MOST_UNKNOWNS and has_linear_solver(request.scene)


def _tolerances(request: RunRequest) -> tuple[Array, Array]:
    """Relative and absolute tolerance; the latter positive, so that the error of a constant zero is zero, not 0/0."""
    # Both rise by one factor: in stick a velocity is zero, and its error the rounding of forces that cancel.
    kind, rtol = jnp.finfo(request.atol.dtype), request.rtol
    raised = jnp.maximum(rtol, TIGHTEST * float(kind.eps))
    atol = request.atol * jnp.where(rtol > 0, raised / jnp.where(rtol > 0, rtol, 1.0), 1.0)
    return raised, jnp.maximum(atol, float(kind.tiny))


def _solver(
    solver: dfx.AbstractSolver, functions: RunFunctions, scene: Scene, request: RunRequest
) -> dfx.AbstractSolver:
    """`solver`, wrapped for the events, projections and signals of the scene."""
    if isinstance(solver, ImplicitFriction):
        solver = ImplicitFriction(functions.system.advance)
    freeze_args, samples = None, None
    if signals_of(scene.params):
        freeze_args = _step_from
        samples = SampledJumps(freeze_args, sample_times(scene.params, linear=False))
    dof = request.q0.shape[0]
    if scene.mode_names:
        return EventSolver(
            solver,
            functions.guards,
            functions.reset,
            carries_on=_carried_on(request),
            project=functions.project_and_stick if functions.projects or functions.sticks else None,
            samples=samples,
            rtol=functions.tolerances[0],
            dtmin=request.shortest_step,
            enforce=True,
            at_event=functions.derivative_and_guards,
            event_mode=functions.event_mode if scene.num_modes(dof) > len(scene.mode_names) else None,
            max_events=request.choices.max_events,
            log=request.choices.log,
        )
    if functions.projects or freeze_args is not None:
        return Projected(solver, functions.project if functions.projects else None, freeze_args)
    return solver


def _carried_on(request: RunRequest) -> tuple[bool, ...]:
    """Which guards may fire again and again without time between: impacts, and friction where chatter is held."""
    kinds = request.choices.stick_on_chatter, True, False
    parts = request.scene.split_modes(range(request.scene.num_modes(request.q0.shape[0])))
    return tuple(carries for carries, part in zip(kinds, parts, strict=True) for _ in part)


def _step_from(t: Array, scene: Scene) -> Scene:
    return scene.step_from(t)


def _controller(request: RunRequest, solver: dfx.AbstractSolver) -> dfx.AbstractStepSizeController:
    p, i = _ROSENBROCK_GAINS if isinstance(solver, Rodas5P) and not request.scene.mode_names else _GAINS
    steps = {"dtmin": request.shortest_step, "dtmax": request.dtmax, "force_dtmin": False}
    adaptive = dfx.PIDController(*_tolerances(request), pcoeff=p, icoeff=i, **steps)
    controller = adaptive if request.dt is None else FiniteSteps()
    times = sample_times(request.scene.params, linear=True)
    if request.scene.mode_names:
        return EventController(controller, times, direction=1)
    return controller if request.dt is not None and times is None else StepsTo(controller, times)


def _plugins(request: RunRequest, system: IntegratedSystem) -> tuple[Any, Any]:
    """Solver and adjoint: those of the request, or the defaults."""
    solver = default_solver(request.scene, request.q0.shape[0], request.dt is not None)
    if request.solver is not None:
        solver = request.solver.whole
    if isinstance(solver, Rodas5P) and solver.linear_solver is None and not system.audited and _structured(request):
        solver = Rodas5P(solver.pivot, system.linear_solver)
    adjoint = StoredSteps() if request.adjoint is None else request.adjoint.whole
    if request.scene.compliant and isinstance(adjoint, StoredSteps):
        adjoint = replace(adjoint, brief=True)
    return solver, adjoint


def _well_posed(request: RunRequest) -> Bool[Array, ""]:
    """Whether times and tolerances are valid; known values have been checked before, with their own errors."""
    t0, t1, ts, rtol, atol = request.t0, request.t1, request.ts, request.rtol, request.atol
    steps = [step for step in (request.dt, request.dtmax) if step is not None]
    fine = (t0 <= t1) & (rtol >= 0) & (atol >= 0) & (rtol + atol > 0)
    for step in steps:
        fine &= step > 0
    if ts is not None:
        fine &= (t0 <= ts[0]) & jnp.all(ts[1:] >= ts[:-1]) & (ts[-1] <= t1)
    # Between finite ends increasing ts are finite, too.
    return fine & jnp.isfinite(jnp.stack([t0, t1, rtol, atol, *steps])).all()


class _Start(NamedTuple):
    """Start of a run: state, modes, rate, and the first step [s]."""

    y: PyTree
    mode: Array | None
    rate: PyTree
    first: Float[Array, ""]


def _functions(request: RunRequest) -> RunFunctions:
    scene, canonical = request.scene, request.solver is not None and isinstance(request.solver.rest, Gauss)
    return RunFunctions(
        IntegratedSystem(request.choices.audited, canonical),
        _REST * request.atol,
        (request.rtol, request.atol),
        bool(scene.bilateral or scene.contacts) and request.choices.project,
        scene.stick_drifts,
        request.choices.stick_on_chatter,
        scene.mode_widths(request.q0.shape[0]),
    )


def _start(request: RunRequest, functions: RunFunctions, order: Any) -> _Start:
    """The start of a run whose method has an error estimate of this order.

    A loop, which is compiled once, evaluates the initial modes, the rate, and another rate for the first step. Reverse
    mode evaluates it again.
    """
    scene, t0, exact = request.scene, request.t0, bool(request.scene.mode_names)
    initial = request.initial_state
    check_scene(scene, initial)
    mode = jnp.zeros(scene.num_modes(request.q0.shape[0]), request.q0.dtype) if exact else None
    if functions.projects:
        initial = project(t0, initial, scene.bind_time(t0), mode)
    y0 = functions.system.start(t0, initial, scene, mode)
    tolerances = _tolerances(request)

    @partial(jax.checkpoint, prevent_cse=False)
    def evaluate(at: tuple[Array, PyTree, Array | None], turn: Array) -> tuple[PyTree, PyTree]:
        held, (t, y, mode) = jax.lax.stop_gradient((*at, scene)), at
        slope = functions.plain_derivative(held[0], held[1], held[3], held[2])
        trial = trial_step(held[1], slope, tolerances)
        following = held[0] + trial, jtu.tree_map(lambda y, f: y + trial * f, held[1], slope), held[2]
        if mode is not None:
            y, mode = functions.begin(t, y, scene, mode)
            following = jtu.tree_map(lambda a, b: jnp.where(turn == 0, a, b), (t, y, mode), following)
        return following, ((y, mode) if exact else None, slope)

    turns = exact + (1 if request.dt is not None else 2)
    _, (begun, slopes) = jax.lax.scan(evaluate, (t0, y0, mode), jnp.arange(turns))
    if exact:
        y0, mode = jtu.tree_map(lambda x: x[0], begun)
    slope = jtu.tree_map(lambda x: x[int(exact)], slopes)
    if request.dt is not None:
        return _Start(y0, mode, slope, request.dt)
    there = jtu.tree_map(lambda x: x[-1], slopes)
    step = first_step(jax.lax.stop_gradient(y0), (slope, there), order, tolerances, request.shortest_step)
    return _Start(y0, mode, slope, step if request.dtmax is None else jnp.minimum(step, request.dtmax))


def _start_code(request: RunRequest, functions: RunFunctions, mode: Array | None, rate: PyTree) -> Int[Array, ""]:
    """Code of an error before the first step; `rate` is that of the first state."""
    rate = rate.motion if isinstance(rate, AugmentedState) else rate
    atol = None if request.dt is not None else request.atol
    start = start_code(request.scene, request.t0, request.initial_state, rate, mode, atol, functions.system.canonical)
    return jnp.where(_well_posed(request), start, ILL_POSED)


def _field(functions: RunFunctions, method: dfx.AbstractSolver, exact: bool) -> Callable[..., PyTree]:
    """The vector field of a run, with modes if `exact`.

    The stages of an explicit Runge-Kutta method are one loop. Reverse mode evaluates the field of each stage again: an
    array for each of its intermediate numbers took most of the time to compile a gradient.
    """
    field = functions.derivative if exact else functions.plain_derivative
    if not isinstance(method, dfx.AbstractERK):
        return field
    return jax.checkpoint(lambda *at: field(*at), prevent_cse=False)  # a method of a module with arrays has no hash


def _integrate(request: RunRequest) -> RunOutput:
    """Run diffrax, with modes if the scene has them, and with a log, work and a series if requested."""
    scene, exact, series = request.scene, bool(request.scene.mode_names), request.choices.series
    functions = _functions(request)
    method, adjoint = _plugins(request, functions.system)
    solver = _solver(method, functions, scene, request)
    y0, mode, rate, first = _start(request, functions, method.error_order(dfx.ODETerm(functions.plain_derivative)))
    controller = _controller(request, method)
    start = _start_code(request, functions, mode, rate)
    # A run that cannot start ends at t0; diffrax needs its saved times there, too.
    starts = start == SUCCESS
    ts = None if request.ts is None else jnp.where(starts, request.ts, request.t0)
    if isinstance(solver, EventSolver):
        y0 = solver.start(request.t0, y0, mode, scene)

    # Without projections, which `_kept` applies to all saved states after the run.
    def saved(t: Array, y: PyTree, scene: Scene) -> tuple[PyTree, Array | None]:
        del t, scene
        return (y.y, y.mode) if isinstance(y, EventState) else (y, None)

    def observed(t: Array, y: PyTree, scene: Scene) -> Any:
        assert series is not None
        y, mode = saved(t, y, scene)
        return functions.observe(t, y, scene, mode, series)

    def last(t: Array, y: PyTree, scene: Scene) -> Any:
        return saved(t, y, scene), ((y.events, y.status, y.fired), _motions(y.log)) if exact else None

    def integrate(first: Array, ts: Array | None) -> dfx.Solution:
        subs = [dfx.SubSaveAt(t1=True, fn=last)] + ([] if ts is None else [dfx.SubSaveAt(ts=ts, fn=saved)])
        subs += [] if series is None else [dfx.SubSaveAt(t0=True, steps=True, fn=observed)]
        return dfx.diffeqsolve(
            dfx.ODETerm(_field(functions, method, exact)),
            solver,
            request.t0,
            jnp.where(starts, request.t1, request.t0),
            first,
            y0,
            args=scene,
            saveat=dfx.SaveAt(subs=subs),
            stepsize_controller=controller,
            adjoint=adjoint,
            max_steps=request.choices.max_steps,
            throw=False,
            # Traced from the start, as `EventController` returns it: the step is traced once, not for each type.
            made_jump=jnp.asarray(False) if exact else None,
        )

    # `_well_posed` has checked their order and range, as diffrax would.
    solution = without_error_checks(integrate, first, ts)
    assert solution.ts is not None
    assert solution.ys is not None
    (rows, events), ending, log = solution.ys[0], None, None
    stats = {name: solution.stats[name] for name in ("num_steps", "num_rejected_steps")}
    if exact:
        (count, status, fired), log = jtu.tree_map(lambda x: x[0], events)
        ending, stats["num_events"] = Ending(status, fired), count.astype(int)
    t = solution.ts[0]
    if ts is not None:
        t, rows = jtu.tree_map(lambda *x: jnp.concatenate(x), (t, rows), (solution.ts[1], solution.ys[1]))
    t, y, modes, instants = _kept(request, functions, starts, t, rows)
    end, rate, missed = jtu.tree_map(lambda x: x[0], (t, y, modes)), None, jnp.asarray(False)
    if ts is not None:
        t, y, modes = jtu.tree_map(lambda x: x[1:], (t, y, modes))
    if instants is not None:
        rate = jtu.tree_map(lambda x: x[0], instants.rate)
        if ts is not None:  # an element that sticks under a load beyond its limit: the run has missed an event
            beyond = jnp.any(instants.stick_violation[1:] > _OVERLOAD, axis=1)
            missed = jnp.any(beyond & jnp.isfinite(t))
    (y, work), (end_state, _) = (y, end[1]) if request.choices.audited else ((y, None), (end[1], None))
    ended = _ended(request, end[0], end_state, rate, end[2], solution.result, ending)
    code = jnp.where(starts, ended, start)
    if exact and not request.choices.stick_on_chatter:
        code = jnp.where((code == SUCCESS) & missed, MISSED_EVENT, code)
    nodes = None if series is None else Nodes(solution.ts[-1], *solution.ys[-1])
    return RunOutput(t, y, modes, code, None if ts is None else (end[0], end_state), stats, log, work, nodes)


def _motions(log: EventLog | None) -> EventLog | None:
    """A log without the work that an audited run integrates."""
    if log is None or not isinstance(log.before[0], AugmentedState):
        return log
    return log._replace(before=(log.before[0].motion, log.before[1]), after=(log.after[0].motion, log.after[1]))


def _ended(
    request: RunRequest,
    t: Array,
    y: State,
    rate: State | None,
    mode: Array | None,
    result: dfx.RESULTS,
    ending: Ending | None,
) -> Array:
    """Code of the outcome of a run that started; the rate is None if it is not known yet."""
    span = jnp.maximum(jnp.abs(request.t0), jnp.abs(request.t1))
    ahead = float(jnp.finfo(span.dtype).eps) ** 0.5 * span if request.dt is None else request.dt
    rate = vector_field(t, y, request.scene, mode) if rate is None else rate
    return end_code(request.scene, t, y, rate, mode, result, ending, ahead)


def _kept(
    request: RunRequest, functions: RunFunctions, starts: Array, t: Array, rows: tuple[PyTree, Array | None]
) -> tuple[Array, PyTree, Array | None, Instant | None]:
    """Times, results, modes and an `Instant` at the end and at all saved times; infinite at times not reached.

    A run that did not start has reached times up to t0.
    """
    times = t[:1] if request.ts is None else jnp.concatenate([t[:1], request.ts])
    reached = jnp.isfinite(t) & (starts | (times <= request.t0) | (jnp.arange(t.shape[0]) == 0))

    def fill(x: Array, filling: Array | float) -> Array:
        return jnp.where(jnp.expand_dims(reached, tuple(range(1, x.ndim))), x, filling)

    # Rows at times that were not reached are evaluated at the end of the run. Reverse mode evaluates each row again.
    t_there, (y, modes) = jtu.tree_map(lambda x: fill(x, x[:1]), (t, rows))
    keep = lambda row: functions.keep(row[0], row[1], request.scene, row[2])  # noqa: E731
    y, instants = jax.lax.map(jax.checkpoint(keep, prevent_cse=False), (t_there, y, modes))
    t, y, modes = jtu.tree_map(lambda x: fill(x, jnp.inf), (t, y, modes))
    return t, y, modes, instants


@jax.jit
def solve(request: RunRequest) -> RunOutput:
    """Run a scene; the run, and its derivatives, in one kernel each."""
    if why := request.scene.without_derivatives:
        request = constant(request, why)
    return in_one_kernel(jax.jit(_integrate), request)


def compiled_runs() -> int:
    """Number of programs that `solve` has compiled."""
    return programs_of(solve)


@jax.jit
def solve_start(request: RunRequest) -> State:
    """The first state of a run: on the constraints, and without slip of sticking elements."""
    functions = _functions(request)
    y0 = _start(request, functions, 1).y
    return functions.system.state(request.t0, y0, request.scene.bind_time(request.t0))
