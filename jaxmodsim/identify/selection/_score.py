"""A fitted model on a record that it was not fitted to."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ...scene import Scene, State
from ..data._record import Record, cut, runs_of
from ..estimate._prepare import measured_start
from ..estimate._problem import FitProblem, Prior, SquaredLoss
from ..estimate._search import SearchOptions, channels_seen, solve
from ..model._engines import DELAY, EventEngine, ReplayEngine
from ..model._parameters import FreeParameters
from ..uncertainty._result import FitResult
from ._opening import begin, check_lengths, opening, start_errors_of

_Start: TypeAlias = ArrayLike | Sequence[ArrayLike] | None
# Standard errors beyond which a fitted start is no longer what was measured.
_FAR = 3.0


@dataclass(frozen=True, kw_only=True)
class Score:
    """How a fitted model does on a record.

    - `record`: the record. `outputs`: the model's output at its times, by channel.
    - `rmse`: root mean square of output less measured value, by channel, in its unit, over the samples that did not
      show the start.
    - `fit`: `100 (1 - rmse/standard deviation of the channel)` [%], by channel: 100 is perfect, 0 no better than the
      mean.
    - `q0`, `qd0`: coordinates and velocities at the first sample, shape `[dof]`; None for a law by itself.
    - `opening`: number of the first samples, which showed the start; 0 where it was given.
    - `start_fitted`: the same samples with a start that is fitted to all of the record; None for a law by itself.
    """

    record: Record
    outputs: dict[str, Float[np.ndarray, " samples"]]
    rmse: dict[str, float]
    fit: dict[str, float]
    q0: Float[np.ndarray, " dof"] | None
    qd0: Float[np.ndarray, " dof"] | None
    opening: int = 0
    start_fitted: "StartFitted | None" = None

    @property
    def residuals(self) -> dict[str, Float[np.ndarray, " samples"]]:
        """Output less measured value by channel."""
        return {name: x - self.record.channels[name] for name, x in self.outputs.items()}

    def __str__(self) -> str:
        """A line for each channel."""
        lines = [f"{self.record.name}{f', started from its first {self.opening} samples' if self.opening else ''}:"]
        lines += [f"  {name}: RMSE {x:.6g}, fit {self.fit[name]:.2f} %" for name, x in self.rmse.items()]
        if self.start_fitted is not None:
            lines += [
                f"  {name}: RMSE {x:.6g} with a start fitted to all of it" for name, x in self.start_fitted.rmse.items()
            ]
        return "\n".join(lines + [f"  {each}" for each in self.remarks])

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on a fitted start that the first samples contradict: it has taken up an error of the model."""
        away = {} if self.start_fitted is None else self.start_fitted.away
        return tuple(
            f"Fitted to all of {self.record.name}, {name} moves by {abs(x):.3g} standard errors from what its first"
            " samples show: the start takes up an error of the model."
            for name, x in away.items()
            if abs(x) > _FAR
        )


@dataclass(frozen=True, kw_only=True)
class StartFitted:
    """What becomes of a record if the state at its first sample is fitted to all of its samples.

    - `rmse`: by channel, as in `Score`. `q0`, `qd0`: the state, shape `[dof]`. `ending`: how the search ended.
    - `away`: how far each number of it, such as `q0[0]`, is from what the first samples show, in standard errors of
      these; those that they do not show are left out.
    """

    rmse: dict[str, float]
    q0: Float[np.ndarray, " dof"]
    qd0: Float[np.ndarray, " dof"]
    away: dict[str, float]
    ending: str


