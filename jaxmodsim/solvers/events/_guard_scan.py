"""Roots of functions of time that are known at five points of a step, and the resolution of these roots."""

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..._core.arrays import fusion_barrier

# Newton iterations for a root, which is only the end of the next attempt.
_REFINEMENTS = 4
# A root this close to the start of a step, in steps, is at the start.
_ZERO = 1e-3
# Largest error of the cubic through the values at 0, 1/3, 2/3, 1 over its error at 1/2: s (s - 1/3) (s - 2/3) (s - 1)
# is 1/81 at most, and 1/144 there.
_LARGEST = 144 / 81
# A step is resolved if the third difference is below these parts of the range of the values and of the headroom ...
_CUBIC_OF_RANGE, _CUBIC_OF_HEADROOM = 0.3, 3.0
# ... and the error of the cubic below these.
_ERROR_OF_RANGE, _ERROR_OF_HEADROOM = 0.05, 0.3
# Rounding units in the values.
_ROUNDING = 1e3
# Where a step ends on a root the error of the cubic is below this many of the tolerances.
_ERROR_AT_ROOT = 10.0
# An instant in resolutions of time, the larger of: so many, and this part of the inverse root of the rounding unit.
_INSTANT, _INSTANT_OF_ROOT = 16.0, 1.5e-5

Numbers = Float[Array, " n"]
Flags = Bool[Array, " n"]


class GuardScan(NamedTuple):
    """Properties of functions, elementwise, from five values of each in a step.

    - `armed`: whether the function counts as positive at some time of the step.
    - `crosses`: whether it falls through zero after it was positive or armed.
    - `root`: estimate of its first fall, as a fraction of the step; 1 without one.
    - `ahead`: distance in steps from the end to the root of its tangent there, negative before the end; infinite if the
      function does not fall.
    - `step_factor`: the factor by which the length of the step may change before it no longer resolves the function.
    - `landing_factor`: the same for a step that ends on a root of the function.
    - `cubic`: the coefficients of the cubic through the values.
    """

    armed: Flags
    crosses: Flags
    root: Numbers
    ahead: Numbers
    step_factor: Numbers
    landing_factor: Numbers
    cubic: tuple[Numbers, Numbers, Numbers, Numbers]

    def slopes(self, place: Array) -> tuple[Numbers, Numbers]:
        """First and second derivative of the cubic at a fraction `place` of the step, in steps."""
        _, c1, c2, c3 = self.cubic
        return c1 + place * (2.0 * c2 + place * 3.0 * c3), 2.0 * c2 + place * 6.0 * c3


