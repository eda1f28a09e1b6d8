"""Combinations of parameters that a record does not determine, in words."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from ._result import FitResult

# A combination known worse than this, relative to its parameters, is called undetermined.
_WEAK = 0.3
# Entries of a direction below this share of the largest do not belong to it; those nearer than this are equal.
_PART, _EQUAL = 0.2, 0.15


@dataclass(frozen=True)
class Direction:
    """A way in which the parameters can change together without the record telling.

    - `names`: of the parameters that take part, the strongest first.
    - `changes`: their changes relative to the value or the start, whichever is larger; the largest 1.
    - `error`: standard error along it, relative in the same way.
    - `sentence`: in words.
    """

    names: tuple[str, ...]
    changes: tuple[float, ...]
    error: float
    sentence: str


def weak_directions(result: "FitResult", left_out: Collection[str]) -> list[Direction]:
    """Weak directions of the Fisher information in relative parameters, the weakest first."""
    names = [
        name
        for name, value in result.values.items()
        if name not in left_out and np.isfinite(result.errors[name]) and value not in result.bounds[name]
    ]
    if len(names) < 2:
        return []
    keep = [list(result.values).index(name) for name in names]
    size = np.array([max(abs(result.values[name]), abs(result.start[name])) or 1.0 for name in names])
    relative = result.information[np.ix_(keep, keep)] * np.outer(size, size)
    values, vectors = np.linalg.eigh(relative)
    factor = _inflation(result, keep)
    found = []
    found = []
    for value, vector in zip(values, vectors.T, strict=True):
        error = float(np.sqrt(factor / max(value, 1e-14 * values[-1])))
        vector = vector / vector[np.argmax(np.abs(vector))]
        order = [i for i in np.argsort(-np.abs(vector)) if abs(vector[i]) >= _PART]
        if error < _WEAK or len(order) < 2:
            continue
        parts = tuple(names[i] for i in order)
        sentence = _sentence(result, parts, vector[order], error, size[order])
        found.append(Direction(parts, tuple(float(vector[i]) for i in order), error, sentence))
    return [direction for direction in found if not _covered(direction, found)]


def _covered(direction: Direction, found: list[Direction]) -> bool:
    """Whether every combination of its parameters is weak, so that there is none to be named."""
    parts = set(direction.names)
    return sum(set(other.names) <= parts for other in found) >= len(parts)


def _inflation(result: "FitResult", keep: list[int]) -> float:
    """What correlation in time and the true size of the residual make of a variance by the Fisher information.

    From the parameters that are known well: of the others the covariance is no more than a large number.
    """
    level = float(np.mean([(result.rmse_by[name] / noise) ** 2 for name, noise in result.noise.items()]))
    sizes = np.abs(np.array(list(result.values.values())))[keep]
    variance, white = np.diag(result.covariance)[keep], np.diag(result.white)[keep]
    known = (variance < (_WEAK * sizes) ** 2) & (white > 0)
    return level * float(np.median(variance[known] / white[known])) if known.any() else level


def _sentence(
    result: "FitResult",
    names: tuple[str, ...],
    vector: Float[np.ndarray, " parts"],
    error: float,
    size: Float[np.ndarray, " parts"],
) -> str:
    how = f"known to {100 * error:.0f} % only" if error < 10 else "not known at all"
    if len(names) == 2:
        first = list(result.values).index
        (a, x, u), (b, y, v) = sorted(zip(names, vector, vector * size, strict=True), key=lambda part: first(part[0]))
        alike = result.units[a] == result.units[b]
        positive = min(result.values[a], result.values[b]) > 0
        if alike and abs(abs(u / v) - 1) < _EQUAL:
            what = f"the sum {a} + {b}" if u * v < 0 else f"the difference {a} - {b}"
            return f"The record determines only {what}; how it is shared between them is {how}."
        if positive and abs(abs(x / y) - 1) < _EQUAL:
            what, other = ("product {} {}", "ratio") if x * y < 0 else ("ratio {}/{}", "common size")
            return f"The record determines only the {what.format(a, b)}; their {other} is {how}."
    small = 0.1
    changes = ", ".join(f"{name} by {small * c * s:+.2g}" for name, c, s in zip(names, vector, size, strict=True))
    return (
        f"The record determines only combinations of {', '.join(names)}: a change of {changes} together hardly shows"
        f" (this direction is {how})."
    )
