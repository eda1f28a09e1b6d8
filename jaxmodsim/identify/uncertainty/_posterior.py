"""The posterior of a fit: its density for samplers, unconstrained and whitened, and samples of it by NUTS."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from types import ModuleType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..._core.arguments import as_share, as_whole
from ..._core.readable import AbstractReadable, Table, interval_text, table_of
from ..._core.system import extra
from ..estimate._problem import FitProblem
from ..estimate._search import SearchResult
from ._estimate import ParameterEstimate
from ._result import FitResult

# Information about a number without effect, for the scale of its coordinate: x is about 1 in size.
_LEAST_INFORMATION = 1.0
# Added to the scaled normal matrix, so that it has a factor.
_JITTER = 1e-12
# If a fit ended on a limit, the density starts beside it: by these shares of a standard error and of the range.
_BESIDE, _BESIDE_RANGE = float(np.log(2.0)), 0.25
_LARGEST_MEMORY = 0.98
# Largest R-hat and fewest effective samples per chain of reliable chains: Vehtari et al. 2021.
_RHAT, _EFFECTIVE_A_CHAIN = 1.01, 100
# Target acceptance. Fixed steps through a kink of a friction law leave small jumps in the density, for which no step of
# NUTS is short enough: 0.85 takes three times as many gradients.
_ACCEPTANCE = 0.75
# Chains start scattered by this many standard deviations of the fit, so that R-hat shows whether they mix.
_SCATTER = 1.0
# Relative difference of the standard deviation from the standard error of the fit that is reported.
_DIFFERS = 0.15


@eqx.filter_custom_jvp
def _residual(x: Float[Array, " n"], problem: FitProblem) -> Float[Array, " rows"]:
    return problem.evaluate(x)[0]


@_residual.def_jvp
def _(primals: tuple[Array, FitProblem], tangents: tuple[Array | None, PyTree]) -> tuple[Array, Array]:
    """All columns in one forward sweep: cheaper than reverse mode for a few unknowns, and exact through events."""
    residual, jacobian = primals[1].evaluate(primals[0])
    return residual, jnp.zeros_like(residual) if tangents[0] is None else jacobian @ tangents[0]


class _SoftBox(eqx.Module):
    """Map from the real line to the inside of bounds, linear beyond a few widths from them.

    `x = v + width (softplus(-(v - lower)/width) - softplus((v - upper)/width))`
    """

    lower: Float[Array, " n"]
    upper: Float[Array, " n"]
    width: Float[Array, " n"]

    def inside(self, v: Float[Array, " n"]) -> Float[Array, " n"]:
        below, above = (v - self.lower) / self.width, (v - self.upper) / self.width
        return v + self.width * (jax.nn.softplus(-below) - jax.nn.softplus(above))

    def log_slope(self, v: Float[Array, " n"]) -> Float[Array, " n"]:
        below, above = (v - self.lower) / self.width, (v - self.upper) / self.width
        constant = jnp.log(-jnp.expm1(-(self.upper - self.lower) / self.width))  # 0 without two bounds
        return jax.nn.log_sigmoid(below) + jax.nn.log_sigmoid(-above) + constant

    def outside(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """The v of an x strictly inside."""
        over, under = (x - self.lower) / self.width, (self.upper - x) / self.width
        return x + self.width * (jnp.log(-jnp.expm1(-over)) - jnp.log(-jnp.expm1(-under)))


class LogDensity(eqx.Module):
    """Logarithm of the posterior density of all unknowns of a fit, up to a constant: `density(u)`, u of shape `[n]`.

    - `names`: of the unknowns: parameters, initial states, then the standard deviation `noise.CHANNEL` of each channel
      and the correlation `memory.CHANNEL` of its noise from one sample to the next.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    _problem: FitProblem
    _box: _SoftBox
    _centre: Float[Array, " n"]
    _factor: Float[Array, "n n"]

    @property
    def start(self) -> Float[Array, " n"]:
        """The u of the fit: zeros. A standard deviation of the fit is about 1 in any direction of u."""
        return jnp.zeros_like(self._centre)

    @eqx.filter_jit
    def __call__(self, u: Float[Array, " n"]) -> Float[Array, ""]:
        """The logarithm of the density at `u`, up to a constant; minus infinity if the model is not finite."""
        problem = self._problem
        v, level, memory = self._parts(u)
        x, size = self._box.inside(v), len(problem.free.names)
        residual = _residual(x, problem)
        # Flat in the parameters, not in their coordinates. A limit depends only on parameters before it, so the
        # determinant is the product of the diagonal.
        slopes = jnp.diagonal(problem.free.slopes(x[:size]))
        total = jnp.sum(self._box.log_slope(v)) + jnp.sum(jnp.log(jnp.abs(slopes)))
        total = total - 0.5 * jnp.sum(residual[problem.samples :] ** 2)
        for name, (rows, weight) in problem.by_channel(residual).items():
            rho = memory.get(name, jnp.zeros_like(level[name]))
            counted, runs = jnp.sum(weight), jnp.sum(jnp.max(weight, axis=1))
            standard = jnp.where(weight > 0, _innovations(rows, rho), 0.0) * jnp.exp(-level[name])
            total = total - problem.loss.cost(jnp.reshape(standard, (-1,))) - counted * level[name]
            total = total + 0.5 * runs * jnp.log1p(-(rho**2))
            total = total + (jnp.log1p(-(rho**2)) if name in memory else 0.0)  # flat in the correlation
        return jnp.where(jnp.isfinite(total), total, -jnp.inf)

    def values(self, u: Float[Array, " n"]) -> dict[str, Float[Array, ""]]:
        """The unknowns at `u` by name, in their units."""
        return dict(zip(self.names, self.vector(u), strict=True))

    def vector(self, u: Float[Array, " n"]) -> Float[Array, " n"]:
        """The unknowns at `u` in the order of `names`, in their units."""
        problem = self._problem
        v, level, memory = self._parts(u)
        x = self._box.inside(v)
        values = [*problem.free.vector(x[: len(problem.free.names)])]
        start = problem.starts(x) if problem.local else None
        values += [] if start is None else [*jnp.reshape(jax.vmap(problem.local_values)(start), (-1,))]
        none = jnp.zeros((), v.dtype)
        values += [
            problem.noise[name] * jnp.exp(t) / jnp.sqrt(1.0 - memory.get(name, none) ** 2) for name, t in level.items()
        ]
        return jnp.stack([*values, *memory.values()])

    def _parts(self, u: Float[Array, " n"]) -> tuple[Array, dict[str, Array], dict[str, Array]]:
        """Coordinates, logarithms of the innovations' level over the noise, and memories."""
        v = self._centre + self._factor @ u
        count, channels = self._box.width.shape[0], tuple(self._problem.columns)
        level = {name: v[count + i] for i, name in enumerate(channels)}
        first = count + len(channels)
        remembering = [name for name in channels if name in self._problem.runs.weight]
        return v[:count], level, {name: jnp.tanh(v[first + i]) for i, name in enumerate(remembering)}


