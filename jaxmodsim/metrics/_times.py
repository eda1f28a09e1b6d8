"""Metrics that are times: break-away and period."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..simulation import Trajectory, named_series
from ._metric import Metric
from ._motion import ALIVE, changes_of, cycle_of, is_event_driven, magnitude_of, slip_of


def break_away(element: str = "friction", *, distance: float | None = None) -> Metric:
    """Time [s] at which a friction element breaks away; NaN if it never does.

    For an event-driven element this is the first event that leaves stick. Other laws creep from the start: for these it
    is the time at which the slip since t0 first exceeds `distance`. Slip is the integral of the slip velocity by
    trapezoids between the saved times `ts`, with an error of the order of their spacing squared. With `distance`,
    event-driven elements are measured in the same way. Their slip has a corner between two samples, which leaves
    derivatives with a relative error of up to the spacing over the time since the corner.

    **Arguments:**

    - `element`: name of the friction element.
    - `distance`: slip [m or rad] that counts as break-away, > 0. It must be well above the largest deflection of a
      bristle, `Fs/sigma0`. Required if the element is not event-driven.

    **Returns:**

    A `Metric` in s.

    **Raises:**

    - `ValueError` if `distance` is not positive; when called, if the run has no such element, or requires `distance`.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    run = jms.simulate(scene, [0.0], [0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 301))
    print(f"{jms.metrics.break_away('friction')(run):.4f} s")
    ```

    ```text
    0.8100 s
    ```
    """
    if distance is not None and not (math.isfinite(distance) and distance > 0):
        raise ValueError(f"distance must be a positive number of metres or radians, but {distance!r} was given.")
    return Metric(f"break-away of {element}", "s", _break_away, (element, distance))


def _break_away(run: Trajectory, element: str, distance: float | None) -> Array:
    if distance is not None:
        return _slipped(run, element, distance)
    if not is_event_driven(run, element):
        raise ValueError(
            f"The law of {element!r} is not event-driven and creeps from the start: pass the slip that counts as"
            " break-away, as in break_away(distance=1e-3)."
        )
    events, own = changes_of(run, element)
    leaves = own & (events.before == 0)
    t = jnp.sum(jnp.where(leaves & (jnp.cumsum(leaves) == 1), events.t, 0.0))
    return jnp.where(jnp.any(leaves), t, jnp.nan)


def _slipped(run: Trajectory, element: str, distance: float) -> Array:
    """First time at which the slip since t0 exceeds a distance, by a parabola between two samples."""
    t, v = slip_of(run, element)
    steps = jnp.where(jnp.isfinite(t[1:]), jnp.diff(t), 0.0)
    pieces = 0.5 * jnp.expand_dims(steps, range(1, v.ndim)) * (v[1:] + v[:-1])
    slip = jnp.concatenate([jnp.zeros_like(v[:1]), jnp.cumsum(jnp.where(jnp.isfinite(pieces), pieces, 0.0), axis=0)])
    x = magnitude_of(slip)
    crosses = (x[:-1] < distance) & (x[1:] >= distance) & (steps > 0)
    happens, k = jnp.any(crosses), jnp.argmax(crosses)
    dot = jnp.sum(jnp.reshape(slip[k] * v[k], -1))
    pace = jnp.where(x[k] > 0, dot / jnp.where(x[k] > 0, x[k], 1.0), magnitude_of(v[k][None])[0])
    step, left, rise = (jnp.where(happens, y, 1.0) for y in (steps[k], distance - x[k], x[k + 1] - x[k]))
    pace = jnp.where(happens, pace, 1.0)
    # left = pace tau + bend tau^2/2, which is rise at the end of the step.
    bend = 2.0 * (rise - pace * step) / step**2
    tau = 2.0 * left / (pace + jnp.sqrt(pace**2 + 2.0 * bend * left))
    return jnp.where(happens, t[k] + tau, jnp.nan)


def _crossings(t: Float[Array, " n"], x: Float[Array, " n"]) -> tuple[Array, Array]:
    """Time of an upward zero crossing in each interval between samples, by linear interpolation, and a mask of them."""
    crosses = (x[:-1] < 0) & (x[1:] >= 0) & jnp.isfinite(t[1:])
    rise = jnp.where(crosses, x[1:] - x[:-1], 1.0)
    step, before = (jnp.where(crosses, each, 0.0) for each in (t[1:] - t[:-1], x[:-1]))
    return jnp.where(crosses, t[:-1], 0.0) - before / rise * step, crosses


def period(of: str = "friction", *, since: float | None = None, swing: float = 1e-3) -> Metric:
    """Period [s] of a limit cycle; NaN without a cycle.

    For an event-driven friction element it is the time between its last two events into stick. For a coordinate,
    velocity or force it is the mean time between upward crossings of the mean, interpolated between the saved times
    `ts`. If return times vary, the result is the last of them for events and their mean for crossings. A cycle that has
    not returned in the last 1.5 periods of the run counts as ended, which gives NaN.

    **Arguments:**

    - `of`: name of a friction element, or `q[0]`, `qd[0]`.
    - `since`: first time [s] that counts; by default the middle of the run, to skip the transient. Unused for events.
    - `swing`: smallest range since then, as a fraction of the range in the whole run, that counts as a cycle, 0 to 1.
      Unused for events.

    **Returns:**

    A `Metric` in s.

    **Raises:**

    - `ValueError` if `swing` is not between 0 and 1; when called, for an unknown name.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    run = jms.simulate(scene, [0.0], [0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 301))
    print(f"{jms.metrics.period('friction')(run):.4f} s")
    ```

    ```text
    0.9785 s
    ```
    """
    if not 0 <= swing < 1:
        raise ValueError(f"swing must be a fraction, 0 <= swing < 1, but {swing!r} was given.")
    return Metric(f"period of {of}", "s", _period, (of, since, swing))


def _period(run: Trajectory, of: str, since: float | None, swing: float) -> Array:
    if of in run.scene.event_driven:
        gap, alive = cycle_of(run, of)
        return jnp.where(alive, gap, jnp.nan)
    x = named_series(run, of)
    begin = 0.5 * (run.request.t0 + run.t_end) if since is None else since
    counts = jnp.isfinite(run.t) & (run.t >= begin)
    x = jnp.where(jnp.isfinite(run.t), x, 0.0)
    mean = jnp.sum(jnp.where(counts, x, 0.0)) / jnp.maximum(jnp.sum(counts), 1)
    times, crosses = _crossings(run.t, x - mean)
    crosses = crosses & counts[:-1]
    count = jnp.sum(crosses)
    latest = jnp.max(jnp.where(crosses, times, -jnp.inf), initial=-jnp.inf)
    earliest = jnp.min(jnp.where(crosses, times, jnp.inf), initial=jnp.inf)
    several = count >= 2
    mean_gap = jnp.where(several, latest - earliest, 0.0) / jnp.maximum(count - 1, 1)
    swings = _swing(x, counts) > swing * _swing(x, jnp.isfinite(run.t))
    alive = several & swings & (run.t_end - latest <= ALIVE * mean_gap)
    return jnp.where(alive, mean_gap, jnp.nan)


def _swing(x: Float[Array, " n"], these: Array) -> Array:
    return jnp.max(jnp.where(these, x, -jnp.inf)) - jnp.min(jnp.where(these, x, jnp.inf))
