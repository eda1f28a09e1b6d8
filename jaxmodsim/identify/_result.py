"""What a fit found, with how sure it is."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from os import PathLike
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.files import jsonable
from ..friction import AbstractLaw
from ..scene import Scene
from ._causes import Cause, causes_of
from ._interval import interval
from ._model import PREFIX, holder_of, model_numbers, with_numbers
from ._motion import Motion, coordinates_seen, motion_of
from ._profile import Profile, profile_of
from ._record import Record
from ._remarks import remarks_of, uncertain_of
from ._residual_tests import ResidualTests, residual_tests_of
from ._runs import Windows
from ._save import read_fields, write_fields
from ._score import Score, score_of
from ._solve import Found, by_channel, spread_of


@dataclass(frozen=True)
class FitResult:
    """A fitted model.

    - `values`, `errors`, `start`: parameters, their standard errors and start values by name. The errors take the
      correlation of the residual in time into account; they hold for the model being right but for noise.
    - `units`: unit of each parameter that declares one.
    - `covariance`, `white`: of the parameters, shape `[free, free]`, in the order of `values`; the second as it would
      be if the residual were white noise.
    - `information`: Fisher information of the parameters, shape `[free, free]`, the noise at its level.
    - `logarithmic`: names of the parameters that must be positive; their intervals are symmetric in the logarithm.
    - `bounds`: lower and upper limit of each parameter at the estimate.
    - `model`: the scene or law with the fitted numbers; None in a result that was loaded without one.
    - `records`: what was fitted. `outputs`: the model's output at their times, by channel, one dict a record.
    - `noise`: standard deviation of each channel, as given or as estimated.
    - `rmse_by`: root mean square of output less measured value of each channel.
    - `evaluations`, `ending`: how often the model and its derivatives were computed, and how the search ended.
    - `step_error`: root mean square by which the output moves with four times as many integration steps; None where
      there are none.
    - `starts`: root mean square, in noise levels, that each of several starts ended with, best first.
    - `single_precision`: whether it was computed in float32.
    - `numbers`: all numbers of the model by name, those that were not fitted included.
    - `seen`: channels (of a law by itself, inputs) that are a coordinate or a velocity: `q[0]`, `qd[0]`, by name.
    - `causes`: what the motion lacks, and which parameters that leaves unknown; part of `remarks`.
    - `found`: the search, for further questions; None in a result that was loaded.
    """

    values: dict[str, float]
    errors: dict[str, float]
    start: dict[str, float]
    units: dict[str, str]
    covariance: Float[np.ndarray, "free free"]
    white: Float[np.ndarray, "free free"]
    information: Float[np.ndarray, "free free"]
    logarithmic: tuple[str, ...]
    bounds: dict[str, tuple[float, float]]
    model: eqx.Module | None
    records: tuple[Record, ...]
    outputs: tuple[dict[str, np.ndarray], ...]
    noise: dict[str, float]
    rmse_by: dict[str, float]
    evaluations: int
    ending: str
    step_error: float | None
    starts: tuple[float, ...]
    single_precision: bool
    numbers: dict[str, np.ndarray]
    seen: dict[str, str]
    causes: tuple[Cause, ...]
    found: Found | None

    @property
    def record(self) -> Record:
        """The record, where there is one.

        **Raises:**

        - `ValueError` if there are several.
        """
        if len(self.records) > 1:
            raise ValueError(f"{len(self.records)} records were fitted: take them from `records`.")
        return next(iter(self.records))

    @property
    def simulated(self) -> Float[np.ndarray, " samples"]:
        """The model's output along the one channel of the one record.

        **Raises:**

        - `ValueError` if there are several.
        """
        residual = next(iter(self.residuals[0].values()))
        return self.record.measured + residual  # both refuse several

    @property
    def rmse(self) -> float:
        """Root mean square of `simulated - measured` of the one channel.

        **Raises:**

        - `ValueError` if there are several.
        """
        if len(self.rmse_by) > 1:
            raise ValueError(f"There are the channels {', '.join(self.rmse_by)}: take theirs from `rmse_by`.")
        return next(iter(self.rmse_by.values()))

    @property
    def residuals(self) -> tuple[dict[str, np.ndarray], ...]:
        """Output less measured value by channel, one dict a record."""
        return tuple(
            {name: x - record.channels[name] for name, x in seen.items()}
            for record, seen in zip(self.records, self.outputs, strict=True)
        )

    @property
    def motions(self) -> tuple[Motion, ...]:
        """Coordinates and velocities as far as the model's output shows them, one a record."""
        return tuple(
            motion_of(record, seen, self.seen) for record, seen in zip(self.records, self.outputs, strict=True)
        )

    @property
    def correlation(self) -> Float[np.ndarray, "free free"]:
        """Correlation of the parameters, in the order of `values`."""
        errors = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        safe = np.where((errors > 0) & np.isfinite(errors), errors, 1.0)
        known = np.isfinite(self.covariance) & np.isfinite(np.add.outer(errors, errors))
        correlation = np.where(known, np.where(known, self.covariance, 0.0) / np.outer(safe, safe), 0.0)
        np.fill_diagonal(correlation, 1.0)
        return correlation

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence intervals, symmetric in the logarithm for parameters that must be positive.

        **Raises:**

        - `ValueError` unless 0 < level < 1.
        """
        return {
            name: interval(value, self.errors[name], self.bounds[name], name in self.logarithmic, level)
            for name, value in self.values.items()
        }

    def profile(self, name: str, *, points: int = 6, level: float = 0.95) -> Profile:
        """Profile likelihood of one parameter: all others, and free initial states, are fitted again at each value.

        Unlike `intervals` it holds where the model is far from linear, and shows what the record leaves open: it
        walks both ways from the estimate, in the logarithm of a parameter that must be positive, until the fit is
        worse than the level allows. The noise levels stay as they are. Costs a few evaluations a point, and compiles
        nothing.

        **Arguments:**

        - `name`: of a free parameter that is no initial state.
        - `points`: about how many on either side, at least 2.
        - `level`: of the interval, between 0 and 1.

        **Returns:**

        A `Profile`, drawn by `jaxmodsim.plot.profile_figure`.

        **Raises:**

        - `ValueError` for another name or level, or of a result that was loaded.
        """
        return profile_of(self, name, points, level)

    def residual_tests(self) -> ResidualTests:
        """Whether the residuals are noise, how long they remember, and what they go with.

        Position and velocity are those of the model's output, where a channel shows them.
        """
        return residual_tests_of(self)

    def score(self, record: Record, *, q0: Any = None, qd0: Any = None, free_start: bool = True) -> Score:
        """Run the fitted model on another record, with nothing fitted but its initial state.

        **Arguments:**

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
        return score_of(self, record, q0, qd0, free_start)

    def save(self, path: str | PathLike[str]) -> None:
        """Write everything but the model's functions and the search into one file, whole or not at all.

        A zip of one JSON text and of arrays (`numpy.load` opens it, too), in which every number stays what it is.
        """
        write_fields(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @staticmethod
    def load(path: str | PathLike[str], model: eqx.Module | None = None) -> "FitResult":
        """A result that `save` wrote. It can do all but run the model: no `profile` and no `score`.

        **Arguments:**

        - `path`: of the file.
        - `model`: the scene or law that was fitted, with any numbers; `model` of the result is this one with all its
          numbers as they were.

        **Raises:**

        - `ValueError` for a file that is damaged or something else, or a model whose numbers have other names.
        - `OSError` if the file cannot be read.
        """
        found = read_fields(path, tuple(field.name for field in fields(FitResult)))
        given = None if model is None else with_numbers(model, found["numbers"])
        return FitResult(**found, model=given, found=None)

    def plot(self, record: int = 0, units: Mapping[str, str] | None = None) -> Any:
        """One figure for a report: record and residual, its autocorrelation, intervals and correlations.

        **Arguments:**

        - `record`: number of the record that is drawn.
        - `units`: of the channels by name, for the axes: `{"measured": "m"}`.

        **Returns:**

        A `matplotlib.figure.Figure`, as `jaxmodsim.plot.result_figure` draws it.

        **Raises:**

        - `ValueError` if there is no such record or channel.
        """
        from ..plot import result_figure

        return result_figure(self, record=record, units=units)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the record can not tell, in words."""
        return remarks_of(self)

    def rows(self) -> list[tuple[str, float, float, float, str]]:
        """Rows of a table: name, value, standard error, start, unit."""
        return [
            (name, value, self.errors[name], self.start[name], self.units[name]) for name, value in self.values.items()
        ]

    def to_dict(self) -> dict[str, Any]:
        """All but the samples and the model, as JSON knows it: numbers that are not finite are None."""
        intervals = self.intervals()
        return jsonable(
            {
                "records": [record.name for record in self.records],
                "samples": [len(record.t) for record in self.records],
                "rmse": self.rmse_by,
                "noise": self.noise,
                "parameters": {
                    name: {
                        "value": value,
                        "standard_error": error,
                        "interval": list(intervals[name]),
                        "start": start,
                        "unit": unit,
                    }
                    for name, value, error, start, unit in self.rows()
                },
                "correlation": {"names": list(self.values), "matrix": self.correlation.tolist()},
                "evaluations": self.evaluations,
                "ending": self.ending,
                "step_error": self.step_error,
                "remarks": list(self.remarks),
            }
        )

    def __str__(self) -> str:
        """A table of the parameters, and what the record cannot tell."""
        width = max(len(name) for name in self.values)
        lines = [f"{'':{width}}  {'value':>13}  {'std. error':>11}  {'95 % interval':>25}  unit"]
        for name, value, error, _, unit in self.rows():
            low, high = self.intervals()[name]
            lines.append(f"{name:{width}}  {value:13.6g}  {error:11.2g}  {low:12.5g} {high:12.5g}  {unit}")
        errors = ", ".join(f"{'' if len(self.rmse_by) == 1 else name + ' '}{x:.6g}" for name, x in self.rmse_by.items())
        return "\n".join([*lines, f"RMSE {errors}; {self.evaluations} evaluations, {self.ending}", *self.remarks])


def result_of(
    found: Found,
    records: tuple[Record, ...],
    windows: Windows,
    units: dict[str, str],
    model: eqx.Module,
    step_error: float | None = None,
    starts: tuple[float, ...] = (),
) -> FitResult:
    """What a search found, in the words of those who asked."""
    problem, search = found.problem, found.search
    names, at_start, values = list(problem.free.names), [], []
    shared, own = problem.split(search.x)
    values += [float(x) for x in problem.free.vector(shared)]
    at_start += [float(problem.free.start[name]) for name in names]
    whole = len(set(windows.record)) == len(windows.record)
    if whole and problem.local:
        base = _first_states(found)
        for i, record in enumerate(records):
            prefix = "" if len(records) == 1 else f"{record.name}/"
            names += [prefix + name for name in problem.local]
            at_start += base[i].tolist()
            values += (base[i] + np.asarray(own[i])).tolist()
    how_sure = spread_of(problem, search, len(names))
    errors = np.sqrt(np.maximum(np.diag(np.asarray(how_sure.covariance)), 0.0))
    outputs, rmse = _stitched(found, records, windows)
    result = FitResult(
        dict(zip(names, values, strict=True)),
        dict(zip(names, errors.tolist(), strict=True)),
        dict(zip(names, at_start, strict=True)),
        {name: units.get(name, "") for name in names},
        np.asarray(how_sure.covariance),
        np.asarray(how_sure.white),
        np.asarray(how_sure.information),
        tuple(name for name, kind in zip(problem.free.names, problem.free.kinds, strict=True) if kind == "log"),
        problem.free.limits(shared) | {name: (-np.inf, np.inf) for name in names[len(problem.free.names) :]},
        model,
        records,
        outputs,
        {name: float(x) for name, x in problem.noise.items()},
        rmse,
        found.iterations,
        found.ending,
        step_error,
        starts,
        jnp.result_type(float) == jnp.float32,
        model_numbers(model),
        _seen(found),
        (),
        found,
    )
    return replace(result, causes=_causes(result))


def _seen(found: Found) -> dict[str, str]:
    """Which channels, or inputs of a law, are coordinates and velocities."""
    base = found.problem.base
    if base is None:
        return {"x": "q[0]"} if "x" in found.problem.runs.inputs else {}
    return coordinates_seen(found.problem.engine.observables, base.q.shape[-1])


def _causes(result: FitResult) -> tuple[Cause, ...]:
    """Causes in the motion for what the figures call uncertain."""
    uncertain = uncertain_of(result)
    assert result.found is not None
    base, model = result.found.problem.base, result.model
    law = isinstance(model, AbstractLaw)
    scene = holder_of(model) if law else model
    if not uncertain or not isinstance(scene, Scene):
        return ()
    dof = 1 if base is None else base.q.shape[-1]
    free = result.found.problem.free.names
    return causes_of(scene, PREFIX if law else "", result.motions, dof, result.numbers, free, uncertain)


def _first_states(found: Found) -> np.ndarray:
    """Free numbers of the initial states before the fit, shape `[runs, local]`."""
    from_base = found.problem.base
    assert from_base is not None
    return np.asarray(jax.vmap(found.problem.taken)(from_base))


def _stitched(
    found: Found, records: tuple[Record, ...], windows: Windows
) -> tuple[tuple[dict[str, np.ndarray], ...], dict[str, float]]:
    """The model's output along each record, and the root mean squares of the differences."""
    problem = found.problem
    split = by_channel(problem, found.search.residual)
    seen: list[dict[str, np.ndarray]] = [
        {name: np.array(x) for name, x in record.channels.items()} for record in records
    ]
    rmse = {}
    for name, (residual, weight) in split.items():
        level = float(problem.noise[name])
        rmse[name] = level * float(np.sqrt(np.sum(residual[weight > 0] ** 2) / max(np.sum(weight > 0), 1)))
        for run, (i, first, last) in enumerate(zip(windows.record, windows.first, windows.last, strict=True)):
            if name in seen[i]:
                counted = np.flatnonzero(weight[run, : last - first + 1] > 0)
                seen[i][name][first + counted] += level * residual[run, counted]
    return tuple(seen), rmse
