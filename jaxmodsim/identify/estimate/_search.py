"""Levenberg-Marquardt within bounds, one iteration per call, for one search or a batch of searches."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from ..._core.arrays import on_device
from ..data._record import Window
from ._problem import AbstractLoss, Box, FitProblem

# `x` -> residual and its Jacobian.
Evaluate: TypeAlias = Callable[[Float[Array, " n"]], tuple[Float[Array, " m"], Float[Array, "m n"]]]
# A step that changes the residual by less than this, in units of its rounding error, is lost in rounding.
_ROUNDING = 8.0
_LARGEST_DAMPING = 1e14
# Damping of the first step, and its factor after a rejected one.
_DAMPING, _GROWTH = 1e-3, 2.0
# The cost is flat to second order around its minimum, so its tolerance is smaller than that of the parameters.
_FLAT = 0.1
# Fixed steps through stick and slip leave small steps in the cost, on which a search never converges. It has settled
# after so many evaluations in a row that each lowered the cost by less than so many `rtol` of itself.
_PATIENCE, _SLOW = 8, 10.0
# Iterations after which a search restarts where it is: in a long curved valley its damping suits the last bend only.
_ROUND = 100
# Called after each iteration with its number, the root mean square of the residual and the parameters by name.
Progress: TypeAlias = Callable[[int, float, dict[str, float]], None]
# Noise levels are estimated up to so many times, until they change by less than this share.
_NOISE_ROUNDS, _NOISE_SETTLED = 6, 0.02
# Least mean slope of the influence of a robust loss.
_LEAST_SLOPE = 1e-3
ENDINGS = {1: "converged", 2: "settled where the cost is no smoother than the steps of the model"}


class SearchState(NamedTuple):
    """The state of a search.

    - `x`, `residual`, `jacobian`, `cost`: the best so far; the cost is half the sum of losses.
    - `damping`, `growth`: of the next step, and the factor of the damping after a rejected one.
    - `steps`: number of evaluations; `slow`: number of the last ones that changed the cost little.
    - `done`: 1 where it converged, 2 where it settled on a cost that is not smooth, else 0.
    """

    x: Float[Array, " n"]
    residual: Float[Array, " m"]
    jacobian: Float[Array, "m n"]
    cost: Float[Array, ""]
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    steps: Int[Array, ""]
    slow: Int[Array, ""]
    done: Int[Array, ""]


def start_search(x: Float[Array, " n"], rows: int) -> SearchState:
    """A new search, whose first iteration evaluates `x`."""
    cost, damping, growth = (on_device(np.asarray(each, x.dtype)) for each in (np.inf, _DAMPING, _GROWTH))
    residual = on_device(np.zeros(rows, x.dtype))
    jacobian = on_device(np.zeros((rows, x.shape[0]), x.dtype))
    none = on_device(0)
    return SearchState(x, residual, jacobian, cost, damping, growth, none, none, none)


def levenberg_marquardt_step(
    evaluate: Evaluate, loss: AbstractLoss, box: Box, state: SearchState, rtol: Float[Array, ""]
) -> SearchState:
    """One iteration: a trial point, which is accepted if it is better.

    Normal equations in columns of unit length; parameters on a bound that the gradient pushes outwards stay there,
    the others move and are clipped (Kanzow, Yamashita, Fukushima 2004, J. Comput. Appl. Math. 172:375). The damping
    follows Nielsen (1999, IMM-REP-1999-05). The search is done when the linear model promises to lower the cost by no
    more than a tenth of `rtol` and the trial does not do better, or when only rounding is left.
    """
    x, eps = state.x, jnp.finfo(state.x.dtype).eps
    r, jacobian = loss.weighted(state.residual, state.jacobian)
    gradient, matrix = jacobian.T @ r, jacobian.T @ jacobian
    size = jnp.sqrt(jnp.diagonal(matrix))
    size = jnp.where(size > 0, size, 1.0)
    held = ((x <= box.lower) & (gradient > 0)) | ((x >= box.upper) & (gradient < 0))
    moves = ~held
    normal = jnp.where(jnp.outer(moves, moves), matrix / jnp.outer(size, size), 0.0)
    normal = normal + jnp.diag(jnp.where(moves, state.damping, 1.0))
    step = -jnp.linalg.solve(normal, jnp.where(moves, gradient / size, 0.0)) / size
    trial = jnp.clip(x + jnp.clip(step, -box.longest, box.longest), box.lower, box.upper)
    step = trial - x

    residual, trial_jacobian = evaluate(trial)
    cost = loss.cost(residual)
    finite = jnp.isfinite(cost) & jnp.isfinite(trial_jacobian).all()
    first = state.steps == 0
    better = finite & (first | (cost < state.cost))

    predicted = -(gradient @ step + 0.5 * step @ matrix @ step)
    gain = jnp.where(predicted > 0, (state.cost - cost) / jnp.where(predicted > 0, predicted, 1.0), 0.0)
    gain = jnp.clip(jnp.where(jnp.isfinite(gain), gain, 0.0), -1.0, 2.0)
    shrink = jnp.maximum(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
    damping = jnp.where(better, state.damping * shrink, state.damping * state.growth)
    damping = jnp.where(first, state.damping, jnp.maximum(damping, eps))

    little = _FLAT * rtol * state.cost
    flat = (predicted >= 0) & (predicted <= little) & (~better | (state.cost - cost <= little))
    still = jnp.sqrt(step @ matrix @ step) <= _ROUNDING * eps * jnp.sqrt(2 * state.cost)
    converged = ~first & (flat | still | (damping > _LARGEST_DAMPING)) | (better & (cost == 0))
    fell = jnp.where(better, state.cost - cost, 0.0)
    slow = jnp.where(fell <= _SLOW * rtol * state.cost, state.slow + 1, 0)
    done = jnp.where(converged, 1, jnp.where(slow >= _PATIENCE, 2, 0))
    return SearchState(
        jnp.where(better, trial, x),
        jnp.where(better, residual, state.residual),
        jnp.where(better, trial_jacobian, state.jacobian),
        jnp.where(better, cost, state.cost),
        damping,
        jnp.where(better, _GROWTH, 2.0 * state.growth),
        state.steps + 1,
        slow,
        jnp.where(state.done > 0, state.done, done),
    )


@dataclass(frozen=True)
class SearchOptions:
    """Relative tolerance, limit of iterations, and progress function of a search."""

    rtol: float = 1e-6
    max_steps: int = 400
    progress: Progress | None = None


@dataclass(frozen=True)
class SearchResult:
    """The end of a search: the problem with its last noise levels, the best iterate, and the reason.

    - `windows`: of the records that are its runs; none until it is the search of a result.
    """

    problem: FitProblem
    state: SearchState
    iterations: int
    ending: str
    windows: tuple[Window, ...] = ()

    @property
    def residuals(self) -> dict[str, tuple[Float[np.ndarray, "runs samples"], Float[np.ndarray, "runs samples"]]]:
        """Residual in noise levels and weight of each channel."""
        return self.problem.by_channel(np.asarray(self.state.residual))

    @property
    def converged(self) -> bool:
        """Whether it ended before any limit."""
        return ended_by_itself(self.ending)


def ended_by_itself(ending: str) -> bool:
    """Whether an `ending` is that of a search that ended before any limit."""
    return ending.startswith(tuple(ENDINGS.values()))


def continued(ending: str, times: int, where: str) -> str:
    """An `ending` with the number of continuations, and where these started."""
    often = "once" if times == 1 else f"{times} times"
    return f"{ending}; continued {often} {where}" if times else ending


@eqx.filter_jit
def step(problem: FitProblem, state: SearchState, rtol: Array) -> SearchState:
    """One iteration."""
    return levenberg_marquardt_step(problem.evaluate, problem.loss, problem.box, state, rtol)


def state_at(problem: FitProblem, x: Float[Array, " n"]) -> SearchState:
    """Residual, Jacobian and cost at `x`, by the compiled program of a search, whose first step only evaluates x."""
    return step(problem, start_search(x, problem.rows), on_device(np.asarray(SearchOptions.rtol, x.dtype)))


@eqx.filter_jit
def steps_side_by_side(problem: FitProblem, axes: PyTree[int | None], states: SearchState, rtol: Array) -> SearchState:
    """One iteration of a batch of searches; `axes`: which numbers of the problem have a leading axis."""
    moved = eqx.filter_vmap(step, in_axes=(axes, 0, None))(problem, states, rtol)

    def keep(new: Array, old: Array) -> Array:
        done = jnp.reshape(states.done > 0, (-1,) + (1,) * (old.ndim - 1))
        return jnp.where(done, old, new)

    return jax.tree.map(keep, moved, states)


def solve(problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> SearchResult:
    """Search from `x`; the damping is reset after every hundred iterations.

    **Raises:**

    - `ValueError` if there are no more samples than free parameters.
    - `RuntimeError` if the model is not finite at the start.
    """
    counted = int(np.sum(problem.weights > 0)) + int(np.sum(np.asarray(problem.prior.weight) > 0))
    unknown = x.shape[0]
    if counted <= unknown:
        raise ValueError(
            f"{counted} samples are too few for {unknown} unknowns: free parameters and unknown initial states."
        )
    rtol = on_device(np.asarray(options.rtol, x.dtype))
    state, rounds = start_search(x, problem.rows), 0
    at = f"after {_ROUND} iterations each"
    try:
        for iteration in range(1, options.max_steps + 1):
            if iteration > 1 and iteration % _ROUND == 1:
                rounds += 1
                fresh = start_search(state.x, problem.rows)
                state = state._replace(damping=fresh.damping, growth=fresh.growth)
            state = step(problem, state, rtol)
            if iteration == 1 and not np.isfinite(float(state.cost)):
                raise RuntimeError(
                    "The model gives values that are not finite at the start of the fit: check the start values, or"
                    " take more substeps."
                )
            if options.progress is not None:
                shown = dict(zip(problem.free.names, problem.at(state.x).vector.tolist(), strict=True))
                options.progress(iteration, _rms(problem, state), shown)
            if int(state.done):
                return SearchResult(problem, state, int(state.steps), continued(ENDINGS[int(state.done)], rounds, at))
    except KeyboardInterrupt:
        if not np.isfinite(float(state.cost)):
            raise
        return SearchResult(problem, state, int(state.steps), "interrupted; these are the best values so far")
    ending = f"stopped at the limit of {options.max_steps} iterations (max_steps)"
    return SearchResult(problem, state, int(state.steps), continued(ending, rounds, at))


def finished(search: SearchResult) -> SearchResult:
    """A search that was not interrupted, and whose end is finite.

    **Raises:**

    - `KeyboardInterrupt` for an interrupted one, `RuntimeError` for values that are not finite.
    """
    if search.ending.startswith("interrupted"):
        raise KeyboardInterrupt
    if not np.isfinite(float(search.state.cost)):
        raise RuntimeError("The fit ended with values that are not finite.")
    return search


@eqx.filter_jit
def channels_seen(problem: FitProblem, x: Float[Array, " n"]) -> dict[str, Float[Array, "runs samples"]]:
    """Output of the model in each channel at `x`."""
    return problem.seen(x).channels


def linearised(problem: FitProblem, state: SearchState) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n"]]:
    """Residual and Jacobian of a search, whose products are the scores and the curvature of the cost.

    The curvature of a robust loss is the slope of its influence. The weights of the search are larger, as they bound
    that slope. All samples of a channel have the mean slope (Huber 1981, Robust Statistics, section 7.6).
    """
    residual, jacobian = np.asarray(state.residual), np.asarray(state.jacobian)
    if not problem.loss.robust:
        return residual, jacobian
    influence, slope = (np.asarray(each) for each in problem.loss.influence(state.residual))
    means = []
    for rows, weight in problem.by_channel(slope).values():
        mean = float(np.mean(rows[weight > 0])) if np.any(weight > 0) else 1.0
        means.append(np.full(weight.shape, max(mean, _LEAST_SLOPE)))
    factor = np.sqrt(np.concatenate(means, axis=1).reshape(-1)).astype(residual.dtype)
    rows = problem.samples
    # A prior and the other rows that are no samples are not robust here.
    return (
        np.concatenate([influence[:rows] / factor, residual[rows:]]),
        np.concatenate([jacobian[:rows] * factor[:, None], jacobian[rows:]]),
    )


def _rms(problem: FitProblem, state: SearchState) -> float:
    """Root mean square of the residual: in the unit of the channel where there is one, in noise levels otherwise."""
    samples = np.asarray(state.residual)[: problem.samples]
    rms = float(np.sqrt(np.sum(samples**2) / max(float(np.sum(problem.weights)), 1.0)))
    return rms * float(next(iter(problem.noise.values()))) if len(problem.noise) == 1 else rms


def solve_freed(
    problem: FitProblem, x: Float[Array, " n"], options: SearchOptions, known: frozenset[str]
) -> SearchResult:
    """`solve_with_noise`, after a search with the unreported starts held where they were measured."""
    first = solve(problem.held, x, options) if problem.nuisance else None
    if first is None or not first.converged:
        return first or solve_with_noise(problem, x, options, known)
    search = solve_with_noise(problem, first.state.x, options, known)
    return replace(search, iterations=first.iterations + search.iterations)


def solve_with_noise(
    problem: FitProblem, x: Float[Array, " n"], options: SearchOptions, known: frozenset[str]
) -> SearchResult:
    """Search, then estimate the noise levels that are not `known` from the residual, until both settle.

    This maximises the likelihood over parameters and noise levels in turn. For least squares with one channel the level
    does not move the optimum.
    """
    search = solve(problem, x, options)
    if not set(problem.noise) - known:
        return search
    single = (
        len(problem.noise) == 1 and not problem.loss.robust and float(np.max(np.asarray(problem.prior.weight))) == 0
    )
    single = single and problem.jump is None
    for _ in range(_NOISE_ROUNDS):
        levels = estimated_noise(search, known)
        changes = [abs(float(levels[k]) / float(search.problem.noise[k]) - 1) for k in levels]
        problem = eqx.tree_at(lambda p: p.noise, search.problem, levels)
        if single or search.ending.startswith("interrupted") or max(changes) < _NOISE_SETTLED:
            return _rescaled(search, problem)
        again = solve(problem, search.state.x, options)
        search = SearchResult(problem, again.state, search.iterations + again.iterations, again.ending)
    return search


def estimated_noise(search: SearchResult, known: frozenset[str]) -> dict[str, Array]:
    """Standard deviation of the residual of each channel; for a robust loss, from the median."""
    problem, levels = search.problem, dict(search.problem.noise)
    for name, (residual, weight) in search.residuals.items():
        if name in known:
            continue
        own = residual[weight > 0]
        size = 1.4826 * np.median(np.abs(own)) if problem.loss.robust else np.sqrt(np.mean(own**2))
        floor = 10 * float(jnp.finfo(levels[name].dtype).eps)  # of a model that is exact
        levels[name] = on_device(np.asarray(levels[name]) * np.asarray(max(float(size), floor), levels[name].dtype))
    return levels


def _rescaled(search: SearchResult, problem: FitProblem) -> SearchResult:
    """The same iterate in the noise levels of `problem`."""
    old = search.problem
    ratio = {name: np.asarray(level) / np.asarray(problem.noise[name]) for name, level in old.noise.items()}
    factors = [np.full(weight.shape, ratio[name]) for name, weight in old.columns.items()]
    factor = np.concatenate(factors, axis=1).reshape(-1)
    rest = np.ones(old.rows - old.samples, factor.dtype)
    before, now = old.start_weights, problem.start_weights
    if before is not None and now is not None and before.size:
        rest[-before.size :] = np.reshape(np.asarray(now) / np.where(before > 0, before, 1.0), -1)
    factor = np.concatenate([factor, rest])
    residual = on_device(np.asarray(search.state.residual) * factor)
    jacobian = on_device(np.asarray(search.state.jacobian) * factor[:, None])
    state = search.state._replace(residual=residual, jacobian=jacobian, cost=old.loss.cost(residual))
    return replace(search, problem=problem, state=state)
