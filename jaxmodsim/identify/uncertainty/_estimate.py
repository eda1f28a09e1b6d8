"""Estimates with their covariance, for residuals of any size that may be correlated in time."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int
from scipy import special  # scipy.stats takes most of a second to import

from ..._core.arguments import as_share
from ..._core.arrays import on_device
from ..data._record import Record
from ..estimate._problem import FitProblem
from ..estimate._search import SearchState, linearised, state_at
from ..model._observe import RecordedMotion, motion_of

# Blocks of samples: enough for the scatter of the scores of a dozen parameters, each much longer than the correlation
# of the residual of a mechanism, which sensor steps in slow motion make long.
BLOCKS = 16
# Smallest eigenvalue of a scaled normal matrix, relative to the largest one, in units of rounding.
ROUNDING = 10.0
# A block of samples determines a direction alone if less than this share of its information is in other blocks.
_ALONE = 0.01
# An offset is reported beyond so many standard errors; share of a constant below which the parameters take it up.
_BEYOND, _NO_PART = 4.0, 1e-8
# Lags of tests for whiteness for a decade of samples, and samples for each lag at least. Probability below which a
# residual is not white. Keeps divisions finite.
_LAGS_A_DECADE, _SAMPLES_A_LAG = 10, 5
_CHANCE, _TINY = 0.01, 1e-30
# Derivatives are tested over this share of a standard error; their error must be below this share of the change.
_TRIED, _HOLDS = 0.1, 0.5
# Share of the largest information from which an axis is determined.
_SEEN = 1e-6


@dataclass(frozen=True, kw_only=True)
class ParameterEstimate:
    """Fitted parameters and their uncertainty.

    - `values`, `start`: by name. `units`: unit of each parameter that declares one.
    - `covariance`, `white`: of the parameters, shape `[free, free]`, in the order of `values`; the first with the
      correlation of the residual in time, the second for a residual of white noise. Both assume that the model is right
      except for noise.
    - `information`: Fisher information of the parameters, shape `[free, free]`, the noise at its level.
    - `logarithmic`: names of the parameters that must be positive; their intervals are symmetric in the logarithm.
    - `bounds`: lower and upper limit of each parameter at the estimate.
    - `natural`: for a parameter of either sign, the change that moves the output by as much as the measured samples
      scatter (for a constant force: the forces in the record); 0 for the others.
    """

    values: dict[str, float]
    start: dict[str, float]
    units: dict[str, str]
    covariance: Float[np.ndarray, "free free"]
    white: Float[np.ndarray, "free free"]
    information: Float[np.ndarray, "free free"]
    logarithmic: tuple[str, ...]
    bounds: dict[str, tuple[float, float]]
    natural: dict[str, float] = field(default_factory=dict)

    def scale(self, name: str) -> float:
        """The scale of a standard error: the value, or the natural scale if that is larger."""
        return max(abs(self.values[name]), self.natural.get(name, 0.0))

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
    """A deficiency of the motion, in a sentence, and the free parameters that it leaves unknown."""

    sentence: str
    about: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class FitDiagnostics:
    """The course of a fit, and its residual.

    - `rmse`: root mean square of output less measured value, by channel, in its unit.
    - `noise`: standard deviation of each channel, known or estimated.
    - `ending`: why the search ended. `evaluations`: of the model and its derivatives.
    - `step_error`: root mean square change of each channel with four times as many integration steps, and
      `step_moves`: by how many standard errors each parameter moves then; both empty for adaptive steps.
    - `starts`: root mean square, in noise levels, at the end from each of several starts, best first.
    - `single_precision`: whether it was computed in float32.
    - `issues`: deficiencies of the motion, with the parameters that they leave unknown; part of the warnings.
    """

    rmse: dict[str, float]
    noise: dict[str, float]
    ending: str
    evaluations: int
    step_error: dict[str, float]
    step_moves: dict[str, float]
    starts: tuple[float, ...]
    single_precision: bool
    issues: tuple[IdentifiabilityIssue, ...]


@dataclass(frozen=True, kw_only=True)
class FitProvenance:
    """The records and the model of a fit.

    - `records`: the fitted records. `outputs`: the model's output at their times, by channel, one dict a record.
    - `coordinates`: channels (for a law by itself, inputs) that are a coordinate or a velocity, as `q[0]`, by name.
    - `numbers`: all numbers of the model by name, fixed ones included.
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
        """Coordinates and velocities that the model's output shows, one a record."""
        return tuple(
            motion_of(record, outputs, self.coordinates)
            for record, outputs in zip(self.records, self.outputs, strict=True)
        )


