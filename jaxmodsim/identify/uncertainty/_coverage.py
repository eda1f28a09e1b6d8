"""Whether intervals keep their promise: the same fit of many synthetic records whose truth is known."""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Float

from ..estimate._initializers import AbstractInitializer, problem_at, run_initializers, side_by_side, starts_of
from ..estimate._problem import FitProblem
from ..estimate._search import SearchOptions, SearchState
from ._estimate import covariance_of, interval
from ._result import FitResult


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """How often intervals held the truth.

    - `level`: what was promised; `shares`: what was seen, by name.
    - `truth`: by name. `values`, `errors`: of every repeat, shape `[repeats]`, by name.
    - `converged`: number of repeats whose search ended by itself.
    """

    level: float
    shares: dict[str, float]
    truth: dict[str, float]
    values: dict[str, Float[np.ndarray, " repeats"]]
    errors: dict[str, Float[np.ndarray, " repeats"]]
    converged: int

    def __str__(self) -> str:
        """A table."""
        width = max(len(name) for name in self.shares)
        repeats = len(next(iter(self.values.values())))
        lines = [f"{'':{width}}  {'truth':>12}  {'scatter':>10}  {'std. error':>10}  covered"]
        for name, share in self.shares.items():
            # Half the width that holds 68 %: a repeat that went astray shows in the share that is covered.
            low, high = np.quantile(self.values[name], [0.1587, 0.8413])
            scatter, error = 0.5 * (high - low), np.median(self.errors[name])
            lines.append(f"{name:{width}}  {self.truth[name]:12.5g}  {scatter:10.2g}  {error:10.2g}  {share:7.1%}")
        return "\n".join([*lines, f"{repeats} repeats, {self.converged} converged; promised {self.level:.0%}"])


def coverage(
    result: FitResult,
    repeats: int = 200,
    *,
    level: float = 0.95,
    memory: float = 0.0,
    initializer: AbstractInitializer | Sequence[AbstractInitializer] = (),
    steps: int = 60,
    seed: int = 0,
) -> Coverage:
    """Repeat a fit on synthetic records: its own output as the truth, with new noise of the estimated level.

    Every repeat starts where the fit itself started, and all of them run side by side.

    **Arguments:**

    - `result`: a fit with one channel, not loaded from a file.
    - `repeats`: number of records, >= 2.
    - `level`: of the intervals, between 0 and 1.
    - `memory`: correlation of the noise from one sample to the next, >= 0 and < 1; 0 is white noise.
    - `initializer`: how each repeat finds where its search starts; see `fit`.
    - `steps`: limit of evaluations of each repeat.
    - `seed`: of the noise.

    **Returns:**

    A `Coverage`.

    **Raises:**

    - `ValueError` for a result that was loaded, for several channels, or numbers out of range.
    """
    if result.search is None:
        raise ValueError("coverage fits again, which a result loaded from a file cannot: fit, then ask it.")
    problem = result.search.problem
    if len(problem.noise) > 1:
        raise ValueError("coverage knows one channel; the fit has several.")
    if repeats < 2 or not 0 <= memory < 1:
        raise ValueError(f"repeats must be >= 2 and memory in [0, 1), but they are {repeats} and {memory}.")
    name = next(iter(problem.noise))
    rng = np.random.default_rng(seed)
    seen = np.asarray(jnp.reshape(result.search.state.residual[: problem.samples], (problem.count, -1)))
    truth = np.asarray(problem.runs.measured[name]) + float(problem.noise[name]) * seen
    noise = float(problem.noise[name]) * _correlated(rng.standard_normal((repeats, *truth.shape)), memory)
    several = eqx.tree_at(lambda p: p.runs.measured[name], problem, jnp.asarray(truth + noise))
    # A problem with nothing but the measured samples different from repeat to repeat.
    axes = eqx.tree_at(
        lambda p: p.runs.measured[name], jtu.tree_map(lambda _: None, problem), 0, is_leaf=lambda x: x is None
    )
    options = SearchOptions(max_steps=steps)
    starts = []
    for measured in truth + noise:
        one = eqx.tree_at(lambda p: p.runs.measured[name], problem, jnp.asarray(measured))
        starts.append(run_initializers(initializer, one.held, options)[0])
    x = jnp.stack(starts)
    if problem.nuisance:
        x = side_by_side(several.held, axes, starts_of(problem, x), options, steps).x
    state = side_by_side(several, axes, starts_of(problem, x), options, steps)
    values, errors = _estimates(several, axes, state)
    names, estimate = problem.free.names, result.estimate
    shares = {}
    for k, each in enumerate(names):
        true, log = estimate.values[each], each in estimate.logarithmic
        limits = [estimate.bounds[each]] * repeats
        spans = [interval(v, e, b, log, level) for v, e, b in zip(values[:, k], errors[:, k], limits, strict=True)]
        shares[each] = float(np.mean([low <= true <= high for low, high in spans]))
    return Coverage(
        level=level,
        shares=shares,
        truth={each: estimate.values[each] for each in names},
        values={each: values[:, k] for k, each in enumerate(names)},
        errors={each: errors[:, k] for k, each in enumerate(names)},
        converged=int(np.sum(np.asarray(state.done) > 0)),
    )


def _correlated(white: np.ndarray, memory: float) -> np.ndarray:
    """Noise of variance one whose neighbours have the correlation `memory`, along the last axis."""
    from scipy import signal  # most of a second to import, and only needed here

    driving = np.sqrt(1 - memory**2) * white
    driving[..., 0] = white[..., 0]
    return np.asarray(signal.lfilter([1.0], [1.0, -memory], driving))


def _estimates(problem: FitProblem, axes: FitProblem, state: SearchState) -> tuple[np.ndarray, np.ndarray]:
    """Parameters and standard errors of every repeat, shape `[repeats, free]`."""
    states, values, errors = jtu.tree_map(np.asarray, state), [], []
    for i in range(state.x.shape[0]):
        one, here = problem_at(problem, axes, i), jtu.tree_map(lambda x, i=i: x[i], states)
        values.append(problem.at(here.x).vector)
        errors.append(np.sqrt(np.diagonal(covariance_of(one, here, range(len(problem.free.names))).covariance)))
    return np.stack(values), np.stack(errors)
