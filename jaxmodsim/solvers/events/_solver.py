"""A solver wrapper that makes events non-terminating."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from ..._core.arrays import Real, fusion_barrier, opaque_one
from .._projected import projected
from .._wrapper import AbstractSolverWrapper
from ._guard_scan import GuardScan, arrives, first_root, instant, scan_guards
from ._passage import LATITUDE, Landed, Passage, choose, in_turn, pass_event
from ._policy import AbstractGuardPolicy, Conditions, Crossings
from ._samples import SampledJumps, on_jump
from ._state import ACCUMULATION, ONGOING, TOO_MANY, EventLog, EventMemory, EventState, Landing, StepReport, write

# Landing distance, the largest distance of the end of a step from a root, as a fraction of the last steps, and of the
# time since the last event. The state is carried over that distance with an error of its third power, also by a field
# behind the event that is many times faster than the last steps: that of a stiff contact.
_LANDING, _LANDING_OF_INTERVAL = 1e-8, 1e-2
# A step that is at most this part of the last ones counts as one without length: guards vary by their rounding.
_SHORT = 1e-6
# Within this part of the last steps after an event a guard without a root is one that the event has violated.
_CHAIN = 1e-3
# Events accumulate where the longest of the last intervals is below this part of the time since the start, times the
# square root of the rounding unit.
_ACCUMULATION = 1e-3
# Weights of the last intervals between events, and of the last steps, at each new one. That of intervals is small: the
# intervals of a ball with little restitution are rounding before a larger weight has forgotten the first of them.
_FORGET_INTERVALS, _FORGET_STEPS = 0.05, 0.25
# A step counts as no longer than this many of those before it.
_GROW = 2.0
# Fewer events than this do not accumulate.
_FEWEST = 8

_constant = jax.lax.stop_gradient


class _EventInterpolation(dfx.AbstractLocalInterpolation):
    """Dense output of the wrapped solver inside a step, and the state after the event from that event on.

    `event` is the time from which the state after it holds, and the rate of y there.
    """

    t0: Real
    t1: Real
    inner: dfx.AbstractLocalInterpolation
    state0: EventState
    state1: EventState
    event: tuple[Array, PyTree]

    def evaluate(self, t0: Real, t1: Real | None = None, left: bool = True) -> EventState:
        """State at `t0`, or the increment from `t0` to `t1`."""
        del left
        if t1 is not None:
            return jtu.tree_map(lambda a, b: a - b, self.evaluate(t1), self.evaluate(t0))
        inside, (begins, slope) = self.state0._replace(y=self.inner.evaluate(t0)), self.event
        back = jtu.tree_map(lambda y, f: y + (jnp.subtract(t0, self.t1) * f).astype(y.dtype), self.state1.y, slope)
        return jtu.tree_map(lambda a, b: jnp.where(t0 >= begins, b, a), inside, self.state1._replace(y=back))


class _Field(eqx.Module):
    """Vector field of the integrated part; the arguments hold the state that it belongs to."""

    terms: PyTree

    def __call__(self, t: Real, y: PyTree, args: tuple[EventState, PyTree]) -> PyTree:
        """Rate of `y`."""
        return self.terms.vf(t, args[0]._replace(y=y), args[1]).y


class EventSolver(AbstractSolverWrapper):
    """Wrap a diffrax solver so that the solution passes through events: resets, changes of mode, counters.

    Saving, dense output, progress meters and adjoints of diffrax work as without events, except `BacksolveAdjoint`,
    whose adjoint equation has no resets. Time runs forward.

    **Events.** Let `g_i(t)` be guard i along the solution on `[t0, t1]`. A guard is *armed* or waits. It
    fires at the first `t_event > t0` where it is armed, `g_i(t_event) = 0`, and `g_i < 0` right after: events are
    crossings from above to below (pass `-g` for the other direction, both for both). An event at `t0` itself does not
    fire, one at `t1` does, so that runs over `[t0, t1]` and `[t1, t2]` together have the events of one over `[t0, t2]`.

    - *At the start* the guards with `g_i(t0) > 0` are armed. The others wait until they are positive: a guard that is
      violated on entry, or zero and falling, does not fire; one that is zero and rising is armed as it rises.
    - *At an event* all armed guards whose roots lie within the landing distance (1e-8 of a step) of the first one
      fire together, in one call of `reset` with all of them marked in `fired`. Later roots in the same step are
      searched again after the reset.
    - *After an event* the guards that fired wait until they are positive, so that each crossing fires once; other armed
      guards stay armed. A guard that the reset has made negative therefore fires at once, with the time of that event.
    - *With `enforce`* all guards are armed at all times: one that is violated at the start fires at once, and one that
      its own reset leaves violated fires again and again, until the events accumulate.
    - *Within a step* a guard is the cubic through its values at 0, 1/3, 2/3 (from dense output) and 1. Its value at 1/2
      gives the error of the cubic. A step is repeated with a shorter length if error or third difference are not small
      against the variation of the guard and its distance from zero (at most twelve times, for guards that jump). A
      guard that is smooth on the scale of the steps is therefore resolved to `rtol` near zero, whether or not the
      integrated state moves. A spike between the five points that shows at none of them is not detected. Let a step end
      there (`dtmax`, or `times` of the controller).

    The event is located on steps of the solver, not on its dense output: a step that passes a root is
    rejected, and repeated to end on the root. The saved value at an event, and at t1 if that is one, is the one after
    the reset; times that differ by 1e-12 of their value are equal (64 rounding units in float32).

    **Derivatives.** From the end of the step the state is carried to the root, reset there, and carried back with the
    new field. The way is as short as the landing error, and its derivative is that of the event time: the result
    is the saltation matrix `DR + (f_plus - DR f_minus - D_t R) (x) Dg / (D_t g + Dg f_minus)`, and times in the log are
    differentiable. Guards that fire together each have the derivative of their own root, if resets one by one lead to
    the same state; else all have that of the first. Second derivatives hold too, if the adjoint supports them. A
    guard that touches zero without crossing (grazing) has no derivative.

    **Accumulation of events** (a ball that comes to rest, chatter): if the last intervals between events fall below
    1e-3 sqrt(eps) of the time since the start, the run ends with `status = 1` in the state and diffrax's result
    `dt_min_reached`. Where guards of `carries_on` fire it goes on: `reset` finds `s.dense` true there, and those that
    are not positive after it wait. After `max_events` events the next one ends the run with `status = 2` and
    `max_steps_reached`.

    **Arguments:**

    - `solver`: the diffrax solver of an `ODETerm`: explicit, `Rodas5P`, `diffrax.Kvaerno5`.
    - `guards`: `guards(t, s, args)` -> shape `[guards]`; `s` is an `EventState` with your `s.y` and `s.mode`. Or a
      tuple of that and two arrays of the same shape: the error that each guard may have beside `rtol` of its magnitude,
      and its value at its event. The guard fires at zero, below that value, so that rounding does not fire it again;
      times in between have the state after the event. If that value is less than the error, the guard may also fire
      before it, within the resolution of time.
    - `reset`: `reset(t, s, args, fired)` -> `s` with another `y` or `mode` (by `s._replace`); `fired` are booleans,
      shape `[guards]`. There `s.slope` is the rate of `s.y` in the mode before the event, a constant.
    - `carries_on`: whether the run goes on where events accumulate, for all guards or one flag for each.
    - `project`: `project(t, s, args)` -> `s`, applied after every step, for invariants that drift.
    - `enforce`: whether the guards are conditions that have to hold, instead of crossings.
    - `samples`: a `SampledJumps` if `args` hold sampled values.
    - `rtol`: the part of its largest magnitude in a step by which a guard may fall below zero, and return, undetected.
    - `dtmin`: that of the controller, which ends the run at shorter steps. Events are located to it, or to four
      rounding units of time.
    - `event_mode`: `event_mode(mode)` -> the part of the mode that an event changes. A reset that changes only other
      parts, such as the choice of coordinates, is no event. By default all of it.
    - `at_event`: `at_event(t, s, args)` -> the rate of `s.y` and the guards, where one evaluation gives both. By
      default they come from the term and from `guards`.
    - `max_events`: limit of the number of events, > 0.
    - `log`: number of entries of the `EventLog` in the state; later events are counted, not logged. By default
      `max_events`; 0 for no log.

    **Example:**

    ```python
    def field(t, s, args):  # s.y is integrated, s.mode is constant between events
        return s.rate(jnp.array([s.y[1], -9.81]))

    def guards(t, s, args):
        return s.y[:1]

    def reset(t, s, args, fired):
        return s._replace(y=jnp.array([0.0, -0.8 * s.y[1]]))

    solver = jms.EventSolver(diffrax.Tsit5(), guards, reset)
    control = jms.EventController(diffrax.PIDController(rtol=1e-8, atol=1e-8))
    start, term = solver.start(0.0, jnp.array([1.0, 0.0])), diffrax.ODETerm(field)
    solution = diffrax.diffeqsolve(term, solver, 0.0, 0.8, None, start, stepsize_controller=control)
    print(solution.ys.y.round(4), solution.ys.log.t[0, :2].round(4))
    ```

    ```text
    [[0.6392 0.125 ]] [0.4515    inf]
    ```

    ??? cite "Reference"

        ```bibtex
        @article{aizerman1958stability,
            author={Aizerman, M. A. and Gantmacher, F. R.},
            title={On the stability of periodic motions},
            journal={Journal of Applied Mathematics and Mechanics}, volume={22}, number={6},
            pages={1065--1078}, year={1958},
        }
        ```
    """

    # Wider than `ODETerm`, so that `EventController` refuses other terms with its own error.
    term_structure: ClassVar = dfx.AbstractTerm
    solver: dfx.AbstractSolver  # pyright: ignore[reportIncompatibleVariableOverride]
    guards: Callable[..., Array | tuple[Array, ...]]
    reset: Callable[..., EventState]
    project: Callable[..., EventState] | None = None
    samples: SampledJumps | None = None
    rtol: Real = 1e-6
    dtmin: Real = 0.0
    event_mode: Callable[[PyTree], PyTree] | None = None
    at_event: Callable[..., tuple[PyTree, Array]] | None = None
    carries_on: bool | tuple[bool, ...] = eqx.field(default=False, static=True)
    enforce: bool = eqx.field(default=False, static=True)
    max_events: int = eqx.field(default=128, static=True)
    log: int | None = eqx.field(default=None, static=True)

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Interpolation of the wrapped solver, with the event at the end of the step."""

        def interpolation(*, t0: Real, t1: Real, inner: PyTree, state0: Any, state1: Any, event: Any) -> Any:
            path = self.solver.interpolation_cls(t0=t0, t1=t1, **inner)
            return _EventInterpolation(t0, t1, path, state0, state1, event)

        return interpolation

    @property
    def _policy(self) -> AbstractGuardPolicy:
        return Conditions() if self.enforce else Crossings()

    def start(self, t0: Real, y0: PyTree, mode: PyTree = None, args: PyTree = None) -> EventState:
        """Initial state, the `y0` of `diffeqsolve`.

        **Arguments:**

        - `t0`: start time.
        - `y0`: the part that the vector field integrates, any pytree.
        - `mode`: the part that is constant between events (modes, counters), any pytree of numbers; they become
          floating.
        - `args`: as for `diffeqsolve`.
        """
        y0, mode = jtu.tree_map(_real, (y0, mode))
        zero = jnp.zeros((), jnp.result_type(t0, *jtu.tree_leaves(y0)))
        t0 = jnp.asarray(t0, zero.dtype)
        one = zero + 1.0
        state = EventState(y0, mode, t0, zero, zero, zero, None, StepReport(zero, one, one))
        guard = eqx.filter_eval_shape(self._guards, t0, state, args)
        log = None
        entries = self.max_events if self.log is None else self.log
        if entries:

            def rows(x: Any) -> Array:
                return jnp.zeros((entries, *x.shape), x.dtype)

            pair, each = jtu.tree_map(rows, (y0, mode)), jnp.zeros((entries, *guard.shape), zero.dtype)
            log = EventLog(jnp.full(entries, jnp.inf, zero.dtype), rows(guard), each, pair, pair)
        return state._replace(fired=jnp.zeros(guard.shape, guard.dtype), log=log)

    def _guards(self, t: Real, state: EventState, args: PyTree) -> Float[Array, " guards"]:
        return self._guards_and_limits(t, state, args)[0]

    def _guards_and_limits(
        self, t: Real, state: EventState, args: PyTree
    ) -> tuple[Float[Array, " guards"], Float[Array, " guards"], Float[Array, " guards"]]:
        given = self.guards(t, state, args)
        values, *limits = given if isinstance(given, tuple) else (given,)
        values = jnp.asarray(values)
        atol, root, *_ = (*limits, jnp.zeros_like(values), jnp.zeros_like(values))
        return values, atol, root

    def func(self, terms: PyTree, t0: Real, y0: EventState, args: PyTree) -> PyTree:
        """The vector field of the wrapped solver."""
        return self.solver.func(dfx.ODETerm(_Field(terms)), t0, y0.y, (y0, args))

    def init(self, terms: PyTree, t0: Real, t1: Real, y0: EventState, args: PyTree) -> tuple[PyTree, EventMemory]:
        """State of the wrapped solver, and an `EventMemory`."""
        inner = self.solver.init(dfx.ODETerm(_Field(terms)), t0, t1, y0.y, (y0, args))
        guard, first = self._guards(*_held((t0, y0, args))), _constant(t1 - t0)
        none, armed = jnp.zeros((), int), self._policy.armed_at_start(guard)
        sound, begin = jnp.zeros_like(armed), _constant(t0 - (t1 - t0))
        return inner, EventMemory(guard, armed, sound, none, none, jnp.zeros_like(first), first, begin)

    def step(
        self, terms: PyTree, t0: Real, t1: Real, y0: EventState, args: PyTree, solver_state: PyTree, made_jump: Real
    ) -> tuple[EventState, PyTree, dict[str, PyTree], PyTree, dfx.RESULTS]:
        """A step of the wrapped solver, a scan of the guards along it, and the reset where it ends on an event."""
        inner, memory = solver_state[0], _held(solver_state[1])
        t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
        whole, args = args, args if self.samples is None else self.samples.freeze_args(t0, args)
        y1, error, dense, inner, result = self.solver.step(
            dfx.ODETerm(_Field(terms)), t0, t1, y0.y, (y0._replace(log=None), args), inner, made_jump
        )
        if self.project is not None:
            y1, distant = projected(y0.y, y1, error, self.project(t1, y0._replace(y=y1), args).y, (t0, t1))
            # A state that an event has carried on is not projected. Its distance does not shrink with the step.
            carried = y0.report.landed > 0.5
            error = jtu.tree_map(lambda a, b: jnp.where(carried, a, b), error, distant)
        path = self.solver.interpolation_cls(t0=t0, t1=t1, **dense)
        length = _constant(t1 - t0)
        unit = opaque_one(length)
        eps = float(jnp.finfo(length.dtype).eps)
        resolution = jnp.maximum(4.0 * eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1)), _constant(jnp.asarray(self.dtmin)))
        seen, *ends = self._look(path, (t0, t1), y0._replace(y=y1), memory, args, resolution)
        # At rest steps grow without limit, and their length says nothing about the motion after the event.
        measure = jnp.minimum(length, _GROW * memory.pace)
        jumps = None if self.samples is None else self.samples.at(t1, length)
        # Before the first event, intervals begin a step before the run: an event may be as close to t0 as rounding.
        last = jnp.where(memory.resets == 0, memory.begin, y0.t)
        shortest = jnp.maximum(_SHORT * memory.pace, 2.0 * _constant(resolution))
        steps = jnp.maximum(measure, memory.pace), shortest
        landing = self._land(seen, ends, (t1, length, resolution, last), steps, jumps)
        next_root = fusion_barrier(landing.next_root, unit)
        landed = fusion_barrier(_flags(landing.landed, next_root), unit)
        landing = landing._replace(next_root=next_root, landed=landed > 0.5, happens=landed > 0.5)
        if jumps is not None:
            landing = on_jump(landing, jumps)
        factor = jnp.min(jnp.where(landing.fired, seen.landing_factor, seen.step_factor))
        factor = jnp.maximum(factor, jnp.where(length <= shortest, 1.0, 0.0))
        report = StepReport(landed, landing.next_root, fusion_barrier(factor, unit))
        pace = jnp.maximum(measure, _FORGET_STEPS * memory.pace)
        end, root, _ = ends
        memory = memory._replace(guard=end, armed=seen.armed, violated=jnp.zeros_like(seen.armed), pace=pace)
        at_end = y0._replace(y=y1, report=report), memory
        (state1, memory), (t_event, slope) = jax.lax.cond(
            landing.happens,
            lambda: self._jump(terms, t1, at_end, landing, (root, landing.near * length), (args, whole)),
            lambda: (at_end, (t1, jtu.tree_map(jnp.zeros_like, y1))),
        )
        begins = jnp.where(landing.happens, _constant(t_event) - instant(resolution), t1)
        dense = {"inner": dense, "state0": y0, "state1": state1, "event": (begins, slope)}
        return state1, error, dense, (inner, memory), result

    def _look(
        self,
        path: dfx.AbstractLocalInterpolation,
        times: tuple[Array, Array],
        state: EventState,
        memory: EventMemory,
        args: PyTree,
        resolution: Array,
    ) -> tuple[GuardScan, Float[Array, " guards"], Float[Array, " guards"], Float[Array, " guards"]]:
        """Scan of the guards in a step that ends at `state`, their values there, at events, and where they arrive."""
        t0, t1 = times
        places = [t0 + (t1 - t0) * part for part in (1 / 3, 1 / 2, 2 / 3)]
        # Constants, so that the guards have no derivative.
        state, args, ends = _held((state, args, [(t, path.evaluate(t)) for t in places] + [(t1, state.y)]))
        looks = jtu.tree_map(lambda *x: jnp.stack(x), *ends)
        values, atol, root = jax.lax.map(
            lambda at: self._guards_and_limits(at[0], state._replace(y=at[1]), args), looks
        )
        length = _constant(t1 - t0)
        unit = opaque_one(length)
        one, middle, two, end = fusion_barrier(_constant([*values]), unit)
        # If limits vanish at one end of the step, the other end gives their size.
        tolerances = jnp.asarray(_constant(self.rtol), end.dtype), _constant(jnp.maximum(atol[0], atol[-1]))
        blur = _constant(resolution) / jnp.where(length > 0, length, 1.0)
        flags = memory.armed, memory.violated
        seen = scan_guards((memory.guard, one, two, end), middle, *flags, tolerances, blur, unit)
        return seen, end, _constant(root[-1]), _constant(jnp.where(root[-1] < atol[-1], root[-1], 0.0))

    def _land(
        self,
        seen: GuardScan,
        ends: list[Float[Array, " guards"]],
        step: tuple[Array, Array, Array, Array],
        steps: tuple[Array, Array],
        jumps: Bool[Array, ""] | None,
    ) -> Landing:
        """Which guards fire at the end of a step, and the end of the next step.

        `ends`: values of the guards there, at events, and where they arrive. `step`: its end, its length, the
        resolution of time and the time of the last event. `steps`: the length of this or the last steps, and that of
        one that counts as none.
        """
        (end, root, arrival), (t1, length, resolution, last), (longest, shortest) = ends, step, steps
        divisor, tiny = jnp.where(length > 0, length, 1.0), float(jnp.finfo(length.dtype).tiny)

        def landing(place: Array) -> Array:
            """Largest distance [time] of the root of each guard from this place; values at events are rounding."""
            slope, bend = seen.slopes(jnp.minimum(place, 1.0))
            blur = jnp.abs(slope) + jnp.sqrt(jnp.maximum(slope * slope + 2.0 * root * jnp.abs(bend), tiny))
            since = _constant(t1 - last) + (jnp.minimum(place, 2.0) - 1.0) * length
            near = jnp.minimum(_LANDING * longest, _LANDING_OF_INTERVAL * since)
            return jnp.maximum(jnp.maximum(near, length * 2.0 * root / blur), _constant(resolution))

        near = landing(jnp.ones_like(length))
        if jumps is not None:  # an event before a jump is another event
            near = jnp.where(jumps, _constant(resolution), near)
        comes = arrives(seen, end, arrival, resolution / divisor)  # from as far as an instant
        near = jnp.where(comes, jnp.maximum(near, instant(resolution) / LATITUDE), near) / divisor
        # The cubic of a guard that has just fallen may be flat: within `root`, a rounding, it is at its root.
        here = (seen.armed & (jnp.abs(seen.ahead) <= near)) | (seen.crosses & (1.0 - seen.root <= near))
        here = here | ((end <= 0) & (end >= -root) & (seen.slopes(jnp.ones(()))[0] < 0))
        here = self._policy.fires(here, seen, end, length, t1) | comes
        # A guard whose root is at the start of a step fires if the step has the shortest length.
        here = here | (seen.crosses & (seen.root * length <= resolution) & (length <= shortest))
        passed = seen.crosses & ~here
        earliest = first_root(seen, passed)
        # No step ends closer to a root than the resolution of time.
        at_end = (1.0 - earliest) * length <= resolution
        here, passed = here | (passed & at_end), passed & ~at_end
        # Without a root inside the step, the next step ends at the next root, if the tangents show one.
        sight = jnp.min(jnp.where(seen.armed, seen.ahead, jnp.inf))
        missed = jnp.any(passed)
        landed = jnp.any(here) & ~missed & (length > 0)
        fired = here & landed
        order = jnp.where(seen.ahead < jnp.inf, seen.ahead, seen.root - 1.0)  # a guard in rounding may not fall
        first = jnp.arange(fired.shape[0]) == jnp.argmin(jnp.where(fired, order, jnp.inf))
        coming = jnp.argmin(jnp.where(missed, jnp.where(passed, seen.root, jnp.inf), seen.ahead))
        # A root that this step does not resolve is reached by a last step that does.
        factor = seen.landing_factor[coming]
        earliest = earliest - jnp.where(factor < earliest, jnp.minimum(factor, 0.5 * earliest), 0.0)
        ahead = jnp.where(missed, earliest, 1.0 + jnp.maximum(sight, 0.0))
        next_end = self._policy.next_end(ahead, missed, (landing(ahead)[coming], divisor))
        return Landing(fired, first, order, missed, landed, landed, next_end, jnp.sum(jnp.where(first, near, 0.0)))

    def _rates(
        self, evaluate: Callable[..., PyTree], t: Array, y: PyTree, mode: PyTree, args: PyTree
    ) -> tuple[PyTree, Float[Array, " guards"]]:
        """The rate of y, and the rates of the guards along it, from one evaluation of both; constant."""
        t, y, mode, args = _held((t, y, mode, args))
        (slope, _), along = jax.linearize(lambda t, y: evaluate(t, y, mode, args), t, y)
        return _held((slope, along(jnp.ones_like(t), slope)[1]))

    def _jump(
        self,
        terms: PyTree,
        t: Real,
        at_end: tuple[EventState, EventMemory],
        landing: Landing,
        places: tuple[Array, Array],
        sides: tuple[PyTree, PyTree],
    ) -> tuple[tuple[EventState, EventMemory], tuple[Array, PyTree]]:
        """Carry the state to the root of the first guard, reset it there, and carry it back to `t`.

        Returned with the time from which the new state holds, and the rate of y there.
        """
        (state, memory), (root, near), (args, whole), fired = at_end, places, sides, landing.fired
        # Arguments after the event are those of the step that begins there.
        new_args = whole if self.samples is None else self.samples.freeze_args(t, whole)
        # An event within no distance is at a jump of the samples: the way back from it is before the jump.
        back = choose(near == 0, args, new_args)
        carries = np.asarray(self.carries_on)
        both = self.at_event or (lambda *at: (terms.vf(*at).y, self._guards(*at)))

        def evaluate(t: Array, y: PyTree, mode: PyTree, args: PyTree) -> tuple[PyTree, Array]:
            return both(t, state._replace(y=y, mode=mode), args)

        def way(y: PyTree, mode: PyTree, first: Array, fires: Array) -> tuple[Passage, PyTree, tuple[Array, Array]]:
            """Through the event of the guards `fires`; with the rates of y and of the first guard, and `early`."""
            here = state._replace(y=y, mode=mode)
            slope, rates = self._rates(evaluate, t, y, mode, args)
            rate = jnp.sum(jnp.where(first, rates, 0.0))
            rate = jnp.where(rate == 0, 1.0, rate)

            def reset(t_event: Array, y: PyTree) -> tuple[PyTree, PyTree]:
                dense = _spread(t_event, state.t, memory)[1] & jnp.any(fires & carries)
                after = self.reset(t_event, here._replace(y=y, dense=dense, slope=slope), whole, fires)
                return after.y, after.mode

            # The event of a guard that arrives is at its value `root`, that of others at zero, `early` later.
            level = jnp.sum(jnp.where(first, root, 0.0))
            arrives = jnp.any(first & (memory.guard > 0))
            early, level = jnp.where(arrives, 0.0, level / jnp.abs(rate)), jnp.where(arrives, level, 0.0)
            soon = (near > 0) & (t - _constant(state.t) <= _CHAIN * memory.pace) & (memory.resets > 0)
            landed = Landed(t, y, mode, first, (level, rate), landing.landed, near, state.t, soon)
            return pass_event(landed, evaluate, (args, back, new_args), reset), slope, (rate, early)

        passage, each, (rate, early) = in_turn(way, (t, state.y, state.mode, memory.guard), landing, near)
        t_event, values, (y, mode, slope) = passage.t, passage.guards, passage.after
        spread, vanishes = _spread(t_event, state.t, memory)
        carried = jnp.any(fired & carries)
        # Between impacts that accumulate there may be other events, but not many in a row.
        alone = jnp.where(carried, 0, memory.alone + 1)
        status = jnp.where(vanishes & (alone > _FEWEST), jnp.asarray(ACCUMULATION, spread.dtype), ONGOING)
        # A reset that changes nothing is no event.
        part = (lambda mode: mode) if self.event_mode is None else self.event_mode
        happened = _differ((passage.before, part(state.mode)), (y, part(mode)))
        events, index = jnp.where(happened, state.events + 1.0, state.events), jnp.where(happened, state.events, -1.0)
        status = jnp.where((status == ONGOING) & (events > self.max_events), TOO_MANY, status)
        clear = _constant(values) > jnp.where(fired, LATITUDE * jnp.abs(rate) * near, 0.0)

        def rises() -> Bool[Array, " guards"]:
            return self._rates(evaluate, t_event, y, mode, new_args)[1] > 0

        armed = self._policy.armed_after(clear, fired, memory.armed, rises)
        if carries.any():
            armed = jnp.where(vanishes & carried & carries, values > 0, armed)
        flags = _flags(fired, values)
        entry = EventLog(t_event, flags, each, (passage.before, state.mode), (y, mode))
        log = None if state.log is None else jtu.tree_map(lambda a, b: write(a, index, b), state.log, entry)
        guard, violated = _constant(values), ~fired & (values < 0) & self.enforce
        passed = state._replace(y=passage.y, mode=mode), memory._replace(guard=guard, armed=armed, violated=violated)
        after_reset = (
            passed[0]._replace(t=t_event, events=events, status=status, fired=flags, log=log),
            passed[1]._replace(resets=memory.resets + 1, alone=alone, spread=spread),
        )
        event = t_event - early, slope
        if self.event_mode is None and (self.samples is None or self.samples.times is None):
            return after_reset, event
        # Samples without a change, and resets that are no events, do not count as accumulation.
        chatters = jnp.any(fired) if self.event_mode is None else jnp.any(fired) & ~_differ(state.mode, mode)
        return jtu.tree_map(lambda a, b: jnp.where(happened | chatters, a, b), after_reset, passed), event


