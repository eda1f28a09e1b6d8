"""The outcome of `jaxmodsim fit`: numbers, tables and the sentences that summarise them."""

import math
import shlex
import sys
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib import metadata

import numpy as np
import pandas as pd

from .._core.arguments import axis_unit
from .._core.system import jsonable
from ..identify import (
    Comparison,
    FitResult,
    InputDesign,
    PredictionError,
    Profile,
    RecordAgreement,
    RecordPrediction,
    Score,
    warnings_for,
)
from ..scene import Scene, scene_numbers
from ._plan import FitPlan

# Units of numbers that declare none: the params of an axis, and initial states.
_UNITS = {"m": "kg", "offset": "N", "q0[0]": "m", "qd0[0]": "m/s"}


def _origin() -> dict[str, str]:
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("jaxmodsim", "jax", "diffrax", "numpy"))
    return {
        "command": shlex.join(["jaxmodsim", *sys.argv[1:]]),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "versions": f"{versions}, Python {sys.version.split()[0]}",
    }


@dataclass(frozen=True)
class FitOutcome:
    """Everything that `jaxmodsim fit` computes.

    - `plan`: the arguments. `model`: name of the selected model. `result`: its fit to all records.
    - `comparison`: None for a single model without cross-validation.
    - `predictions`: of the held-out records. `agreement`: of several records; None for a single one.
    - `expected`: error on a new record; None after Ctrl-C.
    - `substeps`: integration steps between two samples. `seconds`: duration of the computation.
    - `profiles`, `design`: profile likelihoods and a designed input, if requested.
    - `origin`: command, date and versions.
    """

    plan: FitPlan
    model: str
    result: FitResult
    comparison: Comparison | None = None
    predictions: tuple[RecordPrediction, ...] = ()
    agreement: RecordAgreement | None = None
    expected: PredictionError | None = None
    substeps: int = 1
    seconds: float = 0.0
    profiles: tuple[Profile, ...] = ()
    design: InputDesign | None = None
    origin: dict[str, str] = field(default_factory=_origin)

    @property
    def scores(self) -> tuple[Score, ...]:
        """Scores on the held-out records."""
        return tuple(prediction.score for prediction in self.predictions)

    @property
    def scene(self) -> Scene:
        """The model with its fitted numbers."""
        assert isinstance(self.result.model, Scene)
        return self.result.model

    @property
    def title(self) -> str:
        """Records and model."""
        names = ", ".join(record.name for record in self.result.provenance.records)
        return f"{names}: {self.model}, {self.plan.candidates[self.model].description}"

    @property
    def measured(self) -> dict[str, str]:
        """Quantity and unit of the measurement, as figures name them."""
        return {
            "quantity": "angle" if self.plan.rotary else "position",
            "unit": axis_unit("m", self.plan.rotary),
        }

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended the search, or the comparison before all models were fitted."""
        left = self.comparison.left if self.comparison else ()
        return self.result.diagnostics.ending.startswith("interrupted") or bool(left)

    @property
    def held(self) -> dict[str, float]:
        """Numbers of the model that were not fitted, by name."""
        return {
            name: float(x)
            for name, x in scene_numbers(self.scene).items()
            if name not in self.result.values and name != "u" and not name.endswith("belt_velocity")
        }

    def equations(self) -> tuple[str, ...]:
        """The equation of motion of the axis, then the force of each friction element, as text."""
        elements = list(self.scene.friction.values())
        params = self.scene.params
        assert isinstance(params, dict)
        terms = ["offset"] if float(params["offset"]) != 0 else []
        lines = [" - ".join(["m q'' = u", *terms, *(f"F_{effect.name}" for effect in elements)]) + ",   v = q'"]
        for effect in elements:
            first, *rest = effect.law.formulas()
            lines += [f"F_{effect.name} = {first}", *(f"    {line}" for line in rest)]
        return tuple(lines)

    def headline(self) -> tuple[str, ...]:
        """The summary in a few lines: numbers, error, the first warning, the error to expect on a new record."""
        result, records, unit = self.result, self.result.provenance.records, f"m{self.measured['unit']}"
        numbers = ", ".join(
            f"{name} {value:.4g}{f' {own}' if own else ''} (+-{error:.2g})"
            for name, value, error, _, own in result.estimate.rows()
        )
        residual = np.concatenate([each["measured"] for each in result.residuals])
        squares = np.concatenate([(record.measured - np.mean(record.measured)) ** 2 for record in records])
        share = 100 * np.std(residual) / math.sqrt(np.mean(squares))
        seconds = sum(float(record.t[-1] - record.t[0]) for record in records)
        held_out = "".join(
            f"; on the held-out {each.record.name}, {1e3 * each.rmse['measured']:.3g} {unit} with the initial state"
            f" fitted to its first {each.opening} samples"
            for each in self.scores
        )
        warnings = (
            *self.plan.notes,
            *(self.agreement.sentences if self.agreement else ()),
            *(warning for each in self.scores for warning in each.warnings),
            *warnings_for(result),
        )
        return (
            f"{self.model.capitalize()}: {numbers}.",
            f"Simulated from the force alone for {seconds:.3g} s, the model misses the measured"
            f" {self.measured['quantity']} by {1e3 * math.sqrt(np.mean(residual**2)):.3g} {unit} RMS, {share:.2g} % of"
            f" its standard deviation{held_out}.",
            f"Before you rely on it: {warnings[0]}" if warnings else "Nothing in the records contradicts the model.",
            *([] if self.expected is None else [self._new_record(self.expected, unit)]),
        )

    def _new_record(self, error: PredictionError, unit: str) -> str:
        """The error to expect on a record of the same motion, and the coverage of the bands on held-out records."""
        coverage = "".join(
            f" Of {each.score.record.name} {100 * each.shares['measured']:.0f} % of the samples lie within the band for"
            f" {100 * each.level:g} %."
            for each in self.predictions
        )
        single = "A single record cannot show changes from day to day. " if error.records == 1 else ""
        return (
            f"{single}On a new record of this motion expect an error of {1e3 * error.unchanged:.3g} {unit} if nothing"
            f" has changed ({1e3 * error.model:.3g} from the model, {1e3 * error.parameters:.3g} from uncertain"
            f" parameters), and of {1e3 * error.total:.3g} {unit} with {error.assumption}.{coverage}"
        )

    def summary(self) -> dict[str, object]:
        """Everything but the samples, as JSON knows it."""
        columns = ("parameter", "common", "standard error", "between records", "95 % from", "to", "p of no difference")
        agreed = self.agreement and [dict(zip(columns, row, strict=True)) for row in self.agreement.rows()]
        return {
            "headline": list(self.headline()),
            "read": list(self.plan.notes),
            "model": self.model,
            "description": self.plan.candidates[self.model].description,
            "equations": list(self.equations()),
            **self.result.to_dict(),
            "held": self.held,
            "held_out": {each.record.name: each.rmse for each in self.scores},
            "held_out_start_fitted": {
                each.record.name: each.start_fitted.rmse if each.start_fitted else None for each in self.scores
            },
            "expected": None if self.expected is None else self.expected.total,
            "expected_if_unchanged": None if self.expected is None else self.expected.unchanged,
            "held_out_within_band": {each.score.record.name: each.shares for each in self.predictions},
            "agreement": jsonable(agreed),
            "differing": None if self.agreement is None else list(self.agreement.differing),
            "comparison": None if self.comparison is None else self.comparison.to_dict(),
            "substeps": self.substeps,
            "seconds": self.seconds,
            **self.origin,
        }


def with_units(result: FitResult, rotary: bool) -> FitResult:
    """The result with a unit for every parameter, those of a rotary axis if it is one."""
    units = {
        name: axis_unit(unit or _UNITS.get(name.rpartition("/")[2], ""), rotary)
        for name, unit in result.estimate.units.items()
    }
    return replace(result, estimate=replace(result.estimate, units=units))


def record_table(outcome: FitOutcome) -> pd.DataFrame:
    """Records, fitted and held out, with the RMSE of the simulation."""
    fitted = zip(outcome.result.provenance.records, outcome.result.residuals, strict=True)
    errors = [(record, "fitted", math.sqrt(np.mean(each["measured"] ** 2)), math.nan) for record, each in fitted]
    for score in outcome.scores:
        start = score.start_fitted.rmse["measured"] if score.start_fitted else math.nan
        errors.append((score.record, "held out", score.rmse["measured"], start))
    unit = f"RMSE [m{outcome.measured['unit']}]"
    return pd.DataFrame(
        {
            "record": record.name,
            "use": use,
            "samples": len(record.t),
            "from [s]": float(record.t[0]),
            "to [s]": float(record.t[-1]),
            unit: 1e3 * rmse,
            "of its standard deviation [%]": 100 * rmse / float(np.std(record.measured) or np.nan),
            f"start fitted, {unit}": 1e3 * start,
        }
        for record, use, rmse, start in errors
    )


def sample_table(outcome: FitOutcome) -> pd.DataFrame:
    """All samples of all records, measured and simulated."""
    provenance, unit = outcome.result.provenance, outcome.measured["unit"]
    fitted = zip(provenance.records, provenance.outputs, strict=True)
    runs = [(record, "fitted", output["measured"]) for record, output in fitted]
    runs += [(score.record, "held out", score.outputs["measured"]) for score in outcome.scores]
    return pd.concat(
        pd.DataFrame(
            {
                "record": record.name,
                "use": use,
                "t [s]": record.t,
                f"force [{axis_unit('N', outcome.plan.rotary)}]": record.inputs["u"],
                f"measured [{unit}]": record.measured,
                f"simulated [{unit}]": simulated,
            }
        )
        for record, use, simulated in runs
    )
