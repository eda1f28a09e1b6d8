"""A prediction band on a new record, and the error to expect there."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import special  # scipy.stats takes most of a second to import

from ..._core.arguments import as_share
from ..data._record import Record
from ..data._signals import sample_noise
from ..estimate._search import SearchResult, channels_seen, state_at
from ..model._engines import DELAY, with_values
from ..uncertainty._result import FitResult
from ._agreement import VARIATION, RecordAgreement, change_between, covariances, mean_variances, output_changes
from ._comparison import penalty
from ._evaluation import RecordRun, RecordStart, Score, rms, run_on, score_of


@dataclass(frozen=True, kw_only=True)
class PredictionError:
    """Root mean square error to expect in one channel of a new record like the fitted ones, by its causes.

    - `model`: the residual of the fitted records, noise included, corrected for the degrees of freedom of the fit.
    - `parameters`: what their uncertainty adds. `between`: what their change from record to record adds.
    - `variation`, `records`: see `RecordPrediction`.
    """

    model: float
    parameters: float
    between: float
    variation: float
    records: int

    @property
    def unchanged(self) -> float:
        """The error if no parameter changes: the root of the sum of squares without `between`."""
        return float(np.hypot(self.model, self.parameters))

    @property
    def total(self) -> float:
        """Root of the sum of squares."""
        return float(np.hypot(self.unchanged, self.between))

    @property
    def assumption(self) -> str:
        """How parameters are assumed to change from record to record, in words."""
        return _assumption(self.variation, self.records)


@dataclass(frozen=True, kw_only=True)
class RecordPrediction:
    """A fitted model on a new record, with a band that is expected to hold a share of its samples.

    - `score`: the output and its error. `counts`: samples that did not show the start, shape `[samples]`.
    - `level`: the share of the samples. `lower`, `upper`: the band, by channel, in its unit, shape `[samples]` each.
    - `model`, `parameters`, `between`: standard deviations of the output by cause, by channel, shape `[samples]` each;
      see `PredictionError`.
    - `variation`: standard deviation of the friction level from record to record that was assumed, as a share of it.
    - `records`: number of records that showed how parameters change; 1 if it is assumed alone.
    """

    score: Score
    counts: Bool[np.ndarray, " samples"]
    level: float
    lower: dict[str, Float[np.ndarray, " samples"]]
    upper: dict[str, Float[np.ndarray, " samples"]]
    model: dict[str, Float[np.ndarray, " samples"]]
    parameters: dict[str, Float[np.ndarray, " samples"]]
    between: dict[str, Float[np.ndarray, " samples"]]
    variation: float
    records: int

    @property
    def assumption(self) -> str:
        """How parameters are assumed to change from record to record, in words."""
        return _assumption(self.variation, self.records)

    @property
    def shares(self) -> dict[str, float]:
        """Share of the samples within the band, by channel."""
        measured = self.score.record.channels
        return {
            name: float(np.mean(((low <= measured[name]) & (measured[name] <= self.upper[name]))[self.counts]))
            for name, low in self.lower.items()
        }

    def __str__(self) -> str:
        """A line for each channel, and the assumption."""
        lines = [str(self.score)]
        for name, share in self.shares.items():
            half = 0.5 * (self.upper[name] - self.lower[name])[self.counts]
            causes = ", ".join(
                f"{cause} {rms(deviation[name][self.counts]):.3g}"
                for cause, deviation in (("model", self.model), ("parameters", self.parameters),
                                         ("change between records", self.between))
            )  # fmt: skip
            lines.append(
                f"  {name}: {100 * share:.0f} % of the samples within the {100 * self.level:g} % band of"
                f" +-{rms(half):.3g} (standard deviations: {causes})"
            )
        return "\n".join([*lines, f"  with {self.assumption}"])


def _assumption(variation: float, records: int) -> str:
    assumed = f"a friction level that varies by {100 * variation:.2g} % from record to record"
    if records < 2:
        return f"{assumed} (assumed)"
    return f"parameters that vary as these {records} records show and, with the weight of one, {assumed} (assumed)"


def predict(
    result: FitResult,
    record: Record,
    *,
    q0: RecordStart = None,
    qd0: RecordStart = None,
    level: float = 0.9,
    variation: float = VARIATION,
    agreement: RecordAgreement | None = None,
) -> RecordPrediction:
    """Run a fitted model on a record that it was not fitted to, with a band for a share of its samples.

    At each sample the band has the variance `J (V + (1 + 1/n) T) J' + s^2` of normal errors:

    - J is the change of the output with the parameters, from runs at sqrt(3) standard deviations on either side, with
      the start fitted again to the first samples. The noise of these samples adds the error of the start.
    - V is the covariance of the estimate from n records, T that of the parameters between records.
    - s^2 is the mean square of the residual of the fitted records, times one plus the share of the degrees of freedom
      of the fit, with correlation in time (Takeuchi 1976).

    T is a common change of all friction levels (the free parameters in N), relative to their values, by `variation`.
    With `agreement` it is the mean of this change, which counts as one record, and of the observed covariance, which
    counts as n - 1 records.

    **Arguments:**

    - `result`, `record`, `q0`, `qd0`: see `evaluate_on`.
    - `level`: share of the samples within the band, 0 < level < 1.
    - `variation`: standard deviation of the friction level from record to record, as a share of it, >= 0.
    - `agreement`: from `agreement(result)`, if several records were fitted.

    **Returns:**

    A `RecordPrediction`. Parameters without effect on the fitted records are taken as known.

    **Raises:**

    - `ValueError` for numbers out of range or an agreement of another fit, and as `evaluate_on` does.
    - `RuntimeError` if the model's output is not finite.
    """
    level = as_share(level, name="level")
    search = result.search_for("A prediction")
    own, between = covariances(result, variation, agreement)
    run = run_on(result, record, q0, qd0)
    score, noise, channels = score_of(run), search.problem.noise, sorted(record.channels)
    by_start, back, by_noise = _start(run, score, noise)

    def deviations(covariance: np.ndarray, beside: np.ndarray) -> dict[str, np.ndarray]:
        square = beside
        for change in output_changes(search, covariance, partial(_output, run, search)):
            stacked = np.concatenate([change[name][0] / float(noise[name]) for name in channels])
            square = square + (stacked - by_start @ (back @ stacked)) ** 2
        rows = np.sqrt(square).reshape(len(channels), -1)
        return {name: float(noise[name]) * row for name, row in zip(channels, rows, strict=True)}

    excess = _model_excess(search)
    causes = {
        "model": {name: np.full(len(record.t), float(noise[name]) * excess[name] ** 0.5) for name in channels},
        "parameters": deviations(own, by_noise),
        "between": deviations(between, np.zeros(len(by_start))),
    }
    half = {
        name: float(special.ndtri(0.5 + level / 2)) * np.sqrt(sum(x[name] ** 2 for x in causes.values()))
        for name in channels
    }
    return RecordPrediction(
        score=score,
        counts=run.counts,
        level=level,
        lower={name: score.outputs[name] - half[name] for name in channels},
        upper={name: score.outputs[name] + half[name] for name in channels},
        variation=variation,
        records=1 if agreement is None else len(agreement.records),
        **causes,
    )


def prediction_error(
    result: FitResult, *, variation: float = VARIATION, agreement: RecordAgreement | None = None
) -> dict[str, PredictionError]:
    """The error to expect on a new record of the same motion as the fitted ones, by channel, in its unit.

    **Arguments:**

    - `result`: a fit that was not loaded from a file.
    - `variation`, `agreement`: see `predict`.

    **Returns:**

    A `PredictionError` by channel.

    **Raises:**

    - `ValueError` for a loaded result, or a variation or an agreement that `predict` refuses.
    """
    search = result.search_for("A prediction error")
    own, between = covariances(result, variation, agreement)
    parts = _model_excess(search), mean_variances(search, own), change_between(search, between)
    errors = {}
    for name in parts[-1]:
        level = float(search.problem.noise[name])
        model, parameters, changed = (level * float(np.sqrt(each[name])) for each in parts)
        records = 1 if agreement is None else len(agreement.records)
        errors[name] = PredictionError(
            model=model, parameters=parameters, between=changed, variation=variation, records=records
        )
    return errors


def _model_excess(search: SearchResult) -> dict[str, float]:
    """Mean square of the residual, by channel, in squared noise levels, corrected for the degrees of freedom."""
    split = search.residuals
    taken = penalty(search) / max(sum(int(np.sum(weight > 0)) for _, weight in split.values()), 1)
    return {name: float(np.mean(x[weight > 0] ** 2)) * (1 + taken) for name, (x, weight) in split.items()}


def _start(
    run: RecordRun, score: Score, noise: Mapping[str, Array]
) -> tuple[Float[np.ndarray, "rows local"], Float[np.ndarray, "local rows"], Float[np.ndarray, " rows"]]:
    """Derivatives of the output by the start, of the start by the first samples, and the variance that it adds.

    All in noise levels of the fit. The start has errors from the noise of the first samples. They are shorter than
    what the residual of the model takes to grow.
    """
    channels, shown = sorted(score.outputs), ~run.counts
    rows = len(channels) * shown.size
    if not shown.any():
        return np.zeros((rows, 0)), np.zeros((0, rows)), np.zeros(rows)
    jacobian = np.asarray(state_at(run.problem, run.x).jacobian)[: run.problem.samples]
    back = np.linalg.pinv(np.where(np.tile(shown, len(channels))[:, None], jacobian, 0.0), rcond=1e-10)
    levels = [
        max(sample_noise(score.record.channels[name]), rms(score.residuals[name][shown])) / float(noise[name])
        for name in channels
    ]
    scatter = back * np.repeat(levels, shown.size)
    return jacobian, back, np.sum((jacobian @ (scatter @ scatter.T)) * jacobian, axis=1)


def _output(run: RecordRun, search: SearchResult, x: Float[Array, " free"]) -> dict[str, Array]:
    """Output of the record with other parameters; only arrays differ, so nothing compiles again."""
    problem = run.problem
    if not problem.local:
        return channels_seen(problem, x)
    engine, values = problem.engine, search.problem.free.values(x)
    late = {name: value for name, value in values.items() if name.startswith(DELAY)}
    engine = dataclasses.replace(engine, model=with_values(engine.model, values), delays={**engine.delays, **late})
    return channels_seen(dataclasses.replace(problem, engine=engine), run.x)