class CovarianceEstimate(NamedTuple):
    """The uncertainty of an estimate.

    - `covariance`: of the parameters, with the correlation of the residual in time.
    - `white`: the covariance for a residual of white noise.
    - `information`: Fisher information of the samples, in noise levels, and of the prior, with the other numbers
      unknown.
    - `refused`: whether the derivatives do not hold, see `derivatives_hold`; the variances are then infinite.
    """

    covariance: Float[np.ndarray, "free free"]
    white: Float[np.ndarray, "free free"]
    information: Float[np.ndarray, "free free"]
    refused: bool = False


def covariance_estimate(
    residual: Float[np.ndarray, " rows"],
    jacobian: Float[np.ndarray, "rows n"],
    extra: Float[np.ndarray, "others n"],
    slopes: Float[np.ndarray, "n n"],
    blocks: Int[np.ndarray, " rows"],
    count: int,
    parameters: int,
    white: bool,
) -> CovarianceEstimate:
    """Covariance `H^-1 S H^-1` with S from the scatter of the scores of blocks of samples.

    Residuals may be correlated in any way within a block. Each block's score `J_b' r_b` is corrected for the fit to the
    block itself by `(I - J_b'J_b H^-1)^-1`, which makes the sum the jackknife over blocks (Bell, McCaffrey 2002, Survey
    Methodology 28:169). Otherwise errors are too small if few samples determine a parameter.

    With so few blocks a variance is uncertain by a quarter. If the residual passes for white noise, S is shrunk towards
    that of white noise, by the share of their squared difference that chance explains (Ledoit, Wolf 2003, J. Empirical
    Finance 10:603; Schaefer, Strimmer 2005, Stat. Appl. Genet. Mol. Biol. 4:32), in coordinates in which the latter is
    the unit matrix.

    **Arguments:**

    - `residual`, `jacobian`: of the samples, by the coordinates x.
    - `extra`: rows of the Jacobian that are no samples: the prior, links between windows.
    - `slopes`: derivatives of the parameters by x.
    - `blocks`, `count`: number of each row's block, and of blocks.
    - `parameters`: number of parameters, the first entries of x; the others are nuisance.
    - `white`: whether the residual passes for white noise.
    """
    rounding = ROUNDING * float(np.finfo(jacobian.dtype).eps)
    residual, jacobian, extra = (each.astype(float) for each in (residual, jacobian, extra))
    n = jacobian.shape[1]
    beside = extra.T @ extra
    matrix = jacobian.T @ jacobian + beside
    silent = np.diagonal(matrix) == 0
    # Coordinates in which the information is the unit matrix; sums of squares, so that no variance is below zero.
    root = _floored_root(matrix, rounding)
    rows, others = jacobian @ root, extra @ root
    shows = np.any(jacobian != 0, axis=1)
    # Samples of rest have noise, but may show no parameter at all.
    variance = np.sum(residual**2) / max(np.sum(shows | (residual != 0)) - n, 1)
    own = [np.flatnonzero(shows & (blocks == b)) for b in range(count)]
    scores = np.concatenate([_block_scores(rows[here], residual[here], variance) for here in own])
    noise, fair = np.sqrt(variance) * rows, (count - 1) / count
    share = _chance(scores, fair * scores.T @ scores - noise.T @ noise) if white else 0.0
    change = slopes @ root

    first, nuisance = slice(parameters), slice(parameters, None)

    def of_parameters(*parts: np.ndarray) -> np.ndarray:
        moved = np.concatenate(parts) @ change[first].T
        covariance = moved.T @ moved
        np.fill_diagonal(covariance, np.where(silent[first], np.inf, np.diagonal(covariance)))
        return covariance

    back, cross = np.linalg.pinv(slopes[first, first]), matrix[first, nuisance]
    known = matrix[first, first] - cross @ floored_inverse(matrix[nuisance, nuisance], rounding) @ cross.T
    information = back.T @ known @ back
    whole = of_parameters(np.sqrt(fair * (1 - share)) * scores, np.sqrt(share) * noise, others)
    return CovarianceEstimate(whole, of_parameters(noise, others), information)


