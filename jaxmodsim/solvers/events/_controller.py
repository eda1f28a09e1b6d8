"""A step size controller that ends steps on events."""

from typing import Any, NamedTuple, cast

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree

from ..._core.arrays import Fn, Real, fusion_barrier, is_one_of, opaque_one
from .._controllers import FiniteSteps, end_at, without_infinity
from .._equation import check_ode
from .._wrapper import AbstractControllerWrapper
from ._state import ACCUMULATION, TOO_MANY, EventState

# Limit of successive attempts that are rejected only because they do not resolve the guards; each is 0.2 to 0.9 times
# as long as the one before. After that the guards count as resolved: a guard may jump.
_MAX_DOUBTS = 12
_SHRINK, _SMALLEST = 0.9, 0.2
# The error did not limit a step if the next step may be this many times as long.
_UNLIMITED = 5.0

# The shortest step towards an event, in steps.
_SHORTEST = 1e-9
# The next step ends at an event that is at most this many steps ahead.
_CLOSE = 0.1
# The error of a rejected step is small if the next attempt is at least this part of it.
_MILD = 0.3

_BACKWARD = "EventSolver runs forward in time, but t1 < t0: count time the other way, and negate the vector field."

_constant = jax.lax.stop_gradient


class _ControllerState(NamedTuple):
    """State of the controller.

    - `inner`: state of the wrapped controller.
    - `usual`: the last length of step that the error limited.
    - `doubts`: number of attempts, since the last accepted step, that were rejected for unresolved guards.
    """

    inner: PyTree
    usual: Float[Array, ""]
    doubts: Float[Array, ""]


