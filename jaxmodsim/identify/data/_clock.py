"""What the times of a record show: gaps, and an input on a clock of its own."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._record import Record, smooth, smooth_span, without_outliers

# An interval so many times the median is a gap, unless more than this share of all intervals are as long.
_GAP, _FEW = 5.0, 0.01
# Slower than this share of the top speed friction may be anything.
_MOVING = 0.05
# Largest offset that is looked for, as a share of the record, and in samples.
_FURTHEST_SHARE, _FURTHEST = 0.1, 500
# Iterations of the golden section by which the minimum is found between two samples.
_REFINED, _GOLDEN = 40, 0.5 * (math.sqrt(5.0) - 1.0)
# Samples in motion that tell four regressors from chance. Keeps divisions by what may vanish finite.
_LEAST_MOVING, _TINY = 100, 1e-300


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
