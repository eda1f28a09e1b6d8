"""Signals of a record: smoothed, differentiated, their noise and outliers, gaps in time, and the offset of a clock."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import convolve1d, median_filter

from ._record import Record

# First samples of a record, from which position and velocity are estimated.
_SAMPLES = 20
# Neighbours of a sample. An outlier is this many times as far from their median as nearly all other samples, and as the
# usual step from sample to sample.
_NEIGHBOURS, _STANDS_OUT, _NEARLY_ALL = 5, 10.0, 0.95
# Tolerance of values on a grid, as a share of its step. Keeps divisions finite.
_ON_A_GRID, _TINY = 1e-3, 1e-300
# Smoothing: one sample to either side for so many of the record, and at least so many.
_SAMPLES_A_SIDE, _LEAST_SPAN = 1000, 3
# Orders of the differences that show noise; number of parts of a record, and samples in a part at least.
_ORDERS, _PARTS, _LEAST_PART = (2, 3, 4, 5, 6), 32, 32
# An interval of so many medians is a gap, unless more than this share of all intervals are as long.
_GAP, _FEW = 5.0, 0.01
# Samples slower than this share of the top speed are left out.
MOVING = 0.05
# Largest offset, as a share of the record, and in samples.
_FURTHEST_SHARE, _FURTHEST = 0.1, 500
# Tolerance of an offset, in intervals of the samples.
_REFINED = 1e-8
# Least number of moving samples for four regressors.
_LEAST_MOVING = 100


class SmoothedMotion(NamedTuple):
    """A smoothed motion, shape `[samples]` each, and the samples inside, without ends that smoothing distorts."""

    x: Float[np.ndarray, " samples"]
    v: Float[np.ndarray, " samples"]
    a: Float[np.ndarray, " samples"]
    inside: slice


def smooth(x: Float[np.ndarray, " samples"], span: int) -> Float[np.ndarray, " samples"]:
    """Weighted mean over `span` samples to either side."""
    kernel = np.hanning(2 * span + 3)[1:-1]
    return convolve1d(x, kernel / kernel.sum(), mode="nearest")


def smooth_span(samples: int) -> int:
    """Samples to either side in the smoothing of a record."""
    return max(samples // _SAMPLES_A_SIDE, _LEAST_SPAN)


def outliers(x: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    """Samples that differ from their neighbours on both sides, as from a sensor that drops out."""
    deviation, steps = np.abs(x - median_filter(x, _NEIGHBOURS, mode="nearest")), np.abs(np.diff(x))
    step = float(np.median(steps[steps > 0])) if steps.any() else 0.0
    usual = max(float(np.quantile(deviation, _NEARLY_ALL)), step)
    return deviation > _STANDS_OUT * usual


def without_outliers(x: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """The samples with outliers replaced by the median of their neighbours."""
    bad = outliers(x)
    return np.where(bad, median_filter(x, _NEIGHBOURS, mode="nearest"), x) if bad.any() else x


def sample_noise(x: Float[np.ndarray, " samples"]) -> float:
    """Standard deviation of uncorrelated noise; at least that of rounding.

    From differences of the order that leaves least of the motion. The median over parts of the record is robust to
    impacts and outliers. Steps of a sensor of resolution r have a standard deviation of r/sqrt(12).
    """
    levels = [np.inf]
    for order in _ORDERS:
        squares = np.diff(x, order) ** 2 / math.comb(2 * order, order)
        parts = np.array_split(squares, max(min(squares.size // _LEAST_PART, _PARTS), 1))
        levels.append(float(np.sqrt(np.median([np.mean(part) for part in parts]))) if squares.size else np.inf)
    rounding = float(np.finfo(float).eps * np.max(np.abs(x)))
    seen = min(levels) if np.isfinite(min(levels)) else 0.0
    return max(seen, resolution(x) / 12.0**0.5, rounding, _TINY)


def differentiate(t: Float[np.ndarray, " samples"], x: Float[np.ndarray, " samples"]) -> SmoothedMotion:
    """Velocity and acceleration of a position, smoothed before either differentiation."""
    span = smooth_span(len(t))
    position, edge = smooth(x, span), 3 * span
    v = smooth(np.gradient(position, t), span)
    inside = slice(edge, -edge) if len(t) > 4 * edge else slice(None)
    return SmoothedMotion(position, v, np.gradient(v, t), inside)


def start_state(record: Record, channel: str | None = None) -> tuple[float, float]:
    """Position and velocity at the first sample, by a parabola through the first 20 samples.

    **Arguments:**

    - `record`: with a position [m or rad]. `channel`: its name; by default the only one.

    **Returns:**

    Position and velocity.
    """
    x = without_outliers(record.measured if channel is None else record.channels[channel])
    powers = _start_powers(record.t)
    return tuple(np.linalg.lstsq(powers, x[: len(powers)])[0][:2].tolist())


def start_errors(record: Record, channel: str) -> float:
    """Standard error of the velocity of `start_state` over the noise of the channel [1/s].

    Larger if the first samples differ from the parabola by more than the noise, being too far apart.
    """
    x = without_outliers(record.channels[channel])
    powers = _start_powers(record.t)
    first = x[: len(powers)]
    off = np.sqrt(np.mean((first - powers @ np.linalg.lstsq(powers, first)[0]) ** 2))
    return float(np.linalg.norm(np.linalg.pinv(powers)[1])) * max(1.0, float(off) / sample_noise(x))


def _start_powers(t: Float[np.ndarray, " samples"]) -> Float[np.ndarray, "first powers"]:
    """Powers of time since the first sample, for a parabola through the first samples."""
    count = min(_SAMPLES, len(t))
    return np.vander(t[:count] - t[0], min(3, count), increasing=True)


def resolution(x: Float[np.ndarray, " samples"]) -> float:
    """Resolution of a sensor, of which all differences of values are multiples; 0 for none."""
    values = np.unique(x)
    steps = np.diff(values)
    if not steps.size:
        return 0.0
    step = float(np.median(steps[steps < 1.5 * np.min(steps)]))
    return step if np.max(np.abs(steps / step - np.round(steps / step))) < _ON_A_GRID else 0.0


def sampling_gaps(record: Record) -> tuple[int, ...]:
    """Numbers of the samples before gaps.

    A record with irregular intervals has none.

    **Returns:**

    Indices of the samples, increasing.
    """
    steps = np.diff(record.t)
    long = np.flatnonzero(steps > _GAP * np.median(steps))
    return tuple(long.tolist()) if long.size <= max(_FEW * steps.size, 1) else ()


def _regression(record: Record, name: str, furthest: int) -> Callable[[float], tuple[float, float]] | None:
    """Regression of a force on the motion: acceleration, velocity, its sign, and one. None for a short motion.

    The function returns the sums of squares of the residual of the force `offset` [s] earlier, and of its scatter.
    """
    t, span, u = record.t, smooth_span(len(record.t)), record.inputs[name]
    edge = 2 * span + furthest + 2
    if len(t) <= 2 * edge or not np.ptp(u) or not np.ptp(record.measured):
        return None

    def smoothed(x: np.ndarray) -> np.ndarray:
        return smooth(smooth(x, span), span)

    v = np.gradient(smoothed(without_outliers(record.measured)), t)
    moving = np.abs(v) > MOVING * np.max(np.abs(v))
    moving[:edge] = moving[-edge:] = False
    if np.count_nonzero(moving) < _LEAST_MOVING:
        return None
    columns = np.column_stack([np.gradient(v, t), v, smoothed(np.sign(v)), np.ones_like(v)])[moving]
    basis = np.linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), _TINY))[0]
    # A held value belongs to the interval after it.
    middle, force = t + 0.5 * float(np.median(np.diff(t))), smoothed(u)

    def squares(offset: float) -> tuple[float, float]:
        shifted = np.interp(t[moving] - offset, middle, force)
        residual = shifted - basis @ (basis.T @ shifted)
        return float(residual @ residual), float(np.sum((shifted - np.mean(shifted)) ** 2))

    return squares


def unexplained_force(record: Record, name: str = "u") -> float:
    """Share of the variance of a force that acceleration, velocity and its sign do not explain.

    **Arguments:**

    - `record`: of one position [m or rad]. `name`: of the input, a force [N or N m].

    **Returns:**

    The share, 0 to 1; 0 for a motion that is too short.
    """
    regression = _regression(record, name, 0)
    if regression is None:
        return 0.0
    residual, scatter = regression(0.0)
    return residual / max(scatter, _TINY)


def clock_offset(record: Record, name: str = "u") -> tuple[float, float]:
    """Time by which an input is ahead of the force that the motion shows, as from a different clock.

    The input is shifted against its regressors, which are acceleration, velocity and its sign. The shift with the least
    residual is the offset, to a tenth of the interval of the samples or better.

    **Arguments:**

    - `record`: of one position [m or rad]. `name`: of the input, a force [N or N m] held from sample to sample.

    **Returns:**

    The offset [s], positive for an early input, and the root mean square of the residual with the shift, relative to
    that without it. `(0, 1)` for a motion that is too short.
    """
    from scipy.optimize import minimize_scalar  # slow to import, and only needed here

    interval, furthest = float(np.median(np.diff(record.t))), int(min(_FURTHEST_SHARE * len(record.t), _FURTHEST))
    regression = _regression(record, name, furthest)
    if regression is None or furthest < 1:
        return 0.0, 1.0

    def squares(offset: float) -> float:
        return regression(offset)[0]

    def least(first: int, last: int, step: int) -> int:
        return min(range(max(first, -furthest), min(last, furthest) + 1, step), key=lambda k: squares(interval * k))

    # First on a coarse grid: a smoothed force changes little over a quarter of the span.
    step = max(smooth_span(len(record.t)) // 4, 1)
    best = least(-furthest, furthest, step)
    best = least(best - step, best + step, 1)
    low, high = (interval * min(max(best + side, -furthest), furthest) for side in (-1, 1))
    optimum: Any = minimize_scalar(squares, bounds=(low, high), options={"xatol": _REFINED * interval})
    offset = float(optimum.x)
    return offset, math.sqrt(squares(offset) / max(squares(0.0), _TINY))