class EventController(AbstractControllerWrapper):
    """Wrap a step size controller so that steps end on the events that `EventSolver` sees.

    A step that passes a root of a guard is rejected and aimed at the root, until one lands. The step after an event is
    as long as the error last allowed. A step that does not resolve the guards is repeated with a shorter length. The
    wrapped controller decides all else.

    Roots take precedence over `times`, and `times` over the end of the run: a step that is aimed at a root is never
    extended to a time just behind it.

    **Arguments:**

    - `controller`: any diffrax step size controller, adaptive or constant.
    - `times`: increasing times at which a step ends and the method starts anew, shape `[n]`; None for none.
    - `direction`: 1 if time is known to run forward; by default a run-time check.

    **Raises:**

    - `ValueError` where the state is not from `EventSolver.start`, as under `diffrax.BacksolveAdjoint`.
    - `RuntimeError` at run time, by `equinox.error_if`, where t1 < t0.

    **Example:**

    ```python
    ball = jms.problems.bouncing_ball.BouncingBall(e=0.5)
    solver = jms.EventSolver(diffrax.Tsit5(), ball.guards, ball.reset)
    control = jms.EventController(diffrax.PIDController(rtol=1e-8, atol=1e-8))
    start, field = solver.start(0.0, ball.dropped(h=1.0), mode=0.0), diffrax.ODETerm(ball.field)
    solution = diffrax.diffeqsolve(field, solver, 0.0, 0.8, None, start, stepsize_controller=control)
    print(solution.ys.y.round(4))
    ```

    ```text
    [[ 0.1761 -1.2038]]
    ```
    """

    controller: dfx.AbstractStepSizeController
    times: Float[Array, " n"] | None
    direction: Any

    def __init__(
        self,
        controller: dfx.AbstractStepSizeController,
        times: Float[Array, " n"] | None = None,
        direction: Any = None,
    ):
        self.controller, self.times, self.direction = FiniteSteps.instead(controller), times, direction

    def wrap(self, direction: Real) -> "EventController":
        """Wrap the controller inside."""
        known = direction if self.direction is None else self.direction
        return EventController(self.controller.wrap(direction), self.times, known)

    def init(
        self, terms: PyTree, t0: Real, t1: Real, y0: PyTree, dt0: Real | None, args: PyTree, func: Fn, error_order: Any
    ) -> tuple[Array, _ControllerState]:
        """First step of the wrapped controller, which sees the integrated part of the state."""
        check_ode(terms, method="EventSolver")
        t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
        if not isinstance(y0, EventState):
            raise ValueError(
                "EventController needs y0=solver.start(t0, y0) of its EventSolver. diffrax.BacksolveAdjoint does not"
                " pass events: leave the adjoint out, or take diffrax.ForwardMode()."
            )
        if not isinstance(self.direction, int):
            # diffrax has negated the times if t1 < t0; the direction of a run of no length is -1, too.
            t0 = eqx.error_if(t0, (self.direction < 0) & (t0 < t1), _BACKWARD)

        def inner_func(terms: PyTree, t: Real, y: PyTree, args: PyTree) -> PyTree:
            return func(terms, t, y0._replace(y=y), args)

        first, inner = self.controller.init(terms, t0, t1, y0.y, dt0, args, inner_func, error_order)
        first = jnp.asarray(first)
        usual = (1.0 if isinstance(self.controller, FiniteSteps) else _UNLIMITED) * (first - t0)
        longest = getattr(self.controller, "dtmax", None)
        usual = usual if longest is None else jnp.minimum(usual, longest)
        first = first if self.times is None else end_at(self.times, t0, first)
        return _constant(first), _ControllerState(inner, _constant(usual), jnp.zeros_like(t0))

    def adapt_step_size(
        self,
        t0: Real,
        t1: Real,
        y0: EventState,
        y1_candidate: EventState,
        args: PyTree,
        y_error: PyTree,
        error_order: PyTree,
        controller_state: _ControllerState,
    ) -> tuple[Array, Array, Array, Array, _ControllerState, dfx.RESULTS]:
        """As the wrapped controller, but reject a step that passes an event or does not resolve the guards."""
        old, seen, t0, t1 = controller_state, y1_candidate.report, jnp.asarray(t0), jnp.asarray(t1)
        keep, inner_t0, inner_t1, jump, inner, result = self.controller.adapt_step_size(
            t0, t1, y0.y, without_infinity(y1_candidate.y), args, y_error, error_order, old.inner
        )
        length = _constant(t1 - t0)
        next_root, factor, landed = _constant(seen.next_root), _constant(seen.step_factor), _constant(seen.landed) > 0.5
        proposed = jnp.subtract(inner_t1, inner_t0)
        passed = keep & (next_root < 1.0) & ~landed
        doubtful = keep & ~passed & (factor < _SHRINK) & (old.doubts < _MAX_DOUBTS)
        accept = keep & ~passed & ~doubtful
        accept = fusion_barrier(jnp.where(accept, 1.0, jnp.zeros_like(length)), opaque_one(length)) > 0.5
        landed = landed & accept

        dtmin = getattr(self.controller, "dtmin", None)
        resolution = 4.0 * float(jnp.finfo(length.dtype).eps) * jnp.abs(t0)
        resolution = resolution if dtmin is None else jnp.maximum(resolution, dtmin)
        shortest = jnp.maximum(resolution, _SHORTEST * length)
        given = isinstance(self.controller, FiniteSteps)
        unlimited = (proposed > _UNLIMITED * length) & (not given)
        usual = jnp.where(accept & ~unlimited, proposed, old.usual)
        step = jnp.minimum(proposed, jnp.maximum(_SHRINK * factor, _SMALLEST) * length)
        step = jnp.where(doubtful, step, proposed) if given else step
        # A step with a small error still locates the event.
        near = proposed > _MILD * length
        step = jnp.where(keep, step, jnp.where(near, jnp.minimum(proposed, next_root * length), proposed))
        # Just in front of an event, go straight to it.
        ahead = (next_root - 1.0) * length
        close = accept & ~landed & (next_root - 1.0 < _CLOSE) & (ahead < step)
        step = jnp.where(close, ahead, step)
        step = jnp.where(landed, usual, step)
        step = jnp.where(passed, jnp.maximum(next_root * length, shortest), step)
        next_t0 = jnp.where(accept, t1, t0)
        next_t1 = next_t0 + step
        if self.times is not None:
            next_t1 = end_at(self.times, next_t0, next_t1, stretch=~(close | passed))
            jump = jump | is_one_of(self.times, next_t0)
        state = _ControllerState(
            jtu.tree_map(lambda a, b: jnp.where(accept | ~keep, a, b), inner, old.inner),
            _constant(usual),
            _constant(jnp.where(accept, 0.0, old.doubts + doubtful)),
        )
        status = jnp.where(landed, y1_candidate.status, 0.0)
        ended = cast(dfx.RESULTS, dfx.RESULTS.where(landed, dfx.RESULTS.successful, result))
        ended = dfx.RESULTS.where(status == ACCUMULATION, dfx.RESULTS.dt_min_reached, ended)
        ended = dfx.RESULTS.where(status == TOO_MANY, dfx.RESULTS.max_steps_reached, ended)
        return accept, next_t0, _constant(next_t1), landed | jump, state, ended
