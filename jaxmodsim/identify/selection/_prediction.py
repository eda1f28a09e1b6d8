"""What to expect of a new record: parameters that are uncertain, that change between records, a model that errs."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float
from scipy import special  # scipy.stats takes most of a second to import

from ..data._record import Record
from ..estimate._problem import FitProblem
from ..estimate._search import SearchOptions, SearchResult, channels_seen, start_search, step
from ..estimate._search import by_channel as residual_by_channel
from ..model._engines import DELAY, with_values
from ..uncertainty._result import FitResult
from ._agreement import RecordAgreement
from ._comparison import penalty
from ._opening import opening
from ._score import Score, evaluate_on, record_problem
from ._variation import VARIATION, change_between, covariances, mean_variances, output_changes, search_of


@dataclass(frozen=True, kw_only=True)
class PredictionError:
    """Root mean square error to expect in one channel of a new record like those that were fitted, by its causes.

    - `model`: what the model misses in the records that were fitted, noise included, corrected for what the fit took
      from it.
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
        """What to expect if no parameter changes: the root of the sum of squares without `between`."""
        return float(np.hypot(self.model, self.parameters))

    @property
    def total(self) -> float:
        """Root of the sum of squares."""
        return float(np.hypot(self.unchanged, self.between))

    @property
    def assumption(self) -> str:
        """How parameters are taken to change from record to record, in words."""
        return _assumption(self.variation, self.records)


