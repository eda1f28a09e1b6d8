"""Where a search begins: many starts side by side, or an easier problem first."""

import abc
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._core.speed import cores
from ._bounded import Search, search_start
from ._problem import Problem
from ._solve import Options, solve, steps_side_by_side

# Lanes that are run as one.
_GROUP = 32

# Shares of the evaluations after which the worse starts are given up.
_FIRST, _SECOND = 0.25, 0.25


class AbstractBeginning(eqx.Module):
    """How to find where a search begins."""

    @abc.abstractmethod
    def begin(
        self, problem: Problem, x: Float[Array, " n"], options: Options
    ) -> tuple[Float[Array, " n"], tuple[float, ...]]:
        """A better `x`, and the root mean squares, in noise levels, of all starts that were tried, best first."""


def begin_all(
    begin: AbstractBeginning | Sequence[AbstractBeginning],
    problem: Problem,
    options: Options,
) -> tuple[Float[Array, " n"], tuple[float, ...]]:
    """Where the search begins after one beginning or several, each from where the one before it ended."""
    x, starts = problem.x0, ()
    for each in (begin,) if isinstance(begin, AbstractBeginning) else begin:
        x, starts = each.begin(problem, x, options)
    return x, tuple(starts)


class MultiStart(AbstractBeginning):
    """Many searches side by side from starts that cover the neighbourhood of the given one; the best is taken.

    **Arguments:**

    - `count`: number of starts, the given one among them, >= 1.
    - `spread`: factor by which parameters that must be positive, and distances from limits, are drawn larger or smaller
      than they start, uniformly in the logarithm, > 1. Parameters without limits are drawn within their own size of
      where they start.
    - `steps`: limit of evaluations of each search.
    - `seed`: of the scrambled Sobol sequence that the starts are drawn from.

    **Raises:**

    - `ValueError` for a number out of range.
    """

    count: int = eqx.field(static=True, default=64)
    spread: float = eqx.field(static=True, default=10.0)
    steps: int = eqx.field(static=True, default=30)
    seed: int = eqx.field(static=True, default=0)

    def __check_init__(self) -> None:
        """Refuse numbers out of range."""
        if self.count < 1 or self.steps < 1 or not self.spread > 1:
            raise ValueError(
                f"MultiStart needs count >= 1, steps >= 1 and spread > 1, but they are {self.count}, {self.steps} and"
                f" {self.spread}."
            )

    def starts(self, problem: Problem, x: Float[Array, " n"]) -> Float[np.ndarray, "count n"]:
        """Where the searches start; the first one at `x`."""
        from scipy.stats import qmc  # most of a second to import, and only needed here

        size = len(problem.free.names)
        points = qmc.Sobol(size, rng=self.seed).random(1 << max(self.count - 1, 1).bit_length())[: self.count]
        away = 2 * points - 1  # -1 to 1
        here = np.asarray(x[:size])
        lower, upper = (np.asarray(each) for each in problem.free.bounds)
        factor = self.spread**away
        drawn = np.empty_like(away)
        for i, kind in enumerate(problem.free.kinds):
            if kind == "log":
                drawn[:, i] = here[i] + np.log(factor[:, i])
            elif kind == "above":
                drawn[:, i] = (here[i] or 1.0) * factor[:, i]
            else:
                drawn[:, i] = here[i] + (abs(here[i]) or 1.0) * away[:, i]
        drawn = np.clip(drawn, lower, upper)
        drawn[0] = here
        return np.concatenate([drawn, np.broadcast_to(np.asarray(x[size:]), (self.count, x.shape[0] - size))], axis=1)

    def begin(
        self, problem: Problem, x: Float[Array, " n"], options: Options
    ) -> tuple[Float[Array, " n"], tuple[float, ...]]:
        """Search from all starts; the best end, and the root mean squares of all ends in noise levels, best first.

        After a few evaluations the worse ones are given up, in two rounds.
        """
        search = starts_of(problem, jnp.asarray(self.starts(problem, x)))
        ends: list[np.ndarray] = []
        for share, kept in ((_FIRST, 0.25), (_SECOND, 0.125), (1.0, 0.0)):
            steps = max(round(self.steps * share), 1)
            search = side_by_side(problem, None, search, options, steps)
            order = np.argsort(np.where(np.isfinite(search.cost), search.cost, np.inf))
            going = max(round(kept * self.count), 1)
            ends.append(np.asarray(search.cost)[order[going:]])
            search = jtu.tree_map(lambda x, best=order[:going]: x[best], search)
        cost = np.concatenate([np.asarray(search.cost), *ends])
        rms = np.sort(np.sqrt(2 * cost / float(jnp.sum(problem.weights > 0))))
        return search.x[0], tuple(rms.tolist())


