"""Estimates with their covariance, from residuals that may be correlated in time, of any size, of a model that errs."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import special  # scipy.stats takes most of a second to import

from ..data._record import Record
from ..estimate._problem import FitProblem
from ..estimate._search import SearchState
from ..model._observe import RecordedMotion, motion_of

# Blocks of samples: enough for the scatter of the scores of a dozen parameters, and each far longer than what the
# residual of a mechanism is correlated over.
BLOCKS = 32

# Smallest eigenvalue of a scaled normal matrix against the largest one, in units of rounding.
ROUNDING = 10.0

# A block of samples whose share of the information leaves a determinant below this decides something alone, and has no
# residual to be judged by.
_ALONE = 1e-6

# Lags of tests for whiteness: a decade of samples, and at most one for so many samples. Probability below which
# residuals do not pass for white, and what keeps divisions by what may vanish finite.
_LAGS_A_DECADE, _SAMPLES_A_LAG = 10, 5
_CHANCE, _TINY = 0.01, 1e-30


@dataclass(frozen=True, kw_only=True)
class ParameterEstimate:
    """Fitted parameters, and how sure they are.

    - `values`, `start`: by name. `units`: unit of each parameter that declares one.
    - `covariance`, `white`: of the parameters, shape `[free, free]`, in the order of `values`; the first takes the
      correlation of the residual in time into account, the second is what it would be if the residual were white noise.
      They hold for the model being right but for noise.
    - `information`: Fisher information of the parameters, shape `[free, free]`, the noise at its level.
    - `logarithmic`: names of the parameters that must be positive; their intervals are symmetric in the logarithm.
    - `bounds`: lower and upper limit of each parameter at the estimate.
    """

    values: dict[str, float]
    start: dict[str, float]
    units: dict[str, str]
    covariance: Float[np.ndarray, "free free"]
    white: Float[np.ndarray, "free free"]
    information: Float[np.ndarray, "free free"]
    logarithmic: tuple[str, ...]
    bounds: dict[str, tuple[float, float]]

    @property
    def errors(self) -> dict[str, float]:
        """Standard errors by name; infinite for a parameter without effect."""
        errors = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return dict(zip(self.values, errors.tolist(), strict=True))

    def rows(self) -> list[tuple[str, float, float, float, str]]:
        """Rows of a table: name, value, standard error, start, unit."""
        errors = self.errors
        return [(name, x, errors[name], self.start[name], self.units[name]) for name, x in self.values.items()]

    @property
    def correlation(self) -> Float[np.ndarray, "free free"]:
        """Correlation of the parameters, in the order of `values`."""
        return correlation_of(self.covariance)

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence intervals, symmetric in the logarithm for parameters that must be positive.

        **Raises:**

        - `ValueError` unless 0 < level < 1.
        """
        errors = self.errors
        return {
            name: interval(value, errors[name], self.bounds[name], name in self.logarithmic, level)
            for name, value in self.values.items()
        }


@dataclass(frozen=True)
class IdentifiabilityIssue:
    """What the motion lacks, and the free parameters that it leaves unknown."""

    sentence: str
    about: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class FitDiagnostics:
    """How a fit went, and what is left in its residual.

    - `rmse`: root mean square of output less measured value, by channel, in its unit.
    - `noise`: standard deviation of each channel, as given or as estimated.
    - `ending`: how the search ended. `evaluations`: how often the model and its derivatives were computed.
    - `step_error`: root mean square by which the output moves with four times as many integration steps; None where
      there are none.
    - `starts`: root mean square, in noise levels, that each of several starts ended with, best first.
    - `single_precision`: whether it was computed in float32.
    - `issues`: what the motion lacks, and which parameters that leaves unknown; part of the remarks.
    """

    rmse: dict[str, float]
    noise: dict[str, float]
    ending: str
    evaluations: int
    step_error: float | None
    starts: tuple[float, ...]
    single_precision: bool
    issues: tuple[IdentifiabilityIssue, ...]


