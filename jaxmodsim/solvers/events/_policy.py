"""The two kinds of guards: crossings, and conditions that have to hold."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._guard_scan import GuardScan

# End of a step if conditions have to hold after it: this part of the landing distance behind the root, at most this
# part of the rest of the step. The motion after the event does not exist before the root: a slip that begins would
# touch rest there, and end again.
_BEYOND, _BEYOND_OF_REST = 0.3, 0.5
# diffrax ends no step within 100 rounding units of time before the end of a run.
_UNPLACED = 128.0

Flags = Bool[Array, " guards"]


class AbstractGuardPolicy(eqx.Module):
    """Conditions under which a guard is armed and fires, and the end of a step towards its root."""

    @abc.abstractmethod
    def armed_at_start(self, guard: Float[Array, " guards"]) -> Flags:
        """Which guards are armed at the start of a run."""

    @abc.abstractmethod
    def fires(self, here: Flags, scan: GuardScan, end: Array, length: Array, t1: Array) -> Flags:
        """Which guards fire at the end of a step; those that are `here` are on a root, `end` are their values."""

    @abc.abstractmethod
    def next_end(self, root: Array, passed: Array, near: tuple[Array, Array]) -> Array:
        """End of the next step towards `root`, in steps of this one.

        `passed`: whether this step has passed the root. `near`: the landing distance and the length of a step.
        """

    @abc.abstractmethod
    def armed_after(self, clear: Flags, fired: Flags, armed: Flags, rises: Callable[[], Flags]) -> Flags:
        """Which guards are armed after an event.

        `clear`: the guards that are far enough above zero. `rises()`: the guards that rise from the reset.
        """


class Crossings(AbstractGuardPolicy):
    """Guards whose falls through zero count, each once."""

    def armed_at_start(self, guard: Float[Array, " guards"]) -> Flags:
        """Those that are positive."""
        return guard > 0

    def fires(self, here: Flags, scan: GuardScan, end: Array, length: Array, t1: Array) -> Flags:
        """Those on a root."""
        del scan, end, length, t1
        return here

    def next_end(self, root: Array, passed: Array, near: tuple[Array, Array]) -> Array:
        """At the root."""
        del passed, near
        return root

    def armed_after(self, clear: Flags, fired: Flags, armed: Flags, rises: Callable[[], Flags]) -> Flags:
        """A guard that rises from the reset will fall again, even if it is as small as rounding."""
        return clear | (~fired & armed) | (fired & rises())


class Conditions(AbstractGuardPolicy):
    """Guards that have to be positive: armed at all times."""

    def armed_at_start(self, guard: Float[Array, " guards"]) -> Flags:
        """All of them."""
        return jnp.ones_like(guard, bool)

    def fires(self, here: Flags, scan: GuardScan, end: Array, length: Array, t1: Array) -> Flags:
        """Those that are violated behind their root."""
        eps = float(jnp.finfo(length.dtype).eps)
        return (here | (scan.crosses & (length <= _UNPLACED * eps * jnp.abs(t1)))) & (end <= 0)

    def next_end(self, root: Array, passed: Array, near: tuple[Array, Array]) -> Array:
        """Behind the root."""
        beyond = _BEYOND * near[0] / near[1]
        return root + jnp.where(passed, jnp.minimum(beyond, _BEYOND_OF_REST * (1.0 - root)), beyond)

    def armed_after(self, clear: Flags, fired: Flags, armed: Flags, rises: Callable[[], Flags]) -> Flags:
        """All of them."""
        del fired, armed, rises
        return jnp.ones_like(clear)
