"""Metrics of the modes of friction elements, and the readers of elements and events that all metrics share."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._core.safe import safe_norm
from ..scene import Friction
from ..simulation import Events, Trajectory
from ._metric import Metric

# A cycle has ended if it has not returned for more than this number of its periods.
ALIVE = 1.5
_KINDS = ("never slips", "sticks for good", "stick-slip cycle", "slips back and forth", "slips for good")


def mode_changes(element: str = "friction") -> Metric:
    """Number of mode changes of an event-driven friction element.

    **Arguments:**

    - `element`: name of the friction element.

    **Returns:**

    A `Metric`, a whole number.

    **Raises:**

    - `ValueError` when called, if the run has no such element, or the element is not event-driven.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    run = jms.simulate(scene, [0.0], [0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 301))
    print(jms.metrics.mode_changes("friction")(run))
    ```

    ```text
    6
    ```
    """
    return Metric(f"mode changes of {element}", "1", _mode_changes, (element,))


def _mode_changes(run: Trajectory, element: str) -> Array:
    _check_modes(run, element, "mode_changes", "count crossings of your own choice in a function of the Trajectory")
    return jnp.sum(changes_of(run, element)[1])


def stick_share(element: str = "friction", *, since: float | None = None, rest: float | None = None) -> Metric:
    """Share of the time in which a friction element sticks, between 0 and 1.

    An event-driven element is measured by its event times. Any other element, or any with `rest`, is measured between
    the saved times `ts`: an interval counts as stick if the mean slip speed, by trapezoids, is at most `rest`. That
    share is a step function of the parameters.

    **Arguments:**

    - `element`: name of the friction element.
    - `since`: start of the measurement [s]; by default t0.
    - `rest`: largest slip speed [m/s or rad/s] that counts as stick, > 0. Required if the element is not event-driven.

    **Returns:**

    A `Metric` without a unit.

    **Raises:**

    - `ValueError` if `rest` is not positive; when called, if the run has no such element, or requires `rest`.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    run = jms.simulate(scene, [0.0], [0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 301))
    print(f"{jms.metrics.stick_share('friction', since=1.0)(run):.3f}")
    ```

    ```text
    0.600
    ```
    """
    if rest is not None and not rest > 0:
        raise ValueError(f"rest must be a positive speed, but {rest!r} was given.")
    return Metric(f"stick share of {element}", "1", _stick_share, (element, since, rest))


def _stick_share(run: Trajectory, element: str, since: float | None, rest: float | None) -> Array:
    begin = run.request.t0 if since is None else jnp.asarray(since, run.t.dtype)
    if rest is not None:
        t, v = slip_of(run, element)
        steps = jnp.diff(jnp.maximum(t, begin))
        steps = jnp.where(jnp.isfinite(t[1:]), steps, 0.0)
        rests = magnitude_of(0.5 * (v[1:] + v[:-1])) <= rest
        return jnp.sum(jnp.where(rests, steps, 0.0)) / jnp.sum(steps)
    _check_modes(run, element, "stick_share", "pass the largest slip speed of stick, as in stick_share(rest=1e-4)")
    events, own = changes_of(run, element)
    first, last = _modes_at_ends(run, element, events, own)
    t = jnp.where(own, jnp.maximum(events.t, begin), 0.0)
    leaving, entering = (jnp.sum(jnp.where(mode == 0, t, 0.0)) for mode in (events.before, events.after))
    stuck = leaving - entering + jnp.where(last == 0, run.t_end, 0.0) - jnp.where(first == 0, begin, 0.0)
    return stuck / (run.t_end - begin)


def motion_kind(*elements: str) -> Metric:
    """Kind of motion of friction elements in a run, as an integer that `describe` reads.

    - "never slips".
    - "sticks for good": sticks at the end after slip.
    - "stick-slip cycle": has entered stick twice or more. At the end of the run the last entry is at most 1.5 times as
      long ago as the time between the last two entries.
    - "slips back and forth": has reversed its slip twice or more, as recently, and does not stick.
    - "slips for good": anything else, with slip in one direction at the end.

    A run with fewer than three cycles is classified by its end.

    **Arguments:**

    - `elements`: names of event-driven friction elements; by default `friction`. The kinds of several elements are
      digits in base 5.

    **Returns:**

    A `Metric`, a whole number from 0 to `5**len(elements) - 1`.

    **Raises:**

    - `ValueError` for more than 10 elements or a repeated one; when called, if the run has no such element, or the
      element is not event-driven.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    run = jms.simulate(scene, [0.0], [0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 301))
    kind = jms.metrics.motion_kind("friction")
    print(kind.describe(kind(run)))
    ```

    ```text
    stick-slip cycle
    ```
    """
    elements = elements or ("friction",)
    if len(set(elements)) < len(elements):
        raise ValueError(f"motion_kind needs each element once, but {elements!r} were given.")
    if len(elements) > 10:
        raise ValueError(f"motion_kind classifies up to 10 elements, but {len(elements)} were given.")
    return Metric(f"motion of {', '.join(elements)}", "1", _kinds, elements, _read_kinds)


def _kinds(run: Trajectory, *elements: str) -> Array:
    code = jnp.zeros((), int)
    for i, name in enumerate(elements):
        _check_modes(run, name, "motion_kind", "classify by a function of your own, as in classes(fn, names)")
        code = code + len(_KINDS) ** i * _kind(run, name)
    return code


def _kind(run: Trajectory, element: str) -> Array:
    events, own = changes_of(run, element)
    first, last = _modes_at_ends(run, element, events, own)
    latest, gap, two = _last_two(events.t, own & (events.before * events.after < 0))
    swings = two & (run.t_end - latest <= ALIVE * gap)
    kind = jnp.where(last == 0, jnp.where((first == 0) & ~jnp.any(own), 0, 1), jnp.where(swings, 3, 4))
    return jnp.where(cycle_of(run, element)[1], 2, kind)


def _read_kinds(value: int, *elements: str) -> str:
    kinds = []
    for name in elements:
        value, kind = divmod(value, len(_KINDS))
        kinds.append(_KINDS[kind] if len(elements) == 1 else f"{name} {_KINDS[kind]}")
    return ", ".join(kinds)


def is_event_driven(run: Trajectory, name: str) -> bool:
    """Whether the friction element of this name is event-driven.

    **Raises:**

    - `ValueError` if the run has no such element.
    """
    _element_of(run, name)
    return name in run.scene.event_driven


def slip_of(run: Trajectory, name: str) -> tuple[Float[Array, " nodes"], Float[Array, "nodes ..."]]:
    """Times and slip velocities of a friction element, at t0 and at the saved times."""
    element, request = _element_of(run, name), run.request

    def slip(t: Array, q: Array, qd: Array) -> Array:
        return element.slip(t, q, qd, run.scene.bind_time(t).params)

    def joined(first: ArrayLike, rest: Array) -> Array:
        return jnp.concatenate([jnp.asarray(first, rest.dtype)[None], rest])

    t, q, qd = joined(request.t0, run.t), joined(request.q0, run.q), joined(request.qd0, run.qd)
    return t, jax.vmap(slip)(t, q, qd)


def magnitude_of(x: Float[Array, "time ..."]) -> Float[Array, " time"]:
    """Magnitude at each time: the norm of a series with several components."""
    return jnp.abs(x) if x.ndim == 1 else jax.vmap(safe_norm)(jnp.reshape(x, (x.shape[0], -1)))


def changes_of(run: Trajectory, name: str) -> tuple[Events, Array]:
    """Events of a run, and a mask of those that are mode changes of this element."""
    events = jax.tree.map(jnp.asarray, run.events)  # where an index may be traced
    return events, (events.effect == run.scene.names.index(name)) & jnp.isfinite(events.t)


def cycle_of(run: Trajectory, element: str) -> tuple[Array, Array]:
    """Time [s] between the last two events into stick of an element, and whether the cycle lasts until the end."""
    events, own = changes_of(run, element)
    last, gap, two = _last_two(events.t, own & (events.after == 0))
    return gap, two & (run.t_end - last <= ALIVE * gap)


def _element_of(run: Trajectory, name: str) -> Friction:
    elements = run.scene.friction
    if name not in elements:
        raise ValueError(f"The scene has no friction element {name!r}; there are: {', '.join(elements) or 'none'}.")
    return elements[name]


def _check_modes(run: Trajectory, name: str, metric: str, mend: str) -> None:
    if not is_event_driven(run, name):
        raise ValueError(
            f"{metric} needs the modes of {name!r}, but its law is not event-driven and has no modes: {mend}."
        )


def _modes_at_ends(run: Trajectory, name: str, events: Events, own: Array) -> tuple[Array, Array]:
    """Mode of an element at t0 and at the end of a run: 0 in stick, else the sign of its slip velocity."""
    constant = run.mode[name][-1].astype(int)
    if not own.shape[0]:
        return constant, constant
    first, last = jnp.argmax(own), own.shape[0] - 1 - jnp.argmax(own[::-1])
    changed = jnp.any(own)
    return jnp.where(changed, events.before[first], constant), jnp.where(changed, events.after[last], constant)


def _last_two(t: Float[Array | np.ndarray, " events"], these: Array) -> tuple[Array, Array, Array]:
    """Time [s] of the last of these events, time since the one before, and whether there are two.

    Times of missing events are zero, and so are their gradients.
    """
    order = jnp.cumsum(these)
    count = order[-1] if t.shape[0] else jnp.zeros((), int)
    last = jnp.sum(jnp.where(these & (order == count), t, 0.0))
    before = jnp.sum(jnp.where(these & (order == count - 1), t, 0.0))
    return last, last - before, count >= 2
