"""A fitted model on a record that it was not fitted to."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ...scene import Scene, State
from ..data._record import Record, cut, runs_of
from ..estimate._prepare import measured_start
from ..estimate._problem import FitProblem, Prior, SquaredLoss
from ..estimate._search import SearchOptions, by_channel, channels_seen, solve
from ..model._engines import DELAY, EventEngine, ReplayEngine
from ..model._parameters import FreeParameters
from ..uncertainty._result import FitResult

_Start: TypeAlias = ArrayLike | Sequence[ArrayLike] | None


@dataclass(frozen=True, kw_only=True)
class Score:
    """How a fitted model does on a record.

    - `record`: the record. `outputs`: the model's output at its times, by channel.
    - `rmse`: root mean square of output less measured value, by channel, in its unit.
    - `fit`: `100 (1 - rmse/standard deviation of the channel)` [%], by channel: 100 is perfect, 0 no better than the
      mean.
    - `q0`, `qd0`: coordinates and velocities at the first sample, shape `[dof]`; None for a law by itself.
    - `ending`: how the search of the initial state ended; None where nothing was searched.
    """

    record: Record
    outputs: dict[str, Float[np.ndarray, " samples"]]
    rmse: dict[str, float]
    fit: dict[str, float]
    q0: Float[np.ndarray, " dof"] | None
    qd0: Float[np.ndarray, " dof"] | None
    ending: str | None

    @property
    def residuals(self) -> dict[str, Float[np.ndarray, " samples"]]:
        """Output less measured value by channel."""
        return {name: x - self.record.channels[name] for name, x in self.outputs.items()}

    def __str__(self) -> str:
        """A line for each channel."""
        lines = [f"{self.record.name}:"]
        lines += [f"  {name}: RMSE {x:.6g}, fit {self.fit[name]:.2f} %" for name, x in self.rmse.items()]
        if self.ending is not None:
            lines.append(f"  initial state fitted: q0 = {self.q0}, qd0 = {self.qd0}; {self.ending}")
        return "\n".join(lines)


def score(
    result: FitResult, record: Record, *, q0: _Start = None, qd0: _Start = None, free_start: bool = True
) -> Score:
    """Run a fitted model on another record, with nothing fitted but its initial state.

    **Arguments:**

    - `result`: a fit that was not loaded from a file.
    - `record`: with the inputs, and some of the channels, of the records that were fitted. Better a part of the
      measurement that the fit has not seen.
    - `q0`, `qd0`: state at the first sample, shape `[dof]`; by default what the record's beginning shows of each
      coordinate that was measured, the others 0.
    - `free_start`: whether the state at the first sample is fitted to this record, from `q0` and `qd0`. If not, it
      is as given, by default the first measured position and rest. A law by itself starts unloaded at rest always.

    **Returns:**

    A `Score`.

    **Raises:**

    - `ValueError` for channels or inputs that the fit does not know, or of a result that was loaded.
    """
    search = result.search
    if search is None:
        raise ValueError("A score needs what the fit observed, which a loaded result does not have: fit again.")
    problem = search.problem
    _check(record, problem)
    if not isinstance(problem.engine, ReplayEngine | EventEngine):
        values, _ = problem.split(search.state.x)
        fixed = dataclasses.replace(problem, runs=runs_of((_bare(record),), cut((record,), None)))
        return _scored(record, channels_seen(fixed, values), None, None)
    alone = _alone(result, problem, record, (q0, qd0), free_start)
    if not free_start:
        assert alone.base is not None
        return _scored(record, channels_seen(alone, alone.x0), alone.base, None)
    start = solve(alone, alone.x0, SearchOptions())
    outputs = {
        name: (record.channels[name] + float(alone.noise[name]) * residual[0])[None]
        for name, (residual, _) in by_channel(alone, start.state.residual).items()
    }
    return _scored(record, outputs, alone.starts(start.state.x), start.ending)


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


def _alone(
    result: FitResult,
    old: FitProblem,
    record: Record,
    given: tuple[ArrayLike | Sequence[ArrayLike] | None, ...],
    free_start: bool,
) -> FitProblem:
    """The fitted model with nothing free but the initial state."""
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
    guessed = measured_start(record, observables, dof, exact=not free_start)
    start = [_given(x, guess, dof, name) for x, guess, name in zip(given, guessed, ("q0", "qd0"), strict=True)]
    q, qd = (jnp.asarray(x, float)[None] for x in start)
    z = scene.initial_state(q[0])
    base = State(q, qd, jax.tree.map(lambda x: jnp.asarray(x)[None], z))
    local = tuple(f"{x}[{i}]" for x in ("q0", "qd0") for i in range(dof)) if free_start else ()
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
    record: Record, outputs: Mapping[str, Array | np.ndarray], start: State | None, ending: str | None
) -> Score:
    seen = {name: np.asarray(outputs[name], float)[0] for name in record.channels}
    rmse = {name: float(np.sqrt(np.mean((x - record.channels[name]) ** 2))) for name, x in seen.items()}
    changes = {name: float(np.std(x)) for name, x in record.channels.items()}
    fit = {name: 100 * (1 - rmse[name] / changes[name]) if changes[name] else float("nan") for name in seen}
    q0, qd0 = (None, None) if start is None else (np.asarray(start.q[0]), np.asarray(start.qd[0]))
    return Score(record=record, outputs=seen, rmse=rmse, fit=fit, q0=q0, qd0=qd0, ending=ending)
