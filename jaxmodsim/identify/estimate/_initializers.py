"""Initializers of a search: many starts in one batch, an easier problem first, or a few records at a time."""

import abc
import threading
from collections.abc import Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..._core.arguments import as_float, as_whole
from ..._core.arrays import on_device
from ..._core.speed import cores
from ._problem import FitProblem
from ._search import SearchOptions, SearchState, solve, start_search, steps_side_by_side

# Start of a search, and the root mean squares, in noise levels, at the ends of all trial starts, best first.
Initialized: TypeAlias = tuple[Float[Array, " n"], tuple[float, ...]]
# Number of searches in a compiled batch.
_GROUP = 32
# Share of the cost by which the fit from a smaller model must be better to be used.
_BETTER = 1e-3
# Rounds of several starts: share of the evaluations, and share of the starts kept after it.
_ROUNDS = ((0.25, 0.25), (0.25, 0.125), (1.0, 0.0))


def _whole(name: str, default: int) -> Any:
    """A field for a positive integer."""
    return eqx.field(static=True, default=default, converter=partial(as_whole, name=name))


def _factor(name: str, default: float) -> Any:
    """A field for a number above one."""
    return eqx.field(static=True, default=default, converter=partial(as_float, name=name, lower=1.0))


class AbstractInitializer(eqx.Module):
    """A method for the start of a search."""

    @abc.abstractmethod
    def initialize(self, problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> Initialized:
        """A better `x`, and the ends of all starts."""


def as_initializers(initializer: object) -> tuple[AbstractInitializer, ...]:
    """One initializer or several, as a tuple; anything else is refused."""
    several = (initializer,) if isinstance(initializer, AbstractInitializer) else initializer
    if not isinstance(several, tuple | list) or not all(isinstance(each, AbstractInitializer) for each in several):
        raise ValueError(
            f"initializer must be one such as Staged(), or several of them, but {initializer!r} was given."
        )
    return tuple(several)


def run_initializers(
    initializers: AbstractInitializer | Sequence[AbstractInitializer], problem: FitProblem, options: SearchOptions
) -> Initialized:
    """The start of the search by one initializer or several, each from the end of the previous one."""
    x, starts = problem.x0, ()
    for each in as_initializers(initializers):
        x, starts = each.initialize(problem, x, options)
    return x, tuple(starts)


class MultiStart(AbstractInitializer):
    """Many searches in one batch from starts around the current one; the best end is used.

    **Arguments:**

    - `count`: number of starts, the current one included, >= 1.
    - `spread`: largest factor or divisor of positive parameters, and of distances from limits, uniform in the
      logarithm, > 1. Parameters without limits are drawn within their own size around the start.
    - `steps`: limit of evaluations of each search.
    - `seed`: of the scrambled Sobol sequence of starts.

    **Raises:**

    - `ValueError` for a number out of range.
    """

    count: int = _whole("MultiStart count", 64)
    spread: float = _factor("MultiStart spread", 10.0)
    steps: int = _whole("MultiStart steps", 30)
    seed: int = eqx.field(static=True, default=0)

    def starts(self, problem: FitProblem, x: Float[Array, " n"]) -> Float[np.ndarray, "count n"]:
        """The starts, the first one at `x`."""
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

    def initialize(self, problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> Initialized:
        """Search from all starts; the best end, and the root mean squares of all ends in noise levels, best first.

        The worse starts are dropped after a few evaluations, in two rounds.
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
    """Continue many searches, for at most `steps` evaluations each; Ctrl-C ends all with the best so far.

    They run in groups of one size, which compile once, on one thread for each core, since a compiled loop over small
    states uses one core.

    **Arguments:**

    - `axes`: numbers of the problem that differ from search to search, as for `equinox.filter_vmap`; None for none.
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
            run(0, 1)  # compiles once, for all threads
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
    """Fit with a larger number first, and reduce it in stages, from a smooth problem to the stiff one.

    For the width of `Regularized`, over which friction changes its sign: a wide one makes the cost smooth, with few
    minima.

    **Arguments:**

    - `name`: name of the number, as `jaxmodsim.scene.scene_numbers` gives it: `"friction.width"`; it must not be free.
    - `factor`: of the number in the first fit, > 1.
    - `stages`: number of fits before the actual one, >= 1; the factor falls to 1 in equal ratios.

    **Raises:**

    - `ValueError` for a number out of range, or (at the fit) an unknown or a free name.
    """

    name: str = eqx.field(static=True)
    factor: float = _factor("Continuation factor", 100.0)
    stages: int = _whole("Continuation stages", 3)

    def initialize(self, problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> Initialized:
        """The end of the last fit before the actual one."""
        if self.name in problem.free.names:
            raise ValueError(f"Continuation in {self.name}, which is free: name a fixed number.")
        for stage in range(self.stages):
            factor = self.factor ** (1 - stage / self.stages)
            x = solve(problem.with_number(self.name, factor), x, options).state.x
        return x, ()


class FromSmaller(AbstractInitializer):
    """Search also from the fit of a model with fewer parameters, so that a larger model does not fit worse.

    The other parameters start at their own start values, or at their limit by another parameter, such as Fs = Fc, where
    they have no effect.

    - `values`: the fitted ones, by the last part of their names, as Fc in friction.Fc.
    """

    values: dict[str, Array]

    def initialize(self, problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> Initialized:
        """The best end."""
        size = len(problem.free.names)
        here = {name: self.values[last_part(name)] for name in problem.free.names if last_part(name) in self.values}
        over = np.asarray(problem.free.coordinates(problem.at(x).values | here))
        rest = np.array([name not in here and isinstance(problem.free[name].base, str) for name in problem.free.names])
        own = np.asarray(x)[size:]
        starts = [x, *(on_device(np.concatenate([each, own])) for each in (over, np.where(rest, 0.0, over)))]
        ends = [solve(problem, each, options).state for each in (starts if np.any(rest) else starts[:2])]
        costs = [float(np.nan_to_num(float(end.cost), nan=np.inf)) for end in ends]
        # Without a real gain, the end from the own start is the fit.
        best = int(np.argmin(costs))
        return ends[best if costs[best] < (1 - _BETTER) * costs[0] else 0].x, ()


def last_part(name: str) -> str:
    """Last part of the name of a number: Fc of friction.Fc."""
    return name.rsplit(".", 1)[-1]


class Stochastic(AbstractInitializer):
    """Stochastic gradient steps on a few runs at a time, for many records.

    Each step uses the gradient of the mean loss of `batch` runs, drawn without replacement until all are used, in the
    coordinates in which limits are bounds. The fit that follows uses all records; with `max_steps=1` it only evaluates
    them.

    **Arguments:**

    - `optimiser`: an `optax.GradientTransformation`, such as `optax.adam(0.05)`; coordinates are about 1 in size.
    - `batch`: number of runs in a step, >= 1.
    - `steps`: number of steps, >= 1.
    - `seed`: of the order of the runs.

    **Raises:**

    - `ValueError` for a number out of range, or (at the fit) linked windows, or a batch larger than the number of runs.
    """

    optimiser: Hashable = eqx.field(static=True)
    batch: int = _whole("Stochastic batch", 4)
    steps: int = _whole("Stochastic steps", 200)
    seed: int = eqx.field(static=True, default=0)

    def __check_init__(self) -> None:
        """Refuse other objects than optimisers."""
        if not (hasattr(self.optimiser, "init") and hasattr(self.optimiser, "update")):
            raise ValueError(f"optimiser must be one of optax, as optax.adam(0.05), but it is {self.optimiser!r}.")

    def initialize(self, problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> Initialized:
        """The end of the last step; Ctrl-C ends at the previous step."""
        if problem.jump is not None:
            raise ValueError(
                "Stochastic() needs independent runs: pass MultipleShooting without jump, or no Stochastic()."
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
                    shown = dict(zip(problem.free.names, problem.at(x).vector.tolist(), strict=True))
                    options.progress(number + 1, float(jnp.sqrt(2 * cost)), shown)
        except KeyboardInterrupt:
            pass  # the fit continues from here
        return x, ()


@eqx.filter_jit
def _gradient(problem: FitProblem, x: Float[Array, " n"], drawn: Array) -> tuple[Array, Array]:
    """Mean loss of the drawn runs per sample, and its gradient by all of x."""
    shared, own = problem.split(x)
    some = problem.of_runs(drawn)
    residual, jacobian = some.evaluate(jnp.concatenate([shared, jnp.reshape(own[drawn], (-1,))]))
    cost = problem.loss.cost(residual)
    residual, jacobian = problem.loss.weighted(residual, jacobian)
    slope, samples = jacobian.T @ residual, sum(map(jnp.sum, some.columns.values()))
    size = shared.shape[0]
    mine = jnp.zeros_like(own).at[drawn].set(jnp.reshape(slope[size:], (drawn.shape[0], own.shape[1])))
    return cost / samples, jnp.concatenate([slope[:size], jnp.reshape(mine, (-1,))]) / samples