def log_density(result: FitResult) -> LogDensity:
    """The posterior density of a fit as a function of one vector, for blackjax, numpyro and other samplers.

    With `density = log_density(result)`, `density(u)` is the logarithm of the density, `jax.grad(density)(u)` its
    gradient, `density.values(u)` the unknowns by name, and `density.start` the fit. u is unconstrained, and whitened by
    the covariance of the fit. Unknowns are all free parameters, initial states and delays, and for each channel the
    level of its noise and its correlation from sample to sample, AR(1). The noise is normal for `SquaredLoss`, and
    has the tails of a robust loss otherwise. Slip instants have uncorrelated noise. The prior is uniform in parameters
    within their limits, in correlations, and in the logarithm of noise levels, times `prior` of `fit`. Parameters that
    the record does not determine need such a prior.

    In runs by events the density jumps where a change in the sequence of events makes the output jump. Samplers by
    gradient do not see this: make such laws `Regularized` if stick and slip change with the parameters.

    **Arguments:**

    - `result`: a fit that was not loaded from a file.

    **Returns:**

    A `LogDensity`.

    **Raises:**

    - `ValueError` for a loaded result.
    """
    search = result.search_for("The posterior")
    problem = search.problem
    residual, jacobian = problem.loss.weighted(search.state.residual, search.state.jacobian)
    split, level, memory = problem.by_channel(residual), {}, {}
    for name, (rows, weight) in split.items():
        square = jnp.maximum(jnp.sum(rows**2), jnp.finfo(rows.dtype).tiny)
        rho = jnp.clip(jnp.sum(rows[:, 1:] * rows[:, :-1]) / square, -_LARGEST_MEMORY, _LARGEST_MEMORY)
        if name in problem.runs.weight:
            memory[name] = rho
        rho = memory.get(name, jnp.zeros_like(rho))
        left = jnp.sum(jnp.where(weight > 0, _innovations(rows, rho), 0.0) ** 2)
        level[name] = 0.5 * jnp.log(jnp.maximum(left, jnp.finfo(rows.dtype).tiny) / jnp.sum(weight))
    box, v, factor = _coordinates_of(search, jacobian, level, memory)
    counted = {name: jnp.sum(weight) for name, (_, weight) in split.items()}
    deviations = [1.0 / jnp.sqrt(2.0 * counted[name]) for name in level]
    deviations += [1.0 / jnp.sqrt(counted[name] * (1.0 - rho**2)) for name, rho in memory.items()]
    beside = jnp.stack([*level.values(), *(jnp.arctanh(rho) for rho in memory.values())])
    n, more = v.shape[0], beside.shape[0]
    whole = jnp.zeros((n + more, n + more), v.dtype)
    whole = whole.at[:n, :n].set(factor).at[n:, n:].set(jnp.diag(jnp.stack(deviations)))
    names = list(problem.free.names)
    if problem.local:
        records = result.provenance.records
        runs = [f"{each.name}/" if len(records) > 1 else "" for each in records]
        if len(records) != problem.count:
            runs = [f"window {i}/" for i in range(problem.count)]
        names += [prefix + name for prefix in runs for name in problem.local]
    names += [f"noise.{name}" for name in level] + [f"memory.{name}" for name in memory]
    return LogDensity(tuple(names), problem, box, jnp.concatenate([v, beside]), whole)


