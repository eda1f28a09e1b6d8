"""What a comparison of models says: errors on what was held back, criteria, and the simplest model that suffices."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from ..._core.arrays import on_device
from ..._core.system import jsonable
from ..estimate._problem import AbstractLoss
from ..estimate._search import SearchResult, cost_of, weighted_by
from ..estimate._search import by_channel as residual_by_channel
from ..uncertainty._estimate import sample_blocks
from ..uncertainty._result import FitResult
from ._memory import effective_samples
from ._variation import VARIATION, change_between, covariances, mean_variances, search_of

# Directions of the parameters known this much worse than the best one are nothing that double precision can weigh.
_LEAST = 1e-10
# What is left of each channel, in its unit, of one part of the records.
Part: TypeAlias = dict[str, np.ndarray]
# A standard error beyond this share of the value says that the record does not determine it; so does a value that went
# further from its start than this factor.
_SHARE, _FAR = 0.5, 1e6
# Errors on what was held back that differ by no more than this factor are the same for whoever uses the model.
_AS_GOOD = 1.1


def deviance(search: SearchResult) -> float:
    """Minus twice the logarithm of the likelihood at the noise levels of the fit, but for a constant.

    `sum over channels of n ln(noise^2) + sum of losses`; with levels estimated by least squares, `n ln(RSS/n) + n`.
    """
    problem = search.problem
    counts = {name: int(np.sum(np.asarray(weight) > 0)) for name, weight in problem.columns.items()}
    levels = sum(count * 2 * float(np.log(float(problem.noise[name]))) for name, count in counts.items())
    return levels + 2 * float(cost_of(problem.loss, on_device(np.asarray(search.state.residual)[: problem.samples])))


def penalty(search: SearchResult) -> float:
    """Trace of `H^-1 S` of Takeuchi (1976, Suri-Kagaku 153:12): information H, covariance S of the scores.

    The number of parameters where the residual is white noise of its level, more where it is correlated. S comes from
    the scatter of the scores of blocks of samples, as in the covariance of the estimate; that one has H^-1 on both
    sides, which leaves nothing to be read where parameters are hardly told apart, so the trace is formed in the
    principal directions of H. A direction that the record does not determine counts as one parameter.
    """
    rows = search.problem.samples
    residual, jacobian = (each[:rows] for each in weighted_by(search.problem.loss, search.state))
    size = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian / np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    known = values > _LEAST * values[-1]
    blocks, count = sample_blocks(search.problem)
    scores = np.zeros((count, len(size)))
    np.add.at(scores, blocks, scaled * residual[:, None])
    across = (scores - np.mean(scores, axis=0)) @ vectors[:, known]
    return float(np.sum(across**2 / values[known]) * count / (count - 1) + np.sum(~known))


class CrossValidated(NamedTuple):
    """A fit, and the residuals of what was held back from it; those with starts fitted to it, where there are any."""

    result: FitResult
    held: tuple[Part, ...]
    start_fitted: tuple[Part, ...]


@dataclass(frozen=True, kw_only=True)
class Ranked:
    """One model of a comparison.

    - `name`, `description`: what it is. `parameters`: number of all that was fitted, initial states included.
    - `held_back`, `error`: root mean square error on what was held back, and its standard error; nothing but
      the start of each part was fitted to it, and that to its first samples. `start_fitted`: the error with starts
      fitted to all of each part; None for laws, which have none.
    - `parts`: the root mean square errors of the parts that were held back, shape `[parts]`.
    - `expected`: root mean square error to expect on a new record: `held_back` and, squares added, what the uncertainty
      of the parameters adds over whole records and what a friction level that varies between records adds. Where
      records were held out, these show it themselves, and it is `held_back`.
    - `over`, `over_error`: by how much it is expected to err more than the best model, and the standard error of this
      difference, from the differences in each part.
    - `fitted`: root mean square error of the fit to everything.
    - `takeuchi`, `bic`: information criteria less the least of all models; see `Comparison`.
    - `penalty`: effective number of parameters, of Takeuchi's criterion.
    - `undetermined`: names of parameters that the records do not determine.
    """

    name: str
    description: str
    parameters: int
    held_back: float
    error: float
    parts: Float[np.ndarray, " parts"]
    expected: float
    over: float
    over_error: float
    start_fitted: float | None
    fitted: float
    takeuchi: float
    bic: float
    penalty: float
    undetermined: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Models, ranked by the error to expect on a new record, from that on what was held back from the fit.

    What is added to the squared error on parts that were held back is `J V J'`, by the covariance V of the parameters
    and the derivatives J of the output of the fit to everything: parts begin anew and are short, and hide what
    uncertain parameters make of a whole record. A friction level that varies from record to record by 4 % (standard
    deviation) adds the same to all models, as it is the machine that varies: as much as the model with the least error
    on what was held back says, of those whose parameters the records determine if there are any.

    Errors are root mean squares in the unit of the channel where there is one, in noise levels (as given, or the least
    that any model found) where there are several; with another loss than squares, roots of the mean loss. The standard
    error of the mean square comes from its scatter over the parts that were held back. These are few and their fits
    share samples, so it is a rough one (Bengio, Grandvalet 2004, J. Mach. Learn. Res. 5:1089).

    Two criteria judge by the fit to everything, residuals correlated in time allowed for. With D the deviance
    `sum of n ln(noise^2) + sum of losses`, k parameters, n samples:

    - Takeuchi's `(D + 2 trace(H^-1 S)) m/n`, H the information, S the covariance of the scores, from their scatter
      over blocks of samples. For white residuals the trace is k and m = n, and this is Akaike's criterion.
    - BIC with effective samples, `D m/n + k ln(m)`.

    m is the number of effective samples, n over the correlation of the residual, by Geyer's initial positive sequence.
    It is that of the model which fits best: its residual is nearest to the noise, and with an m of its own for each
    model different things would be compared. It brings both criteria to one scale: a difference of 2 is little, one of
    10 much.

    - `ranked`: the models, best first. `failures`: reasons, by the name of the model. `left`: names of the models that
      were not finished when the comparison was interrupted.
    - `results`: the fits to everything, by name.
    - `by`: what was held back, in words. `samples`, `effective`: number of samples, and how many independent ones they
      are worth.
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
        return self._first.name

    @property
    def simplest(self) -> str:
        """Name of the simplest model that is expected to be no worse than the best by more than one standard error.

        Nor may its error on what was held back be larger by more than a tenth: with few parts the standard error is
        rough. A tenth alone counts where the records do not determine all parameters of the best.

        The simplest is the one with the fewest parameters among those whose parameters the records determine, and among
        the others where there is none of these: what nothing determines is not known of another motion.

        The one-standard-error rule of Breiman et al. (1984, Classification and Regression Trees, section 3.4.3), with
        the standard error of the difference from the best one, which leaves out what is hard for all of them.

        **Raises:**

        - `ValueError` if no model could be fitted.
        """
        best = self._first
        near = [
            each
            for each in self.ranked
            if each is best
            or (
                each.held_back <= _AS_GOOD * best.held_back
                and (each.over <= each.over_error or bool(best.undetermined))
            )
        ]
        return min(near, key=lambda each: (bool(each.undetermined), each.parameters, each.expected)).name

    @property
    def _first(self) -> Ranked:
        if not self.ranked:
            reasons = " ".join(f"{name}: {reason}" for name, reason in self.failures.items())
            raise ValueError(f"No model could be fitted. {reasons}")
        return self.ranked[0]

    @property
    def table(self) -> list[dict[str, object]]:
        """Rows by rank, then the models that failed or were not finished, of types that JSON knows."""
        rows: list[dict[str, object]] = [
            {
                "name": each.name,
                "description": each.description,
                "parameters": each.parameters,
                "held_back": each.held_back,
                "standard_error": each.error,
                "parts": each.parts.tolist(),
                "expected": each.expected,
                "over_the_best": each.over,
                "over_the_best_standard_error": each.over_error,
                "start_fitted": each.start_fitted,
                "fitted": each.fitted,
                "takeuchi": each.takeuchi,
                "bic": each.bic,
                "penalty": each.penalty,
                "undetermined": list(each.undetermined),
                "failed": None,
            }
            for each in self.ranked
        ]
        rows.extend({"name": name, "failed": reason} for name, reason in self.failures.items())
        return rows + [{"name": name, "failed": "not finished"} for name in self.left]

    @property
    def conclusion(self) -> str:
        """The simplest model that suffices, in a sentence or two."""
        best, chosen = self._first, self.simplest
        by_name = {each.name: each for each in self.ranked}
        simple = by_name[chosen]
        what = f" ({simple.description})" if simple.description else ""
        said = (
            f"The simplest sufficient law is {chosen}{what}: {simple.parameters} parameters, error on what was held"
            f" back {simple.held_back:.4g}"
        )
        if simple.expected > simple.held_back:
            said += f", {simple.expected:.4g} to expect on a new record"
        if simple is not best:
            near = simple.over <= simple.over_error
            said += (
                f"; {best.name} with {best.parameters} is expected to be better by {simple.over:.2g}, which is"
                f" {'within' if near else 'more than'} one standard error, {simple.over_error:.2g}."
            )
        else:
            simpler = [each for each in self.ranked if each.parameters < best.parameters]
            said += ", the least of all"
            if simpler:
                said += (
                    f"; with fewer parameters {simpler[0].name} is worse by {simpler[0].over:.2g}, standard error"
                    f" {simpler[0].over_error:.2g}"
                )
            said += "."
        for name in dict.fromkeys((chosen, best.name)):
            if by_name[name].undetermined:
                names = _listed(by_name[name].undetermined)
                said += f" But the records do not determine {names} of {name}: do not use these values."
        return said

    def __str__(self) -> str:
        """A ranked table that ends with the conclusion."""
        width = max(len(str(row["name"])) for row in self.table)
        lines = [
            f"{'':{width}}  {'param.':>6}  {'held back':>10}  {'std. error':>10}  {'new record':>10}"
            f"  {'over the best':>21}"
            f"  {'start fitted':>12}  {'all fitted':>10}"
            f"  {'Takeuchi':>9}  {'BIC':>9}"
        ]
        for each in self.ranked:
            over = "" if each is self.ranked[0] else f"{each.over:10.3g} +- {each.over_error:7.2g}"
            lines.append(
                f"{each.name:{width}}  {each.parameters:6d}  {each.held_back:10.4g}  {each.error:10.2g}"
                f"  {each.expected:10.4g}  {over:>21}"
                f"  {'' if each.start_fitted is None else f'{each.start_fitted:.4g}':>12}"
                f"  {each.fitted:10.4g}  {each.takeuchi:9.1f}  {each.bic:9.1f}"
            )
        lines += [f"{each.name}: the records do not determine {', '.join(each.undetermined)}." for each in self.ranked
                  if each.undetermined]  # fmt: skip
        lines += [f"{name}: failed. {reason}" for name, reason in self.failures.items()]
        lines.append(
            f"Held back: {self.by}. {self.samples} samples, worth {self.effective:.0f} independent ones. Criteria: less"
            " the least."
        )
        if self.left:
            lines.append(f"Interrupted; not finished: {', '.join(self.left)}.")
        return "\n".join([*lines, self.conclusion] if self.ranked else lines)

    def to_dict(self) -> dict[str, object]:
        """All of it but the samples and the models, as JSON knows it: numbers that are not finite are None."""
        return jsonable(
            {
                "held_back": self.by,
                "samples": self.samples,
                "effective_samples": self.effective,
                "models": self.table,
                "best": self.best if self.ranked else None,
                "simplest": self.simplest if self.ranked else None,
                "conclusion": self.conclusion if self.ranked else None,
                "fits": {name: result.to_dict() for name, result in self.results.items()},
            }
        )


def comparison_of(
    judged: Mapping[str, CrossValidated],
    failures: Mapping[str, str],
    left: tuple[str, ...],
    descriptions: Mapping[str, str],
    by: str,
    *,
    new_records: bool,
) -> Comparison:
    """Rank what was judged; what is not finite failed. `new_records`: whether whole records were held back."""
    failures, kept = dict(failures), {}
    for name, each in judged.items():
        finite = all(np.isfinite(x).all() for part in each.held for x in part.values())
        if finite:
            kept[name] = each
        else:
            failures[name] = "Its error on what was held back is not finite."
    if not kept:
        return Comparison(ranked=(), failures=failures, left=left, results={}, by=by, samples=0, effective=0.0)
    searches = {name: search_of(each.result, "A comparison") for name, each in kept.items()}
    levels = {
        channel: min(float(each.problem.noise[channel]) for each in searches.values())
        for channel in next(iter(searches.values())).problem.noise
    }
    fitted = {name: float(_root(_fitted(each), each.problem.loss, levels)) for name, each in searches.items()}
    samples = int(np.sum(next(iter(searches.values())).problem.weights > 0))
    effective = effective_samples(searches[min(fitted, key=lambda name: fitted[name])])
    losses = {name: _losses(each.held, searches[name].problem.loss, levels) for name, each in kept.items()}
    count = np.array([sum(len(x) for x in part.values()) for part in next(iter(kept.values())).held])
    means = {name: float(np.sum(count * loss) / np.sum(count)) for name, loss in losses.items()}
    expected = dict(means) if new_records else _expected(means, kept, levels)
    order = sorted(expected, key=lambda name: expected[name])
    best = order[0]
    d = {name: deviance(each) for name, each in searches.items()}
    trace = {name: penalty(each) for name, each in searches.items()}
    size = {name: len(each.result.values) for name, each in kept.items()}
    takeuchi = {name: (d[name] + 2 * trace[name]) * effective / samples for name in kept}
    bic = {name: d[name] * effective / samples + size[name] * np.log(effective) for name in kept}
    ranked = []
    for name in order:
        held_back, root, least = (float(np.sqrt(x)) for x in (means[name], expected[name], expected[best]))
        together = root + least
        ranked.append(
            Ranked(
                name=name,
                description=descriptions.get(name, ""),
                parameters=size[name],
                held_back=held_back,
                error=float(_standard_error(losses[name], count) / (2 * held_back)) if held_back > 0 else 0.0,
                parts=np.sqrt(losses[name]),
                expected=root,
                over=root - least,
                over_error=float(_standard_error(losses[name] - losses[best], count) / together) if together else 0.0,
                start_fitted=_mean_root(kept[name].start_fitted, searches[name].problem.loss, levels),
                fitted=fitted[name],
                takeuchi=float(takeuchi[name] - min(takeuchi.values())),
                bic=float(bic[name] - min(bic.values())),
                penalty=trace[name],
                undetermined=_undetermined(kept[name].result),
            )
        )
    results = {name: kept[name].result for name in order}
    return Comparison(
        ranked=tuple(ranked),
        failures=failures,
        left=left,
        results=results,
        by=by,
        samples=samples,
        effective=effective,
    )


def _expected(
    means: Mapping[str, float], judged: Mapping[str, CrossValidated], levels: Mapping[str, float]
) -> dict[str, float]:
    """Mean loss to expect on a new record, by the name of the model."""
    searches = {name: search_of(each.result, "A comparison") for name, each in judged.items()}
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


def _listed(names: tuple[str, ...], most: int = 4) -> str:
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def _fitted(search: SearchResult) -> Part:
    """Residual of all samples that count, in the units of the channels."""
    split = residual_by_channel(search.problem, search.state.residual)
    return {name: float(search.problem.noise[name]) * x[weight > 0] for name, (x, weight) in split.items()}


def _losses(parts: tuple[Part, ...], loss: AbstractLoss, levels: Mapping[str, float]) -> Float[np.ndarray, " parts"]:
    """Mean loss of each part, in the squared unit of the channel if there is one."""
    return np.array([_root(part, loss, levels) ** 2 for part in parts])


def _mean_root(parts: tuple[Part, ...], loss: AbstractLoss, levels: Mapping[str, float]) -> float | None:
    """Root of the mean loss of all parts; None of none."""
    count = [sum(len(x) for x in part.values()) for part in parts]
    return float(np.sqrt(np.average(_losses(parts, loss, levels), weights=count))) if parts else None


def _root(part: Part, loss: AbstractLoss, levels: Mapping[str, float]) -> float:
    """Root of the mean loss: with squares, the root mean square."""
    total = sum(float(np.sum(np.asarray(loss.rho(on_device((x / levels[name]) ** 2))))) for name, x in part.items())
    scale = next(iter(levels.values())) if len(levels) == 1 else 1.0
    return scale * float(np.sqrt(total / sum(len(x) for x in part.values())))


def _standard_error(values: np.ndarray, count: np.ndarray) -> float:
    """Of the mean of parts, weighted by their numbers of samples."""
    share = count / np.sum(count)
    around = values - np.sum(share * values)
    return float(np.sqrt(np.sum((share * around) ** 2) * len(values) / (len(values) - 1)))


def _undetermined(result: FitResult) -> tuple[str, ...]:
    """Names of parameters without effect, with errors of the size of their value, or that ran away."""
    estimate, errors = result.estimate, result.errors

    def free_of_doubt(name: str, value: float) -> bool:
        start = abs(estimate.start[name])
        ran = start > 0 and abs(value) > _FAR * start
        return not ran and (value in estimate.bounds[name] or errors[name] <= _SHARE * estimate.scale(name))

    return tuple(name for name, value in estimate.values.items() if not free_of_doubt(name, value))
