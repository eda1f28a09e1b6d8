"""Jumps of sampled values at times that are known."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ..._core.arrays import is_one_of
from ._state import Landing


class SampledJumps(eqx.Module):
    """Sampled values in the arguments of a run with events.

    **Arguments:**

    - `freeze_args`: `freeze_args(t0, args)` -> `args` of a step that begins at t0, without the jump at its end; the
      reset at the end of the step gets `args` themselves.
    - `times`: times at which fields and guards jump, increasing, shape `[n]`, among the `times` of the controller; None
      for none. `reset` is called there with no guard marked; a change of the modes is an event.
    """

    freeze_args: Callable[[Array, PyTree], PyTree]
    times: Float[Array, " n"] | None = None

    def at(self, t: Array, length: Array) -> Bool[Array, ""] | None:
        """Whether a step of this length ends on a jump; None without jumps."""
        return None if self.times is None else is_one_of(self.times, t) & (length > 0)


def on_jump(landing: Landing, jumps: Bool[Array, ""]) -> Landing:
    """The landing of a step that may end on a jump.

    The estimate of the next root is void after the jump. The root of a guard that fires with the jump is the jump.
    """
    resets = jumps & ~landing.missed
    return landing._replace(
        happens=landing.landed | resets,
        next_root=jnp.where(resets, jnp.inf, landing.next_root),
        near=jnp.where(jumps, 0.0, landing.near),
    )
