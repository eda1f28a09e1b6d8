"""Signals of a record: smoothed, differentiated, their noise and outliers, gaps in time, and the offset of a clock."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ._record import Record

# Samples at the beginning of a record, from which position and velocity are estimated.
_SAMPLES = 20
# A value stands out that is so many times as far from the median of its neighbours as nearly all others are, and as far
# as samples go from one to the next.
_NEIGHBOURS, _STANDS_OUT, _NEARLY_ALL = 5, 10.0, 0.95
# Values are on a grid that lie off it by less than this share of its step; keeps divisions by a level finite.
_ON_A_GRID, _TINY = 1e-3, 1e-300
# Smoothing: one sample to either side for so many of the record, and never fewer than so many to either side.
_SAMPLES_A_SIDE, _LEAST_SPAN = 1000, 3
# Orders of the differences that show noise, into how many parts of how many samples at least a record is cut.
_ORDERS, _PARTS, _LEAST_PART = (2, 3, 4, 5, 6), 32, 32
# An interval so many times the median is a gap, unless more than this share of all intervals are as long.
_GAP, _FEW = 5.0, 0.01
# Slower than this share of the top speed friction may be anything.
_MOVING = 0.05
# Largest offset that is looked for, as a share of the record, and in samples.
_FURTHEST_SHARE, _FURTHEST = 0.1, 500
# Iterations of the golden section by which the minimum is found between two samples.
_REFINED, _GOLDEN = 40, 0.5 * (math.sqrt(5.0) - 1.0)
# Samples in motion that tell four regressors from chance.
_LEAST_MOVING = 100


class SmoothedMotion(NamedTuple):
    """A smoothed motion, shape `[samples]` each, and how many samples at either end the smoothing spoils."""

    x: Float[np.ndarray, " samples"]
    v: Float[np.ndarray, " samples"]
    a: Float[np.ndarray, " samples"]
    edge: int


def smooth(x: Float[np.ndarray, " samples"], span: int) -> Float[np.ndarray, " samples"]:
    """Weighted mean over `span` samples to either side."""
    from scipy.signal import convolve, windows  # most of a second to import, and only needed here

    kernel = windows.hann(2 * span + 3)[1:-1]
    return convolve(np.pad(x, span, mode="edge"), kernel / kernel.sum(), mode="valid", method="direct")


def smooth_span(samples: int) -> int:
    """Samples to either side over which a record of so many is smoothed."""
    return max(samples // _SAMPLES_A_SIDE, _LEAST_SPAN)


def outliers(x: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    """Samples that stand out from their neighbours to either side, as those of a sensor that drops out do."""
    deviation, steps = np.abs(x - _local_median(x)), np.abs(np.diff(x))
    step = float(np.median(steps[steps > 0])) if steps.any() else 0.0
    usual = max(float(np.quantile(deviation, _NEARLY_ALL)), step)
    return deviation > _STANDS_OUT * usual


def without_outliers(x: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """The samples, with the median of their neighbours in place of those that stand out."""
    bad = outliers(x)
    return np.where(bad, _local_median(x), x) if bad.any() else x


def sample_noise(x: Float[np.ndarray, " samples"]) -> float:
    """Standard deviation of the noise that samples do not share with their neighbours; at least that of rounding.

    Differences of the order that leaves least of the motion; the median over parts of the record, so that impacts and
    outliers decide nothing. Steps of a sensor of resolution r have a standard deviation of r/sqrt(12).
    """
    levels = [np.inf]
    for order in _ORDERS:
        squares = np.diff(x, order) ** 2 / math.comb(2 * order, order)
        parts = np.array_split(squares, max(min(squares.size // _LEAST_PART, _PARTS), 1))
        levels.append(float(np.sqrt(np.median([np.mean(part) for part in parts]))) if squares.size else np.inf)
    rounding = float(np.finfo(float).eps * np.max(np.abs(x)))
    seen = min(levels) if np.isfinite(min(levels)) else 0.0
    return max(seen, resolution(x) / 12.0**0.5, rounding, _TINY)


def _local_median(x: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    side = _NEIGHBOURS // 2
    return np.median(np.lib.stride_tricks.sliding_window_view(np.pad(x, side, mode="edge"), _NEIGHBOURS), axis=-1)


def differentiate(t: Float[np.ndarray, " samples"], x: Float[np.ndarray, " samples"]) -> SmoothedMotion:
    """Velocity and acceleration of a position, smoothed before either differentiation."""
    span = smooth_span(len(t))
    position = smooth(x, span)
    v = smooth(np.gradient(position, t), span)
    return SmoothedMotion(position, v, np.gradient(v, t), 3 * span)


def start_state(record: Record, channel: str | None = None) -> tuple[float, float]:
    """Position and velocity at the first sample, by a parabola through the first 20.

    **Arguments:**

    - `record`: its `channel`, by default the only one, is a position [m or rad].

    **Returns:**

    Position and velocity.
    """
    x = without_outliers(record.measured if channel is None else record.channels[channel])
    powers = _start_powers(record.t)
    return tuple(np.linalg.lstsq(powers, x[: len(powers)])[0][:2].tolist())


def start_errors(record: Record, channel: str) -> float:
    """Standard error of the velocity of `start_state` over the noise of the channel [1/s].

    Larger where the first samples lie off the parabola by more than the noise: they are too far apart for it.
    """
    x = without_outliers(record.channels[channel])
    powers = _start_powers(record.t)
    first = x[: len(powers)]
    off = np.sqrt(np.mean((first - powers @ np.linalg.lstsq(powers, first)[0]) ** 2))
    return float(np.linalg.norm(np.linalg.pinv(powers)[1])) * max(1.0, float(off) / sample_noise(x))


def _start_powers(t: Float[np.ndarray, " samples"]) -> Float[np.ndarray, "first powers"]:
    """The parabola through the first samples, as a matrix: by time since the first one."""
    count = min(_SAMPLES, len(t))
    return np.vander(t[:count] - t[0], min(3, count), increasing=True)


def resolution(x: Float[np.ndarray, " samples"]) -> float:
    """Step of the values of a sensor, all of which are multiples of it apart; 0 where there is none."""
    values = np.unique(x)
    steps = np.diff(values)
    if not steps.size:
        return 0.0
    step = float(np.median(steps[steps < 1.5 * np.min(steps)]))
    return step if np.max(np.abs(steps / step - np.round(steps / step))) < _ON_A_GRID else 0.0


def sampling_gaps(record: Record) -> tuple[int, ...]:
    """Numbers of the samples after which some are missing.

    A record whose intervals differ throughout has none.
    """
    steps = np.diff(record.t)
    long = np.flatnonzero(steps > _GAP * np.median(steps))
    return tuple(long.tolist()) if long.size <= max(_FEW * steps.size, 1) else ()


class _Explained(NamedTuple):
    """What the motion of a record explains of a force: the regressors where it moves, as an orthonormal basis.

    - `basis`, shape `[moving, 4]`, at the times `t`. `middle`, `force`: the force, smoothed as the motion is.
    """

    basis: Float[np.ndarray, "moving 4"]
    t: Float[np.ndarray, " moving"]
    middle: Float[np.ndarray, " samples"]
    force: Float[np.ndarray, " samples"]

    def left(self, offset: float) -> tuple[float, float]:
        """Sum of squares of the force `offset` [s] before that is not explained, and of its scatter."""
        shifted = np.interp(self.t - offset, self.middle, self.force)
        missed = shifted - self.basis @ (self.basis.T @ shifted)
        return float(missed @ missed), float(np.sum((shifted - np.mean(shifted)) ** 2))


def _explained(record: Record, name: str, furthest: int) -> _Explained | None:
    """Regressors of the force: acceleration, velocity, its direction, and one. None where the motion is too short."""
    t, span, u = record.t, smooth_span(len(record.t)), record.inputs[name]
    edge = 2 * span + furthest + 2
    if len(t) <= 2 * edge or not np.ptp(u) or not np.ptp(record.measured):
        return None

    def smoothed(x: np.ndarray) -> np.ndarray:
        return smooth(smooth(x, span), span)

    v = np.gradient(smoothed(without_outliers(record.measured)), t)
    moving = np.abs(v) > _MOVING * np.max(np.abs(v))
    moving[:edge] = moving[-edge:] = False
    if np.count_nonzero(moving) < _LEAST_MOVING:
        return None
    columns = np.column_stack([np.gradient(v, t), v, smoothed(np.sign(v)), np.ones_like(v)])[moving]
    basis = np.linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), _TINY))[0]
    # A held value stands for the interval that follows it.
    return _Explained(basis, t[moving], t + 0.5 * float(np.median(np.diff(t))), smoothed(u))


def unexplained_force(record: Record, name: str = "u") -> float:
    """Share of the variance of a force that does not go with the motion: with acceleration, velocity, its direction.

    **Arguments:**

    - `record`: of one position [m or rad]. `name`: of the input, a force [N or N m].

    **Returns:**

    The share, 0 to 1; 0 where the motion is too short to tell.
    """
    explained = _explained(record, name, 0)
    if explained is None:
        return 0.0
    left, scatter = explained.left(0.0)
    return left / max(scatter, _TINY)


def clock_offset(record: Record, name: str = "u") -> tuple[float, float]:
    """By how much an input comes before the force that the motion shows, as from a clock that differs.

    The force is regressed on acceleration, velocity and its direction, with the input shifted against them; the shift
    that leaves least is the offset, to a tenth of the interval of the samples or better.

    **Arguments:**

    - `record`: of one position [m or rad]. `name`: of the input, a force [N or N m] held from sample to sample.

    **Returns:**

    The offset [s], positive where the input is early, and the root mean square that is left with the shift, as a share
    of what is left without it. `(0, 1)` where the motion is too short to tell.
    """
    interval, furthest = float(np.median(np.diff(record.t))), int(min(_FURTHEST_SHARE * len(record.t), _FURTHEST))
    explained = _explained(record, name, furthest)
    if explained is None or furthest < 1:
        return 0.0, 1.0

    def left(offset: float) -> float:
        return explained.left(offset)[0]

    def least(first: int, last: int, step: int) -> int:
        return min(range(max(first, -furthest), min(last, furthest) + 1, step), key=lambda k: left(interval * k))

    # A smoothed force changes little over a quarter of the span: so far apart are the offsets of a first look.
    step = max(smooth_span(len(record.t)) // 4, 1)
    best = least(-furthest, furthest, step)
    best = least(best - step, best + step, 1)
    low, high = (interval * min(max(best + side, -furthest), furthest) for side in (-1, 1))
    for _ in range(_REFINED):
        a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        low, high = (low, b) if left(a) < left(b) else (a, high)
    offset = 0.5 * (low + high)
    return offset, math.sqrt(left(offset) / max(left(0.0), _TINY))
