"""The state that diffrax integrates where events happen."""

from typing import NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int, PyTree

# Why events ended a run: they accumulate (Zeno, chatter), or there were more than allowed.
ONGOING, ACCUMULATION, TOO_MANY = 0.0, 1.0, 2.0


class EventLog(NamedTuple):
    """Events in the order of time; unused entries have an infinite time and zeros.

    - `t`: times [s], shape `[max_events]`.
    - `fired`: 1 for each guard that fired, shape `[max_events, guards]`.
    - `each`: the same times for each guard, with the derivative of its own root, shape `[max_events, guards]`.
    - `before`, `after`: the pair (y, mode) at the event before and after the reset, with a leading axis `max_events`.
    """

    t: Float[Array, "*s events"]
    fired: Float[Array, "*s events guards"]
    each: Float[Array, "*s events guards"]
    before: tuple[PyTree, PyTree]
    after: tuple[PyTree, PyTree]


class StepReport(NamedTuple):
    """The report of a step to `EventController`.

    - `landed`: 1 where the step ended on a root.
    - `next_root`: position of the next root, or its estimate, in steps from the start of this one.
    - `step_factor`: the factor by which the length of the step may change before it no longer resolves the guards.
    """

    landed: Float[Array, "..."]
    next_root: Float[Array, "..."]
    step_factor: Float[Array, "..."]


class EventState(NamedTuple):
    """State of a run with events; made by `EventSolver.start`.

    diffrax converts every leaf of a state to the type of time. Counts and flags in it are therefore floating.

    - `y`: the part that the vector field integrates.
    - `mode`: the part that is constant between events.
    - `t`: time of the last event, or of the start.
    - `events`: number of events so far: of resets that changed something.
    - `status`: 0; 1 where events accumulate; 2 where there were more than allowed.
    - `fired`: 1 for each guard that fired in the last event, shape `[guards]`.
    - `log`: an `EventLog`, or None.
    - `report`: the report of the last step to the controller.
    - `dense`: in a call of `reset`, whether events accumulate and the run carries on; None elsewhere.
    - `slope`: in a call of `reset`, the rate of y in this mode, constant; None elsewhere.
    """

    y: PyTree
    mode: PyTree
    t: Float[Array, "..."]
    events: Float[Array, "..."]
    status: Float[Array, "..."]
    fired: Float[Array, "*s guards"]
    log: EventLog | None
    report: StepReport
    dense: Bool[Array, ""] | None = None
    slope: PyTree = None

    def rate(self, dy: PyTree) -> "EventState":
        """The value of a vector field: `dy` for `y`, and zero for everything else, which is constant in a step."""
        return jtu.tree_map(jnp.zeros_like, self)._replace(y=dy)


class EventMemory(NamedTuple):
    """Memory of `EventSolver` from step to step, beside the state of the wrapped solver; constant in derivatives.

    - `guard`, `armed`: values of the guards at the end of the last step, and which are armed, shape `[guards]`.
    - `violated`: conditions that the last step's event has made negative, beside those that fired, shape `[guards]`.
    - `resets`: number of calls of `reset`. `alone`: of the last ones by guards that do not carry on.
    - `spread`: the longest of the last intervals between them [time].
    - `pace`: the longest of the last steps [time].
    - `begin`: a time one first step before the start.
    """

    guard: Float[Array, " guards"]
    armed: Bool[Array, " guards"]
    violated: Bool[Array, " guards"]
    resets: Int[Array, ""]
    alone: Int[Array, ""]
    spread: Float[Array, ""]
    pace: Float[Array, ""]
    begin: Float[Array, ""]


class Landing(NamedTuple):
    """Events at the end of a step.

    - `fired`, `first`: the guards that fire, and the first of them, shape `[guards]`.
    - `ahead`: distance of the roots from the end of the step, in steps, shape `[guards]`.
    - `missed`: whether the step has passed a root.
    - `landed`: whether it ends on one.
    - `happens`: whether the state is to be reset.
    - `next_root`: see `StepReport`.
    - `near`: the largest distance of the root from the end of the step, in steps.
    """

    fired: Bool[Array, " guards"]
    first: Bool[Array, " guards"]
    ahead: Float[Array, " guards"]
    missed: Bool[Array, ""]
    landed: Bool[Array, ""]
    happens: Bool[Array, ""]
    next_root: Float[Array, ""]
    near: Float[Array, ""]


def write(log: Array, index: Array, entry: Array) -> Array:
    """Array `log` with `entry` at `index`; without effect where the index lies outside."""
    here = jnp.arange(log.shape[0]) == index
    return jnp.where(jnp.reshape(here, (-1, *(1,) * (log.ndim - 1))), entry[None], log)
