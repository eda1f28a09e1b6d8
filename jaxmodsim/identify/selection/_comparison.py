"""The result of a comparison: held-out errors, information criteria, and the simplest sufficient model."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from ..._core.arrays import on_device
from ..._core.readable import AbstractReadable, Table, table_of
from ..._core.system import jsonable
from ..estimate._problem import AbstractLoss
from ..estimate._search import SearchResult, linearised
from ..uncertainty._estimate import in_unit_columns, sample_blocks
from ..uncertainty._residual_tests import effective_samples
from ..uncertainty._result import FitResult
from ._agreement import VARIATION, change_between, covariances, mean_variances

# Directions of the parameters whose information is below this share of the largest are lost in rounding.
_LEAST = 1e-10
# Residual of each channel, in its unit, in one part of the records.
Part: TypeAlias = dict[str, np.ndarray]
# A parameter is not determined if its standard error is above this share of its value, or if it has moved by more than
# this factor from its start.
_SHARE, _FAR = 0.5, 1e6
# Held-out errors that differ by no more than this factor make no difference in use.
_AS_GOOD = 1.1
# Relative tolerance of the fits to all but a part, which start close to the optimum: errors that are closer are equal.
ENOUGH = 1e-4
# Undetermined parameters that the conclusion names.
_MOST_NAMES = 4


def deviance(search: SearchResult) -> float:
    """Minus twice the logarithm of the likelihood at the noise levels of the fit, up to a constant.

    `sum over channels of n ln(noise^2) + sum of losses`; with levels estimated by least squares, `n ln(RSS/n) + n`.
    """
    problem = search.problem
    counts = {name: int(np.sum(np.asarray(weight) > 0)) for name, weight in problem.columns.items()}
    levels = sum(count * 2 * float(np.log(float(problem.noise[name]))) for name, count in counts.items())
    return levels + 2 * float(problem.loss.cost(on_device(np.asarray(search.state.residual)[: problem.samples])))


def penalty(search: SearchResult) -> float:
    """Trace of `H^-1 S` of Takeuchi (1976, Suri-Kagaku 153:12): information H, covariance S of the scores.

    It is the number of parameters for a residual of white noise, and larger for a correlated one. S comes from the
    scatter of the scores of blocks of samples, as in the covariance of the estimate. The trace is formed in the
    principal directions of H, since H^-1 is useless for parameters that are hardly distinguishable. A direction that
    the record does not determine counts as one parameter.
    """
    rows = search.problem.samples
    residual, jacobian = (each[:rows] for each in linearised(search.problem, search.state))
    scaled, size = in_unit_columns(jacobian)
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    known = values > _LEAST * values[-1]
    blocks, count = sample_blocks(search.problem)
    scores = np.zeros((count, len(size)))
    np.add.at(scores, blocks, scaled * residual[:, None])
    across = (scores - np.mean(scores, axis=0)) @ vectors[:, known]
    return float(np.sum(across**2 / values[known]) * count / (count - 1) + np.sum(~known))


class CrossValidated(NamedTuple):
    """A fit, and the residuals of its held-out parts; those with starts fitted to these, if the model has states."""

    result: FitResult
    held: tuple[Part, ...]
    start_fitted: tuple[Part, ...]


@dataclass(frozen=True, kw_only=True)
class Ranked:
    """One model of a comparison.

    - `name`, `description`: of the model. `parameters`: number of all fitted numbers, initial states included.
    - `held_out`, `standard_error`: root mean square held-out error, and its standard error; only the start of each
      part was fitted, to its first samples. `start_fitted`: the error with starts fitted to all of each part; None for
      laws, which have none.
    - `parts`: the root mean square errors of the held-out parts, shape `[parts]`.
    - `expected`: root mean square error to expect on a new record. Its square is that of `held_out`, plus the
      variances that uncertain parameters add over whole records and that a varying friction level adds. With held-out
      records, which show these, it is `held_out`.
    - `over_the_best`, `over_the_best_standard_error`: `expected` less that of the best model, and the standard error of
      this difference, from the differences in each part; at least the tolerance of the fits, 1e-4 of `expected`.
    - `fitted`: root mean square error of the fit to everything.
    - `takeuchi`, `bic`: information criteria less the least of all models; see `Comparison`.
    - `penalty`: effective number of parameters, of Takeuchi's criterion.
    - `undetermined`: names of parameters that the records do not determine.
    """

    name: str
    description: str
    parameters: int
    held_out: float
    standard_error: float
    parts: Float[np.ndarray, " parts"]
    expected: float
    over_the_best: float
    over_the_best_standard_error: float
    start_fitted: float | None
    fitted: float
    takeuchi: float
    bic: float
    penalty: float
    undetermined: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Comparison(AbstractReadable):
    """Models, ranked by the error to expect on a new record, from their held-out error.

    Held-out parts begin anew and are short, which hides the effect of uncertain parameters on a whole record. So
    `J V J'` is added to the squared error, with the covariance V of the parameters and the derivatives J of the output
    of the fit to everything. A friction level that varies from record to record by 4 % (standard deviation) adds the
    same to all models, since the machine varies. This variance is that of the model with the least held-out error, of
    those whose parameters the records determine if there are any.

    Errors are root mean squares in the unit of a single channel. With several channels they are in noise levels (known,
    or the least of any model); with another loss than squares, they are roots of the mean loss. The standard error of
    the mean square comes from its scatter over the held-out parts. It is an approximation: the parts are few, and their
    fits share samples (Bengio, Grandvalet 2004, J. Mach. Learn. Res. 5:1089).

    Two criteria rank the fits to everything, with residuals correlated in time. With D the deviance
    `sum of n ln(noise^2) + sum of losses`, k parameters, n samples:

    - Takeuchi's `(D + 2 trace(H^-1 S)) m/n`, H the information, S the covariance of the scores, from their scatter
      over blocks of samples. For white residuals the trace is k and m = n, and this is Akaike's criterion.
    - BIC with effective samples, `D m/n + k ln(m)`.

    m is the number of effective samples: n over the correlation of the residual, by Geyer's initial positive sequence.
    It is that of the best fit, whose residual is nearest to the noise; a separate m for each model would compare
    different things. It brings both criteria to one scale: a difference of 2 is small, one of 10 large.

    - `ranked`: the models, best first. `failures`: reasons, by the name of the model. `left`: names of the models that
      were not finished when the comparison was interrupted.
    - `results`: the fits to everything, by name.
    - `by`: the held-out parts, in words. `samples`, `effective`: number of samples, and of equivalent independent ones.
    """

    ranked: tuple[Ranked, ...]
    failures: dict[str, str]
    left: tuple[str, ...]
    results: dict[str, FitResult]
    by: str
    samples: int
    effective: float

    @property
    def best(self) -> str:
        """Name of the model with the least error to expect on a new record.

        **Raises:**

        - `ValueError` if no model could be fitted.
        """
        if not self.ranked:
            reasons = " ".join(f"{name}: {reason}" for name, reason in self.failures.items())
            raise ValueError(f"No model could be fitted. {reasons}")
        return self.ranked[0].name

    @property
    def simplest(self) -> str:
        """Name of the simplest model that is no worse than the best by more than one standard error.

        Its held-out error must also be larger by no more than a tenth, since with few parts the standard error is
        uncertain. Only the second condition counts if the records do not determine all parameters of the best.

        The simplest has the fewest parameters among the models whose parameters the records determine, or among all if
        there are none: undetermined parameters say nothing about another motion.

        This is the one-standard-error rule of Breiman et al. (1984, Classification and Regression Trees, section
        3.4.3), with the standard error of the difference from the best model, which excludes errors common to all.

        **Raises:**

        - `ValueError` if no model could be fitted.
        """
        best = self._of(self.best)
        near = [
            each
            for each in self.ranked
            if each is best
            or (
                each.held_out <= _AS_GOOD * best.held_out
                and (each.over_the_best <= each.over_the_best_standard_error or bool(best.undetermined))
            )
        ]
        return min(near, key=lambda each: (bool(each.undetermined), each.parameters, each.expected)).name

    def _of(self, name: str) -> Ranked:
        return next(each for each in self.ranked if each.name == name)

    @property
    def table(self) -> list[dict[str, object]]:
        """Rows by rank, then the models that failed or were not finished, of types that JSON knows."""
        rows: list[dict[str, object]] = [
            {**asdict(each), "parts": each.parts.tolist(), "undetermined": list(each.undetermined), "failed": None}
            for each in self.ranked
        ]
        rows.extend({"name": name, "failed": reason} for name, reason in self.failures.items())
        return rows + [{"name": name, "failed": "not finished"} for name in self.left]

    @property
    def conclusion(self) -> str:
        """The simplest sufficient model, in a sentence or two."""
        best, simple = self._of(self.best), self._of(self.simplest)
        text = (
            f"The simplest sufficient law is {simple.name}{f' ({simple.description})' if simple.description else ''}:"
            f" {simple.parameters} parameters, held-out error {simple.held_out:.4g}"
        )
        if simple.expected > simple.held_out:
            text += f", {simple.expected:.4g} to expect on a new record"
        simpler = [each for each in self.ranked if each.parameters < best.parameters]
        if simple is not best:
            over, error = simple.over_the_best, simple.over_the_best_standard_error
            text += (
                f"; {best.name} with {best.parameters} is expected to be better by {over:.2g}, which is"
                f" {'within' if over <= error else 'more than'} one standard error, {error:.2g}."
            )
        elif simpler:
            near = simpler[0]
            text += (
                f", the least of all; with fewer parameters {near.name} is worse by {near.over_the_best:.2g}, standard"
                f" error {near.over_the_best_standard_error:.2g}."
            )
        else:
            text += ", the least of all."
        for each in dict.fromkeys((simple.name, best.name)):
            if names := self._of(each).undetermined:
                listed = ", ".join(names[:_MOST_NAMES])
                listed += f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
                text += f" But the records do not determine {listed} of {each}: do not use these values."
        return text

    def to_dict(self) -> dict[str, object]:
        """Everything except samples and models, in types of JSON; numbers that are not finite are None."""
        return jsonable(
            {
                "held_out": self.by,
                "samples": self.samples,
                "effective_samples": self.effective,
                "models": self.table,
                "best": self.best if self.ranked else None,
                "simplest": self.simplest if self.ranked else None,
                "conclusion": self.conclusion if self.ranked else None,
                "fits": {name: result.to_dict() for name, result in self.results.items()},
            }
        )


@table_of.register
def _(comparison: Comparison) -> Table:
    head = ("model", "parameters", "held out", "standard error", "new record", "over the best", "start fitted",
            "all fitted", "Takeuchi", "BIC")  # fmt: skip
    rows, notes = [], []
    for each in comparison.ranked:
        over = f"{each.over_the_best:.3g} +- {each.over_the_best_standard_error:.2g}"
        start_fitted = "" if each.start_fitted is None else f"{each.start_fitted:.4g}"
        over = "" if each is comparison.ranked[0] else over
        numbers = f"{each.held_out:.4g}", f"{each.standard_error:.2g}", f"{each.expected:.4g}", over, start_fitted
        criteria = f"{each.fitted:.4g}", f"{each.takeuchi:.1f}", f"{each.bic:.1f}"
        rows.append((each.name, str(each.parameters), *numbers, *criteria))
        if each.undetermined:
            notes.append(f"{each.name}: the records do not determine {', '.join(each.undetermined)}.")
    notes += [f"{name}: failed. {reason}" for name, reason in comparison.failures.items()]
    notes.append("Criteria: less the least.")
    if comparison.left:
        notes.append(f"Interrupted; not finished: {', '.join(comparison.left)}.")
    if comparison.ranked:
        notes.append(comparison.conclusion)
    title = (
        f"Held out: {comparison.by}. {comparison.samples} samples, equivalent to {comparison.effective:.0f} independent"
        " ones."
    )
    return Table(title, head, rows, tuple(notes))


def comparison_of(
    judged: Mapping[str, CrossValidated],
    failures: Mapping[str, str],
    left: tuple[str, ...],
    descriptions: Mapping[str, str],
    by: str,
    *,
    new_records: bool,
) -> Comparison:
    """Rank the models; one whose error is not finite has failed. `new_records`: whether whole records were held out."""
    kept = {
        name: each
        for name, each in judged.items()
        if all(np.isfinite(x).all() for part in each.held for x in part.values())
    }
    not_finite = [name for name in judged if name not in kept]
    failures = {**failures, **dict.fromkeys(not_finite, "Its held-out error is not finite.")}
    if not kept:
        return Comparison(ranked=(), failures=failures, left=left, results={}, by=by, samples=0, effective=0.0)
    searches = {name: each.result.search_for("A comparison") for name, each in kept.items()}
    levels = {
        channel: min(float(each.problem.noise[channel]) for each in searches.values())
        for channel in next(iter(searches.values())).problem.noise
    }
    fitted = {name: _fitted_error(each, levels) for name, each in searches.items()}
    samples = int(np.sum(next(iter(searches.values())).problem.weights > 0))
    effective = effective_samples(searches[min(fitted, key=lambda name: fitted[name])])
    losses = {name: _losses(each.held, searches[name].problem.loss, levels) for name, each in kept.items()}
    count = np.array([sum(len(x) for x in part.values()) for part in next(iter(kept.values())).held])
    means = {name: float(np.average(loss, weights=count)) for name, loss in losses.items()}
    expected = dict(means) if new_records else _expected(means, kept, searches, levels)
    order = sorted(expected, key=lambda name: expected[name])
    best = order[0]
    d = {name: deviance(each) for name, each in searches.items()}
    trace = {name: penalty(each) for name, each in searches.items()}
    size = {name: len(each.result.values) for name, each in kept.items()}
    takeuchi = {name: (d[name] + 2 * trace[name]) * effective / samples for name in kept}
    bic = {name: d[name] * effective / samples + size[name] * np.log(effective) for name in kept}
    ranked = []
    for name in order:
        held_out, root, least = (float(np.sqrt(x)) for x in (means[name], expected[name], expected[best]))
        error = _standard_error(losses[name], count) / (2 * held_out) if held_out > 0 else 0.0
        difference = _standard_error(losses[name] - losses[best], count)
        difference = max(difference / (root + least) if root + least else 0.0, ENOUGH * root)
        start_fitted = None
        if starts := kept[name].start_fitted:
            loss = _losses(starts, searches[name].problem.loss, levels)
            start_fitted = float(np.sqrt(np.average(loss, weights=count)))
        ranked.append(
            Ranked(
                name=name,
                description=descriptions.get(name, ""),
                parameters=size[name],
                held_out=held_out,
                standard_error=error,
                parts=np.sqrt(losses[name]),
                expected=root,
                over_the_best=root - least,
                over_the_best_standard_error=difference,
                start_fitted=start_fitted,
                fitted=fitted[name],
                takeuchi=float(takeuchi[name] - min(takeuchi.values())),
                bic=float(bic[name] - min(bic.values())),
                penalty=trace[name],
                undetermined=_undetermined(kept[name].result),
            )
        )
    return Comparison(
        ranked=tuple(ranked),
        failures=failures,
        left=left,
        results={name: kept[name].result for name in order},
        by=by,
        samples=samples,
        effective=effective,
    )


def _expected(
    means: Mapping[str, float],
    judged: Mapping[str, CrossValidated],
    searches: Mapping[str, SearchResult],
    levels: Mapping[str, float],
) -> dict[str, float]:
    """Mean loss to expect on a new record, by the name of the model."""
    covariance = {name: covariances(each.result, VARIATION, None) for name, each in judged.items()}
    best = min(means, key=lambda name: (bool(_undetermined(judged[name].result)), means[name]))
    between = _mean(change_between(searches[best], covariance[best][1]), searches[best], levels)
    return {
        name: mean + _mean(mean_variances(searches[name], covariance[name][0]), searches[name], levels) + between
        for name, mean in means.items()
    }


def _mean(variances: Mapping[str, float], search: SearchResult, levels: Mapping[str, float]) -> float:
    """Over all samples, of variances in the noise levels of the search; in the squared unit of a single channel."""
    count = {name: float(np.sum(np.asarray(search.problem.columns[name]) > 0)) for name in variances}
    ratio = {name: float(search.problem.noise[name]) / level for name, level in levels.items()}
    total = sum(count[name] * ratio[name] ** 2 * x for name, x in variances.items()) / sum(count.values())
    return (next(iter(levels.values())) ** 2 if len(levels) == 1 else 1.0) * total


def _fitted_error(search: SearchResult, levels: Mapping[str, float]) -> float:
    """Error of all samples that count."""
    noise = search.problem.noise
    residual = {name: float(noise[name]) * x[weight > 0] for name, (x, weight) in search.residuals.items()}
    return float(_root(residual, search.problem.loss, levels))


def _losses(parts: tuple[Part, ...], loss: AbstractLoss, levels: Mapping[str, float]) -> Float[np.ndarray, " parts"]:
    """Mean loss of each part, in the squared unit of the channel if there is one."""
    return np.array([_root(part, loss, levels) ** 2 for part in parts])


def _root(part: Part, loss: AbstractLoss, levels: Mapping[str, float]) -> float:
    """Root of the mean loss: with squares, the root mean square."""
    total = sum(float(np.sum(np.asarray(loss.rho(on_device((x / levels[name]) ** 2))))) for name, x in part.items())
    scale = next(iter(levels.values())) if len(levels) == 1 else 1.0
    return scale * float(np.sqrt(total / sum(len(x) for x in part.values())))


def _standard_error(values: np.ndarray, count: np.ndarray) -> float:
    """Of the mean of parts, weighted by their numbers of samples; infinite for one part."""
    if len(values) < 2:
        return float("inf")
    around = count * (values - np.average(values, weights=count)) / np.sum(count)
    return float(np.sqrt(np.sum(around**2) * len(values) / (len(values) - 1)))


def _undetermined(result: FitResult) -> tuple[str, ...]:
    """Names of parameters without effect, with errors of the size of their value, or far from their start."""
    estimate, names = result.estimate, []
    for name, value in estimate.values.items():
        start = abs(estimate.start[name])
        known = value in estimate.bounds[name] or result.errors[name] <= _SHARE * estimate.scale(name)
        if not known or (start > 0 and abs(value) > _FAR * start):
            names.append(name)
    return tuple(names)
