"""Where a search starts: many starts side by side, an easier problem first, or a few records at a time."""

import abc
import threading
from collections.abc import Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..._core.device import on_device
from ..._core.speed import cores
from ._problem import FitProblem
from ._search import SearchOptions, SearchState, solve, start_search, steps_side_by_side

# Searches that are run as one.
_GROUP = 32
# Share of the cost by which the fit from a smaller model must be better to be taken.
_BETTER = 1e-3
# Rounds of several starts: share of the evaluations, and share of the starts that is kept after it.
_ROUNDS = ((0.25, 0.25), (0.25, 0.125), (1.0, 0.0))


class AbstractInitializer(eqx.Module):
    """How to find where a search starts."""

    @abc.abstractmethod
    def initialize(
        self, problem: FitProblem, x: Float[Array, " n"], options: SearchOptions
    ) -> tuple[Float[Array, " n"], tuple[float, ...]]:
        """A better `x`, and the root mean squares, in noise levels, of all starts that were tried, best first."""


def as_initializers(initializer: object) -> tuple[AbstractInitializer, ...]:
    """One initializer or several, as a tuple.

    **Raises:**

    - `ValueError` for anything else.
    """
    several = (initializer,) if isinstance(initializer, AbstractInitializer) else initializer
    if not isinstance(several, tuple | list) or not all(isinstance(each, AbstractInitializer) for each in several):
        raise ValueError(
            f"initializer must be one such as Staged(), or several of them, but {initializer!r} was given."
        )
    return tuple(several)


def run_initializers(
    initializers: AbstractInitializer | Sequence[AbstractInitializer], problem: FitProblem, options: SearchOptions
) -> tuple[Float[Array, " n"], tuple[float, ...]]:
    """Where the search starts after one initializer or several, each from where the one before it ended."""
    x, starts = problem.x0, ()
    for each in as_initializers(initializers):
        x, starts = each.initialize(problem, x, options)
    return x, tuple(starts)


class MultiStart(AbstractInitializer):
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

    def starts(self, problem: FitProblem, x: Float[Array, " n"]) -> Float[np.ndarray, "count n"]:
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
            elif kind in ("above", "ratio"):
                drawn[:, i] = (here[i] or 1.0) * factor[:, i]
            else:
                drawn[:, i] = here[i] + (abs(here[i]) or 1.0) * away[:, i]
        drawn = np.clip(drawn, lower, upper)
        drawn[0] = here
        return np.concatenate([drawn, np.broadcast_to(np.asarray(x[size:]), (self.count, x.shape[0] - size))], axis=1)

    def initialize(
        self, problem: FitProblem, x: Float[Array, " n"], options: SearchOptions
    ) -> tuple[Float[Array, " n"], tuple[float, ...]]:
        """Search from all starts; the best end, and the root mean squares of all ends in noise levels, best first.

        After a few evaluations the worse ones are given up, in two rounds.
        """
        state = starts_of(problem, jnp.asarray(self.starts(problem, x)))
        ends: list[np.ndarray] = []
        for share, kept in _ROUNDS:
            steps = max(round(self.steps * share), 1)
            state = side_by_side(problem, None, state, options, steps)
            order = np.argsort(np.where(np.isfinite(state.cost), state.cost, np.inf))
            going = max(round(kept * self.count), 1)
            ends.append(np.asarray(state.cost)[order[going:]])
            state = jtu.tree_map(lambda x, best=order[:going]: x[best], state)
        cost = np.concatenate([np.asarray(state.cost), *ends])
        rms = np.sort(np.sqrt(2 * cost / float(jnp.sum(problem.weights > 0))))
        return state.x[0], tuple(rms.tolist())