@dataclass(frozen=True, kw_only=True)
class FitProvenance:
    """What was fitted to what.

    - `records`: what was fitted. `outputs`: the model's output at their times, by channel, one dict a record.
    - `coordinates`: channels (of a law by itself, inputs) that are a coordinate or a velocity, as `q[0]`, by name.
    - `numbers`: all numbers of the model by name, those that were not fitted included.
    - `model`: the scene or law with the fitted numbers; None in a result that was loaded without one.
    """

    records: tuple[Record, ...]
    outputs: tuple[dict[str, np.ndarray], ...]
    coordinates: dict[str, str]
    numbers: dict[str, np.ndarray]
    model: eqx.Module | None

    @property
    def residuals(self) -> tuple[dict[str, np.ndarray], ...]:
        """Output less measured value by channel, one dict a record."""
        return tuple(
            {name: x - record.channels[name] for name, x in outputs.items()}
            for record, outputs in zip(self.records, self.outputs, strict=True)
        )

    @property
    def motions(self) -> tuple[RecordedMotion, ...]:
        """Coordinates and velocities as far as the model's output shows them, one a record."""
        return tuple(
            motion_of(record, outputs, self.coordinates)
            for record, outputs in zip(self.records, self.outputs, strict=True)
        )


class CovarianceEstimate(NamedTuple):
    """How sure an estimate is.

    - `covariance`: of the parameters, correlation of the residual in time taken into account.
    - `white`: what it would be if the residual were white noise.
    - `information`: Fisher information of the samples, in noise levels, and of the prior.
    """

    covariance: Float[Array, "free free"]
    white: Float[Array, "free free"]
    information: Float[Array, "free free"]


