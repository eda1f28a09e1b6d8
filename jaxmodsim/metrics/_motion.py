"""How friction elements move: how often they change, how long they stick, and in which order."""

import jax.numpy as jnp
from jaxtyping import Array

from ..simulation import Trajectory
from ._metric import Metric
from ._names import changes_of, last_two, magnitude_of, modes_at_ends, needs_modes, slip_of
from ._times import cycle_of

# Largest integers that float32 and float64 hold exactly.
_SINGLE, _DOUBLE = 2**24, 2**53
# Half cycles since the last reversal after which they have ended.
_ALIVE = 1.5
# Modes from -1 on, and what `motion_kind` tells apart.
_MODES = ("slip-", "stick", "slip+")
_KINDS = ("never slips", "sticks for good", "stick-slip cycle", "slips back and forth", "slips for good")
# The code of a sequence that is too long.
_LONGER = -1
_MEND = "tell motions apart by a function of your own, as in classes(fn, names)"


def mode_changes(element: str = "friction") -> Metric:
    """Number of mode changes of a friction element that runs by events.

    ```python
    metrics.mode_changes("friction")(run)
    ```

    **Arguments:**

    - `element`: name of the friction element.

    **Raises:**

    - `ValueError` when called, if the run has no such element, or its law does not run by events.
    """
    return Metric(f"mode changes of {element}", "1", _mode_changes, (element,))


def _mode_changes(run: Trajectory, element: str) -> Array:
    needs_modes(run, element, "mode_changes", "count crossings of your own choice in a function of the Trajectory")
    return jnp.sum(changes_of(run, element)[1])