def side_by_side(
    problem: FitProblem, axes: PyTree[int | None], state: SearchState, options: SearchOptions, steps: int
) -> SearchState:
    """Go on with many searches, for at most so many evaluations each; Ctrl-C ends all with the best so far.

    They go in groups of one size, shared out among threads, one for each core: a compiled loop over small states uses
    one core, and groups of one size compile once.

    **Arguments:**

    - `axes`: which numbers of the problem differ from search to search, as for `equinox.filter_vmap`; None for none.
    - `state`: with a leading axis of searches.
    """
    searches = state.x.shape[0]
    rtol = jnp.asarray(options.rtol, state.x.dtype)
    problems, states = [], []
    for first in range(0, searches, _GROUP):
        rows = jnp.minimum(jnp.arange(first, first + _GROUP), searches - 1)
        problems.append(problem if axes is None else problem_at(problem, axes, rows))
        states.append(jtu.tree_map(lambda x, rows=rows: x[rows], state))
    stopped = threading.Event()

    def run(group: int, count: int) -> None:
        for _ in range(count):
            if stopped.is_set() or bool(jnp.all(states[group].done > 0)):
                return
            states[group] = steps_side_by_side(problems[group], axes, states[group], rtol)

    with ThreadPoolExecutor(cores()) as pool:
        try:
            run(0, 1)  # compiles; the others find it done
            list(pool.map(run, range(len(states)), [steps - 1, *(steps for _ in states[1:])]))
        except KeyboardInterrupt:
            stopped.set()
            if not np.isfinite(np.concatenate([np.asarray(each.cost) for each in states])).any():
                raise
    return jtu.tree_map(lambda *x: jnp.concatenate(x)[:searches], *states)


def starts_of(problem: FitProblem, x: Float[Array, "starts n"]) -> SearchState:
    """Searches that start at the rows of `x`."""
    return eqx.filter_vmap(lambda x: start_search(x, problem.rows))(x)


def problem_at(problem: FitProblem, axes: PyTree[int | None], rows: Array | int) -> FitProblem:
    """The problem of some of the searches, or of one."""
    return jtu.tree_map(
        lambda axis, leaf: leaf if axis is None else leaf[rows], axes, problem, is_leaf=lambda x: x is None
    )


class Continuation(AbstractInitializer):
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

    def initialize(
        self, problem: FitProblem, x: Float[Array, " n"], options: SearchOptions
    ) -> tuple[Float[Array, " n"], tuple[float, ...]]:
        """Where the last but one of the fits ended."""
        if self.name in problem.free.names:
            raise ValueError(f"Continuation in {self.name}: a number that is free cannot be given.")
        for stage in range(self.stages):
            factor = self.factor ** (1 - stage / self.stages)
            x = solve(problem.with_number(self.name, factor), x, options).state.x
        return x, ()


class FromSmaller(AbstractInitializer):
    """Search also from where a model with fewer parameters ended, so that one with more is not left behind it.

    Its parameters are taken over, and the others start as they were given; or at their limit by another one, as
    Fs = Fc, where they have no effect and the model is the smaller one.

    - `values`: those that were fitted, by the last part of their names, as Fc in friction.Fc.
    """

    values: dict[str, Array]

    def initialize(
        self, problem: FitProblem, x: Float[Array, " n"], options: SearchOptions
    ) -> tuple[Float[Array, " n"], tuple[float, ...]]:
        """The best of the ends."""
        size = len(problem.free.names)
        here = {name: self.values[last_part(name)] for name in problem.free.names if last_part(name) in self.values}
        over = np.asarray(problem.free.coordinates(problem.at(x).values | here))
        rest = np.array([name not in here and isinstance(problem.free[name].base, str) for name in problem.free.names])
        own = np.asarray(x)[size:]
        starts = [x, *(on_device(np.concatenate([each, own])) for each in (over, np.where(rest, 0.0, over)))]
        ends = [solve(problem, each, options).state for each in (starts if np.any(rest) else starts[:2])]
        costs = [float(np.nan_to_num(float(end.cost), nan=np.inf)) for end in ends]
        # An end that is no better is the same fit, which is then the one without the smaller model.
        best = int(np.argmin(costs))
        return ends[best if costs[best] < (1 - _BETTER) * costs[0] else 0].x, ()


def last_part(name: str) -> str:
    """Of the name of a number: Fc of friction.Fc."""
    return name.rsplit(".", 1)[-1]