def _block_scores(
    jacobian: Float[np.ndarray, "rows n"], residual: Float[np.ndarray, " rows"], variance: float
) -> Float[np.ndarray, "scores n"]:
    """Scores of a block, corrected for the fit to it, in coordinates in which the whole information is the unit matrix.

    In directions that the block determines alone its score is zero, as its residual is fitted to it. There the scores
    are those of its parts; a single sample has the `variance` of all residuals.
    """
    shares, axes = np.linalg.eigh(jacobian.T @ jacobian)
    alone = shares > 1 - _ALONE
    corrected = axes.T @ (jacobian.T @ residual) / np.where(alone, 1.0, 1 - shares)
    score = (axes[:, ~alone] @ corrected[~alone])[None]
    if not alone.any():
        return score
    only = axes[:, alone]
    if len(residual) == 1:
        return np.concatenate([score, np.sqrt(variance) * only.T])
    parts = np.array_split(np.arange(len(residual)), min(BLOCKS, len(residual)))
    inner = [_block_scores(jacobian[part], residual[part], variance) for part in parts]
    return np.concatenate([score, np.concatenate(inner) @ only @ only.T])


def _chance(scores: Float[np.ndarray, "scores n"], difference: Float[np.ndarray, "n n"]) -> float:
    """Share of a squared difference of S that chance explains, in coordinates of unit information."""
    products = np.einsum("bi,bj->bij", scores, scores)
    chance = np.sum((products - np.mean(products, axis=0)) ** 2)
    share = chance / max(float(np.sum(difference**2)), _TINY)
    return min(float(share), 1.0) if np.isfinite(share) else 0.0


def floored_inverse(matrix: Float[np.ndarray, "n n"], least: float) -> Float[np.ndarray, "n n"]:
    """Inverse of a normal matrix, with eigenvalues of at least the share `least` of the largest one.

    They are those in columns of unit length; a column of zeros counts as one. A direction that the record does not
    determine gets a huge error.
    """
    root = _floored_root(matrix, least)
    return root @ root.T


def _floored_root(matrix: Float[np.ndarray, "n n"], least: float) -> Float[np.ndarray, "n n"]:
    """R with `R R'` the `floored_inverse` of the matrix."""
    if not matrix.size:
        return matrix
    scale = np.sqrt(np.diagonal(matrix))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    return vectors / np.sqrt(np.maximum(values, least * max(values[-1], 1.0))) / scale[:, None]


def in_unit_columns(
    jacobian: Float[np.ndarray, "rows n"],
) -> tuple[Float[np.ndarray, "rows n"], Float[np.ndarray, " n"]]:
    """A Jacobian with columns of unit length, and their lengths; a column of zeros stays, and has the length 1."""
    size = np.linalg.norm(jacobian, axis=0)
    size = np.where(size > 0, size, 1.0)
    return jacobian / size, size


