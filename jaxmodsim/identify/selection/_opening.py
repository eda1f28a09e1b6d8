"""The first samples of a record that was not fitted: they show where it starts, and do not count after that."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..data._record import Runs
from ..estimate._problem import FitProblem
from ..estimate._search import SearchOptions, SearchResult, SearchState, solve, start_search, step

# So many of the samples, and at least so many, show the state at the first one.
SHARE, LEAST = 0.05, 20


def sample_counts(runs: Runs) -> Int[np.ndarray, "runs 1"]:
    """Number of the samples of each run that count in any channel."""
    return np.sum(np.any([np.asarray(x) > 0 for x in runs.weight.values()], axis=0), axis=1, keepdims=True)


def opening(runs: Runs) -> Bool[np.ndarray, "runs samples"]:
    """The first samples of each run."""
    return np.arange(runs.t.shape[1]) < np.maximum(np.ceil(SHARE * sample_counts(runs)), LEAST)


def counting(problem: FitProblem, mask: np.ndarray, *, slips: bool = True) -> FitProblem:
    """The problem in which only the samples in the mask count, and with `slips` slip instants of runs that have any."""
    own = np.any(mask, axis=1, keepdims=True) & slips
    runs = problem.runs._replace(
        weight={name: jnp.where(mask, weight, 0.0) for name, weight in problem.runs.weight.items()},
        slip_weight={name: jnp.where(own, weight, 0.0) for name, weight in problem.runs.slip_weight.items()},
    )
    return eqx.tree_at(lambda p: p.runs, problem, runs)


def begin(problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> SearchResult:
    """Search for the states at the first samples with these samples alone; parameters must be pinned or none."""
    return solve(counting(problem, opening(problem.runs), slips=False), x, options)


def after(problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> tuple[FitProblem, SearchState]:
    """The residual at `x` of the samples behind the first ones."""
    rest = counting(problem, ~opening(problem.runs))
    # The first evaluation of a search, which has nothing to move by yet.
    return rest, step(rest, start_search(x, rest.rows), jnp.asarray(options.rtol, x.dtype))