def scan_guards(
    values: tuple[Numbers, Numbers, Numbers, Numbers],
    middle: Numbers,
    armed: Flags,
    violated: Flags,
    tolerances: tuple[Float[Array, ""], Numbers],
    blur: Float[Array, ""],
    unit: Float[Array, ""],
) -> GuardScan:
    """First fall through zero of functions known at 0, 1/3, 1/2, 2/3 and 1 of a step.

    Between the points a function is the cubic through its first, second, fourth and fifth value. The minimum of the
    cubic counts as another point, unless the error of the cubic may have made it. A function that is not armed must be
    positive at a point, or rise from zero at the start, before it can fall.

    The value in the middle gives the error of the cubic. A step is resolved if third difference and error are small
    against the range of the values, so that no oscillation looks like a slow change, and against the headroom: the
    least distance from zero inside the step.

    **Arguments:**

    - `values`: at 0, 1/3, 2/3 and 1, shape `[n]` each.
    - `middle`: at 1/2, shape `[n]`.
    - `armed`: whether a function counts as positive at the start, whatever its value there. If it is armed, not
      positive and does not rise, it falls at once.
    - `violated`: whether an event at the start has made a function negative, so that it falls at once if it rises, too.
    - `tolerances`: depth of a fall that may be missed, relative to the largest magnitude in the step, and absolute.
    - `blur`: rounding error of the points, as a fraction of the step.
    - `unit`: an `opaque_one`.

    **Returns:**

    A `GuardScan`.
    """
    g0, g1, g2, g3 = values
    c1 = -5.5 * g0 + 9.0 * g1 - 4.5 * g2 + g3
    c2 = 9.0 * g0 - 22.5 * g1 + 18.0 * g2 - 4.5 * g3
    third = g3 - 3.0 * g2 + 3.0 * g1 - g0
    c1, c2, third = fusion_barrier((c1, c2, third), unit)
    c3 = 4.5 * third
    everything = (*values, middle)
    high, low = reduce(jnp.maximum, everything), reduce(jnp.minimum, everything)
    spread = high - low
    rtol, atol = tolerances
    rtol = jnp.maximum(rtol, _ROUNDING * float(jnp.finfo(third.dtype).eps))
    tolerance = rtol * jnp.maximum(jnp.abs(high), jnp.abs(low)) + atol + blur * spread

    # The minimum of a cubic, by the form of the quadratic formula that is accurate for small c3.
    discriminant = c2 * c2 - 3.0 * c1 * c3
    denominator = c2 + jnp.sqrt(jnp.where(discriminant > 0, discriminant, 1.0))
    inside = (discriminant > 0) & (denominator > 0) & (c1 < 0) & (-c1 < denominator)
    lowest = -c1 / jnp.where(inside, denominator, 1.0)
    bottom = jnp.where(inside, g0 + lowest * (c1 + lowest * (c2 + lowest * c3)), g3)

    error = _LARGEST * jnp.abs(middle - (g0 + 0.5 * (c1 + 0.5 * (c2 + 0.5 * c3))))

    # Points from the last to the first, the minimum among them: the first one below zero closes the bracket.
    rises = (c1 > 0) & (g0 >= -_ZERO * c1)
    high1 = armed | rises
    high_middle = high1 | (g1 > 0)
    high2 = high_middle | (middle > 0)
    high3 = high2 | (g2 > 0)
    high_lowest = jnp.where(lowest < 1 / 2, high_middle, jnp.where(lowest < 2 / 3, high2, high3))
    high_lowest = jnp.where(lowest < 1 / 3, high1, high_lowest)
    dips = inside & (bottom < -jnp.minimum(error, tolerance)) & high_lowest
    end, low = jnp.ones_like(g0), g3
    crosses = jnp.zeros_like(armed)
    for point, value, below in (
        (1.0, g3, high3 & (g3 < 0)),
        (lowest, bottom, dips),
        (2 / 3, g2, high2 & (g2 < 0)),
        (lowest, bottom, dips & (lowest < 2 / 3)),
        (1 / 2, middle, high_middle & (middle < 0)),
        (lowest, bottom, dips & (lowest < 1 / 2)),
        (1 / 3, g1, high1 & (g1 < 0)),
        (lowest, bottom, dips & (lowest < 1 / 3)),
    ):
        end, low, crosses = jnp.where(below, point, end), jnp.where(below, value, low), crosses | below
    start, high = jnp.zeros_like(g0), g0
    for point, value in ((1 / 3, g1), (1 / 2, middle), (2 / 3, g2)):
        later = (point < end) & (value > 0)
        start, high = jnp.where(later, point, start), jnp.where(later, value, high)
    # Not left of the middle of the bracket: a function that rises from zero has a root at the start, which is no fall.
    secant = start + (end - start) * jnp.clip(high / jnp.where(high > low, high - low, 1.0), 0.5, 1.0)
    at_once = (violated & (g0 < -tolerance)) | (armed & (g0 <= 0) & (g1 < 0) & (c1 <= 0))
    root = fusion_barrier(jnp.where(at_once, 0.0, jnp.where(crosses, secant, 1.0)), unit)
    crosses = root < 1.0

    falls = c1 + 2.0 * c2 + 3.0 * c3
    ahead = jnp.where(falls < 0, -g3 / jnp.where(falls < 0, falls, 1.0), jnp.inf)
    headroom = reduce(jnp.minimum, (jnp.abs(g1), jnp.abs(middle), jnp.abs(g2)))
    headroom = jnp.where(inside & (bottom > 0), jnp.minimum(headroom, bottom), headroom)
    step_factor, landing_factor = _step_factors(jnp.abs(third), error, spread, headroom, tolerance)
    high, cubic = high3 | (g3 > 0), (g0, c1, c2, c3)
    return GuardScan(high, crosses, root, ahead, step_factor, landing_factor, cubic)


