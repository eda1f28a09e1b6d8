"""Step size controllers: one that stops at the first value that is not finite, one that ends steps at given times."""

from typing import Any, cast

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree

from .._core.arrays import Fn, Real, after, is_one_of
from ._wrapper import AbstractControllerWrapper

# Part of a step by which it may end before or after the required time.
_STRETCH = 1e-6


class FiniteSteps(dfx.AbstractStepSizeController):
    """Given steps that end the run at its last finite state, instead of NaN to the end.

    After a step that an event or a sample has shortened, the next step covers the rest of it.
    """

    inner: dfx.ConstantStepSize | dfx.StepTo = dfx.ConstantStepSize()

    @classmethod
    def instead(cls, controller: dfx.AbstractStepSizeController) -> dfx.AbstractStepSizeController:
        """These steps instead of those of diffrax, which are longer after a step that was shortened."""
        return cls(controller) if isinstance(controller, dfx.ConstantStepSize | dfx.StepTo) else controller

    def wrap(self, direction: Real) -> "FiniteSteps":
        """Wrap the controller inside."""
        return FiniteSteps(self.inner.wrap(direction))

    def init(
        self, terms: PyTree, t0: Real, t1: Real, y0: PyTree, dt0: Real | None, args: PyTree, func: Fn, error_order: Any
    ) -> tuple[Real, PyTree]:
        """As the controller inside."""
        end, state = self.inner.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return end, (state, end)

    def adapt_step_size(
        self,
        t0: Real,
        t1: Real,
        y0: PyTree,
        y1_candidate: PyTree,
        args: PyTree,
        y_error: PyTree,
        error_order: PyTree,
        controller_state: PyTree,
    ) -> tuple[Real, Real, Real, Real, PyTree, dfx.RESULTS]:
        """Keep the step if all of its result is finite."""
        old, target = controller_state
        _, next_t0, next_t1, jump, new, _ = self.inner.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, old
        )
        shorter = target - t1 > _STRETCH * (target - t0)
        state = jtu.tree_map(lambda a, b: jnp.where(shorter, a, b), controller_state, (new, next_t1))
        finite = jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jtu.tree_leaves(y1_candidate)]).all()
        # diffrax has no code for a value that is not finite; this is the nearest code that step control does not use.
        result = dfx.RESULTS.where(finite, dfx.RESULTS.successful, cast(dfx.RESULTS, dfx.RESULTS.nonlinear_divergence))
        return finite, jnp.where(finite, next_t0, t0), state[1], jump, state, result


def end_at(times: Float[Array, " n"], t0: Real, t1: Real, stretch: Real = True) -> Array:
    """End of a step from `t0` to `t1`, or the next one of `times` if that is earlier.

    With `stretch` also if that is just after `t1`, so that no tiny step remains.
    """
    t0, t1, last = jnp.asarray(t0), jnp.asarray(t1), times.shape[0] - 1
    i = after(times, t0)
    time = jax.lax.dynamic_index_in_dim(times, jnp.minimum(i, last), keepdims=False).astype(t1.dtype)
    longest = jnp.where(stretch, 1.0 + _STRETCH, 1.0) * (t1 - t0)
    return jnp.where((i <= last) & (time - t0 <= longest), time, t1)


def without_infinity(y: PyTree) -> PyTree:
    """`y` with NaN for infinity: diffrax rejects a step to NaN, but an error relative to infinity is inf / inf."""
    return jtu.tree_map(lambda x: jnp.where(jnp.isinf(x), jnp.nan, x), y)


class StepsTo(AbstractControllerWrapper):
    """Wrap a step size controller so that steps end on given times, where the method starts anew.

    `EventController` does the same in runs with events. Unlike `diffrax.ClipStepSizeController(jump_ts=...)` this
    controller takes constant steps, too, and steps end on the times themselves, not one rounding unit before them. The
    numbers of adaptive steps are about equal: 52 and 52 without stiffness, 463 and 458 with LuGre friction under a
    signal of 11 samples. A step to infinity is repeated with a shorter one, as diffrax does with a step to NaN.

    **Arguments:**

    - `controller`: any diffrax step size controller, adaptive or constant.
    - `times`: increasing, shape `[n]`; None for none.
    """

    controller: dfx.AbstractStepSizeController
    times: Float[Array, " n"] | None

    def __init__(self, controller: dfx.AbstractStepSizeController, times: Float[Array, " n"] | None = None):
        self.controller = FiniteSteps.instead(controller)
        self.times = times

    def wrap(self, direction: Real) -> "StepsTo":
        """Wrap the controller inside. Time runs forward."""
        return StepsTo(self.controller.wrap(direction), self.times)

    def init(
        self, terms: PyTree, t0: Real, t1: Real, y0: PyTree, dt0: Real | None, args: PyTree, func: Fn, error_order: Any
    ) -> tuple[Real, PyTree]:
        """First step of the wrapped controller, at most to the first time."""
        end, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return end if self.times is None else end_at(self.times, t0, end), inner

    def adapt_step_size(
        self,
        t0: Real,
        t1: Real,
        y0: PyTree,
        y1_candidate: PyTree,
        args: PyTree,
        y_error: PyTree,
        error_order: PyTree,
        controller_state: PyTree,
    ) -> tuple[Real, Real, Real, Real, PyTree, dfx.RESULTS]:
        """As the wrapped controller, but no step passes one of the times."""
        keep, next_t0, next_t1, jump, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, without_infinity(y1_candidate), args, y_error, error_order, controller_state
        )
        if self.times is not None:
            next_t1 = end_at(self.times, next_t0, next_t1)
            jump |= is_one_of(self.times, jnp.asarray(next_t0))
        return keep, next_t0, next_t1, jump, inner, result
