"""A solver wrapper that makes events non-terminating."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, PyTree

from ..numerics import first_root, watch
from ._event_state import ACCUMULATION, NO_TROUBLE, TOO_MANY, EventLog, EventState, write

# How far beside the root a step may end, as a fraction of the step; from there the state is carried to the root, with
# an error of the third power of that distance.
_LANDING = 1e-5
# Events accumulate where the longest of the last intervals is below this part of the time since the start, times the
# square root of the rounding unit.
_ACCUMULATION = 1e-3
# Weight that the last intervals between events, and the last steps, keep at each new one.
_FORGET = 0.25

_constant = jax.lax.stop_gradient


class _EventInterpolation(dfx.AbstractLocalInterpolation):
    """Dense output of the wrapped solver inside a step; at its end the state after the event."""

    t0: Any
    t1: Any
    inner: dfx.AbstractLocalInterpolation
    state0: EventState
    state1: EventState

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> EventState:
        """State at `t0`, or the increment from `t0` to `t1`."""
        del left
        if t1 is not None:
            return jtu.tree_map(lambda a, b: a - b, self.evaluate(t1), self.evaluate(t0))
        inside = self.state0._replace(y=self.inner.evaluate(t0))
        return jtu.tree_map(lambda a, b: jnp.where(t0 >= self.t1, b, a), inside, self.state1)


class _Field(eqx.Module):
    """Vector field of the part that is integrated; the state it belongs to comes with the arguments."""

    terms: PyTree

    def __call__(self, t: Any, y: PyTree, args: tuple[EventState, PyTree]) -> PyTree:
        """Rate of `y`."""
        return self.terms.vf(t, args[0]._replace(y=y), args[1]).y


class EventSolver(dfx.AbstractAdaptiveSolver, dfx.AbstractWrappedSolver):
    """TODO."""

    term_structure: ClassVar = dfx.ODETerm
    solver: dfx.AbstractSolver
    guards: Callable[..., Any]
    reset: Callable[..., Any]
    hold: Callable[..., Any] | None = None
    project: Callable[..., Any] | None = None
    max_events: int = eqx.field(default=128, static=True)
    log: bool = eqx.field(default=True, static=True)

    @property
    def root_finder(self) -> Any:
        """That of the wrapped solver, if it is implicit: diffrax gives it the tolerances of the controller."""
        return self.solver.root_finder

    @property
    def scan_kind(self) -> Any:
        """That of the wrapped solver, if it is a Runge-Kutta method: diffrax sets it for the kind of derivative."""
        return self.solver.scan_kind

    @property
    def interpolation_cls(self) -> Any:
        """Interpolation of the wrapped solver, with the event at the end of the step."""

        def interpolation(*, t0: Any, t1: Any, inner: Any, state0: Any, state1: Any) -> _EventInterpolation:
            return _EventInterpolation(t0, t1, self.solver.interpolation_cls(t0=t0, t1=t1, **inner), state0, state1)

        return interpolation

    def order(self, terms: PyTree) -> Any:
        """Order of the wrapped solver, which events keep."""
        return self.solver.order(terms)

    def error_order(self, terms: PyTree) -> Any:
        """Order of the error estimate of the wrapped solver."""
        return self.solver.error_order(terms)

    def start(self, t0: Any, y0: PyTree, mode: PyTree = None, args: PyTree = None, *, armed: bool = False) -> EventState:
        """State to begin with."""
        y0, mode = jtu.tree_map(_real, (y0, mode))
        zero = jnp.zeros((), jnp.result_type(t0, *jtu.tree_leaves(y0)))
        t0 = jnp.asarray(t0, zero.dtype)
        state = EventState(y0, mode, t0, zero, zero, zero, None, zero, zero, zero, zero, zero, zero + 1.0, zero + 1.0)
        guard = self._guards(t0, state, args)
        log = None
        if self.log:

            def rows(x: Array) -> Array:
                return jnp.zeros((self.max_events, *x.shape), x.dtype)

            pair = jtu.tree_map(rows, (y0, mode))
            log = EventLog(jnp.full(self.max_events, jnp.inf, zero.dtype), rows(guard), pair, pair)
        ready = jnp.ones_like(guard) if armed else jnp.where(guard > 0, 1.0, jnp.zeros_like(guard))
        return state._replace(fired=jnp.zeros_like(guard), log=log, guard=guard, armed=ready)

    def _guards(self, t: Any, state: EventState, args: PyTree) -> Float[Array, " guards"]:
        return jnp.asarray(self.guards(t, state, args))

    def func(self, terms: PyTree, t0: Any, y0: EventState, args: PyTree) -> PyTree:
        """The vector field of the wrapped solver."""
        return self.solver.func(dfx.ODETerm(_Field(terms)), t0, y0.y, (y0, args))

    def init(self, terms: PyTree, t0: Any, t1: Any, y0: EventState, args: PyTree) -> Any:
        """State of the wrapped solver."""
        return self.solver.init(dfx.ODETerm(_Field(terms)), t0, t1, y0.y, (y0, args))

    def step(
        self, terms: PyTree, t0: Any, t1: Any, y0: EventState, args: PyTree, solver_state: Any, made_jump: Any
    ) -> tuple[EventState, PyTree, dict[str, Any], Any, dfx.RESULTS]:
        """A step of the wrapped solver, a look at the guards along it, and the reset where it ends on an event."""
        y1, error, dense, solver_state, result = self.solver.step(
            dfx.ODETerm(_Field(terms)), t0, t1, y0.y, (y0._replace(log=None), args), solver_state, made_jump
        )
        if self.project is not None:
            y1 = self.project(t1, y0._replace(y=y1), args)
        path = self.solver.interpolation_cls(t0=t0, t1=t1, **dense)
        t_one, t_two = t0 + (t1 - t0) / 3.0, t0 + (t1 - t0) * (2.0 / 3.0)
        inside = [self._guards(t, y0._replace(y=path.evaluate(t)), args) for t in (t_one, t_two)]
        end = self._guards(t1, y0._replace(y=y1), args)
        values = tuple(_constant(value) for value in (y0.guard, *inside, end))
        armed = y0.armed > 0.5
        seen = watch(values, armed)
        armed = armed | (values[1] > 0) | (values[2] > 0) | (values[3] > 0)

        # Around t0 = 0 the resolution of time is that of the step itself.
        length = _constant(t1 - t0)
        resolution = 4.0 * float(jnp.finfo(length.dtype).eps) * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
        near = jnp.maximum(_LANDING * jnp.maximum(length, y0.pace), _constant(resolution))
        near = near / jnp.where(length > 0, length, 1.0)
        here = armed & (jnp.abs(seen.ahead) <= near)
        passed = seen.crosses & ~here
        # Without a root inside, the next one may be in sight: then the next step shall end there.
        sight = jnp.min(jnp.where(armed, seen.ahead, jnp.inf))
        missed = jnp.any(passed)
        landed = jnp.any(here) & ~missed & (length > 0)
        fired = here & landed
        first = seen.ahead == sight
        aim = jnp.where(missed, first_root(seen, passed), 1.0 + jnp.maximum(sight, 0.0))
        state1 = y0._replace(
            y=y1,
            guard=end,
            armed=jnp.where(armed, 1.0, jnp.zeros_like(end)),
            landed=jnp.where(landed, 1.0, jnp.zeros_like(aim)),
            pace=jnp.maximum(length, _FORGET * y0.pace),
            aim=aim,
            room=jnp.min(seen.room),
        )
        state1 = jax.lax.cond(
            landed,
            lambda: self._jump(terms, t1, state1, fired, first, near * length, args),
            lambda: state1,
        )
        dense = {"inner": dense, "state0": y0, "state1": state1}
        return state1, error, dense, solver_state, result

    def _jump(
        self,
        terms: PyTree,
        t: Any,
        state: EventState,
        fired: Bool[Array, " guards"],
        first: Bool[Array, " guards"],
        near: Array,
        args: PyTree,
    ) -> EventState:
        """Carry the state to the root of the first guard, reset it there, and carry it back to `t`.

        The way to the root is zero but for the error of the landing; its derivatives are those of the time of the
        event, to second order, so that those of the result are exact.
        """
        def field(t: Any, state: EventState) -> PyTree:
            return terms.vf(t, state, args).y

        def guard(t: Any, y: PyTree) -> Array:
            return jnp.sum(jnp.where(first, self._guards(t, state._replace(y=y), args), 0.0))

        slope = field(t, state)
        height, rate = jax.jvp(guard, (t, state.y), (jnp.ones_like(t), slope))
        rate = _constant(rate)
        rate = jnp.where(rate == 0, 1.0, rate)
        way = -height / rate
        # A guard that a reset has violated fires where it stands; it has no root here.
        on_root = (state.landed > 0.5) & (jnp.abs(_constant(way)) <= 4.0 * near)
        way = jnp.where(on_root, way, 0.0)
        middle = field(t + 0.5 * way, state._replace(y=_along(state.y, 0.5 * way, slope)))
        there = _along(state.y, way, middle)
        rest = jnp.where(on_root, -guard(t + way, there) / rate, 0.0)
        te, before = t + way + rest, state._replace(y=_along(there, rest, middle))

        spread = jnp.where(
            state.count == 0, te - state.t, jnp.maximum(te - state.t, _FORGET * state.spread)
        )
        spread = _constant(spread)
        eps = float(jnp.finfo(spread.dtype).eps)
        dense_events = (state.count >= 8) & (spread <= _ACCUMULATION * eps**0.5 * jnp.abs(_constant(te)))
        after = self.reset(te, before, args, fired)
        trouble = jnp.where(dense_events, ACCUMULATION, NO_TROUBLE)
        if self.hold is not None:
            held = self.hold(te, before, args, fired)
            after = jtu.tree_map(lambda a, b: jnp.where(dense_events, a, b), held, after)
            trouble = jnp.zeros_like(spread)
        count = state.count + 1.0
        trouble = jnp.where((trouble == NO_TROUBLE) & (count >= self.max_events), TOO_MANY, trouble)

        back = -(way + rest)
        slope = field(te, after)
        middle = field(te + 0.5 * back, after._replace(y=_along(after.y, 0.5 * back, slope)))
        end = after._replace(y=_along(after.y, back, middle))
        guard_new = self._guards(t, end, args)
        flags = jnp.where(fired, 1.0, jnp.zeros_like(guard_new))
        log = state.log
        if log is not None:
            entry = EventLog(te, flags, (before.y, before.mode), (after.y, after.mode))
            log = jtu.tree_map(lambda a, b: write(a, state.count, b), log, entry)
        armed = ~fired | (_constant(guard_new) > 4.0 * jnp.abs(rate) * near)
        if self.hold is not None:
            armed = jnp.where(dense_events, guard_new > 0, armed)
        return state._replace(
            y=end.y,
            mode=end.mode,
            t=te,
            count=count,
            trouble=trouble,
            fired=flags,
            log=log,
            guard=guard_new,
            armed=jnp.where(armed, 1.0, jnp.zeros_like(guard_new)),
            spread=spread,
        )


def _real(x: Any) -> Array:
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(jnp.result_type(float))


def _along(y: PyTree, s: Array, slope: PyTree) -> PyTree:
    return jtu.tree_map(lambda a, b: a + (s * b).astype(a.dtype), y, slope)