def side_by_side(problem: Problem, axes: Any, search: Search, options: Options, steps: int) -> Search:
    """Go on with many searches, for at most so many evaluations each; Ctrl-C ends all with the best so far.

    Lanes go in groups of one size, shared out among threads, one for each core: a compiled loop over small states uses
    one core, and groups of one size compile once.

    **Arguments:**

    - `axes`: which numbers of the problem differ from lane to lane, as for `equinox.filter_vmap`; None for none.
    - `search`: with a leading axis of lanes.
    """
    lanes = search.x.shape[0]
    rtol = jnp.asarray(options.rtol, search.x.dtype)
    groups = []
    for first in range(0, lanes, _GROUP):
        rows = jnp.minimum(jnp.arange(first, first + _GROUP), lanes - 1)
        own = problem if axes is None else chosen_lanes(problem, axes, rows)
        groups.append([own, jtu.tree_map(lambda x, rows=rows: x[rows], search)])
    stopped = threading.Event()

    def run(group: list[Any], count: int) -> None:
        for _ in range(count):
            if stopped.is_set() or bool(jnp.all(group[1].done > 0)):
                return
            group[1] = steps_side_by_side(group[0], axes, group[1], rtol)

    with ThreadPoolExecutor(cores()) as pool:
        try:
            run(groups[0], 1)  # compiles; the others find it done
            list(pool.map(run, groups, [steps - 1, *(steps for _ in groups[1:])]))
        except KeyboardInterrupt:
            stopped.set()
            if not np.isfinite(np.concatenate([np.asarray(group[1].cost) for group in groups])).any():
                raise
    return jtu.tree_map(lambda *x: jnp.concatenate(x)[:lanes], *(group[1] for group in groups))


def starts_of(problem: Problem, x: Float[Array, "lanes n"]) -> Search:
    """Searches that start at the rows of `x`."""
    return eqx.filter_vmap(lambda x: search_start(x, problem.rows))(x)


def chosen_lanes(problem: Problem, axes: Any, rows: Array | int) -> Problem:
    """The problem of some of the lanes, or of one."""
    return jtu.tree_map(
        lambda axis, leaf: leaf if axis is None else leaf[rows], axes, problem, is_leaf=lambda x: x is None
    )


class Continuation(AbstractBeginning):
    """Fit with a larger number first, and bring it down: what is stiff or sharp becomes so little by little.

    Made for the width of `Regularized`, over which friction changes its sign: wide, the cost is smooth and has few
    minima.

    **Arguments:**

    - `name`: name of the number, as `jaxmodsim.scene.scene_numbers` gives it: `"friction.width"`; it must not be free.
    - `factor`: how many times larger it is at first, > 1.
    - `stages`: number of fits before the one asked for, >= 1; the factor falls to 1 in equal ratios.

    **Raises:**

    - `ValueError` for a number out of range, or (at the fit) a name that the scene has not, or that is free.
    """

    name: str = eqx.field(static=True)
    factor: float = eqx.field(static=True, default=100.0)
    stages: int = eqx.field(static=True, default=3)

    def __check_init__(self) -> None:
        """Refuse numbers out of range."""
        if self.stages < 1 or not self.factor > 1:
            raise ValueError(
                f"Continuation needs stages >= 1 and factor > 1, but they are {self.stages} and {self.factor}."
            )

    def begin(
        self, problem: Problem, x: Float[Array, " n"], options: Options
    ) -> tuple[Float[Array, " n"], tuple[float, ...]]:
        """Where the last but one of the fits ended."""
        if self.name in problem.free.names:
            raise ValueError(f"Continuation in {self.name}: a number that is free cannot be given.")
        for stage in range(self.stages):
            factor = self.factor ** (1 - stage / self.stages)
            x = solve(problem.with_number(self.name, factor), x, options).search.x
        return x, ()
