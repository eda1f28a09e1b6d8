"""The first samples of a record that was not fitted: they show where it starts, and do not count after that."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..data._record import Runs
from ..estimate._problem import FitProblem
from ..estimate._search import SearchOptions, SearchResult, SearchState, solve, start_search, step

# So many of the samples, and at least so many, show the state at the first one.
SHARE, LEAST = 0.05, 20


def opening(runs: Runs) -> Bool[np.ndarray, "runs samples"]:
    """The first samples of each run."""
    weight = np.max(np.stack([np.asarray(x) for x in runs.weight.values()]), axis=0)
    counts = np.maximum(np.ceil(SHARE * np.sum(weight > 0, axis=1)), LEAST)
    return np.arange(weight.shape[1])[None, :] < counts[:, None]


def counting(problem: FitProblem, mask: np.ndarray, slips: np.ndarray | None = None) -> FitProblem:
    """The problem in which only the samples in the mask count, and slip instants of the runs in `slips`.

    By default slip instants count in runs of which any sample does.
    """
    own = (np.any(mask, axis=1) if slips is None else slips)[:, None]
    runs = problem.runs._replace(
        weight={name: jnp.where(mask, weight, 0.0) for name, weight in problem.runs.weight.items()},
        slip_weight={name: jnp.where(own, weight, 0.0) for name, weight in problem.runs.slip_weight.items()},
    )
    return eqx.tree_at(lambda p: p.runs, problem, runs)


def begin(problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> SearchResult:
    """Search for the states at the first samples with these samples alone; parameters must be pinned or none."""
    return solve(counting(problem, opening(problem.runs), np.zeros(problem.count, bool)), x, options)


def after(problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> tuple[FitProblem, SearchState]:
    """The residual at `x` of the samples behind the first ones."""
    runs = np.any([np.any(np.asarray(x) > 0, axis=1) for x in problem.runs.weight.values()], axis=0)
    rest = counting(problem, ~opening(problem.runs), runs)
    # The first evaluation of a search, which has nothing to move by yet.
    return rest, step(rest, start_search(x, rest.rows), jnp.asarray(options.rtol, x.dtype))
