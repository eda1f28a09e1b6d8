"""Finite differences with error estimates, and the mode histories of the runs behind them."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# Largest step relative to the number, and number of steps, each a quarter of the one before; by bytes of the type.
STEPS = {8: (1e-2, 5), 4: (4e-2, 4)}
_RATIO = 4.0
# Estimates at two steps are consistent if they differ by less than this fraction.
_SAME = 0.3
# An event is near grazing if its time has a square root within this fraction of the number.
_NEAR = 0.05


class History(NamedTuple):
    """Mode changes of one effect in one run: start of the run, times [s], modes before and after."""

    t0: float
    t: np.ndarray
    changes: tuple[tuple[int, int], ...]


# By number of the run and name of the effect.
Histories = dict[tuple[int, str], History]


class Sample(NamedTuple):
    """One evaluation of the function: the number, the value, the mode histories, and an error message or ""."""

    x: float
    value: float
    histories: Histories
    trouble: str


class Probe(NamedTuple):
    """Evaluations around one number: at it, and below and above it from the largest step to the smallest."""

    center: Sample
    below: list[Sample]
    above: list[Sample]


class DerivativeEstimate(NamedTuple):
    """A derivative by differences: value, estimated error, smaller one of its two steps, and side or `both`."""

    value: float
    error: float
    step: float
    sides: str


class Agreement(NamedTuple):
    """Tolerances of the comparison.

    - `eps`: rounding unit of the floating type.
    - `rtol`, `rtol_modes`: relative, between derivatives and differences, and between forward and reverse mode.
    - `size`: the largest of the function, its changes per relative change of a number, and the absolute tolerance of
      the runs. Much smaller derivatives count as zero.
    """

    eps: float
    rtol: float
    rtol_modes: float
    size: float


class Grazing(NamedTuple):
    """An event near grazing: its run, effect and time [s], and the value of the number at which it vanishes."""

    run: int
    effect: str
    t: float
    vanishes: float


def probe(sample: Callable[[float], Sample], center: Sample, scale: float, itemsize: int) -> Probe:
    """Evaluate the function at all steps."""
    largest, count = STEPS[itemsize]
    steps = [scale * largest / _RATIO**j for j in range(count)]
    return Probe(center, [sample(center.x - h) for h in steps], [sample(center.x + h) for h in steps])


def usable(center: Sample, side: list[Sample]) -> int:
    """First index from which on all evaluations of a side succeed with the modes of the center."""
    first = len(side)
    while first and not side[first - 1].trouble and not changed(center.histories, side[first - 1].histories):
        first -= 1
    return first


def changed(one: Histories, other: Histories) -> tuple[int, str] | None:
    """Run and effect with the earliest difference of modes; None without a difference."""
    empty = History(0.0, np.zeros(0), ())
    differing = []
    for key in {**one, **other}:
        a, b = one.get(key, empty), other.get(key, empty)
        if a.changes != b.changes:
            k = first_difference(a, b)
            differing.append((min(float(h.t[k]) for h in (a, b) if k < len(h.t)), key))
    return min(differing)[1] if differing else None


def first_difference(one: History, other: History) -> int:
    """Index of the first mode change that differs."""
    pairs = zip(one.changes, other.changes, strict=False)
    shorter = min(len(one.changes), len(other.changes))
    return next((k for k, (a, b) in enumerate(pairs) if a != b), shorter)


def estimate(evaluations: Probe, eps: float) -> DerivativeEstimate | None:
    """Derivative by Richardson's extrapolation of the pair of steps with the smallest estimated error.

    The error is the correction of the extrapolation, plus the noise of the evaluations over the smaller step. The
    noise is the deviation from the powers of the step at the smallest steps.
    """
    center, count = evaluations.center, len(evaluations.above)
    below, above = usable(center, evaluations.below), usable(center, evaluations.above)
    bends = [0.0, 0.0]
    if max(below, above) <= count - 2:
        first, order, sides = max(below, above), 2, "both"
        pairs = list(zip(evaluations.below[first:], evaluations.above[first:], strict=True))
        bends = [(low.value + high.value - 2 * center.value) / 2 for low, high in pairs[-2:]]
    elif min(below, above) <= count - 2:
        first, order = min(below, above), 1
        sides, side = ("below", evaluations.below) if below < above else ("above", evaluations.above)
        pairs = [(center, s) for s in side[first:]]
    else:
        return None
    slopes = [(b.value - a.value) / (b.x - a.x) for a, b in pairs]
    steps = [abs(b.x - a.x) / order for a, b in pairs]
    changes = [0.0, *np.diff(slopes)][-2:]
    noise = 4 * eps * abs(center.value) + abs(bends[1] - bends[0] / _RATIO**2)
    noise += steps[-1] * abs(changes[1] - changes[0] / _RATIO**order)
    best: DerivativeEstimate | None = None
    smaller: list[tuple[float, float]] = []
    for j in range(len(pairs) - 1, 0, -1):
        change = (slopes[j] - slopes[j - 1]) / (_RATIO**order - 1)
        value, error = slopes[j] + change, abs(change) + noise / steps[j]
        # The error is at least the distance to the estimates at smaller steps, less their own errors.
        error = max([error, *(abs(value - v) - e for v, e in smaller)])
        smaller.append((value, error))
        if best is None or error < best.error:
            best = DerivativeEstimate(value, error, steps[j], sides)
    return best


def kink(evaluations: Probe) -> tuple[float, float] | None:
    """Slopes below and above, if their difference is nearly constant over the three smallest steps."""
    count, center = len(evaluations.above), evaluations.center
    if max(usable(center, evaluations.below), usable(center, evaluations.above)) > count - 3:
        return None
    below = [(center.value - s.value) / (center.x - s.x) for s in evaluations.below[-3:]]
    above = [(s.value - center.value) / (s.x - center.x) for s in evaluations.above[-3:]]
    gaps = [b - a for a, b in zip(below, above, strict=True)]
    if gaps[2] and _same(gaps[0], gaps[1]) and _same(gaps[1], gaps[2]):
        return below[2], above[2]
    return None


def grazing(evaluations: Probe, scale: float) -> Grazing | None:
    """The first event whose time follows a square root that ends nearby.

    If an event vanishes where the number p reaches c, its time is `t* - a sqrt(|p - c|)` near there, and
    `c = p + t'/(2 t'')`. An event counts if its time moves by more than a tenth of the time since the event before, per
    relative change of the number, and if its second differences at two steps agree, which excludes noise.
    """
    center, count = evaluations.center, len(evaluations.above)
    first = max(usable(center, evaluations.below), usable(center, evaluations.above))
    suspects = []
    for key, history in center.histories.items():
        lengths = np.diff(history.t, prepend=history.t0)
        before: np.ndarray | None = None
        for j in range(first, count):
            low, high = evaluations.below[j], evaluations.above[j]
            down = (history.t - low.histories[key].t) / (center.x - low.x) if len(history.t) else history.t
            up = (high.histories[key].t - history.t) / (high.x - center.x) if len(history.t) else history.t
            rate, bend = (up + down) / 2, (up - down) / ((high.x - low.x) / 2)
            if before is not None:
                away = rate / np.where(bend == 0, np.nan, 2 * bend)
                real = np.abs(bend - before) < _SAME * np.abs(bend)
                moves = np.abs(rate) * scale > 0.1 * lengths
                for k in np.flatnonzero(real & moves & (np.abs(away) < _NEAR * scale)):
                    suspects.append(Grazing(key[0], key[1], float(history.t[k]), center.x + float(away[k])))
            before = bend
    return min(suspects, key=lambda s: (s.run, s.t), default=None)


def _same(one: float, other: float) -> bool:
    return abs(one - other) < _SAME * abs(other)
