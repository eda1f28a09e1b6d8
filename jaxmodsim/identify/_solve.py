"""The search: iterations one by one, with what there is to see, and Ctrl-C keeping the best so far."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._bounded import Search, search_start, search_step
from ._covariance import Spread, block_numbers, spread
from ._problem import Problem

# Called after each iteration with its number, the root mean square of the residual and the parameters by name.
Progress: TypeAlias = Callable[[int, float, dict[str, float]], None]

# Noise levels that are estimated are estimated again until they settle.
_NOISE_ROUNDS, _NOISE_SETTLED = 6, 0.02


ENDINGS = {1: "converged", 2: "settled where the cost is no smoother than the steps of the model"}


@dataclass(frozen=True)
class Options:
    """How a search is run: relative tolerance, limit of iterations, who is told."""

    rtol: float = 1e-6
    max_steps: int = 100
    progress: Progress | None = None


@dataclass(frozen=True)
class Found:
    """Where a search ended: the problem with the noise levels it ended with, the last iterate, and how it ended."""

    problem: Problem
    search: Search
    iterations: int
    ending: str

    @property
    def converged(self) -> bool:
        """Whether it ended by itself."""
        return self.ending in ENDINGS.values()


@eqx.filter_jit
def step(problem: Problem, search: Search, rtol: Array) -> Search:
    """One iteration."""
    return search_step(problem.evaluate, problem.loss, problem.box, search, rtol)


@eqx.filter_jit
def steps_side_by_side(problem: Problem, axes: Any, searches: Search, rtol: Array) -> Search:
    """One iteration of many searches; `axes` says which numbers of the problem differ."""
    one = lambda problem, search: search_step(problem.evaluate, problem.loss, problem.box, search, rtol)  # noqa: E731
    moved = eqx.filter_vmap(one, in_axes=(axes, 0))(problem, searches)
    return jax.tree.map(lambda new, old: jnp.where(_beside(searches.done > 0, old), old, new), moved, searches)


def _beside(done: Array, like: Array) -> Array:
    return jnp.reshape(done, done.shape + (1,) * (like.ndim - 1))


def solve(problem: Problem, x: Float[Array, " n"], options: Options) -> Found:
    """Search from `x`.

    **Raises:**

    - `ValueError` if there are no more samples than free parameters.
    - `RuntimeError` if the model is not finite at the start.
    """
    counted, unknown = int(jnp.sum(problem.weights > 0)), x.shape[0]
    if counted <= unknown:
        raise ValueError(f"{counted} samples are too few for {unknown} free parameters.")
    rtol = jnp.asarray(options.rtol, x.dtype)
    search, best = search_start(x, problem.rows), None
    try:
        for iteration in range(1, options.max_steps + 1):
            search = step(problem, search, rtol)
            if iteration == 1 and not np.isfinite(float(search.cost)):
                raise RuntimeError(
                    "The model gives values that are not finite at the start of the fit: check the start values, or"
                    " take more substeps."
                )
            best = search
            if options.progress is not None:
                values = problem.free.values(problem.split(search.x)[0])
                shown = {name: float(values[name]) for name in problem.free.names}
                options.progress(iteration, _rms(problem, search), shown)
            if int(search.done):
                return Found(problem, search, int(search.steps), ENDINGS[int(search.done)])
    except KeyboardInterrupt:
        if best is None:
            raise  # nothing was computed yet
        return Found(problem, best, int(best.steps), "interrupted; these are the best values so far")
    return Found(problem, search, int(search.steps), f"stopped at the limit of {options.max_steps} iterations")


@eqx.filter_jit
def channels_seen(problem: Problem, x: Float[Array, " n"]) -> dict[str, Float[Array, "runs samples"]]:
    """What the model makes of each channel at `x`."""
    return problem.seen(x).channels


def _rms(problem: Problem, search: Search) -> float:
    """Root mean square of the residual: in the unit of the channel where there is one, in noise levels otherwise."""
    samples = np.asarray(search.residual)[: problem.samples]
    rms = float(np.sqrt(np.sum(samples**2) / max(float(jnp.sum(problem.weights)), 1.0)))
    return rms * float(next(iter(problem.noise.values()))) if len(problem.noise) == 1 else rms


def solve_with_noise(problem: Problem, x: Float[Array, " n"], options: Options, given: frozenset[str]) -> Found:
    """Search, then estimate the noise levels that were not `given` from what is left, until both settle.

    The maximum of the likelihood over parameters and unknown noise levels, one after the other. Where there is one
    channel and squares are summed, the level does not move the optimum.
    """
    found = solve(problem, x, options)
    if not set(problem.noise) - given:
        return found
    single = len(problem.noise) == 1 and not problem.loss.robust and float(jnp.max(problem.prior.weight)) == 0
    single = single and problem.jump is None
    for _ in range(_NOISE_ROUNDS):
        levels = estimated_noise(found, given)
        changes = [abs(float(levels[k] / found.problem.noise[k]) - 1) for k in levels]
        problem = eqx.tree_at(lambda p: p.noise, found.problem, levels)
        if single or found.ending.startswith("interrupted") or max(changes) < _NOISE_SETTLED:
            return _rescaled(found, problem)
        again = solve(problem, found.search.x, options)
        found = Found(problem, again.search, found.iterations + again.iterations, again.ending)
    return found


def estimated_noise(found: Found, given: frozenset[str]) -> dict[str, Array]:
    """Standard deviation of what is left of each channel; the median's, where a loss must not hear outliers."""
    problem, levels = found.problem, dict(found.problem.noise)
    for name, (residual, weight) in by_channel(problem, found.search.residual).items():
        if name in given:
            continue
        own = residual[weight > 0]
        size = 1.4826 * np.median(np.abs(own)) if problem.loss.robust else np.sqrt(np.mean(own**2))
        floor = 10 * float(jnp.finfo(levels[name].dtype).eps)  # of a model that is exact
        levels[name] = levels[name] * max(float(size), floor)
    return levels