def correlated(
    names: Sequence[str], correlation: Float[np.ndarray, "free free"], least: float
) -> list[tuple[str, str, float]]:
    """Pairs of names whose correlation exceeds `least` in size, in the order of the names, with the correlation."""
    places = np.argwhere(np.abs(np.tril(correlation, -1)) > least).tolist()
    return [(names[j], names[i], float(correlation[i, j])) for i, j in places]


def correlation_of(covariance: Float[np.ndarray, "free free"]) -> Float[np.ndarray, "free free"]:
    """Correlation of estimates by their covariance; 0 with undetermined ones."""
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where((errors > 0) & np.isfinite(errors), errors, 1.0)
    known = np.isfinite(covariance) & np.isfinite(np.add.outer(errors, errors))
    correlation = np.where(known, np.where(known, covariance, 0.0) / np.outer(safe, safe), 0.0)
    np.fill_diagonal(correlation, 1.0)
    return correlation


def interval(
    value: float, error: float, limits: tuple[float, float], logarithmic: bool, level: float
) -> tuple[float, float]:
    """Interval by Student's t, with one degree of freedom less than blocks of samples.

    For a `logarithmic` parameter, which must stay above its lower limit, it is symmetric in the logarithm of the
    distance from it. For others it is cut at the limits, which are infinite for none.
    """
    level = as_share(level, name="level")
    low, high = limits
    margin = float(special.stdtrit(BLOCKS - 1, 0.5 + level / 2)) * error
    if logarithmic and value > low:
        with np.errstate(over="ignore"):
            ratio = float(np.exp(margin / (value - low)))
        return low + (value - low) / ratio, min(low + (value - low) * ratio, high)
    return max(value - margin, low), min(value + margin, high)


def covariance_of(
    problem: FitProblem, state: SearchState, entries: Sequence[int], blocks: int = BLOCKS
) -> CovarianceEstimate:
    """The covariance of the entries `entries` of x; the others are nuisance.

    In NumPy, since its many small matrices would take seconds to compile.
    """
    if not derivatives_hold(problem, state):
        unknown, none = np.diag(np.full(len(entries), np.inf)), np.zeros((len(entries), len(entries)))
        return CovarianceEstimate(unknown, unknown, none, refused=True)
    numbers, count = sample_blocks(problem, blocks)
    rows, slopes = problem.samples, problem.slopes_at(state.x)
    residual, jacobian = (each[:rows] for each in linearised(problem, state))
    white = _passes_for_white(problem, residual)
    extra = np.asarray(state.jacobian)[rows:]
    order = np.array([*entries, *(k for k in range(slopes.shape[0]) if k not in set(entries))])
    jacobian, extra, slopes = jacobian[:, order], extra[:, order], slopes[np.ix_(order, order)]
    return covariance_estimate(residual, jacobian, extra, slopes, numbers, count, len(entries), white)


def natural_scales(problem: FitProblem, state: SearchState, entries: Sequence[int]) -> Float[np.ndarray, " entries"]:
    """Changes of the parameters `entries` that move the output by as much as the samples scatter; 0 without effect."""
    jacobian = np.asarray(state.jacobian, float)[: problem.samples]
    scatter = []
    for name, weight in problem.runs.weight.items():
        x = np.asarray(problem.runs.measured[name])[np.asarray(weight) > 0]
        scatter.append(x.size * (np.std(x) / float(problem.noise[name])) ** 2 if x.size else 0.0)
    slopes = np.abs(np.diag(problem.slopes_at(state.x)))[list(entries)]
    moved = np.linalg.norm(jacobian[:, list(entries)], axis=0) / slopes
    return np.where(moved > 0, np.sqrt(sum(scatter)) / np.where(moved > 0, moved, 1.0), 0.0)