def block_numbers(
    weights: Float[Array, "runs samples"], channels: int, blocks: int = BLOCKS
) -> tuple[Int[Array, " rows"], int]:
    """Number of the block of each sample row, in the order of the residual, and the number of blocks.

    All channels of a time are in one block. Runs share the blocks by their numbers of samples.
    """
    samples = weights.shape[1]
    counts = [int(x) for x in jnp.sum(weights > 0, axis=1)]
    whole = sum(counts)
    numbers, used = [], 0
    for count in counts:
        own = max(round(blocks * count / whole), 1)
        here = jnp.minimum(jnp.arange(samples) * own // max(count, 1), own - 1)
        numbers.append(jnp.tile(used + here, channels))
        used += own
    return jnp.concatenate(numbers), used


def covariance_estimate(
    residual: Float[Array, " rows"],
    jacobian: Float[Array, "rows n"],
    extra: Float[Array, "others n"],
    slopes: Float[Array, "n n"],
    blocks: Int[Array, " rows"],
    count: int,
    kept: int,
    white: Bool[Array, ""],
) -> CovarianceEstimate:
    """Covariance `H^-1 S H^-1` with S from the scatter of the scores of blocks of samples.

    Residuals may be correlated in any way within a block. Each block's score `J_b' r_b` is divided by what the block
    itself took from its residual, `(I - J_b'J_b H^-1)^-1`, which makes the sum the jackknife over blocks (Bell,
    McCaffrey 2002, Survey Methodology 28:169): without it errors come out too small where few samples decide.

    So few blocks leave the scatter uncertain: by a quarter in a variance. Where the residual passes for white
    noise, S is shrunk towards what it is for such noise, by the share of their squared difference that chance explains
    (Ledoit, Wolf 2003, J. Empirical Finance 10:603; Schaefer, Strimmer 2005, Stat. Appl. Genet. Mol. Biol. 4:32), in
    coordinates in which the latter is the unit matrix.

    **Arguments:**

    - `residual`, `jacobian`: of the samples, by the coordinates x.
    - `extra`: rows of the Jacobian that are no samples: what was known before, links between windows.
    - `slopes`: derivatives of the parameters by x.
    - `blocks`, `count`: number of each row's block, and of blocks.
    - `kept`: number of parameters, the first entries of x; the others are nuisance.
    - `white`: whether the residual passes for white noise.
    """
    n = jacobian.shape[1]
    beside = extra.T @ extra
    matrix = jacobian.T @ jacobian + beside
    scale = jnp.sqrt(jnp.diagonal(matrix))
    silent = scale == 0
    scale = jnp.where(silent, 1.0, scale)
    bread = floored_inverse(matrix / jnp.outer(scale, scale), ROUNDING * float(jnp.finfo(matrix.dtype).eps))
    scaled = jacobian / scale[None, :]
    scores = jax.ops.segment_sum(scaled * residual[:, None], blocks, count)

    def fair_score(sample: tuple[Array, Array]) -> Array:
        b, score = sample
        own = jnp.where((blocks == b)[:, None], scaled, 0.0)
        rest = jnp.eye(n, dtype=scaled.dtype) - own.T @ own @ bread
        fair = jnp.abs(jnp.linalg.det(rest)) > _ALONE
        return jnp.linalg.solve(jnp.where(fair, rest, jnp.eye(n, dtype=scaled.dtype)), score)

    scores = jax.lax.map(fair_score, (jnp.arange(count), scores))
    samples = jnp.sum(jnp.any(jacobian != 0, axis=1))
    meat = scores.T @ scores * ((count - 1) / count) + beside / jnp.outer(scale, scale)
    variance = jnp.sum(residual**2) / jnp.maximum(samples - n, 1)
    if_white = (matrix - beside) / jnp.outer(scale, scale) * variance + beside / jnp.outer(scale, scale)
    root = jnp.linalg.cholesky(bread)
    products = jax.vmap(jnp.outer)(scores @ root, scores @ root)
    chance = jnp.sum((products - jnp.mean(products, axis=0)[None]) ** 2)
    share = jnp.minimum(chance / jnp.maximum(jnp.sum((root.T @ (meat - if_white) @ root) ** 2), _TINY), 1.0)
    # Where a direction is not determined, the root may not exist.
    meat = jnp.where(white & jnp.isfinite(share), meat + share * (if_white - meat), meat)
    change = slopes / scale[None, :]

    def of_parameters(middle: Array) -> Array:
        covariance = (change @ middle @ change.T)[:kept, :kept]
        return covariance.at[jnp.diag_indices(kept)].set(jnp.where(silent[:kept], jnp.inf, jnp.diagonal(covariance)))

    back = jnp.linalg.pinv(slopes[:kept, :kept])
    information = back.T @ matrix[:kept, :kept] @ back
    return CovarianceEstimate(of_parameters(bread @ meat @ bread), of_parameters(bread @ if_white @ bread), information)


def floored_inverse(matrix: Array | np.ndarray, least: float) -> Any:
    """Inverse of a scaled normal matrix, with eigenvalues kept off zero, as an array of the kind that was given.

    A direction that the record says nothing about gets a huge error, not none.

    **Arguments:**

    - `matrix`: symmetric, its diagonal one, shape `[n, n]`.
    - `least`: smallest eigenvalue, as a share of the largest one.
    """
    xp = jnp if isinstance(matrix, jax.Array) else np
    values, vectors = xp.linalg.eigh(matrix)
    return vectors / xp.maximum(values, least * xp.maximum(values[-1], 1.0))[None, :] @ vectors.T


def correlation_of(covariance: Float[np.ndarray, "free free"]) -> Float[np.ndarray, "free free"]:
    """Correlation of estimates by their covariance; none with those of which nothing is known."""
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where((errors > 0) & np.isfinite(errors), errors, 1.0)
    known = np.isfinite(covariance) & np.isfinite(np.add.outer(errors, errors))
    correlation = np.where(known, np.where(known, covariance, 0.0) / np.outer(safe, safe), 0.0)
    np.fill_diagonal(correlation, 1.0)
    return correlation


def interval(
    value: float, error: float, limits: tuple[float, float], logarithmic: bool, level: float
) -> tuple[float, float]:
    """Interval by Student's t with one degree of freedom less than there are blocks of samples.

    Symmetric in the logarithm of the distance from the lower limit for a parameter that must stay above it, cut at the
    limits for others.

    **Arguments:**

    - `value`, `error`: estimate and its standard error.
    - `limits`: lower and upper limit of the parameter, infinite where it has none.
    - `logarithmic`: whether it must stay above its lower limit.
    - `level`: of confidence, between 0 and 1.

    **Raises:**

    - `ValueError` unless 0 < level < 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1, but it is {level}.")
    low, high = limits
    margin = float(special.stdtrit(BLOCKS - 1, 0.5 + level / 2)) * error
    if logarithmic and value > low:
        with np.errstate(over="ignore"):
            ratio = float(np.exp(margin / (value - low)))
        return low + (value - low) / ratio, min(low + (value - low) * ratio, high)
    return max(value - margin, low), min(value + margin, high)


def covariance_of(problem: FitProblem, state: SearchState, kept: int, blocks: int = BLOCKS) -> CovarianceEstimate:
    """How sure the estimate is; the first `kept` entries of x are parameters, the others nuisance."""
    numbers, count = sample_blocks(problem, blocks)
    return _covariance_of(problem, state, numbers, count, kept)


def sample_blocks(problem: FitProblem, blocks: int = BLOCKS) -> tuple[Array, int]:
    """Block of each sample row, and the number of blocks."""
    weight = next(iter(problem.runs.weight.values()))
    numbers, count = block_numbers(weight, 1, blocks)
    time = np.asarray(numbers).reshape(problem.count, -1)
    parts = [time] * len(problem.runs.weight)
    for effect in sorted(problem.runs.slips):
        ts, instants = np.asarray(problem.runs.t), np.asarray(problem.runs.slips[effect])
        nearest = np.stack([np.searchsorted(t, own) for t, own in zip(ts, instants, strict=True)])
        parts.append(np.take_along_axis(time, np.minimum(nearest, time.shape[1] - 1), axis=1))
    return jnp.asarray(np.concatenate(parts, axis=1).reshape(-1)), count


@eqx.filter_jit
def _covariance_of(problem: FitProblem, state: SearchState, blocks: Array, count: int, kept: int) -> CovarianceEstimate:
    return covariance_inside(problem, state, blocks, count, kept)


def covariance_inside(
    problem: FitProblem, state: SearchState, blocks: Array, count: int, kept: int
) -> CovarianceEstimate:
    """`covariance_of`, for compiled code."""
    rows, size = problem.samples, len(problem.free.names)
    residual, jacobian = problem.loss.weighted(state.residual[:rows], state.jacobian[:rows])
    slopes = jnp.eye(state.x.shape[0], dtype=state.x.dtype)
    slopes = slopes.at[:size, :size].set(problem.free.slopes(state.x[:size]))
    white = _passes_for_white(problem, residual)
    return covariance_estimate(residual, jacobian, state.jacobian[rows:], slopes, blocks, count, kept, white)


def _passes_for_white(problem: FitProblem, residual: Float[Array, " rows"]) -> Bool[Array, ""]:
    """Whether the test of Ljung and Box (1978, Biometrika 65:297) finds no memory in any channel."""
    passes = jnp.asarray(True)
    for name, (rows, weight) in problem.by_channel(residual).items():
        if name not in problem.runs.weight:
            continue  # instants have no neighbours
        counted = jnp.sum(weight)
        e = jnp.where(weight > 0, rows - jnp.sum(rows) / counted, 0.0)
        lags = lag_number(rows.shape[1])
        later = jnp.arange(rows.shape[1])[None, :] + jnp.arange(1, lags + 1)[:, None]
        products = jnp.einsum("rs,rks->k", e, jnp.pad(e, ((0, 0), (0, lags)))[:, later])
        correlation = products / jnp.maximum(jnp.sum(e**2), _TINY)
        left = jnp.maximum(counted - jnp.arange(1, lags + 1), 1)
        statistic = counted * (counted + 2) * jnp.sum(correlation**2 / left)
        passes &= statistic < special.chdtri(lags, _CHANCE)
    return passes


def lag_number(n: int) -> int:
    """Lags of tests of n samples for whiteness: ten a decade, a fifth of the samples at most."""
    return max(min(round(_LAGS_A_DECADE * math.log10(n)), n // _SAMPLES_A_LAG), 1)
