"""What uncertain parameters, and parameters that change from record to record, make of the output of a fit."""

from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np
from jaxtyping import Array, Float

from ..._core.arrays import on_device
from ..estimate._search import SearchResult, channels_seen
from ..estimate._search import by_channel as residual_by_channel
from ..uncertainty._estimate import covariance_of
from ..uncertainty._result import FitResult
from ._agreement import RecordAgreement, friction_levels
from ._memory import blocks_that_are_independent

# Standard deviation of the friction level from record to record, as a share of it, where nobody says another one: two
# records then differ by 5.7 % (root mean square).
VARIATION = 0.04
# Longest step in the coordinates of the fit, and variance along an axis, against the largest, that is rounding.
_LONGEST, _NOTHING = 0.1, 1e-12
_Matrix: TypeAlias = Float[np.ndarray, "free free"]


def covariances(result: FitResult, variation: float, agreement: RecordAgreement | None) -> tuple[_Matrix, _Matrix]:
    """Of the free parameters: of their estimate, and of their difference in a new record from the records' mean.

    The first is that of the estimate, but from blocks of samples that are longer where the residual remembers for long.
    """
    if not (np.isfinite(variation) and variation >= 0):
        raise ValueError(f"variation must be finite and >= 0, as 0.04 for 4 %, but it is {variation!r}.")
    search = search_of(result, "A prediction")
    names, count = search.problem.free.names, len(result.provenance.records)
    blocks = blocks_that_are_independent(search)
    own = covariance_of(search.problem, search.state, range(len(names)), blocks).covariance
    known = np.isfinite(np.diag(own))
    own = np.where(np.outer(known, known), own, 0.0)
    level = np.array([result.values[name] * (name in friction_levels(result)) for name in names])
    between = variation**2 * np.outer(level, level)
    if agreement is not None:
        fitted = tuple(record.name for record in result.provenance.records)
        if agreement.names != names or agreement.records != fitted:
            raise ValueError(
                f"The agreement is of {', '.join(agreement.names)} in {', '.join(agreement.records)}, but the fit has"
                f" {', '.join(names)} in {', '.join(fitted)}: take agreement(result)."
            )
        between = (between + (count - 1) * agreement.covariance) / count
    return own, (1 + 1 / count) * between


def mean_variances(search: SearchResult, covariance: _Matrix) -> dict[str, float]:
    """Mean variance of the output at the samples that were fitted, by channel, in squared noise levels, linearised.

    **Arguments:**

    - `covariance`: of the free parameters, by the same derivatives.
    """
    problem, size = search.problem, len(search.problem.free.names)
    slopes = problem.at(search.state.x).slopes
    jacobian = np.asarray(search.state.jacobian)[: problem.samples, :size] @ np.linalg.pinv(slopes)
    split = residual_by_channel(problem, np.sum((jacobian @ covariance) * jacobian, axis=1))
    return {name: max(float(np.mean(x[weight > 0])), 0.0) for name, (x, weight) in split.items()}


def output_changes(
    search: SearchResult, covariance: _Matrix, seen: Callable[[Float[Array, " free"]], Mapping[str, Array]]
) -> list[dict[str, np.ndarray]]:
    """Changes of an output, by channel, whose squares sum up to its variance.

    One for each principal axis of the covariance: half the difference of the outputs at points on either side, at
    sqrt(3) standard deviations (Norgaard, Poulsen, Ravn 2000, Automatica 36:1627), divided by that. Motions that stick
    and slip have derivatives that hold over much shorter distances. Beyond a tenth in the coordinates of the fit the
    change is taken as linear: where parameters are hardly determined, models there have little to do with the records.

    **Arguments:**

    - `covariance`: of the free parameters.
    - `seen`: the output at coordinates of the free parameters.
    """
    size, here = len(search.problem.free.names), search.problem.at(search.state.x)
    x = np.asarray(search.state.x)[:size]
    back = np.linalg.pinv(here.slopes)
    scatter = back @ covariance @ back.T
    moving = np.flatnonzero(np.diag(scatter) > 0)
    if not moving.size:
        return []
    scale = np.sqrt(np.diag(scatter)[moving])
    values, vectors = np.linalg.eigh(scatter[np.ix_(moving, moving)] / np.outer(scale, scale))
    changes = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value <= _NOTHING * values[-1]:
            continue
        axis = np.zeros(size)
        axis[moving] = np.sqrt(value) * scale * vector
        step = min(np.sqrt(3.0), _LONGEST / float(np.max(np.abs(axis))))
        ends = (np.clip(x + side * step * axis, here.lower, here.upper).astype(x.dtype) for side in (1.0, -1.0))
        ahead, behind = (seen(on_device(end)) for end in ends)
        changes.append({name: (np.asarray(ahead[name]) - np.asarray(behind[name])) / (2 * step) for name in ahead})
    return changes


def change_between(search: SearchResult, covariance: _Matrix) -> dict[str, float]:
    """Mean variance that parameters of this covariance give the output at the samples that were fitted, by channel.

    In squared noise levels.
    """
    problem, starts = search.problem, np.asarray(search.state.x)[len(search.problem.free.names) :]
    changes = output_changes(
        search, covariance, lambda x: channels_seen(problem, on_device(np.concatenate([x, starts])))
    )
    found = {}
    for name, weight in problem.runs.weight.items():
        square = sum((change[name] / float(problem.noise[name])) ** 2 for change in changes)
        found[name] = float(np.mean((square + np.zeros(weight.shape))[np.asarray(weight) > 0]))
    return found


def search_of(result: FitResult, what: str) -> SearchResult:
    if result.search is None:
        raise ValueError(f"{what} needs what the fit observed, which a loaded result does not have: fit again.")
    return result.search