def offset_issues(
    problem: FitProblem, state: SearchState, entries: Sequence[int], errors: Float[np.ndarray, " entries"]
) -> tuple[IdentifiabilityIssue, ...]:
    """Constant offsets of channels that the model lacks, as an offset of a sensor.

    One Gauss-Newton step with the offset as one more parameter. Only offsets far beyond their standard error that move
    a parameter by more than its own; none of a channel whose offset the start takes up.

    **Arguments:**

    - `entries`: entries of x whose parameters count. `errors`: their standard errors.
    """
    if problem.loss.robust or problem.base is None or not np.isfinite(float(state.cost)):
        return ()
    rows, residual = problem.samples, np.asarray(state.residual, float)
    scaled, size = in_unit_columns(np.asarray(state.jacobian, float))
    numbers, count = sample_blocks(problem)
    issues = []
    for channel in problem.runs.weight:
        column = np.concatenate([np.asarray(w) * (name == channel) for name, w in problem.columns.items()], axis=1)
        column = np.concatenate([column.reshape(-1), np.zeros(problem.rows - rows)])
        taken = np.linalg.lstsq(scaled, column, rcond=_NO_PART)[0]
        rest = column - scaled @ taken
        if np.sum(rest**2) <= _NO_PART * np.sum(column**2):
            continue
        wide = np.column_stack([column, scaled])
        step = -np.linalg.lstsq(wide, residual, rcond=_NO_PART)[0]
        offset, left = float(step[0]), residual + wide @ step
        estimate = covariance_estimate(
            left[:rows], wide[:rows], wide[rows:], np.eye(wide.shape[1]), numbers, count, 1, False
        )
        error = math.sqrt(estimate.covariance[0, 0])
        moved = problem.slopes_at(state.x) @ (offset * taken / size)
        far = np.abs(moved[list(entries)]) > errors
        if abs(offset) > _BEYOND * error and far.any():
            level = float(problem.noise[channel])
            sentence = (
                f"{channel} seems to have a constant offset of {offset * level:.3g} +- {error * level:.1g}: with it"
                " parameters move by more than their standard errors, so their intervals do not hold. Subtract it from"
                " the record and fit again."
            )
            issues.append(IdentifiabilityIssue(sentence, ()))
    return tuple(issues)


def step_moves(
    problem: FitProblem,
    state: SearchState,
    entries: Sequence[int],
    errors: Mapping[str, float],
    changes: Mapping[str, Float[np.ndarray, "runs samples"]],
) -> dict[str, float]:
    """By how many standard errors each parameter moves with four times as many integration steps.

    One Gauss-Newton step. A small error of the steps counts in long records, since it is the same in all of them.

    **Arguments:**

    - `entries`: entries of x whose parameters count. `errors`: their standard errors by name.
    - `changes`: of the output with more steps, by channel.

    **Returns:**

    The moves by name; none without changes, or if they are not finite.
    """
    if not changes or not all(np.isfinite(each).all() for each in changes.values()):
        return {}
    rows = [changes[name] / float(problem.noise[name]) for name in problem.columns]
    scaled, size = in_unit_columns(np.asarray(state.jacobian, float))
    moved = np.concatenate([np.concatenate(rows, axis=1).reshape(-1), np.zeros(problem.rows - problem.samples)])
    step = -np.linalg.lstsq(scaled, moved, rcond=_NO_PART)[0] / size
    far = np.abs(problem.slopes_at(state.x) @ step)[list(entries)]
    return {name: x / errors[name] for name, x in zip(errors, far.tolist(), strict=True) if errors[name] > 0}


