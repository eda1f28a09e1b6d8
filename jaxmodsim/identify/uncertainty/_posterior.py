"""Samples of the posterior of a fit by NUTS, whether they can be relied on, and the fit's intervals beside theirs."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from types import ModuleType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..._core.arguments import as_whole
from ..._core.system import extra
from ._estimate import ParameterEstimate
from ._log_density import LogDensity, log_density
from ._result import FitResult

# Largest R-hat and fewest effective samples a chain of chains that can be relied on: Vehtari et al. 2021.
_RHAT, _EFFECTIVE_A_CHAIN = 1.01, 100
# Acceptance aimed at. Fixed steps through a kink of a friction law leave small jumps in the density, which no step of
# NUTS is short enough for: at 0.85 it takes three times as many gradients.
_ACCEPTANCE = 0.75
# Chains start by this many standard deviations of the fit about it, so that R-hat sees whether they forget where.
_SCATTER = 1.0
# Ratio of the standard deviation to that of the fit from which on the two are said to differ.
_DIFFERS = 0.15


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """Samples of all unknowns of a fit from their posterior.

    - `draws`: by name, shape `[chains, draws]` each, in the units of the parameters.
    - `rhat`: by name, from ranks of split chains; 1 where all chains tell the same (Vehtari et al. 2021, Bayesian
      Analysis 16:667). `effective`: by name, as how many independent samples they count, for the bulk or the tails,
      whichever is fewer.
    - `divergences`: samples at which the integration of NUTS went astray.
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
        """Intervals by name, with as much of the posterior below as above.

        **Raises:**

        - `ValueError` unless 0 < level < 1.
        """
        if not 0 < level < 1:
            raise ValueError(f"level must lie between 0 and 1, but it is {level}.")
        edges = [0.5 - level / 2, 0.5 + level / 2]
        return {name: (float(low), float(high)) for name, (low, high) in self._quantiles(edges).items()}

    def _quantiles(self, shares: list[float]) -> dict[str, np.ndarray]:
        return {name: np.quantile(x, shares) for name, x in self.draws.items()}

    @property
    def remarks(self) -> tuple[str, ...]:
        """Whether the samples can be relied on, and where they differ from the fit, in sentences."""
        sentences = []
        worst = max(self.rhat, key=lambda name: self.rhat[name] if math.isfinite(self.rhat[name]) else math.inf)
        if not self.rhat[worst] <= _RHAT:
            sentences.append(
                f"The chains do not tell the same (R-hat of {worst} {self.rhat[worst]:.3g}, {_RHAT} at most):"
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
                f"{self.divergences} samples diverged: the density has corners or jumps there, and what is beyond them"
                " may be missing."
            )
        for name, error in self.estimate.errors.items():
            if name in self.draws and math.isfinite(error) and error > 0:
                ratio = float(np.std(self.draws[name])) / error
                if abs(ratio - 1) > _DIFFERS:
                    sentences.append(
                        f"{name}: its standard deviation is {ratio:.2f} times the standard error of the fit."
                    )
        return tuple(sentences)

    def __str__(self) -> str:
        """A table of the unknowns, the fit's standard error beside, and what to think of it."""
        errors, values, rows = self.estimate.errors, self.estimate.values, self._quantiles([0.025, 0.975])
        width = max(len(name) for name in self.draws)
        lines = [
            f"{'':{width}}  {'mean':>13}  {'std. dev.':>11}  {'95 % interval':>25}  {'fit':>13}  {'std. error':>11}"
            f"  {'R-hat':>6}  {'samples':>7}"
        ]
        for name, x in self.draws.items():
            low, high = rows[name]
            fitted = f"{values[name]:13.6g}  {errors[name]:11.2g}" if name in values else f"{'':13}  {'':11}"
            lines.append(
                f"{name:{width}}  {x.mean():13.6g}  {x.std():11.2g}  {low:12.5g} {high:12.5g}  {fitted}"
                f"  {self.rhat[name]:6.3f}  {self.effective[name]:7.0f}"
            )
        chains, draws = next(iter(self.draws.values())).shape
        return "\n".join([*lines, f"{chains} chains of {draws} draws, {self.divergences} divergences", *self.remarks])

    __repr__ = __str__


def sample_posterior(
    result: FitResult, *, draws: int = 500, warmup: int = 300, chains: int = 4, seed: int = 0
) -> Posterior:
    """Sample the posterior of a fit by NUTS (Hoffman, Gelman 2014, JMLR 15:1593), on `log_density(result)`.

    By blackjax, the chains side by side on all cores; each adapts its step and the covariance of its unknowns during
    the warm-up, in windows, as Stan does.

    **Arguments:**

    - `result`: a fit that was not loaded from a file; what it takes to be known before, see `log_density`.
    - `draws`: samples that each chain keeps, >= 4. `warmup`: samples before them, which are not kept, >= 20.
    - `chains`: number of chains, >= 2.
    - `seed`: of the random numbers.

    **Returns:**

    A `Posterior`, drawn by `jaxmodsim.plot.posterior_figure`.

    **Raises:**

    - `ImportError` without blackjax, which the extra `posterior` brings along.
    - `ValueError` of a result that was loaded, or numbers out of range.
    """
    blackjax = extra("blackjax", "sample_posterior", "posterior")
    draws, warmup, chains = (
        as_whole(x, name=name) for x, name in ((draws, "draws"), (warmup, "warmup"), (chains, "chains"))
    )
    if draws < 4 or warmup < 20 or chains < 2:
        raise ValueError(
            f"At least 4 draws, a warmup of 20 and 2 chains are needed, but {draws}, {warmup} and {chains} were given."
        )
    density = log_density(result)
    keys = jax.random.split(jax.random.key(seed), chains)
    # Side by side under vmap all chains would wait at each draw for the one with the longest path.
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
    """Draws of one chain, whether they diverged, and how many gradients each took."""
    start_key, warm_key, draw_key = jax.random.split(key, 3)
    start = density.start + _SCATTER * jax.random.normal(start_key, density.start.shape, density.start.dtype)
    start = jnp.where(jnp.isfinite(density(start)), start, density.start)  # the model may not run that far off
    adaptation = blackjax.window_adaptation(
        blackjax.nuts, density, is_mass_matrix_diagonal=False, target_acceptance_rate=_ACCEPTANCE
    )
    (state, tuned), _ = adaptation.run(warm_key, start, num_steps=warmup)
    nuts = blackjax.nuts(density, **tuned)

    def draw(state: PyTree, key: Array) -> tuple[PyTree, tuple[Array, Array, Array]]:
        state, info = nuts.step(key, state)
        return state, (state.position, info.is_divergent, info.num_integration_steps)

    return jax.lax.scan(draw, state, jax.random.split(draw_key, draws))[1]
