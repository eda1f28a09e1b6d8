"""The state that diffrax integrates where events happen."""

from typing import NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree

# Why events ended a run: they accumulate (Zeno, chatter), or there were more than allowed.
ONGOING, ACCUMULATION, TOO_MANY = 0.0, 1.0, 2.0


class EventLog(NamedTuple):
    """Events in the order of time; entries that were not needed hold an infinite time and zeros.

    - `t`: times [s], shape `[max_events]`.
    - `fired`: 1 for each guard that fired, shape `[max_events, guards]`.
    - `before`, `after`: the pair (y, mode) at the event before and after the reset, with a leading axis `max_events`.
    """

    t: Float[Array, "*s events"]
    fired: Float[Array, "*s events guards"]
    before: tuple[PyTree, PyTree]
    after: tuple[PyTree, PyTree]


class EventMemory(NamedTuple):
    """What `EventSolver` tells `EventController`, and keeps from event to event.

    - `guard`, `armed`: values of the guards at this state, and 1 for each that is armed, shape `[guards]`.
    - `resets`: number of calls of `reset`.
    - `spread`: the longest of the last intervals between them.
    - `landed`: 1 where the step ended on a root.
    - `next_root`: where the next root is or seems to be, in steps from the start of this one.
    - `step_factor`: by which factor the length of the step may change before the guards are not resolved.
    """

    guard: Float[Array, "*s guards"]
    armed: Float[Array, "*s guards"]
    resets: Float[Array, "..."]
    spread: Float[Array, "..."]
    landed: Float[Array, "..."]
    next_root: Float[Array, "..."]
    step_factor: Float[Array, "..."]


class EventState(NamedTuple):
    """State of a run with events; made by `EventSolver.start`.

    - `y`: what the vector field integrates.
    - `mode`: what is constant between events.
    - `t`: time of the last event, or of the start.
    - `events`: number of events so far: of resets that changed something.
    - `status`: 0; 1 where events accumulate; 2 where there were more than allowed.
    - `fired`: 1 for each guard that fired in the last event, shape `[guards]`.
    - `log`: an `EventLog`, or None.
    - `memory`: of the solver itself.
    """

    y: PyTree
    mode: PyTree
    t: Float[Array, "..."]
    events: Float[Array, "..."]
    status: Float[Array, "..."]
    fired: Float[Array, "*s guards"]
    log: EventLog | None
    memory: EventMemory

    def rate(self, dy: PyTree) -> "EventState":
        """What a vector field returns: `dy` for `y`, and zero for everything else, which is constant in a step."""
        return jtu.tree_map(jnp.zeros_like, self)._replace(y=dy)


def write(log: Array, index: Array, entry: Array) -> Array:
    """Array `log` with `entry` at `index`; without effect where the index lies outside."""
    here = jnp.arange(log.shape[0]) == index
    return jnp.where(jnp.reshape(here, (-1, *(1,) * (log.ndim - 1))), entry[None], log)