def derivatives_hold(problem: FitProblem, state: SearchState) -> bool:
    """Whether the output changes as its derivatives predict, over a small part of the standard errors.

    It does not if rounding or the integration steps make the output rough. Derivatives are then too large by many
    powers of ten, and standard errors too small, down to below the rounding of the parameter.
    """
    x, box = np.asarray(state.x), problem.box
    jacobian, residual = (np.asarray(each).astype(float) for each in (state.jacobian, state.residual))
    scale = np.sqrt(np.sum(jacobian**2, axis=0))
    # Columns of rounding belong to parameters without effect.
    scale = np.where(scale > float(np.finfo(x.dtype).eps) * np.max(scale), scale, np.inf)
    values, vectors = np.linalg.eigh(np.nan_to_num((jacobian / scale).T @ (jacobian / scale)))
    rounding = ROUNDING * float(np.finfo(x.dtype).eps) * max(values[-1], _TINY)
    level = np.sqrt(np.mean(residual[: problem.samples][problem.weights > 0] ** 2))
    axes = _TRIED * level * vectors / np.sqrt(np.maximum(values, rounding)) / scale[:, None]
    # Along undetermined axes the output is not linear over a standard error. Coordinates are about 1 in size.
    axes = axes[:, values > _SEEN * values[-1]]
    farthest = float(np.finfo(x.dtype).eps) ** (1 / 3)
    move = np.sum(axes * np.minimum(1.0, farthest / np.maximum(np.max(np.abs(axes), axis=0), _TINY)), axis=1)
    inside = np.clip(move, np.asarray(box.lower) - x, np.asarray(box.upper) - x)
    there = np.asarray(state_at(problem, on_device((x + inside).astype(x.dtype))).residual)
    missed = np.linalg.norm(there - residual - jacobian @ inside)
    return bool(missed < _HOLDS * np.linalg.norm(jacobian @ move))


def sample_blocks(problem: FitProblem, blocks: int = BLOCKS) -> tuple[Int[np.ndarray, " rows"], int]:
    """Number of the block of each sample row, in the order of the residual, and the number of blocks.

    All channels of a time are in one block. Runs share the blocks by their numbers of samples.
    """
    weight = np.max(np.stack([np.asarray(each) for each in problem.runs.weight.values()]), axis=0)
    counts = np.sum(weight > 0, axis=1).tolist()
    numbers, used = [], 0
    for count in counts:
        own = max(round(blocks * count / sum(counts)), 1)
        numbers.append(used + np.minimum(np.arange(weight.shape[1]) * own // max(count, 1), own - 1))
        used += own
    time = np.stack(numbers)
    parts = [time] * len(problem.runs.weight)
    for effect in sorted(problem.runs.slips):
        ts, instants = np.asarray(problem.runs.t), np.asarray(problem.runs.slips[effect])
        nearest = np.stack([np.searchsorted(t, own) for t, own in zip(ts, instants, strict=True)])
        parts.append(np.take_along_axis(time, np.minimum(nearest, time.shape[1] - 1), axis=1))
    return np.concatenate(parts, axis=1).reshape(-1), used


def _passes_for_white(problem: FitProblem, residual: Float[np.ndarray, " rows"]) -> bool:
    """Whether the test of `whiteness` finds no correlation in any channel."""
    for name, (rows, weight) in problem.by_channel(residual.astype(float)).items():
        if name not in problem.runs.weight:
            continue  # slip instants are no series
        counted = float(np.sum(weight))
        e = np.where(weight > 0, rows - np.sum(rows) / counted, 0.0)
        lags = range(1, lag_number(rows.shape[1]) + 1)
        products = np.array([np.sum(e[:, :-lag] * e[:, lag:]) for lag in lags])
        if not whiteness(products / max(float(np.sum(e**2)), _TINY), counted) > _CHANCE:
            return False
    return True


def whiteness(correlation: Float[np.ndarray, " lags"], samples: float) -> float:
    """Probability that white noise has such an autocorrelation at lags from 1: Ljung, Box 1978, Biometrika 65:297."""
    left = np.maximum(samples - np.arange(1, len(correlation) + 1), 1)
    return float(special.chdtrc(len(correlation), samples * (samples + 2) * np.sum(correlation**2 / left)))


def lag_number(n: int) -> int:
    """Lags of tests of n samples for whiteness: ten a decade, a fifth of the samples at most."""
    return max(min(round(_LAGS_A_DECADE * math.log10(n)), n // _SAMPLES_A_LAG), 1)
