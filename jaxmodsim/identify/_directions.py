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
    - `changes`: their relative changes, the largest 1, in this order; absolute ones for a parameter that is 0.
    - `error`: standard error along it, relative to the strongest parameter.
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
    size = np.array([abs(result.values[name]) or 1.0 for name in names])
    relative = result.information[np.ix_(keep, keep)] * np.outer(size, size)
    scale = np.sqrt(np.maximum(np.diag(relative), 1e-300))
    values, vectors = np.linalg.eigh(relative)
    # The inverse in columns of unit length, where a direction that is not known at all stays finite.
    own, turned = np.linalg.eigh(relative / np.outer(scale, scale))
    inverse = turned / np.maximum(own, 1e-14 * max(own[-1], 1.0)) @ turned.T / np.outer(scale, scale)
    spread = np.diag(result.covariance)[keep] / size**2
    factor = float(np.median(np.maximum(spread, 0.0) / np.diag(inverse)))
    found = []
    for value, vector in zip(values, vectors.T, strict=True):
        error = float(np.sqrt(max(factor, 0.0) / max(value, 1e-14 * values[-1])))
        vector = vector / vector[np.argmax(np.abs(vector))]
        order = [i for i in np.argsort(-np.abs(vector)) if abs(vector[i]) >= _PART]
        if error < _WEAK or len(order) < 2:
            continue
        parts = tuple(names[i] for i in order)
        sentence = _sentence(result, parts, vector[order], error)
        found.append(Direction(parts, tuple(float(vector[i]) for i in order), error, sentence))
    return found


def _sentence(result: "FitResult", names: tuple[str, ...], vector: Float[np.ndarray, " parts"], error: float) -> str:
    how = f"known to {100 * error:.0f} % only" if error < 10 else "not known at all"
    if len(names) == 2:
        (a, b), (x, y) = names, vector
        absolute = [c * (result.values[name] or 1.0) for name, c in zip(names, vector, strict=True)]
        alike = result.units[a] == result.units[b]
        positive = min(result.values[a], result.values[b]) > 0
        if alike and abs(abs(absolute[0] / absolute[1]) - 1) < _EQUAL:
            what = f"the sum {a} + {b}" if absolute[0] * absolute[1] < 0 else f"the difference {a} - {b}"
            return f"The record determines only {what}; how it is shared between them is {how}."
        if positive and abs(abs(x / y) - 1) < _EQUAL:
            what, other = ("product {} {}", "ratio") if x * y < 0 else ("ratio {}/{}", "common size")
            return f"The record determines only the {what.format(a, b)}; their {other} is {how}."
    small = 0.1
    changes = ", ".join(f"{name} by {100 * small * c:+.0f} %" for name, c in zip(names, vector, strict=True))
    if any(result.values[name] == 0 for name in names):
        changes = ", ".join(f"{name} by {small * c:+.2g}" for name, c in zip(names, vector, strict=True))
    return (
        f"The record determines only combinations of {', '.join(names)}: a change of {changes} together hardly shows"
        f" (this direction is {how})."
    )
