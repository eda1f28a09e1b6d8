"""Whether records agree: each fitted by itself, parameter by parameter; what is common, what varies, by how much."""

import dataclasses
from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...friction import AbstractLaw
from ...scene import Scene, scene_numbers, scene_ranges
from ..estimate._problem import FitProblem
from ..estimate._search import SearchOptions, SearchResult, solve
from ..model._parameters import split_ranges
from ..uncertainty._estimate import covariance_of
from ..uncertainty._result import FitResult
from ._memory import blocks_that_are_independent
from ._opening import pinned

# Standard error against the scale of a parameter from which on a record by itself does not determine it.
_DETERMINED = 0.1
# Least eigenvalue of a correlation matrix of estimates against the largest one.
_LEAST = 1e-10


@dataclass(frozen=True, kw_only=True)
class RecordAgreement:
    """Whether the parameters of a model are the same in several records, and by how much they vary if not.

    Each parameter of a record is taken as a common value plus a random part of the record plus the error of its fit.

    - `records`, `names`: of the records and of the parameters.
    - `values`, `errors`: of each parameter where it alone, and what differs, varies from record to record while the
      others are common, and its standard error (residuals correlated in time allowed for), shape
      `[records, parameters]`. Parameters that some record alone does not determine to a tenth stay at the value of
      the fit to all.
    - `p`: probability that values which are the same come out at least as different, shape `[parameters]`; NaN of a
      parameter that some record does not determine or that ends at a limit.
    - `differing`: names of the parameters that differ, most certain first.
    - `level`: probability with which any parameter at all is said to differ where none does.
    - `common`, `common_errors`: the common value of each parameter and its standard error, shape `[parameters]`.
    - `between`: standard deviation of each parameter from record to record (Paule, Mandel 1982, J. Res. NBS 87:377),
      shape `[parameters]`; `between_interval`: its 95 % interval (Viechtbauer 2007, Stat. Med. 26:37), shape
      `[parameters, 2]`, wide with few records. NaN as `p`.
    - `covariance`: of the parameters between records, shape `[parameters, parameters]`, by the method of moments with
      what errors of the fits explain taken off, never below zero in any direction (Jackson, White, Riley 2013, Biom. J.
      55:231); zero where `p` is NaN.
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

    def __str__(self) -> str:
        """What differs, and what does not as far as the records show."""
        lines = [*self.sentences]
        others = [
            name for name, p in zip(self.names, self.p, strict=True) if name not in self.differing and np.isfinite(p)
        ]
        if others:
            lines.append(f"They do not show a difference in {', '.join(others)}.")
        if held := [name for name, p in zip(self.names, self.p, strict=True) if not np.isfinite(p)]:
            lines.append(f"Not every record determines {', '.join(held)}: not compared.")
        width = max(len(name) for name in self.names)
        lines.append(
            f"{'':{width}}  {'common':>12}  {'std. error':>10}  {'between':>10}  {'95 % interval':>21}  {'p':>7}"
        )
        lines += [
            f"{name:{width}}  {x:12.5g}  {error:10.2g}  {between:10.2g}  {low:9.2g} to {high:8.2g}  {p:7.2g}"
            for name, x, error, between, low, high, p in self.rows()
        ]
        return "\n".join(lines)


def agreement(result: FitResult, *, level: float = 0.05, max_steps: int = 400) -> RecordAgreement:
    """Fit each record by itself, from the fit to all, and test whether the parameters are the same.

    Where a single level of friction has changed, parameters that are correlated with it change with it in such fits,
    and none of them by more than its error. So each parameter is tested as the only one that differs: by the value it
    has in each record if the others are common to all, from the quadratic forms of the fits. The parameter with the
    least probability differs if that is below `level` over the number of parameters left to test (Bonferroni); from
    then on it is free, and the others are tested again.

    The sum of squared differences between records, in standard errors, is held against its distribution (F, one degree
    of freedom less than there are records, and one less than there are blocks of samples from whose scatter each error
    comes; blocks are longer where the residual remembers for long). The standard deviation between records is the one
    with which the sum of squared distances from the weighted mean, errors and deviation together, comes to its
    expectation, and the ends of its interval those with which it comes to its quantiles.

    **Arguments:**

    - `result`: a fit to several records, each run as a whole, that was not loaded from a file.
    - `level`: probability of a false alarm, 0 < level < 1.
    - `max_steps`: limit of the iterations of each fit.

    **Returns:**

    An `RecordAgreement`.

    **Raises:**

    - `ValueError` for one record, records in windows, a loaded result, or a level out of range.
    - `RuntimeError` where the fit to a record ends with values that are not finite.
    """
    from scipy.stats import chi2, f  # most of a second to import, and only needed here

    records = tuple(record.name for record in result.provenance.records)
    if result.search is None:
        raise ValueError("Agreement needs what the fit observed, which a loaded result does not have: fit again.")
    problem = result.search.problem
    if len(records) < 2 or problem.count != len(records):
        raise ValueError(
            f"Agreement needs a fit to several whole records, but {len(records)} were fitted in {problem.count} parts."
        )
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1, but it is {level!r}.")
    shared, own = problem.split(result.search.state.x)
    options = SearchOptions(max_steps=max_steps)

    def alone(tested: Collection[str]) -> _Fits:
        fits = [
            _alone(problem, i, jnp.concatenate([shared, own[i]]), result, tested, options) for i in range(len(records))
        ]
        return _Fits(*(np.stack(each) for each in zip(*fits, strict=True)))

    names = problem.free.names
    fits = alone(names)
    tested = _determined(fits.covariances, np.array([result.estimate.scale(name) for name in names]))
    if tested.any() and not tested.all():
        fits = alone([name for name, each in zip(names, tested, strict=True) if each])
    variances = np.diagonal(fits.covariances, axis1=1, axis2=2)
    known = tested & np.all(np.isfinite(variances) & (variances > 0), axis=0)
    values, errors, p = fits.values.copy(), np.sqrt(variances), np.full(len(names), np.nan)
    freedom = len(records) - 1
    differing: list[int] = []
    while left := [k for k in np.flatnonzero(known).tolist() if k not in differing]:
        for k in left:
            values[:, k], covariance = fits.if_only([*differing, k], known)
            errors[:, k] = np.sqrt(np.diag(covariance))
            p[k] = f.sf(_apart(values[:, k], covariance) / freedom, freedom, np.sum(fits.freedoms))
        first = min(left, key=lambda k: p[k])
        if not p[first] <= level / len(left):
            break
        differing.append(first)
    quantiles = (float(freedom), *chi2.ppf([0.975, 0.025], freedom).tolist())
    found = np.full((5, len(names)), np.nan)
    for k in np.flatnonzero(known):
        x, variance = values[:, k], errors[:, k] ** 2
        between = [_between(x, variance, quantile) for quantile in quantiles]
        mean, precision, _ = _weighted(x, variance + between[0])
        found[:, k] = (mean, precision**-0.5, *np.sqrt(between))
    return RecordAgreement(
        records=records,
        names=names,
        values=values,
        errors=errors,
        p=p,
        differing=tuple(names[k] for k in differing),
        level=level,
        common=found[0],
        common_errors=found[1],
        between=found[2],
        between_interval=found[3:5].T,
        covariance=_covariance_between(fits.values, fits.covariances, known),
    )


class _Fits(NamedTuple):
    """Fits of each record by itself: values, covariances, Fisher information, and degrees of freedom of the errors."""

    values: Float[np.ndarray, "records free"]
    covariances: Float[np.ndarray, "records free free"]
    information: Float[np.ndarray, "records free free"]
    freedoms: Int[np.ndarray, " records"]

    def if_only(
        self, varying: list[int], known: Bool[np.ndarray, " free"]
    ) -> tuple[Float[np.ndarray, " records"], Float[np.ndarray, "records records"]]:
        """The last one of the parameters `varying` in each record if the others of those `known` are common.

        With its covariance between records. The sum of the quadratic forms of all fits has its least there.
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


