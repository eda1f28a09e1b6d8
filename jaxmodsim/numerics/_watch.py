"""Where functions of time that are known at four points of a step fall through zero."""

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Refinements of a root. It only says where the next attempt of a step shall end.
_REFINEMENTS = 4
# A root this close to the start of a step, in steps, is at the start.
_ZERO = 1e-3

Numbers = Float[Array, " n"]
Flags = Bool[Array, " n"]


class Watch(NamedTuple):
    """What four values of a function in a step say about it, elementwise.

    - `armed`: whether it counts as positive at some time of the step.
    - `crosses`: whether it falls through zero after it was positive or armed.
    - `root`: where it does so first, as a fraction of the step, roughly; 1 where it does not.
    - `ahead`: how far behind the end it would do so if it went on straight, or how far before the end it would have
      done so (negative), in steps; infinite where it does not fall.
    - `room`: by which factor the step may grow before the four values say too little; below 1 they already do.
    - `cubic`: the coefficients of the cubic through the values.
    """

    armed: Flags
    crosses: Flags
    root: Numbers
    ahead: Numbers
    room: Numbers
    cubic: tuple[Numbers, Numbers, Numbers, Numbers]


def watch(values: tuple[Numbers, Numbers, Numbers, Numbers], armed: Flags) -> Watch:
    """First fall through zero of functions known at 0, 1/3, 2/3 and 1 of a step.

    Between the points each is the cubic through them, whose own minimum counts as a fifth point. If it is not armed, it
    must be seen positive, or rise from zero at the start, before it can fall. The third difference of the four values,
    the cubic's share in them, is held below 0.3 of their range and 10 times the height of the minimum: more could hide
    a crossing.

    **Arguments:**

    - `values`: at the four points, shape `[n]` each.
    - `armed`: whether a function counts as positive at the start, whatever its value there. If it is armed, not
      positive and does not rise, it falls at once.

    **Returns:**

    A `Watch`.
    """
    g0, g1, g2, g3 = values
    c1 = -5.5 * g0 + 9.0 * g1 - 4.5 * g2 + g3
    c2 = 9.0 * g0 - 22.5 * g1 + 18.0 * g2 - 4.5 * g3
    third = g3 - 3.0 * g2 + 3.0 * g1 - g0
    c3 = 4.5 * third

    # The minimum of a cubic, in the form of the quadratic formula that stays exact as c3 goes to zero.
    discriminant = c2 * c2 - 3.0 * c1 * c3
    denominator = c2 + jnp.sqrt(jnp.where(discriminant > 0, discriminant, 1.0))
    inside = (discriminant > 0) & (denominator > 0) & (c1 < 0) & (-c1 < denominator)
    lowest = -c1 / jnp.where(inside, denominator, 1.0)
    bottom = jnp.where(inside, g0 + lowest * (c1 + lowest * (c2 + lowest * c3)), g3)

    # Points in the order of time, the minimum among them; the first one below zero closes the bracket.
    rises = (c1 > 0) & (g0 >= -_ZERO * c1)
    high1 = armed | rises
    high2, high3 = high1 | (g1 > 0), high1 | (g1 > 0) | (g2 > 0)
    dips = inside & (bottom < 0) & jnp.where(lowest < 1 / 3, high1, jnp.where(lowest < 2 / 3, high2, high3))
    end, low = jnp.ones_like(g0), g3
    crosses = jnp.zeros_like(armed)
    for point, value, below in (
        (1.0, g3, high3 & (g3 < 0)),
        (lowest, bottom, dips),
        (2 / 3, g2, high2 & (g2 < 0)),
        (lowest, bottom, dips & (lowest < 2 / 3)),
        (1 / 3, g1, high1 & (g1 < 0)),
        (lowest, bottom, dips & (lowest < 1 / 3)),
    ):
        end, low, crosses = jnp.where(below, point, end), jnp.where(below, value, low), crosses | below
    start, high = jnp.zeros_like(g0), g0
    for point, value in ((1 / 3, g1), (2 / 3, g2)):
        later = (point < end) & (value > 0)
        start, high = jnp.where(later, point, start), jnp.where(later, value, high)
    # Not left of the middle: a function that rises from zero at the start has a root there that is not meant.
    secant = start + (end - start) * jnp.clip(high / jnp.where(high > low, high - low, 1.0), 0.5, 1.0)
    at_once = armed & (g0 <= 0) & (g1 < 0) & (c1 <= 0)
    root = jnp.where(crosses, jnp.where(at_once, 0.0, secant), 1.0)

    falls = c1 + 2.0 * c2 + 3.0 * c3
    ahead = jnp.where(falls < 0, -g3 / jnp.where(falls < 0, falls, 1.0), jnp.inf)
    high = reduce(jnp.maximum, values)
    low = reduce(jnp.minimum, values)
    noise = 1e3 * float(jnp.finfo(third.dtype).eps) * jnp.maximum(jnp.abs(high), jnp.abs(low))
    allowed = 0.3 * (high - low)
    allowed = jnp.where(inside & (bottom > 0), jnp.minimum(allowed, 10.0 * bottom), allowed) + noise
    size = jnp.abs(third)
    room = jnp.where(size > 1e-3 * allowed, jnp.cbrt(allowed / jnp.where(size > 0, size, 1.0)), 10.0)
    return Watch(high3 | (g3 > 0), crosses, root, ahead, room, (g0, c1, c2, c3))


def first_root(watched: Watch, passed: Flags) -> Float[Array, ""]:
    """The earliest root in a step among the functions that `passed` marks; 1 if it marks none.

    Which function is the first is judged by the rough roots; its own is then refined by Newton's iteration.
    """
    rough = jnp.where(passed, watched.root, 1.0)
    first = jnp.min(rough)
    only = jnp.arange(rough.shape[0]) == jnp.argmin(rough)  # one, also where several are equal
    c0, c1, c2, c3 = (jnp.max(jnp.where(only, c, -jnp.inf)) for c in watched.cubic)
    root = first
    for _ in range(_REFINEMENTS):
        slope = c1 + root * (2.0 * c2 + root * 3.0 * c3)
        root = root - (c0 + root * (c1 + root * (c2 + root * c3))) / jnp.where(slope < 0, slope, -jnp.inf)
        root = jnp.clip(root, 0.0, 1.0)
    return jnp.where((first > 0) & (first < 1), root, first)