def stick_share(element: str = "friction", *, since: float | None = None, rest: float | None = None) -> Metric:
    """Part of the time that a friction element sticks, between 0 and 1.

    Of a law that runs by events from the times of these. Of other laws, or with `rest`, the part of the time between
    saved times `ts` in which the mean slip speed, by trapezoids, is at most `rest`: a step function of all numbers.

    ```python
    metrics.stick_share("friction", since=10.0)(run), metrics.stick_share("friction", rest=1e-4)(run)
    ```

    **Arguments:**

    - `element`: name of the friction element.
    - `since`: time [s] from which on; by default t0.
    - `rest`: slip speed [m/s or rad/s] up to which it counts as rest, > 0. To be given for laws that do not run by
      events.

    **Raises:**

    - `ValueError` if `rest` is not positive; when called, if the run has no such element, or needs `rest`.
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
    needs_modes(run, element, "stick_share", "say which slip speed counts as rest, as in stick_share(rest=1e-4)")
    events, own = changes_of(run, element)
    first, last = modes_at_ends(run, element, events, own)
    t = jnp.where(own, jnp.maximum(events.t, begin), 0.0)
    leaving, entering = (jnp.sum(jnp.where(mode == 0, t, 0.0)) for mode in (events.before, events.after))
    stuck = leaving - entering + jnp.where(last == 0, run.t_end, 0.0) - jnp.where(first == 0, begin, 0.0)
    return stuck / (run.t_end - begin)


def mode_sequence(*elements: str, most: int | None = None) -> Metric:
    """An integer for the modes at t0 and the changes that follow; `words` reads it back.

    `mode_sequence("friction").describe(value)` is "stick > slip+ > stick"; of several elements "a stick, b slip+ > a
    slip-". With E elements, a change is a digit `1 + 3 e + 1 + mode`, and the value `start + 3^E sum of digit_i
    (3 E + 1)^i`, `start` from the modes at t0 in base 3. All runs with more than `most` changes have the value -1; for
    what becomes of them see `motion_kind`.

    **Arguments:**

    - `elements`: names of friction elements that run by events; by default `friction`.
    - `most`: number of changes that are told apart, > 0; by default as many as float32 holds exactly, which are 11
      for one element and 7 for two. In float64 25 and 17 are possible.

    **Raises:**

    - `ValueError` if `most` does not fit; when called, if the run has no such element, its law does not run by
      events, or the run is in float32 and holds no such integers.
    """
    elements = elements or ("friction",)
    _distinct(elements)
    if most is None:
        most = _fitting(len(elements), _SINGLE)
    fits = _fitting(len(elements), _DOUBLE)
    if isinstance(most, bool) or not isinstance(most, int) or not 0 < most <= fits:
        raise ValueError(
            f"most must be a number of changes from 1 to {fits}, which is what float64 holds exactly for"
            f" {len(elements)} elements, but {most!r} was given."
        )
    return Metric(f"mode sequence of {', '.join(elements)}", "1", _sequence, (elements, most), _read_sequence)


def _distinct(elements: tuple[str, ...]) -> None:
    if len(set(elements)) < len(elements):
        raise ValueError(f"Each element counts once, but {elements!r} were given.")


def _fitting(count: int, limit: int) -> int:
    """Number of changes of so many elements that integers below `limit` tell apart."""
    most = 0
    while 3**count * (3 * count + 1) ** (most + 1) <= limit:
        most += 1
    return most


def _sequence(run: Trajectory, elements: tuple[str, ...], most: int) -> Array:
    wide = run.t.dtype == jnp.float64
    if not wide and most > (fits := _fitting(len(elements), _SINGLE)):
        raise ValueError(f"A run in {run.t.dtype} holds no more than {fits} changes exactly: pass most={fits}.")
    start, digits = jnp.zeros((), int), 0
    for i, name in enumerate(elements):
        needs_modes(
            run, name, "mode_sequence", "tell motions apart by a function of your own, as in classes(fn, names)"
        )
        events, own = changes_of(run, name)
        start = start + 3**i * (modes_at_ends(run, name, events, own)[0] + 1)
        digits = digits + jnp.where(own, 1 + 3 * i + 1 + events.after, 0)
    digits = jnp.asarray(digits)
    counts = digits > 0
    place = jnp.cumsum(counts) - 1
    weights = jnp.asarray([(3 * len(elements) + 1) ** i for i in range(most)], int)
    fits = counts & (place < most)
    total = jnp.sum(jnp.where(fits, digits * weights[jnp.clip(place, 0, most - 1)], 0))
    return jnp.where(jnp.sum(counts) > most, _LONGER, start + 3 ** len(elements) * total)


def _read_sequence(value: int, elements: tuple[str, ...], most: int) -> str:
    if value < 0:
        return f"more than {most} changes"
    rest, words = value, []
    for _ in elements:
        rest, mode = divmod(rest, 3)
        words.append(_MODES[mode])
    alone = len(elements) == 1
    steps = [words[0] if alone else ", ".join(f"{n} {w}" for n, w in zip(elements, words, strict=True))]
    while rest:
        rest, digit = divmod(rest, 3 * len(elements) + 1)
        which, mode = divmod(digit - 1, 3)
        steps.append(_MODES[mode] if alone else f"{elements[which]} {_MODES[mode]}")
    return " > ".join(steps)


def motion_kind(*elements: str) -> Metric:
    """What becomes of friction elements in a run, as an integer; `words` reads it back.

    - "never slips".
    - "sticks for good": is in stick at the end, after it has slipped.
    - "stick-slip cycle": has come into stick twice or more, and lately: not longer ago at the end than 1.5 times the
      time between the last two.
    - "slips back and forth": has changed the direction of its slip twice or more, and lately, and does not stick.
    - "slips for good": anything else, slip in one direction at the end.

    A run that holds fewer than three cycles is judged by how it ends.

    ```python
    kind = metrics.motion_kind("friction")
    kind.describe(kind(run))
    ```

    **Arguments:**

    - `elements`: names of friction elements that run by events; by default `friction`. Kinds of several are digits in
      base 5.

    **Raises:**

    - `ValueError` if there are more than 10 elements; when called, if the run has no such element, or its law does not
      run by events.
    """
    elements = elements or ("friction",)
    _distinct(elements)
    if len(elements) > 10:
        raise ValueError(f"motion_kind tells apart what up to 10 elements do, but {len(elements)} were given.")
    return Metric(f"motion of {', '.join(elements)}", "1", _kind, elements, _read_kind)


def _kind(run: Trajectory, *elements: str) -> Array:
    code = jnp.zeros((), int)
    for i, name in enumerate(elements):
        needs_modes(run, name, "motion_kind", _MEND)
        code = code + len(_KINDS) ** i * _kind_of(run, name)
    return code


def _kind_of(run: Trajectory, element: str) -> Array:
    events, own = changes_of(run, element)
    first, last = modes_at_ends(run, element, events, own)
    latest, gap, two = last_two(events.t, own & (events.before * events.after < 0))
    swings = two & (run.t_end - latest <= _ALIVE * gap)
    kind = jnp.where(last == 0, jnp.where((first == 0) & ~jnp.any(own), 0, 1), jnp.where(swings, 3, 4))
    return jnp.where(cycle_of(run, element)[1], 2, kind)


def _read_kind(value: int, *elements: str) -> str:
    words = []
    for name in elements:
        value, kind = divmod(value, len(_KINDS))
        words.append(_KINDS[kind] if len(elements) == 1 else f"{name} {_KINDS[kind]}")
    return ", ".join(words)