def _coordinates_of(
    search: SearchResult, jacobian: Float[Array, "rows n"], level: dict[str, Array], memory: dict[str, Array]
) -> tuple[_SoftBox, Float[Array, " n"], Float[Array, "n n"]]:
    """Soft bounds, the coordinates of the fit, and a factor of their covariance at the estimated noise."""
    problem, columns = search.problem, []
    for column in jacobian.T:
        parts = []
        for name, (rows, weight) in problem.by_channel(column).items():
            filtered = _innovations(rows, memory.get(name, jnp.zeros((), rows.dtype)))
            parts.append(jnp.reshape(jnp.where(weight > 0, filtered, 0.0) * jnp.exp(-level[name]), (-1,)))
        columns.append(jnp.concatenate([*parts, column[problem.samples :]]))
    filtered = jnp.stack(columns, axis=1)
    n = jacobian.shape[1]
    matrix = filtered.T @ filtered + _LEAST_INFORMATION * jnp.eye(n, dtype=jacobian.dtype)
    lower, upper, _ = problem.box
    width = jnp.sqrt(jnp.diagonal(_factor(matrix) @ _factor(matrix).T))
    box = _SoftBox(lower, upper, width)
    off = jnp.minimum(_BESIDE * width, _BESIDE_RANGE * (upper - lower))
    v = box.outside(jnp.clip(search.state.x, lower + off, upper - off))
    slope = jnp.exp(box.log_slope(v))
    return box, v, _factor(matrix * jnp.outer(slope, slope) + jnp.diag(_LEAST_INFORMATION * (1.0 - slope)))