def _apart(x: Float[np.ndarray, " records"], covariance: Float[np.ndarray, "records records"]) -> float:
    """Sum of squared differences between records, in standard errors."""
    differences = np.diff(x)
    return float(differences @ np.linalg.solve(np.diff(np.diff(covariance, axis=0), axis=1), differences))


def _alone(
    together: FitProblem,
    i: int,
    x: Float[Array, " n"],
    result: FitResult,
    tested: Collection[str],
    options: SearchOptions,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """What `_Fits` has of a fit to one record with only the parameters in `tested` free."""
    names, record = together.free.names, result.provenance.records[i].name
    base, runs, known = jax.tree.map(lambda leaf: leaf[i : i + 1], (together.base, together.runs, together.known))
    problem = dataclasses.replace(together, base=base, runs=runs, known=known)
    problem = problem if len(tested) == len(names) else pinned(problem, x, result, tested)
    search = _search_alone(problem, x, result, tested, options)
    if not bool(jnp.isfinite(search.state.cost)):
        raise RuntimeError(f"The fit to {record} alone ended with values that are not finite.")
    blocks = blocks_that_are_independent(search)
    found = covariance_of(problem, search.state, range(len(names)), blocks)
    covariance = found.covariance
    value = problem.at(search.state.x).vector
    limits = problem.free.limits(search.state.x[: len(names)])
    out = [x in limits[name] or name not in tested for name, x in zip(names, value.tolist(), strict=True)]
    covariance[np.diag_indices(len(value))] = np.where(out, np.nan, np.diag(covariance))
    return value, covariance, found.information, blocks - 1


def _determined(
    covariances: Float[np.ndarray, "records free free"], scale: Float[np.ndarray, " free"]
) -> Bool[np.ndarray, " free"]:
    """Parameters that each record determines once the least known ones are given, which go one by one."""
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


def _search_alone(
    problem: FitProblem, x: Float[Array, " n"], result: FitResult, tested: Collection[str], options: SearchOptions
) -> SearchResult:
    """From where the fit to all ended, and from there with the friction level of this record: the better of both.

    What fits several records whose levels differ has other parameters wrong, too, and lies in a valley of its own.
    """
    direct = solve(problem, x, options)
    levels = [name for name in friction_levels(result) if name in tested]
    if not levels:
        return direct
    level = solve(pinned(problem, x, result, levels), x, options).state.x
    return min(direct, solve(problem, level, options), key=lambda search: float(search.state.cost))


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
    # With equal weights, which are too large, the sum is still larger than with those of the weighted mean.
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
