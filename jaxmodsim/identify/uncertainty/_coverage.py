"""Coverage of confidence intervals: the same fit of many synthetic records whose truth is known."""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Float

from ..._core.arguments import as_share, as_whole
from ..._core.readable import AbstractReadable, Table, table_of
from ..estimate._initializers import AbstractInitializer, problem_at, run_initializers, side_by_side, starts_of
from ..estimate._search import SearchOptions
from ._estimate import covariance_of, interval
from ._result import FitResult


@dataclass(frozen=True, kw_only=True)
class Coverage(AbstractReadable):
    """The share of confidence intervals that hold the truth.

    - `level`: of the intervals; `shares`: of the repeats whose interval holds the truth, by name.
    - `truth`: by name. `values`, `errors`: of every repeat, shape `[repeats]`, by name.
    - `converged`: number of repeats whose search converged.
    """

    level: float
    shares: dict[str, float]
    truth: dict[str, float]
    values: dict[str, Float[np.ndarray, " repeats"]]
    errors: dict[str, Float[np.ndarray, " repeats"]]
    converged: int


@table_of.register
def _(coverage: Coverage) -> Table:
    rows = []
    for name, share in coverage.shares.items():
        # Half the width that holds 68 %: insensitive to single repeats that failed, which the share counts.
        low, high = np.quantile(coverage.values[name], [0.1587, 0.8413])
        error = np.median(coverage.errors[name])
        rows.append((name, f"{coverage.truth[name]:.5g}", f"{0.5 * (high - low):.2g}", f"{error:.2g}", f"{share:.1%}"))
    repeats = len(next(iter(coverage.values.values())))
    title = f"{repeats} repeats, {coverage.converged} converged; nominal coverage {coverage.level:.0%}"
    return Table(title, ("parameter", "truth", "scatter", "standard error", "covered"), rows)


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

    Every repeat starts where the fit itself started, and all of them run in one batch.

    **Arguments:**

    - `result`: a fit with one channel, not loaded from a file.
    - `repeats`: number of records, >= 2.
    - `level`: of the intervals, between 0 and 1.
    - `memory`: correlation of the noise from one sample to the next, >= 0 and < 1; 0 is white noise.
    - `initializer`: of each repeat; see `fit`.
    - `steps`: limit of evaluations of each repeat.
    - `seed`: of the noise.

    **Returns:**

    A `Coverage`.

    **Raises:**

    - `ValueError` for a result that was loaded, for several channels, or numbers out of range.
    """
    search = result.search_for("Coverage")
    problem, repeats, level = search.problem, as_whole(repeats, name="repeats", least=2), as_share(level, name="level")
    if len(problem.noise) > 1:
        raise ValueError(f"coverage needs a fit with one channel, but it has {len(problem.noise)}.")
    if not 0 <= memory < 1:
        raise ValueError(f"memory must be >= 0 and < 1, but it is {memory!r}.")
    name = next(iter(problem.noise))
    rng = np.random.default_rng(seed)
    residual = np.asarray(jnp.reshape(search.state.residual[: problem.samples], (problem.count, -1)))
    truth = np.asarray(problem.runs.measured[name]) + float(problem.noise[name]) * residual
    noise = float(problem.noise[name]) * _correlated(rng.standard_normal((repeats, *truth.shape)), memory)
    several = eqx.tree_at(lambda p: p.runs.measured[name], problem, jnp.asarray(truth + noise))
    # Only the measured samples differ from repeat to repeat.
    axes = eqx.tree_at(
        lambda p: p.runs.measured[name], jtu.tree_map(lambda _: None, problem), 0, is_leaf=lambda x: x is None
    )
    options = SearchOptions(max_steps=steps)
    repeated = [problem_at(several, axes, i) for i in range(repeats)]
    x = jnp.stack([run_initializers(initializer, one.held, options)[0] for one in repeated])
    if problem.nuisance:
        x = side_by_side(several.held, axes, starts_of(problem, x), options, steps).x
    state = side_by_side(several, axes, starts_of(problem, x), options, steps)
    states, names, estimate = jtu.tree_map(np.asarray, state), problem.free.names, result.estimate
    ends = [jtu.tree_map(lambda x, i=i: x[i], states) for i in range(repeats)]
    values = np.stack([problem.at(end.x).vector for end in ends])
    covariances = [
        covariance_of(one, end, range(len(names))).covariance for one, end in zip(repeated, ends, strict=True)
    ]
    errors = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    shares = {}
    for k, each in enumerate(names):
        true, limits, log = estimate.values[each], estimate.bounds[each], each in estimate.logarithmic
        spans = [interval(x, error, limits, log, level) for x, error in zip(values[:, k], errors[:, k], strict=True)]
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
