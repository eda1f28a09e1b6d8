"""The first samples of a record that was not fitted: they show where it starts, and do not count after that."""

from collections.abc import Collection, Iterable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._core.arrays import on_device
from ..data._record import Record, Runs, sample_noise
from ..estimate._problem import FitProblem, Prior
from ..estimate._search import SearchOptions, SearchResult, SearchState, solve, start_search, step
from ..uncertainty._result import FitResult

# So many samples show the state at the first one, or as many more as give its velocity with an error of so much of the
# record's; but no more than this share of them (or the first number), and no more than half.
LEAST, _ERROR, _MOST = 20, 0.002, 0.05
# Standard error of the slope at the start of a parabola through n samples: so many noise levels over n^1.5 intervals.
_SLOPE = 192.0**0.5
# Largest inverse standard deviation of a start that is shown, which holds it, and least noise.
_STIFF, _TINY = 1e6, float(np.finfo(float).tiny)


def sample_counts(runs: Runs) -> Int[np.ndarray, "runs 1"]:
    """Number of the samples of each run that count in any channel."""
    return np.sum(np.any([np.asarray(x) > 0 for x in runs.weight.values()], axis=0), axis=1, keepdims=True)


def opening(runs: Runs) -> Bool[np.ndarray, "runs samples"]:
    """The first samples of each run: as few as show where it starts.

    What a fitted start takes up of an error of the model grows with the number of samples that it is fitted to.
    """
    count = sample_counts(runs)
    needed = np.full(count.shape, np.inf)
    for x in runs.measured.values():
        far = np.asarray(x)[:, LEAST:] - np.asarray(x)[:, :-LEAST]
        speed = np.sqrt(np.mean(far**2, axis=1, keepdims=True)) / LEAST if far.size else np.zeros(count.shape)
        noise = np.array([[sample_noise(row)] for row in np.asarray(x)])
        own = (_SLOPE * noise / np.maximum(_ERROR * speed, np.finfo(float).tiny)) ** (2 / 3)
        needed = np.minimum(needed, np.where(speed > 0, own, np.inf))
    most = np.maximum(np.ceil(_MOST * count), LEAST)
    return np.arange(runs.t.shape[1]) < np.minimum(np.clip(np.ceil(needed), LEAST, most), count // 2)


def check_lengths(records: Iterable[Record], numbers: int) -> None:
    """Refuse records, or parts of them, half of which does not show so many numbers of a state.

    **Raises:**

    - `ValueError` naming the record.
    """
    for record in records:
        if len(record.t) // 2 <= numbers:
            raise ValueError(
                f"{record.name} has {len(record.t)} samples, too few to show the {numbers} numbers of its start and to"
                f" judge the model by the others: {2 * numbers + 2} are needed. Take a longer record, or fewer folds."
            )


def counting(problem: FitProblem, mask: np.ndarray, *, slips: bool = True) -> FitProblem:
    """The problem in which only the samples in the mask count, and with `slips` slip instants of runs that have any."""
    own = np.any(mask, axis=1, keepdims=True) & slips
    runs = problem.runs._replace(
        weight={name: on_device(np.asarray(weight) * mask) for name, weight in problem.runs.weight.items()},
        slip_weight={name: on_device(np.asarray(weight) * own) for name, weight in problem.runs.slip_weight.items()},
    )
    return eqx.tree_at(lambda p: p.runs, problem, runs)


def begin(problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> SearchResult:
    """Search for the states at the first samples with these samples alone; parameters must be pinned or none."""
    return solve(counting(problem, opening(problem.runs), slips=False), x, options)


def shown_starts(problem: FitProblem, begun: SearchResult) -> FitProblem:
    """The problem whose states at the first samples are what `begin` found, within the errors of that.

    These errors are those of the noise from sample to sample of the first channel. What the model misses is larger, and
    a start with errors of that size would take it up.
    """
    runs, local = problem.count, len(problem.local)
    name = next(iter(problem.known))
    own = np.asarray(begun.state.jacobian, float)[:, len(problem.free.names) :]
    seen, noise = np.asarray(problem.runs.measured[name]), float(problem.noise[name])
    counts = np.asarray(problem.runs.weight[name]) > 0
    weights = np.zeros((runs, local))
    for run in range(runs):
        errors = start_errors_of(own[:, run * local : (run + 1) * local])
        level = max(sample_noise(seen[run][counts[run]]), _TINY)
        weights[run] = noise**2 / np.maximum(errors * level, noise / _STIFF)
    known = {name: on_device(weights)}
    return eqx.tree_at(lambda p: (p.base, p.known), problem, (problem.starts(begun.state.x), known))


def unknown_starts(problem: FitProblem) -> FitProblem:
    """The problem whose states at the first samples are free."""
    return eqx.tree_at(lambda p: p.known, problem, {name: 0 * each for name, each in problem.known.items()})


def start_errors_of(jacobian: Float[np.ndarray, "rows local"]) -> Float[np.ndarray, " local"]:
    """Standard errors of a start from the Jacobian of its residual; infinite of numbers without effect."""
    size = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian / np.where(size > 0, size, 1.0)
    error = np.sqrt(np.diag(np.linalg.pinv(scaled.T @ scaled, rcond=1e-12, hermitian=True)))
    return np.where(size > 0, error / np.where(size > 0, size, 1.0), np.inf)


def after(problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> tuple[FitProblem, SearchState]:
    """The residual at `x` of the samples behind the first ones."""
    rest = counting(problem, ~opening(problem.runs))
    # The first evaluation of a search, which has nothing to move by yet.
    return rest, step(rest, start_search(x, rest.rows), on_device(np.asarray(options.rtol, x.dtype)))


def pinned(problem: FitProblem, x: Float[Array, " n"], result: FitResult, free: Collection[str] = ()) -> FitProblem:
    """The problem with all parameters but `free` held at `x`, by a prior: arrays alone, so nothing compiles again.

    A quarter of the digits beyond what the records know of each parameter: it moves by no more than a
    millionth of its standard error, and the normal equations are still well scaled.
    """
    mean = problem.at(x).vector
    stiff = float(np.finfo(mean.dtype).eps) ** -0.25
    known = np.sqrt(np.maximum(np.diag(result.estimate.information)[: len(mean)], 0.0))  # rounding may leave less
    size = np.abs(mean)
    weight = stiff * np.maximum(known, 1 / np.where(size > 0, size, 1.0))
    moves = np.array([name in free for name in problem.free.names], bool)
    held = Prior(
        on_device(np.where(moves, np.asarray(problem.prior.mean), mean)),
        on_device(np.where(moves, np.asarray(problem.prior.weight), weight).astype(mean.dtype)),
    )
    return eqx.tree_at(lambda p: p.prior, problem, held)
