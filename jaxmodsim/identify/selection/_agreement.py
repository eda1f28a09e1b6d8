"""Variation between records: parameters of each record fitted by itself, tested, and carried to the output."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._core.arguments import as_share, as_whole
from ..._core.arrays import on_device
from ..._core.readable import AbstractReadable, Table, interval_text, table_of
from ...friction import AbstractLaw
from ...scene import Scene, scene_numbers, scene_ranges
from ..estimate._problem import FitProblem
from ..estimate._search import SearchOptions, SearchResult, channels_seen, solve
from ..model._parameters import split_ranges
from ..uncertainty._estimate import covariance_of
from ..uncertainty._residual_tests import independent_blocks
from ..uncertainty._result import FitResult

# Standard error against the scale of a parameter above which a record by itself does not determine it.
_DETERMINED = 0.1
# Least eigenvalue of a correlation matrix of estimates against the largest one.
_LEAST = 1e-10
# Standard deviation of the friction level from record to record, as a share of it, by default: two records then differ
# by 5.7 % (root mean square).
VARIATION = 0.04
# Longest step in the coordinates of the fit; share of the largest variance below which one is rounding.
_LONGEST, _NOTHING = 0.1, 1e-12
_Matrix: TypeAlias = Float[np.ndarray, "free free"]


@dataclass(frozen=True, kw_only=True)
class RecordAgreement(AbstractReadable):
    """Whether the parameters of a model are the same in several records, and by how much they vary.

    Each parameter of a record is modelled as a common value, plus a random part of the record, plus the error of its
    fit.

    - `records`, `names`: of the records and of the parameters.
    - `values`, `errors`: of each parameter if it alone, beside those in `differing`, varies from record to record, and
      its standard error with residuals correlated in time, shape `[records, parameters]`. Parameters that some record
      by itself does not determine to a tenth stay at the value of the fit to all.
    - `p`: probability of differences at least as large between equal values, shape `[parameters]`; NaN for a parameter
      that some record does not determine or that ends at a limit.
    - `differing`: names of the parameters that differ, most certain first.
    - `level`: probability that any parameter is reported to differ if none does.
    - `common`, `common_errors`: the common value of each parameter and its standard error, shape `[parameters]`.
    - `between`: standard deviation of each parameter from record to record (Paule, Mandel 1982, J. Res. NBS 87:377),
      shape `[parameters]`; `between_interval`: its 95 % interval (Viechtbauer 2007, Stat. Med. 26:37), shape
      `[parameters, 2]`, which is wide for few records. NaN as `p`.
    - `covariance`: of the parameters between records, shape `[parameters, parameters]`, by the method of moments: the
      scatter less the errors of the fits, positive semidefinite (Jackson, White, Riley 2013, Biom. J. 55:231). Zero
      where `p` is NaN.
    """

    records: tuple[str, ...]
    names: tuple[str, ...]
    values: Float[np.ndarray, "records parameters"]
    errors: Float[np.ndarray, "records parameters"]
    p: Float[np.ndarray, " parameters"]
    differing: tuple[str, ...]
    level: float
    common: Float[np.ndarray, " parameters"]
    common_errors: Float[np.ndarray, " parameters"]
    between: Float[np.ndarray, " parameters"]
    between_interval: Float[np.ndarray, "parameters 2"]
    covariance: Float[np.ndarray, "parameters parameters"]

    @property
    def sentences(self) -> tuple[str, ...]:
        """One for each parameter that differs."""
        lines = []
        for name in self.differing:
            x = self.values[:, self.names.index(name)]
            share = 100 * np.ptp(x) / np.max(np.abs(x))
            p = self.p[self.names.index(name)]
            each = ", ".join(f"{value:.4g} in {record}" for value, record in zip(x, self.records, strict=True))
            lines.append(f"The records differ in {name} by {share:.2g} %: {each} (p = {p:.1g}).")
        return tuple(lines)

    def rows(self) -> list[tuple[str, float, float, float, float, float, float]]:
        """Rows of a table: name, common value, its standard error, between records, its 95 % interval, p."""
        columns = (self.common, self.common_errors, self.between, *self.between_interval.T, self.p)
        return list(zip(self.names, *(x.tolist() for x in columns), strict=True))


@table_of.register
def _(agreement: RecordAgreement) -> Table:
    notes = [*agreement.sentences]
    tested = [name for name, p in zip(agreement.names, agreement.p, strict=True) if np.isfinite(p)]
    if alike := [name for name in tested if name not in agreement.differing]:
        notes.append(f"They do not show a difference in {', '.join(alike)}.")
    if unknown := [name for name in agreement.names if name not in tested]:
        notes.append(f"Not every record determines {', '.join(unknown)}: not compared.")
    rows = [
        (name, f"{x:.5g}", f"{error:.2g}", f"{between:.2g}", interval_text(low, high), f"{p:.2g}")
        for name, x, error, between, low, high, p in agreement.rows()
    ]
    head = ("parameter", "common", "standard error", "between records", "95 % interval", "p")
    return Table(f"Agreement of {', '.join(agreement.records)}", head, rows, tuple(notes))


def agreement(result: FitResult, *, level: float = 0.05, max_steps: int = 400) -> RecordAgreement:
    """Fit each record by itself, from the fit to all, and test whether the parameters are the same.

    If one friction level has changed, correlated parameters change with it in such fits, each by less than its error.
    So each parameter is tested as the only one that differs: by its value in each record with the others common to all,
    from the quadratic forms of the fits. The parameter with the least probability differs if that is below `level`
    over the number of parameters left to test (Bonferroni). It is free from then on, and the others are tested again.

    The statistic is the sum of squared differences between records, in standard errors. It follows an F distribution
    with one degree of freedom less than records, and one less than blocks of samples, from whose scatter each error
    comes; blocks are longer for residuals with long correlation. The standard deviation between records makes the sum
    of squared distances from the weighted mean equal to its expectation; the ends of its interval make it equal to its
    quantiles.

    **Arguments:**

    - `result`: a fit to several records, each run as a whole, that was not loaded from a file.
    - `level`: probability of a false alarm, 0 < level < 1.
    - `max_steps`: limit of the iterations of each fit.

    **Returns:**

    A `RecordAgreement`.

    **Raises:**

    - `ValueError` for one record, records in windows, a loaded result, or a level out of range.
    - `RuntimeError` if the fit to a record ends with values that are not finite.
    """
    from scipy.stats import chi2, f  # most of a second to import, and only needed here

    records = tuple(record.name for record in result.provenance.records)
    search = result.search_for("Agreement")
    problem, names = search.problem, search.problem.free.names
    if len(records) < 2 or problem.count != len(records):
        raise ValueError(
            f"Agreement needs a fit to several whole records, but {len(records)} were fitted in {problem.count} parts."
        )
    level, options = as_share(level, name="level"), SearchOptions(max_steps=as_whole(max_steps, name="max_steps"))
    shared, own = problem.split(search.state.x)

    def fits_with(free: Collection[str]) -> _Fits:
        starts = (jnp.concatenate([shared, own[i]]) for i in range(len(records)))
        fits = [_fit_one(problem, i, x, result, free, options) for i, x in enumerate(starts)]
        return _Fits(*(np.stack(each) for each in zip(*fits, strict=True)))

    fits = fits_with(names)
    tested = _determined(fits.covariances, np.array([result.estimate.scale(name) for name in names]))
    if tested.any() and not tested.all():
        fits = fits_with([name for name, each in zip(names, tested, strict=True) if each])
    variances = np.diagonal(fits.covariances, axis1=1, axis2=2)
    known = tested & np.all(np.isfinite(variances) & (variances > 0), axis=0)
    values, errors, p = fits.values.copy(), np.sqrt(variances), np.full(len(names), np.nan)
    freedom = len(records) - 1
    differing: list[int] = []
    while left := [k for k in np.flatnonzero(known).tolist() if k not in differing]:
        for k in left:
            values[:, k], covariance = fits.if_only([*differing, k], known)
            errors[:, k] = np.sqrt(np.diag(covariance))
            steps = np.diff(values[:, k])
            squares = float(steps @ np.linalg.solve(np.diff(np.diff(covariance, axis=0), axis=1), steps))
            p[k] = f.sf(squares / freedom, freedom, np.sum(fits.freedoms))
        first = min(left, key=lambda k: p[k])
        if not p[first] <= level / len(left):
            break
        differing.append(first)
    quantiles = (float(freedom), *chi2.ppf([0.975, 0.025], freedom).tolist())
    common, common_errors, *between = np.full((5, len(names)), np.nan)
    for k in np.flatnonzero(known):
        x, variance = values[:, k], errors[:, k] ** 2
        spreads = [_between(x, variance, quantile) for quantile in quantiles]
        common[k], precision, _ = _weighted(x, variance + spreads[0])
        common_errors[k] = precision**-0.5
        for column, spread in zip(between, spreads, strict=True):
            column[k] = np.sqrt(spread)
    return RecordAgreement(
        records=records,
        names=names,
        values=values,
        errors=errors,
        p=p,
        differing=tuple(names[k] for k in differing),
        level=level,
        common=common,
        common_errors=common_errors,
        between=between[0],
        between_interval=np.stack(between[1:], axis=1),
        covariance=_covariance_between(fits.values, fits.covariances, known),
    )


class _Fits(NamedTuple):
    """Fits of each record by itself, with a leading axis of records; `freedoms`: degrees of freedom of the errors."""

    values: Float[np.ndarray, "records free"]
    covariances: Float[np.ndarray, "records free free"]
    information: Float[np.ndarray, "records free free"]
    freedoms: Int[np.ndarray, " records"]

    def if_only(
        self, varying: list[int], known: Bool[np.ndarray, " free"]
    ) -> tuple[Float[np.ndarray, " records"], Float[np.ndarray, "records records"]]:
        """The last of the parameters `varying` in each record, the other `known` ones being common, and its covariance.

        They minimise the sum of the quadratic forms of all fits.
        """
        common = [k for k in np.flatnonzero(known).tolist() if k not in varying]
        count, last = len(self.values), len(varying) - 1
        scale = np.sqrt(np.sum(np.diagonal(self.information, axis1=1, axis2=2), axis=0))
        scale = np.where(scale > 0, scale, 1.0)
        scaled = self.information / np.outer(scale, scale)
        to_varying = np.linalg.solve(scaled[:, varying][:, :, varying], scaled[:, varying][:, :, common])
        left = scaled[:, common][:, :, common] - scaled[:, common][:, :, varying] @ to_varying
        share = np.linalg.solve(np.sum(left, axis=0), left)
        # Derivatives of the scaled value in each record by the parameters of the fit to each record.
        by = np.zeros((count, count, len(known)))
        by[:, :, common] = -np.einsum("ir,jrc->ijc", to_varying[:, last], share)
        own = np.arange(count)
        by[np.ix_(own, own, np.array(common, int))] += np.eye(count)[:, :, None] * to_varying[:, None, last]
        by[own, own, varying[last]] = 1.0
        by *= scale / scale[varying[last]]
        whole = [*varying, *common]
        by, covariances = by[:, :, whole], self.covariances[:, whole][:, :, whole]
        return (
            np.einsum("ijk,jk->i", by, self.values[:, whole]),
            np.einsum("ajk,jkl,bjl->ab", by, covariances, by),
        )


def _fit_one(
    together: FitProblem,
    i: int,
    x: Float[Array, " n"],
    result: FitResult,
    free: Collection[str],
    options: SearchOptions,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """The entries of `_Fits` for one record, with only the parameters in `free` fitted.

    The better of two searches: from the end of the fit to all, and from there with the friction level of this record. A
    fit to records with different levels has other parameters wrong, too, in a valley of its own.
    """
    names, problem = together.free.names, together.of_runs(slice(i, i + 1))
    information = result.estimate.information
    if len(free) < len(names):
        problem = problem.pinned(x, information, free)
    search = solve(problem, x, options)
    if levels := [name for name in friction_levels(result) if name in free]:
        level = solve(problem.pinned(x, information, levels), x, options).state.x
        search = min(search, solve(problem, level, options), key=lambda search: float(search.state.cost))
    if not bool(jnp.isfinite(search.state.cost)):
        raise RuntimeError(
            f"The fit to {result.provenance.records[i].name} alone ended with values that are not finite."
        )
    blocks = independent_blocks(search)
    estimate = covariance_of(problem, search.state, range(len(names)), blocks)
    value = problem.at(search.state.x).vector
    limits = problem.free.limits(search.state.x[: len(names)])
    out = [x in limits[name] or name not in free for name, x in zip(names, value.tolist(), strict=True)]
    covariance = estimate.covariance
    covariance[np.diag_indices(len(value))] = np.where(out, np.nan, np.diag(covariance))
    return value, covariance, estimate.information, blocks - 1


def _determined(
    covariances: Float[np.ndarray, "records free free"], scale: Float[np.ndarray, " free"]
) -> Bool[np.ndarray, " free"]:
    """Parameters that each record determines once the least known ones are fixed, one by one."""
    kept = np.all(np.isfinite(np.diagonal(covariances, axis1=1, axis2=2)), axis=0)
    covariances = np.where(kept[:, None] & kept[None, :], covariances, 0.0)
    while kept.any():
        error = np.sqrt(np.maximum(np.max(np.diagonal(covariances, axis1=1, axis2=2), axis=0), 0.0)) / np.where(
            scale > 0, scale, 1.0
        )
        worst = int(np.argmax(np.where(kept, error, -1.0)))
        if error[worst] <= _DETERMINED:
            break
        kept[worst] = False
        column = covariances[:, :, worst]
        covariances = covariances - column[:, :, None] * column[:, None, :] / column[:, worst, None, None]
    return kept


def friction_levels(result: FitResult) -> tuple[str, ...]:
    """Names of the free parameters that are forces of friction: those of the laws in N."""
    model = result.model
    if not isinstance(model, Scene | AbstractLaw):
        return ()
    ranges = split_ranges(scene_numbers(model), scene_ranges(model))
    return tuple(name for name in result.values if name in ranges and ranges[name].unit.split(" per ")[0] == "N")


def _weighted(x: Float[np.ndarray, " records"], variance: Float[np.ndarray, " records"]) -> tuple[float, float, float]:
    """Weighted mean, the sum of the weights, and the weighted sum of squares around it."""
    weight = 1.0 / variance
    mean = float(np.sum(weight * x) / np.sum(weight))
    return mean, float(np.sum(weight)), float(np.sum(weight * (x - mean) ** 2))


def _between(x: Float[np.ndarray, " records"], variance: Float[np.ndarray, " records"], target: float) -> float:
    """Variance between records, >= 0, with which the weighted sum of squares comes to `target`."""
    from scipy.optimize import brentq  # slow to import, and only needed here

    if _weighted(x, variance)[2] <= target:
        return 0.0
    # An upper bound: the sum with equal weights, which are too large.
    most = float(np.sum((x - np.mean(x)) ** 2)) / target
    return float(np.asarray(brentq(lambda between: _weighted(x, variance + between)[2] - target, 0.0, most)))


def _covariance_between(
    values: Float[np.ndarray, "records free"],
    own: Float[np.ndarray, "records free free"],
    known: Bool[np.ndarray, " free"],
) -> Float[np.ndarray, "free free"]:
    """Covariance between records: of the scatter of the values, what exceeds the mean covariance `own` of the fits."""
    covariance = np.zeros(own.shape[1:])
    if not known.any():
        return covariance
    mean = np.mean(own, axis=0)[np.ix_(known, known)]
    scale = np.sqrt(np.diag(mean))
    size, direction = np.linalg.eigh(mean / np.outer(scale, scale))
    size = np.sqrt(np.maximum(size, _LEAST * size[-1]))
    whitened = ((values - np.mean(values, axis=0))[:, known] / scale) @ direction / size
    spread, axes = np.linalg.eigh(whitened.T @ whitened / (len(values) - 1))
    back = scale[:, None] * direction * size @ axes
    covariance[np.ix_(known, known)] = back * np.maximum(spread - 1.0, 0.0) @ back.T
    return covariance


def covariances(result: FitResult, variation: float, agreement: RecordAgreement | None) -> tuple[_Matrix, _Matrix]:
    """Of the free parameters: of their estimate, and of their difference in a new record from the records' mean.

    The first differs from that of the estimate in its blocks of samples, which are longer for long correlation.
    """
    if not (np.isfinite(variation) and variation >= 0):
        raise ValueError(f"variation must be finite and >= 0, such as 0.04 for 4 %, but it is {variation!r}.")
    search = result.search_for("A prediction")
    names, count = search.problem.free.names, len(result.provenance.records)
    own = covariance_of(search.problem, search.state, range(len(names)), independent_blocks(search)).covariance
    known = np.isfinite(np.diag(own))
    own = np.where(np.outer(known, known), own, 0.0)
    level = np.array([result.values[name] * (name in friction_levels(result)) for name in names])
    between = variation**2 * np.outer(level, level)
    if agreement is not None:
        fitted = tuple(record.name for record in result.provenance.records)
        if agreement.names != names or agreement.records != fitted:
            raise ValueError(
                f"The agreement is of {', '.join(agreement.names)} in {', '.join(agreement.records)}, but the fit has"
                f" {', '.join(names)} in {', '.join(fitted)}: take agreement(result)."
            )
        between = (between + (count - 1) * agreement.covariance) / count
    return own, (1 + 1 / count) * between


def mean_variances(search: SearchResult, covariance: _Matrix) -> dict[str, float]:
    """Mean variance of the output at the fitted samples, by channel, in squared noise levels.

    Linearised, by the derivatives that also gave the covariance of the free parameters.
    """
    problem, size = search.problem, len(search.problem.free.names)
    slopes = problem.at(search.state.x).slopes
    jacobian = np.asarray(search.state.jacobian)[: problem.samples, :size] @ np.linalg.pinv(slopes)
    split = problem.by_channel(np.sum((jacobian @ covariance) * jacobian, axis=1))
    return {name: max(float(np.mean(x[weight > 0])), 0.0) for name, (x, weight) in split.items()}


def output_changes(
    search: SearchResult, covariance: _Matrix, output: Callable[[Float[Array, " free"]], Mapping[str, Array]]
) -> list[dict[str, np.ndarray]]:
    """Changes of an output, by channel, whose squares sum up to its variance by that of the free parameters.

    One for each principal axis of the covariance: a central difference over sqrt(3) standard deviations (Norgaard,
    Poulsen, Ravn 2000, Automatica 36:1627), as the derivatives of stick-slip motions hold over much shorter distances.
    Beyond a tenth in the coordinates of the fit the change is taken as linear: models there have little to do with the
    records.
    """
    size, here = len(search.problem.free.names), search.problem.at(search.state.x)
    x = np.asarray(search.state.x)[:size]
    back = np.linalg.pinv(here.slopes)
    scatter = back @ covariance @ back.T
    moving = np.flatnonzero(np.diag(scatter) > 0)
    if not moving.size:
        return []
    scale = np.sqrt(np.diag(scatter)[moving])
    values, vectors = np.linalg.eigh(scatter[np.ix_(moving, moving)] / np.outer(scale, scale))
    changes = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value <= _NOTHING * values[-1]:
            continue
        axis = np.zeros(size)
        axis[moving] = np.sqrt(value) * scale * vector
        step = min(np.sqrt(3.0), _LONGEST / float(np.max(np.abs(axis))))
        ends = (np.clip(x + side * step * axis, here.lower, here.upper).astype(x.dtype) for side in (1.0, -1.0))
        ahead, behind = (output(on_device(end)) for end in ends)
        changes.append({name: (np.asarray(ahead[name]) - np.asarray(behind[name])) / (2 * step) for name in ahead})
    return changes


def change_between(search: SearchResult, covariance: _Matrix) -> dict[str, float]:
    """Mean variance of the output at the fitted samples for this covariance, by channel, in squared noise levels."""
    problem, starts = search.problem, np.asarray(search.state.x)[len(search.problem.free.names) :]
    changes = output_changes(
        search, covariance, lambda x: channels_seen(problem, on_device(np.concatenate([x, starts])))
    )
    variances = {}
    for name, weight in problem.runs.weight.items():
        square = sum((change[name] / float(problem.noise[name])) ** 2 for change in changes)
        variances[name] = float(np.mean((square + np.zeros(weight.shape))[np.asarray(weight) > 0]))
    return variances