def _factor(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A factor L of the inverse: `L L' = matrix^-1`."""
    scale = jnp.sqrt(jnp.diagonal(matrix))
    eye = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    root = jnp.linalg.cholesky(matrix / jnp.outer(scale, scale) + _JITTER * eye)
    return jax.scipy.linalg.solve_triangular(root.T, eye) / scale[:, None]


def _innovations(rows: Float[Array, "runs samples"], memory: Float[Array, ""]) -> Float[Array, "runs samples"]:
    """Residuals less their prediction from the previous one, all with one standard deviation."""
    first = rows[:, :1] * jnp.sqrt(1.0 - memory**2)
    return jnp.concatenate([first, rows[:, 1:] - memory * rows[:, :-1]], axis=1)


@dataclass(frozen=True, kw_only=True, repr=False)
class Posterior(AbstractReadable):
    """Samples of all unknowns of a fit from their posterior.

    - `draws`: by name, shape `[chains, draws]` each, in the units of the parameters.
    - `rhat`: by name, from ranks of split chains; 1 for chains that agree (Vehtari et al. 2021, Bayesian Analysis
      16:667). `effective`: number of equivalent independent samples by name, for the bulk or the tails, whichever is
      less.
    - `divergences`: number of samples at which the integration of NUTS diverged.
    - `gradients`: number of gradients that all chains took, warm-up not included.
    - `estimate`: of the fit, for comparison.
    """

    draws: dict[str, Float[np.ndarray, "chains draws"]]
    rhat: dict[str, float]
    effective: dict[str, float]
    divergences: int
    gradients: int
    estimate: ParameterEstimate

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Intervals by name, with equal probability below and above.

        **Raises:**

        - `ValueError` unless 0 < level < 1.
        """
        level = as_share(level, name="level")
        edges = [0.5 - level / 2, 0.5 + level / 2]
        return {name: tuple(np.quantile(x, edges).tolist()) for name, x in self.draws.items()}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reliability of the samples, and differences from the fit, in sentences."""
        sentences = []
        worst = max(self.rhat, key=lambda name: self.rhat[name] if math.isfinite(self.rhat[name]) else math.inf)
        if not self.rhat[worst] <= _RHAT:
            sentences.append(
                f"The chains do not agree (R-hat of {worst} {self.rhat[worst]:.3g}, {_RHAT} at most):"
                " take more draws and warmup, or a prior for what the record does not determine."
            )
        fewest, chains = min(self.effective, key=self.effective.__getitem__), next(iter(self.draws.values())).shape[0]
        if not self.effective[fewest] >= _EFFECTIVE_A_CHAIN * chains:
            sentences.append(
                f"{fewest} has {self.effective[fewest]:.0f} effective samples, fewer than the"
                f" {_EFFECTIVE_A_CHAIN * chains} that quantiles need: take more draws."
            )
        if self.divergences:
            sentences.append(
                f"{self.divergences} samples diverged: the density has corners or jumps there, and the region beyond"
                " them may be missing."
            )
        for name, error in self.estimate.errors.items():
            if name in self.draws and math.isfinite(error) and error > 0:
                ratio = float(np.std(self.draws[name])) / error
                if abs(ratio - 1) > _DIFFERS:
                    sentences.append(
                        f"{name}: its standard deviation is {ratio:.2f} times the standard error of the fit."
                    )
        return tuple(sentences)

    __repr__ = AbstractReadable.__str__


@table_of.register
def _(posterior: Posterior) -> Table:
    estimate, edges, rows = posterior.estimate, posterior.intervals(), []
    for name, x in posterior.draws.items():
        low, high = edges[name]
        fitted = name in estimate.values
        rows.append(
            (
                name,
                f"{x.mean():.6g}",
                f"{x.std():.2g}",
                interval_text(low, high),
                f"{estimate.values[name]:.6g}" if fitted else "",
                f"{estimate.errors[name]:.2g}" if fitted else "",
                f"{posterior.rhat[name]:.3f}",
                f"{posterior.effective[name]:.0f}",
            )
        )
    chains, draws = next(iter(posterior.draws.values())).shape
    head = ("unknown", "mean", "std. dev.", "95 % interval", "fit", "std. error", "R-hat", "effective samples")
    title = f"{chains} chains of {draws} draws, {posterior.divergences} divergences"
    return Table(title, head, rows, posterior.warnings)


def sample_posterior(
    result: FitResult, *, draws: int = 500, warmup: int = 300, chains: int = 4, seed: int = 0
) -> Posterior:
    """Sample the posterior of a fit by NUTS (Hoffman, Gelman 2014, JMLR 15:1593), on `log_density(result)`.

    With blackjax, the chains in parallel on all cores. Each adapts its step and the covariance of its unknowns in
    windows of the warm-up, as in Stan.

    **Arguments:**

    - `result`: a fit that was not loaded from a file; for the prior, see `log_density`.
    - `draws`: samples of each chain, >= 4. `warmup`: samples before them, which are dropped, >= 20.
    - `chains`: number of chains, >= 2.
    - `seed`: of the random numbers.

    **Returns:**

    A `Posterior`, drawn by `jaxmodsim.plot.posterior_figure`.

    **Raises:**

    - `ImportError` without blackjax, which is in the extra `posterior`.
    - `ValueError` for a loaded result, or numbers out of range.
    """
    blackjax = extra("blackjax", "sample_posterior", "posterior")
    draws, warmup = as_whole(draws, name="draws", least=4), as_whole(warmup, name="warmup", least=20)
    chains = as_whole(chains, name="chains", least=2)
    density = log_density(result)
    keys = jax.random.split(jax.random.key(seed), chains)
    # In threads, since under vmap all chains would wait at each draw for the longest path.
    with ThreadPoolExecutor() as pool:
        several = pool.map(lambda key: _sampled(density, key, blackjax, draws, warmup), keys)
        u, diverged, steps = (jnp.stack(x) for x in zip(*several, strict=True))
    x, rhat, bulk, tail = (np.asarray(each) for each in _summary(density, u, blackjax.diagnostics))
    return Posterior(
        draws=dict(zip(density.names, x, strict=True)),
        rhat=dict(zip(density.names, rhat.tolist(), strict=True)),
        effective=dict(zip(density.names, np.minimum(bulk, tail).tolist(), strict=True)),
        divergences=int(jnp.sum(diverged)),
        gradients=int(jnp.sum(steps)),
        estimate=result.estimate,
    )


@eqx.filter_jit
def _summary(
    density: LogDensity, u: Float[Array, "chains draws n"], diagnostics: ModuleType
) -> tuple[Float[Array, "n chains draws"], Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
    """The unknowns in their units, R-hat, and effective samples for the bulk and the tails."""
    x = jnp.moveaxis(jax.vmap(jax.vmap(density.vector))(u), -1, 0)
    rhat, bulk, tail = jax.lax.map(
        lambda x: tuple(of(x) for of in (diagnostics.rhat, diagnostics.ess_bulk, diagnostics.ess_tail)), x
    )
    return x, rhat, bulk, tail


@eqx.filter_jit
def _sampled(
    density: LogDensity, key: Array, blackjax: ModuleType, draws: int, warmup: int
) -> tuple[Float[Array, "draws n"], Bool[Array, " draws"], Int[Array, " draws"]]:
    """Draws of one chain, whether they diverged, and the number of gradients of each."""
    start_key, warm_key, draw_key = jax.random.split(key, 3)
    start = density.start + _SCATTER * jax.random.normal(start_key, density.start.shape, density.start.dtype)
    start = jnp.where(jnp.isfinite(density(start)), start, density.start)  # the model may fail that far away
    adaptation = blackjax.window_adaptation(
        blackjax.nuts, density, is_mass_matrix_diagonal=False, target_acceptance_rate=_ACCEPTANCE
    )
    (state, tuned), _ = adaptation.run(warm_key, start, num_steps=warmup)
    nuts = blackjax.nuts(density, **tuned)

    def draw(state: PyTree, key: Array) -> tuple[PyTree, tuple[Array, Array, Array]]:
        state, info = nuts.step(key, state)
        return state, (state.position, info.is_divergent, info.num_integration_steps)

    return jax.lax.scan(draw, state, jax.random.split(draw_key, draws))[1]