def by_channel(problem: Problem, residual: Array) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Residual in noise levels and weight of each channel, shape `[runs, samples]`."""
    rows, split = np.asarray(residual)[: problem.samples].reshape(problem.count, -1), {}
    at = 0
    for name, weight in problem.columns.items():
        width = weight.shape[1]
        split[name] = rows[:, at : at + width], np.asarray(weight)
        at += width
    return split


def _rescaled(found: Found, problem: Problem) -> Found:
    """The same iterate in the noise levels of `problem`."""
    old = found.problem
    factors = [jnp.full(weight.shape, old.noise[name] / problem.noise[name]) for name, weight in old.columns.items()]
    factor = jnp.reshape(jnp.concatenate(factors, axis=1), (-1,))
    factor = jnp.concatenate([factor, jnp.ones(old.rows - old.samples, factor.dtype)])
    residual = found.search.residual * factor
    search = found.search._replace(
        residual=residual, jacobian=found.search.jacobian * factor[:, None], cost=old.loss.cost(residual)
    )
    return Found(problem, search, found.iterations, found.ending)


def spread_of(problem: Problem, search: Search, kept: int) -> Spread:
    """How sure the estimate is; the first `kept` entries of x are parameters, the others nuisance."""
    blocks, count = sample_blocks(problem)
    return _spread(problem, search, blocks, count, kept)


def sample_blocks(problem: Problem) -> tuple[Array, int]:
    """Block of each sample row, and the number of blocks."""
    weight = next(iter(problem.runs.weight.values()))
    numbers, count = block_numbers(weight, 1)
    time = np.asarray(numbers).reshape(problem.count, -1)
    parts = [time] * len(problem.runs.weight)
    for effect in sorted(problem.runs.slips):
        ts, instants = np.asarray(problem.runs.t), np.asarray(problem.runs.slips[effect])
        nearest = np.stack([np.searchsorted(t, own) for t, own in zip(ts, instants, strict=True)])
        parts.append(np.take_along_axis(time, np.minimum(nearest, time.shape[1] - 1), axis=1))
    return jnp.asarray(np.concatenate(parts, axis=1).reshape(-1)), count


@eqx.filter_jit
def _spread(problem: Problem, search: Search, blocks: Array, count: int, kept: int) -> Spread:
    return spread_inside(problem, search, blocks, count, kept)


def spread_inside(problem: Problem, search: Search, blocks: Array, count: int, kept: int) -> Spread:
    """`spread_of`, for compiled code."""
    rows, size = problem.samples, len(problem.free.names)
    residual, jacobian = problem.loss.weighted(search.residual[:rows], search.jacobian[:rows])
    slopes = jnp.eye(search.x.shape[0], dtype=search.x.dtype)
    slopes = slopes.at[:size, :size].set(problem.free.slopes(search.x[:size]))
    return spread(residual, jacobian, search.jacobian[rows:], slopes, blocks, count, kept)