def _spread(t_event: Array, last: Array, memory: EventMemory) -> tuple[Array, Bool[Array, ""]]:
    """The longest of the last intervals between events, and whether it vanishes against the run or rounding."""
    since, t = t_event - last, _constant(t_event)
    spread = _constant(jnp.where(memory.resets == 0, since, jnp.maximum(since, _FORGET_INTERVALS * memory.spread)))
    eps = float(jnp.finfo(spread.dtype).eps)
    vanishes = spread <= jnp.maximum(_ACCUMULATION * eps**0.5 * (t - memory.begin), 64.0 * eps * jnp.abs(t))
    return spread, vanishes & (memory.resets >= _FEWEST)


def _held(tree: PyTree) -> PyTree:
    return jtu.tree_map(lambda x: _constant(x) if eqx.is_inexact_array(x) else x, tree)


def _differ(one: PyTree, other: PyTree) -> Bool[Array, ""]:
    different = jtu.tree_map(lambda a, b: jnp.any(a != b), one, other)
    return jtu.tree_reduce(jnp.logical_or, different, jnp.asarray(False))


def _flags(x: Bool[Array, "..."], like: Array) -> Array:
    """Ones and zeros in the type of `like`, for the state."""
    return jnp.where(x, 1.0, jnp.zeros_like(like))


def _real(x: ArrayLike) -> Array:
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(jnp.result_type(float))