def evaluate_on(result: FitResult, record: Record, *, q0: _Start = None, qd0: _Start = None) -> Score:
    """Run a fitted model on another record, to which nothing is fitted but where it starts.

    The start is fitted to the first samples alone: 20, or as many more as show the velocity to 0.2 % of the speed of
    the record, a twentieth of them at most. They do not count after that. Beside the error stands the one with a start
    fitted to all samples: smaller, as it takes up a part of what the model does wrong.

    **Arguments:**

    - `result`: a fit that was not loaded from a file.
    - `record`: with the inputs, and some of the channels, of the records that were fitted. Better a part of the
      measurement that the fit has not seen.
    - `q0`, `qd0`: state at the first sample, shape `[dof]`, where it is known: both or none. All samples count then.
      A law by itself starts unloaded at rest always.

    **Returns:**

    A `Score`.

    **Raises:**

    - `ValueError` for channels or inputs that the fit does not know, a record that is too short, or a result that was
      loaded.
    - `RuntimeError` where the model gives values that are not finite.
    """
    search = result.search
    if search is None:
        raise ValueError("A score needs what the fit observed, which a loaded result does not have: fit again.")
    problem = search.problem
    _check(record, problem)
    if (q0 is None) != (qd0 is None):
        raise ValueError("A start has positions and velocities: give q0 and qd0, or neither.")
    alone = record_problem(result, record, (q0, qd0))
    if not alone.local:
        values, _ = problem.split(search.state.x)
        return _scored(record, channels_seen(alone, values), np.ones(len(record.t), bool), None)
    counts, x, errors = np.ones(len(record.t), bool), alone.x0, np.full(len(alone.local), np.inf)
    if q0 is None:
        check_lengths((record,), len(alone.local))
        counts, shown = ~opening(alone.runs)[0, : len(record.t)], begin(alone, x, SearchOptions())
        x, errors = shown.state.x, start_errors_of(np.asarray(shown.state.jacobian))
    found = _scored(record, channels_seen(alone, x), counts, alone.starts(x))
    best = solve(alone, x, SearchOptions())
    start = _scored(record, channels_seen(alone, best.state.x), counts, alone.starts(best.state.x))
    moved = np.asarray(best.state.x - x)
    away = {name: float(d / e) for name, d, e in zip(alone.local, moved, errors, strict=True) if np.isfinite(e)}
    assert start.q0 is not None
    assert start.qd0 is not None
    fitted = StartFitted(rmse=start.rmse, q0=start.q0, qd0=start.qd0, away=away, ending=best.ending)
    return dataclasses.replace(found, opening=int(np.sum(~counts)), start_fitted=fitted)


def _check(record: Record, problem: FitProblem) -> None:
    unknown = [name for name in record.channels if name not in problem.runs.measured]
    if unknown:
        raise ValueError(
            f"{record.name} has the channel {unknown[0]!r}, but the fit observed: {', '.join(problem.runs.measured)}."
        )
    if set(record.inputs) != set(problem.runs.inputs):
        raise ValueError(
            f"{record.name} has the inputs {', '.join(record.inputs) or 'none'}, but the model was fitted with:"
            f" {', '.join(problem.runs.inputs) or 'none'}."
        )


def _bare(record: Record) -> Record:
    """Without slip instants, which are no channel to be scored."""
    return Record(record.t, record.channels, record.inputs, record.name, linear=record.linear)


def record_problem(result: FitResult, record: Record, given: tuple[_Start, _Start]) -> FitProblem:
    """The fitted model with nothing free but the initial state; of a law by itself, which has none, the parameters."""
    assert result.search is not None
    old = result.search.problem
    if not isinstance(old.engine, ReplayEngine | EventEngine):
        return dataclasses.replace(old, runs=runs_of((_bare(record),), cut((record,), None)))
    scene, engine, first = result.model, old.engine, old.base
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
    guessed = measured_start(record, observables, dof)
    start = [_given(x, guess, dof, name) for x, guess, name in zip(given, guessed, ("q0", "qd0"), strict=True)]
    q, qd = (jnp.asarray(x, float)[None] for x in start)
    z = scene.initial_state(q[0])
    base = State(q, qd, jax.tree.map(lambda x: jnp.asarray(x)[None], z))
    local = tuple(f"{x}[{i}]" for x in ("q0", "qd0") for i in range(dof))
    return FitProblem(
        engine,
        FreeParameters.none(),
        local,
        base,
        runs_of((_bare(record),), cut((record,), None)),
        {name: old.noise[name] for name in record.channels},
        SquaredLoss(),
        Prior(jnp.zeros(0), jnp.zeros(0)),
    )


def _given(given: _Start, guess: np.ndarray, dof: int, name: str) -> np.ndarray:
    if given is None:
        return guess
    array = np.asarray(given, float)
    if array.shape != (dof,) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite and of the shape {(dof,)}, but it is {given!r}.")
    return array


def _scored(
    record: Record, outputs: Mapping[str, Array], counts: Bool[np.ndarray, " samples"], start: State | None
) -> Score:
    seen = {name: np.asarray(outputs[name], float)[0] for name in record.channels}
    rmse = {name: float(np.sqrt(np.mean((x - record.channels[name])[counts] ** 2))) for name, x in seen.items()}
    for name, x in rmse.items():
        if not np.isfinite(x):
            raise RuntimeError(
                f"{record.name}: the model gives values of {name} that are not finite. Check the units and the"
                " start of the record, or fit with more substeps."
            )
    changes = {name: float(np.std(x)) for name, x in record.channels.items()}
    fit = {name: 100 * (1 - rmse[name] / changes[name]) if changes[name] else float("nan") for name in seen}
    q0, qd0 = (None, None) if start is None else (np.asarray(start.q[0]), np.asarray(start.qd[0]))
    return Score(record=record, outputs=seen, rmse=rmse, fit=fit, q0=q0, qd0=qd0)