@dataclass(frozen=True, kw_only=True)
class RecordPrediction:
    """A fitted model on a new record, with a band that is to hold a share of its samples.

    - `score`: the output and its error. `counts`: samples that did not show the start, shape `[samples]`.
    - `level`: share of the samples that the band is to hold. `lower`, `upper`: the band, by channel, in its unit, shape
      `[samples]` each.
    - `model`, `parameters`, `between`: standard deviations of the output by cause, by channel, shape `[samples]` each;
      see `PredictionError`.
    - `variation`: standard deviation of the friction level from record to record that was assumed, as a share of it.
    - `records`: number of records that showed how parameters change; 1 where it is assumed alone.
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
        """How parameters are taken to change from record to record, in words."""
        return _assumption(self.variation, self.records)

    @property
    def shares(self) -> dict[str, float]:
        """Share of the samples that lie within the band, by channel."""
        measured = self.score.record.channels
        return {
            name: float(np.mean(((low <= measured[name]) & (measured[name] <= self.upper[name]))[self.counts]))
            for name, low in self.lower.items()
        }

    def __str__(self) -> str:
        """A line for each channel, and what was assumed."""
        lines = [str(self.score)]
        for name, share in self.shares.items():
            half = 0.5 * (self.upper[name] - self.lower[name])[self.counts]
            causes = ", ".join(
                f"{cause} {_rms(deviation[name][self.counts]):.3g}"
                for cause, deviation in (("model", self.model), ("parameters", self.parameters),
                                         ("change between records", self.between))
            )  # fmt: skip
            lines.append(
                f"  {name}: {100 * share:.0f} % of the samples within the {100 * self.level:g} % band of"
                f" +-{_rms(half):.3g} (standard deviations: {causes})"
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
    q0: ArrayLike | Sequence[ArrayLike] | None = None,
    qd0: ArrayLike | Sequence[ArrayLike] | None = None,
    level: float = 0.9,
    variation: float = VARIATION,
    agreement: RecordAgreement | None = None,
) -> RecordPrediction:
    """Run a fitted model on a record that it was not fitted to, with a band that is to hold a share of its samples.

    The band has at each sample the variance `J (V + (1 + 1/n) T) J' + s^2`, for normal errors. J is the change of the
    output with the parameters, from runs at sqrt(3) standard deviations on either side, the start fitted again to the
    first samples; V the covariance of the estimate from n records; T the covariance of the parameters between records;
    s^2 the mean square of what the model misses in the
    records that were fitted, times one plus the share of the degrees of freedom that the fit took from it, correlation
    in time allowed for (Takeuchi 1976). T holds a common change of all friction levels (the free parameters of the
    scene or law in N), relative to their values, by `variation`; with `agreement` it is the mean of this one, which
    counts like one record, and of what the records show, which counts n - 1 times.

    **Arguments:**

    - `result`, `record`, `q0`, `qd0`: see `evaluate_on`.
    - `level`: share of the samples that the band is to hold, 0 < level < 1.
    - `variation`: standard deviation of the friction level from record to record, as a share of it, >= 0.
    - `agreement`: from `agreement(result)`, where several records were fitted.

    **Returns:**

    A `RecordPrediction`. Parameters without effect on the records that were fitted are taken as known.

    **Raises:**

    - `ValueError` for numbers out of range or an agreement of another fit, and as `evaluate_on` does.
    - `RuntimeError` where the model gives values that are not finite.
    """
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1, but it is {level!r}.")
    search = search_of(result, "A prediction")
    own, between = covariances(result, variation, agreement)
    judged = evaluate_on(result, record, q0=q0, qd0=qd0)
    problem, noise = record_problem(result, record, (judged.q0, judged.qd0)), search.problem.noise
    channels, samples = sorted(record.channels), len(record.t)
    shown = opening(problem.runs)[0] if q0 is None and problem.local else np.zeros(samples, bool)
    by_start, back = _start(problem, np.tile(shown, len(channels)))

    def deviations(covariance: np.ndarray, beside: np.ndarray) -> dict[str, np.ndarray]:
        square = beside
        for change in output_changes(search, covariance, partial(_seen, problem, search)):
            stacked = np.concatenate([change[name][0] / float(noise[name]) for name in channels])
            square = square + (stacked - by_start @ (back @ stacked)) ** 2
        rows = np.sqrt(square).reshape(len(channels), samples)
        return {name: float(noise[name]) * row for name, row in zip(channels, rows, strict=True)}

    excess = model_excess(search)
    causes = {
        "model": {name: np.full(samples, float(noise[name]) * excess[name] ** 0.5) for name in channels},
        "parameters": deviations(own, np.sum((by_start @ (back @ back.T)) * by_start, axis=1)),
        "between": deviations(between, np.zeros(len(by_start))),
    }
    half = {
        name: float(special.ndtri(0.5 + level / 2)) * np.sqrt(sum(x[name] ** 2 for x in causes.values()))
        for name in channels
    }
    return RecordPrediction(
        score=judged,
        counts=~shown,
        level=level,
        lower={name: judged.outputs[name] - half[name] for name in channels},
        upper={name: judged.outputs[name] + half[name] for name in channels},
        variation=variation,
        records=1 if agreement is None else len(agreement.records),
        **causes,
    )


def prediction_error(
    result: FitResult, *, variation: float = VARIATION, agreement: RecordAgreement | None = None
) -> dict[str, PredictionError]:
    """The error to expect on a new record of the same motion as those that were fitted, by channel, in its unit.

    **Arguments:**

    - `result`: a fit that was not loaded from a file.
    - `variation`, `agreement`: see `predict`.

    **Raises:**

    - `ValueError` for a result that was loaded, or a variation or an agreement as `predict` refuses it.
    """
    search = search_of(result, "An expected error")
    own, between = covariances(result, variation, agreement)
    known, changed, excess = mean_variances(search, own), change_between(search, between), model_excess(search)
    return {
        name: PredictionError(
            model=float(level) * float(np.sqrt(excess[name])),
            parameters=float(level) * float(np.sqrt(known[name])),
            between=float(level) * float(np.sqrt(changed[name])),
            variation=variation,
            records=1 if agreement is None else len(agreement.records),
        )
        for name, level in search.problem.noise.items()
        if name in changed
    }


def model_excess(search: SearchResult) -> dict[str, float]:
    """Mean square of what the model misses, by channel, in squared noise levels, corrected for what the fit took."""
    split = residual_by_channel(search.problem, search.state.residual)
    taken = penalty(search) / max(sum(int(np.sum(weight > 0)) for _, weight in split.values()), 1)
    return {name: float(np.mean(x[weight > 0] ** 2)) * (1 + taken) for name, (x, weight) in split.items()}


def _start(
    problem: FitProblem, shown: Bool[np.ndarray, " rows"]
) -> tuple[Float[np.ndarray, "rows local"], Float[np.ndarray, "local rows"]]:
    """Derivatives of the output by the start, and of a start that is fitted to the rows `shown` by these.

    In noise levels.
    """
    if not shown.any():
        return np.zeros((shown.size, 0)), np.zeros((0, shown.size))
    x = problem.x0
    # The first evaluation of a search, which a score compiles anyway.
    state = step(problem, start_search(x, problem.rows), jnp.asarray(SearchOptions().rtol, x.dtype))
    jacobian = np.asarray(state.jacobian)[: problem.samples]
    return jacobian, np.linalg.pinv(np.where(shown[:, None], jacobian, 0.0), rcond=1e-10)


def _seen(problem: FitProblem, search: SearchResult, x: Float[Array, " free"]) -> dict[str, Array]:
    """Output of the record with other parameters: arrays alone differ, so nothing compiles again."""
    if not problem.local:
        return channels_seen(problem, x)
    engine, values = problem.engine, search.problem.free.values(x)
    late = {name: value for name, value in values.items() if name.startswith(DELAY)}
    engine = dataclasses.replace(engine, model=with_values(engine.model, values), delays={**engine.delays, **late})
    return channels_seen(dataclasses.replace(problem, engine=engine), problem.x0)


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))