def _step_factors(
    third: Numbers, error: Numbers, spread: Numbers, headroom: Numbers, tolerance: Numbers
) -> tuple[Numbers, Numbers]:
    """Admissible factors of the length of the step: in general, and for a step that ends on a root.

    The third difference scales with the third power of the step, the error of the cubic with the fourth.
    """
    cubic = jnp.minimum(_CUBIC_OF_RANGE * spread, _CUBIC_OF_HEADROOM * headroom) + tolerance
    quartic = jnp.minimum(_ERROR_OF_RANGE * spread, _ERROR_OF_HEADROOM * headroom) + tolerance
    landing = jnp.sqrt(jnp.sqrt(_ratio(_ERROR_AT_ROOT * tolerance, error)))
    return jnp.minimum(jnp.cbrt(_ratio(cubic, third)), jnp.sqrt(jnp.sqrt(_ratio(quartic, error)))), landing


def _ratio(allowed: Numbers, size: Numbers) -> Numbers:
    return jnp.where(size > 0, allowed / jnp.where(size > 0, size, 1.0), jnp.inf)


def first_root(scan: GuardScan, passed: Flags) -> Float[Array, ""]:
    """The earliest root in a step among the functions that `passed` marks; 1 if it marks none.

    The estimates of the roots decide which function is the first; Newton's iteration refines its root. A refined root
    near the start counts only if the step resolves the function: one that is zero up to a kink has its root there, but
    its cubic has one at the start.
    """
    rough = jnp.where(passed, scan.root, 1.0)
    first = jnp.min(rough)
    only = jnp.arange(rough.shape[0]) == jnp.argmin(rough)  # one, also where several are equal
    c0, c1, c2, c3, factor = (jnp.max(jnp.where(only, c, -jnp.inf)) for c in (*scan.cubic, scan.landing_factor))
    root = first
    for _ in range(_REFINEMENTS):
        slope = c1 + root * (2.0 * c2 + root * 3.0 * c3)
        root = root - (c0 + root * (c1 + root * (c2 + root * c3))) / jnp.where(slope < 0, slope, -jnp.inf)
        root = jnp.clip(root, 0.0, 1.0)
    trusted = (root > 0.5 * first) | (factor > jnp.where(c1 > 0, first, 1.0))
    return jnp.where((first > 0) & (first < 1) & trusted, root, first)


def instant(resolution: Array) -> Array:
    """How long before an event a saved time counts as that of the event.

    **Arguments:**

    - `resolution`: that of time, in seconds or in steps, any shape.

    **Returns:**

    The interval, in the unit and the shape of `resolution`.
    """
    return max(_INSTANT, _INSTANT_OF_ROOT / float(jnp.finfo(resolution.dtype).eps) ** 0.5) * resolution


def arrives(seen: GuardScan, end: Array, root: Array, resolution: Array) -> Flags:
    """Which guards fall from above and reach their events within an `instant`, though they are not yet at zero.

    `resolution` is that of time, in steps.
    """
    c0, c1, c2, c3 = seen.cubic
    falls, middle = seen.slopes(jnp.ones(()))[0], c0 + 0.5 * (c1 + 0.5 * (c2 + 0.5 * c3))
    comes = (end > 0) & (root > 0) & (middle > 2.0 * root) & (falls < 0)
    return seen.armed & comes & (end - root <= -instant(resolution) * falls)
