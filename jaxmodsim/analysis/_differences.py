"""Finite differences that know their own error, and histories of modes along the way."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# Largest step relative to the number, and how many there are, each a quarter of the one before; by bytes of the type.
STEPS = {8: (1e-2, 5), 4: (4e-2, 4)}
_RATIO = 4.0
# Estimates at two steps count as one value, and not as noise, if they differ by less.
_SAME = 0.3
# An event is near grazing if its time has a square root within this part of the number.
_NEAR = 0.05


class History(NamedTuple):
    """Mode changes of one effect in one run: start of the run, times [s], modes before and after."""

    t0: float
    t: np.ndarray
    changes: tuple[tuple[int, int], ...]


# By number of the run and name of the effect.
Histories = dict[tuple[int, str], History]


class Sample(NamedTuple):
    """One evaluation: where, the value, the modes on the way, and what went wrong (nothing, if empty)."""

    x: float
    value: float
    histories: Histories
    trouble: str


class Probe(NamedTuple):
    """Evaluations about one number: in the middle, and below and above it from the largest step to the smallest."""

    center: Sample
    below: list[Sample]
    above: list[Sample]


class DerivativeEstimate(NamedTuple):
    """A derivative by differences: value, estimated error, smaller one of the two steps it is from, and its sides."""

    value: float
    error: float
    step: float
    sides: str


class Agreement(NamedTuple):
    """What counts as equal.

    - `itemsize`, `eps`: bytes and rounding unit of the floating type.
    - `rtol`, `rtol_modes`: relative, between derivatives and differences, and between forward and reverse mode.
    - `size`: the largest of the function, its changes per relative change of a number, and the absolute tolerance of
      the runs; what is tiny beside it is zero.
    """

    itemsize: int
    eps: float
    rtol: float
    rtol_modes: float
    size: float


class Grazing(NamedTuple):
    """An event whose time has a square root nearby: where it is, and at which value of the number it would vanish."""

    run: int
    effect: str
    t: float
    vanishes: float


def probe(sample: Callable[[float], Sample], center: Sample, scale: float, itemsize: int) -> Probe:
    """Evaluate at all steps."""
    largest, count = STEPS[itemsize]
    steps = [scale * largest / _RATIO**j for j in range(count)]
    return Probe(center, [sample(center.x - h) for h in steps], [sample(center.x + h) for h in steps])


def usable(center: Sample, side: list[Sample]) -> int:
    """From which index on all evaluations of a side worked and had the modes of the one in the middle."""
    first = len(side)
    while first and not side[first - 1].trouble and not changed(center.histories, side[first - 1].histories):
        first -= 1
    return first


def changed(one: Histories, other: Histories) -> tuple[int, str] | None:
    """Run and effect whose modes differ; the first in time, if several do."""
    empty = History(0.0, np.zeros(0), ())
    differing = []
    for key in {**one, **other}:
        a, b = one.get(key, empty), other.get(key, empty)
        if a.changes != b.changes:
            k = first_difference(a, b)
            differing.append((min(float(h.t[k]) for h in (a, b) if k < len(h.t)), key))
    return min(differing)[1] if differing else None


def first_difference(one: History, other: History) -> int:
    """Index of the first change that differs."""
    pairs = zip(one.changes, other.changes, strict=False)
    shorter = min(len(one.changes), len(other.changes))
    return next((k for k, (a, b) in enumerate(pairs) if a != b), shorter)


def estimate(evaluations: Probe, eps: float) -> DerivativeEstimate | None:
    """Derivative by Richardson's extrapolation of the pair of steps with the smallest estimated error.

    The error is that of the smaller step before it is extrapolated, plus the noise of the evaluations over that
    step. The noise is measured at the smallest steps, by what does not follow the powers of the step there.
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
        # What smaller steps contradict, beyond their own errors, is wrong by as much.
        error = max([error, *(abs(value - v) - e for v, e in smaller)])
        smaller.append((value, error))
        if best is None or error < best.error:
            best = DerivativeEstimate(value, error, steps[j], sides)
    return best


def kink(evaluations: Probe) -> tuple[float, float] | None:
    """Slopes below and above, where they differ by about the same at the three smallest steps."""
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
    """The first event whose time bends as a square root does close to where it ends.

    If an event vanishes where the number p reaches c, its time goes as `t* - a sqrt(|p - c|)` near there, and
    `c = p + t'/(2 t'')`. Counted are events whose time moves (by more than a tenth of the time since the event before,
    per relative change of the number) and whose second difference is the same at two steps, so is no noise.
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