class Stochastic(AbstractInitializer):
    """Gradient steps on a few runs at a time, for more records than one would run in every iteration.

    Each step takes the gradient of the mean loss of `batch` runs, drawn without replacement until all have had their
    turn, in the coordinates in which limits are bounds. The fit that follows uses all records; with `max_steps=1` it
    only evaluates them.

    **Arguments:**

    - `optimiser`: an `optax.GradientTransformation`, such as `optax.adam(0.05)`; coordinates are about 1 in size.
    - `batch`: number of runs in a step, >= 1.
    - `steps`: number of steps, >= 1.
    - `seed`: of the order of the runs.

    **Raises:**

    - `ValueError` for a number out of range, or (at the fit) windows that are linked, or more runs in a batch than
      there are.
    """

    optimiser: Hashable = eqx.field(static=True)
    batch: int = eqx.field(static=True, default=4)
    steps: int = eqx.field(static=True, default=200)
    seed: int = eqx.field(static=True, default=0)

    def __check_init__(self) -> None:
        """Refuse what is no optimiser, and numbers out of range."""
        if not (hasattr(self.optimiser, "init") and hasattr(self.optimiser, "update")):
            raise ValueError(f"optimiser must be one of optax, as optax.adam(0.05), but it is {self.optimiser!r}.")
        if self.batch < 1 or self.steps < 1:
            raise ValueError(f"Stochastic needs batch >= 1 and steps >= 1, but they are {self.batch} and {self.steps}.")

    def initialize(
        self, problem: FitProblem, x: Float[Array, " n"], options: SearchOptions
    ) -> tuple[Float[Array, " n"], tuple[float, ...]]:
        """Where the last step ended; Ctrl-C ends at the step before."""
        if problem.jump is not None:
            raise ValueError(
                "Stochastic() draws runs by themselves: give MultipleShooting no jump, or leave Stochastic out."
            )
        if self.batch > problem.count:
            raise ValueError(f"Stochastic() draws {self.batch} runs at a time, but there are {problem.count}.")
        rng, box = np.random.default_rng(self.seed), problem.box
        optimiser: Any = self.optimiser
        state, order = optimiser.init(x), np.zeros(0, int)
        try:
            for number in range(self.steps):
                if order.size < self.batch:
                    order = np.concatenate([order, rng.permutation(problem.count)])
                drawn, order = jnp.asarray(order[: self.batch]), order[self.batch :]
                cost, gradient = _gradient(problem, x, drawn)
                if not bool(jnp.isfinite(cost)):
                    raise RuntimeError(f"The loss is not finite in step {number + 1}: take a smaller learning rate.")
                update, state = optimiser.update(gradient, state, x)
                x = jnp.clip(x + update, box.lower, box.upper)
                if options.progress is not None:
                    values = problem.free.values(problem.split(x)[0])
                    shown = {name: float(values[name]) for name in problem.free.names}
                    options.progress(number + 1, float(jnp.sqrt(2 * cost)), shown)
        except KeyboardInterrupt:
            pass  # the fit that follows goes on from here, and may be interrupted itself
        return x, ()


@eqx.filter_jit
def _gradient(problem: FitProblem, x: Float[Array, " n"], drawn: Array) -> tuple[Array, Array]:
    """Mean loss of a sample of these runs, and its gradient by all of x."""
    shared, own = problem.split(x)
    some = eqx.tree_at(
        lambda p: (p.base, p.runs, p.known),
        problem,
        jtu.tree_map(lambda leaf: leaf[drawn], (problem.base, problem.runs, problem.known)),
        is_leaf=lambda leaf: leaf is None,
    )
    residual, jacobian = some.evaluate(jnp.concatenate([shared, jnp.reshape(own[drawn], (-1,))]))
    cost = problem.loss.cost(residual)
    residual, jacobian = problem.loss.weighted(residual, jacobian)
    slope, samples = jacobian.T @ residual, sum(map(jnp.sum, some.columns.values()))
    size = shared.shape[0]
    mine = jnp.zeros_like(own).at[drawn].set(jnp.reshape(slope[size:], (drawn.shape[0], own.shape[1])))
    return cost / samples, jnp.concatenate([slope[:size], jnp.reshape(mine, (-1,))]) / samples
