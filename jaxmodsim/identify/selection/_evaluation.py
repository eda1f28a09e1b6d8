"""A fitted model on a record that it was not fitted to: its start, which the first samples show, and its error."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..._core.arrays import on_device
from ...scene import Scene, State
from ..data._record import Record, Runs, cut, runs_of
from ..data._signals import sample_noise
from ..estimate._prepare import measured_start
from ..estimate._problem import FitProblem, Prior, SquaredLoss
from ..estimate._search import SearchOptions, SearchResult, channels_seen, solve
from ..model._engines import DELAY, EventEngine, ReplayEngine
from ..model._parameters import FreeParameters
from ..uncertainty._estimate import in_unit_columns
from ..uncertainty._result import FitResult

RecordStart: TypeAlias = ArrayLike | Sequence[ArrayLike] | None
# The first samples that show the state at the start: at least _LEAST, and as many as give the velocity with an error of
# _ERROR times the speed of the record; at most the share _MOST of the samples (or _LEAST), and at most half of them.
_LEAST, _ERROR, _MOST = 20, 0.002, 0.05
# Standard error of the slope at the start of a parabola through n samples, in noise levels over n^1.5 intervals.
_SLOPE = 192.0**0.5
# Largest inverse standard deviation of a start that the first samples show, and the least noise.
_STIFF, _TINY = 1e6, float(np.finfo(float).tiny)
# Standard errors beyond which a fitted start contradicts the first samples.
_FAR = 3.0


def sample_counts(runs: Runs) -> Int[np.ndarray, "runs 1"]:
    """Number of the samples of each run that count in any channel."""
    return np.sum(np.any([np.asarray(x) > 0 for x in runs.weight.values()], axis=0), axis=1, keepdims=True)


def opening(runs: Runs) -> Bool[np.ndarray, "runs samples"]:
    """The first samples of each run: as few as show where it starts.

    The more samples a start is fitted to, the more of the model's error it takes up.
    """
    count = sample_counts(runs)
    needed = np.full(count.shape, np.inf)
    for x in runs.measured.values():
        far = np.asarray(x)[:, _LEAST:] - np.asarray(x)[:, :-_LEAST]
        speed = np.sqrt(np.mean(far**2, axis=1, keepdims=True)) / _LEAST if far.size else np.zeros(count.shape)
        noise = np.array([[sample_noise(row)] for row in np.asarray(x)])
        own = (_SLOPE * noise / np.maximum(_ERROR * speed, _TINY)) ** (2 / 3)
        needed = np.minimum(needed, np.where(speed > 0, own, np.inf))
    most = np.maximum(np.ceil(_MOST * count), _LEAST)
    return np.arange(runs.t.shape[1]) < np.minimum(np.clip(np.ceil(needed), _LEAST, most), count // 2)


def check_lengths(records: Iterable[Record], numbers: int) -> None:
    """Refuse records, or parts of them, half of which cannot show this many numbers of a state."""
    for record in records:
        if len(record.t) // 2 <= numbers:
            raise ValueError(
                f"{record.name} has {len(record.t)} samples, too few to show the {numbers} numbers of its start and to"
                f" judge the model by the others: {2 * numbers + 2} are needed. Take a longer record, or fewer folds."
            )


def begin(problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> SearchResult:
    """Fit the states at the first samples to the opening alone; all parameters must be pinned."""
    return solve(problem.counting(opening(problem.runs), slips=False), x, options)


def shown_starts(problem: FitProblem, begun: SearchResult) -> FitProblem:
    """The problem with initial states tied to those that `begin` returned, within their standard errors.

    The errors are those of the noise from sample to sample in the first channel. The residual of the model is larger:
    a start with errors of that size would take up the model's error.
    """
    runs, local = problem.count, len(problem.local)
    name = next(iter(problem.known))
    own = np.asarray(begun.state.jacobian, float)[:, len(problem.free.names) :]
    measured, noise = np.asarray(problem.runs.measured[name]), float(problem.noise[name])
    counts = np.asarray(problem.runs.weight[name]) > 0
    weights = np.zeros((runs, local))
    for run in range(runs):
        errors = start_errors_of(own[:, run * local : (run + 1) * local])
        level = max(sample_noise(measured[run][counts[run]]), _TINY)
        weights[run] = noise**2 / np.maximum(errors * level, noise / _STIFF)
    known = {name: on_device(weights)}
    return eqx.tree_at(lambda p: (p.base, p.known), problem, (problem.starts(begun.state.x), known))


def start_errors_of(jacobian: Float[np.ndarray, "rows local"]) -> Float[np.ndarray, " local"]:
    """Standard errors of a start from the Jacobian of its residual; infinite for numbers without effect."""
    scaled, size = in_unit_columns(jacobian)
    error = np.sqrt(np.diag(np.linalg.pinv(scaled.T @ scaled, rcond=1e-12, hermitian=True)))
    return np.where(np.any(jacobian, axis=0), error / size, np.inf)


@dataclass(frozen=True, kw_only=True)
class Score:
    """The error of a fitted model on a record.

    - `record`: the record. `outputs`: the model's output at its times, by channel.
    - `rmse`: root mean square of output less measured value, by channel, in its unit, without the opening.
    - `fit`: `100 (1 - rmse/standard deviation of the channel)` [%], by channel: 100 is perfect, 0 no better than the
      mean.
    - `q0`, `qd0`: coordinates and velocities at the first sample, shape `[dof]`; None for a law by itself.
    - `opening`: number of the first samples that the start was fitted to; 0 for a known start.
    - `start_fitted`: the same samples with a start fitted to the whole record; None for a law by itself.
    - `away`: distance of each number of a start that was fitted to the whole record, such as `q0[0]`, from the value
      that the first samples show, in standard errors of that value; without the numbers that they do not show.
    - `ending`: how the search for such a start ended; empty for others.
    """

    record: Record
    outputs: dict[str, Float[np.ndarray, " samples"]]
    rmse: dict[str, float]
    fit: dict[str, float]
    q0: Float[np.ndarray, " dof"] | None
    qd0: Float[np.ndarray, " dof"] | None
    opening: int = 0
    start_fitted: "Score | None" = None
    away: dict[str, float] = field(default_factory=dict)
    ending: str = ""

    @property
    def residuals(self) -> dict[str, Float[np.ndarray, " samples"]]:
        """Output less measured value by channel."""
        return {name: x - self.record.channels[name] for name, x in self.outputs.items()}

    def __str__(self) -> str:
        """A line for each channel."""
        lines = [f"{self.record.name}{f', started from its first {self.opening} samples' if self.opening else ''}:"]
        lines += [f"  {name}: RMSE {x:.6g}, fit {self.fit[name]:.2f} %" for name, x in self.rmse.items()]
        fitted = {} if self.start_fitted is None else self.start_fitted.rmse
        lines += [f"  {name}: RMSE {x:.6g} with a start fitted to all of it" for name, x in fitted.items()]
        return "\n".join(lines + [f"  {each}" for each in self.warnings])

    @property
    def warnings(self) -> tuple[str, ...]:
        """Numbers of the fitted start that the first samples contradict: they have taken up an error of the model."""
        away = {} if self.start_fitted is None else self.start_fitted.away
        return tuple(
            f"Fitted to all of {self.record.name}, {name} moves by {abs(x):.3g} standard errors from what its first"
            " samples show: the start takes up an error of the model."
            for name, x in away.items()
            if abs(x) > _FAR
        )


def evaluate_on(result: FitResult, record: Record, *, q0: RecordStart = None, qd0: RecordStart = None) -> Score:
    """Run a fitted model on another record; only the start is fitted.

    The start is fitted to the first samples: 20, or as many more as show the velocity to 0.2 % of the speed of the
    record, at most a twentieth of all samples. These samples do not count in the error. `start_fitted` has the error
    with a start fitted to all samples, which is smaller because that start takes up part of the model's error.

    **Arguments:**

    - `result`: a fit that was not loaded from a file.
    - `record`: with the inputs, and some of the channels, of the fitted records. Preferably a part of the measurement
      that was held out of the fit.
    - `q0`, `qd0`: state at the first sample, shape `[dof]`, if it is known: both or none. All samples count then.
      A law by itself always starts unloaded at rest.

    **Returns:**

    A `Score`.

    **Raises:**

    - `ValueError` for channels or inputs that the fit does not know, a record that is too short, or a loaded result.
    - `RuntimeError` if the model's output is not finite.
    """
    return score_of(run_on(result, record, q0, qd0))


class RecordRun(NamedTuple):
    """A fitted model on one record.

    - `problem`: the record with only the state at its first sample free; for a law by itself, its parameters.
    - `x`: where that is known. `errors`: standard errors of the free numbers of the state, infinite if they are known.
    - `counts`: the samples that did not show the start.
    """

    record: Record
    problem: FitProblem
    x: Float[Array, " n"]
    errors: Float[np.ndarray, " local"]
    counts: Bool[np.ndarray, " samples"]


def run_on(result: FitResult, record: Record, q0: RecordStart, qd0: RecordStart) -> RecordRun:
    """The model on the record, from the given start or from the one that the first samples show."""
    search = result.search_for("An evaluation")
    known = search.problem.runs
    unknown = [name for name in record.channels if name not in known.measured]
    if unknown:
        raise ValueError(
            f"{record.name} has the channel {unknown[0]!r}, but the fit observed: {', '.join(known.measured)}."
        )
    if set(record.inputs) != set(known.inputs):
        raise ValueError(
            f"{record.name} has the inputs {', '.join(record.inputs) or 'none'}, but the model was fitted with:"
            f" {', '.join(known.inputs) or 'none'}."
        )
    if (q0 is None) != (qd0 is None):
        raise ValueError("A start has positions and velocities: give q0 and qd0, or neither.")
    problem = _record_problem(result, record, {"q0": q0, "qd0": qd0})
    counts, local = np.ones(len(record.t), bool), len(problem.local)
    if not local:
        return RecordRun(record, problem, search.state.x, np.zeros(0), counts)
    if q0 is not None:
        return RecordRun(record, problem, problem.x0, np.full(local, np.inf), counts)
    check_lengths((record,), local)
    begun = begin(problem, problem.x0, SearchOptions()).state
    counts = ~opening(problem.runs)[0]
    return RecordRun(record, problem, begun.x, start_errors_of(np.asarray(begun.jacobian)), counts)


def _record_problem(result: FitResult, record: Record, start: Mapping[str, RecordStart]) -> FitProblem:
    """The fitted model with only the initial state free; for a law by itself, which has none, the parameters."""
    # Slip instants are no channel of a score.
    bare = Record(record.t, record.channels, record.inputs, record.name, linear=record.linear)
    fitted, runs = result.search_for("An evaluation").problem, runs_of((bare,), cut((bare,), None))
    engine, first = fitted.engine, fitted.base
    if not isinstance(engine, ReplayEngine | EventEngine):
        return dataclasses.replace(fitted, runs=runs)
    scene = result.model
    assert isinstance(scene, Scene)
    assert isinstance(first, State)
    late = {name: jnp.asarray(x) for name, x in result.values.items() if name.startswith(DELAY)}
    observables = tuple((name, x) for name, x in engine.observables if name in record.channels)
    engine = dataclasses.replace(
        engine, model=scene, delays={**engine.delays, **late}, observables=observables, linear=record.linear
    )
    if isinstance(engine, EventEngine):
        engine = dataclasses.replace(engine, slips=())
    dof = first.q.shape[-1]
    states = []
    for (name, known), measured in zip(start.items(), measured_start(record, observables, dof), strict=True):
        array = measured if known is None else np.asarray(known, float)
        if array.shape != (dof,) or not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite and of the shape {(dof,)}, but it is {known!r}.")
        states.append(jnp.asarray(array, float)[None])
    q, qd = states
    return FitProblem(
        engine,
        FreeParameters((), (), {}),
        tuple(f"{x}[{i}]" for x in start for i in range(dof)),
        State(q, qd, jax.tree.map(lambda x: jnp.asarray(x)[None], scene.initial_state(q[0]))),
        runs,
        {name: fitted.noise[name] for name in record.channels},
        SquaredLoss(),
        Prior.of({}, ()),
    )


def score_of(run: RecordRun) -> Score:
    """The error with the start of the run, beside that with a start fitted to all samples."""
    score, problem = _score_at(run, run.x), run.problem
    if not problem.local:
        return score
    best = solve(problem, run.x, SearchOptions())
    moved = np.asarray(best.state.x - run.x)
    away = {name: float(d / e) for name, d, e in zip(problem.local, moved, run.errors, strict=True) if np.isfinite(e)}
    start = dataclasses.replace(_score_at(run, best.state.x), away=away, ending=best.ending)
    return dataclasses.replace(score, opening=int(np.sum(~run.counts)), start_fitted=start)


def _score_at(run: RecordRun, x: Float[Array, " n"]) -> Score:
    record, start, seen = run.record, run.problem.starts(x), channels_seen(run.problem, x)
    outputs = {name: np.asarray(seen[name], float)[0] for name in record.channels}
    rmse, fit = {}, {}
    for name, output in outputs.items():
        measured = record.channels[name]
        rmse[name] = rms((output - measured)[run.counts])
        if not np.isfinite(rmse[name]):
            raise RuntimeError(
                f"{record.name}: the model gives values of {name} that are not finite. Check the units and the"
                " start of the record, or fit with more substeps."
            )
        scatter = float(np.std(measured))
        fit[name] = 100 * (1 - rmse[name] / scatter) if scatter else float("nan")
    q0, qd0 = (None, None) if start is None else (np.asarray(start.q[0]), np.asarray(start.qd[0]))
    return Score(record=record, outputs=outputs, rmse=rmse, fit=fit, q0=q0, qd0=qd0)


def rms(x: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(x**2)))
