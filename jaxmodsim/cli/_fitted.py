"""What `jaxmodsim fit` found, as tables."""

import math
import shlex
import sys
from dataclasses import dataclass, replace
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
    remarks,
)
from ..scene import Scene, scene_numbers
from ._equations import equations
from ._plan import Plan

# Units of what declares none: the params of an axis, and initial states.
_UNITS = {"m": "kg", "offset": "N", "q0[0]": "m", "qd0[0]": "m/s"}


@dataclass(frozen=True)
class Fitted:
    """A fit of the command line.

    - `plan`: what was asked for. `model`: name of the model that was taken.
    - `result`: its fit to all records.
    - `comparison`: None where a single model was fitted, and not on folds.
    - `predictions`: of the records that were held out. `agreement`: of several records; None of one.
    - `expected`: error on a new record; None after Ctrl-C.
    - `substeps`: integration steps between two samples.
    - `seconds`: that all took.
    """

    plan: Plan
    model: str
    result: FitResult
    comparison: Comparison | None = None
    predictions: tuple[RecordPrediction, ...] = ()
    agreement: RecordAgreement | None = None
    expected: PredictionError | None = None
    substeps: int = 1
    seconds: float = 0.0

    @property
    def scores(self) -> tuple[Score, ...]:
        """On the records that were held out."""
        return tuple(prediction.score for prediction in self.predictions)

    @property
    def scene(self) -> Scene:
        """The model with its fitted numbers."""
        assert isinstance(self.result.model, Scene)
        return self.result.model

    @property
    def description(self) -> str:
        """The model in words."""
        return self.plan.candidates[self.model].description

    @property
    def quantity(self) -> str:
        """What was measured, in words."""
        return "angle" if self.plan.rotary else "position"

    @property
    def unit(self) -> str:
        """Unit of the position."""
        return axis_unit("m", self.plan.rotary)

    @property
    def measured(self) -> dict[str, str]:
        """What was measured, as figures name it."""
        return {"quantity": self.quantity, "unit": self.unit}

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended the search, or the comparison before all models were fitted."""
        return self.result.diagnostics.ending.startswith("interrupted") or bool(
            self.comparison and self.comparison.left
        )

    @property
    def held(self) -> dict[str, float]:
        """Numbers of the model that were not fitted, by name."""
        return {
            name: float(x)
            for name, x in scene_numbers(self.scene).items()
            if name not in self.result.values and name != "u" and not name.endswith("belt_velocity")
        }


@dataclass(frozen=True)
class Findings:
    """All that a report shows: the fit, profiles, a designed input, and where it all comes from."""

    fitted: Fitted
    profiles: tuple[Profile, ...]
    design: InputDesign | None
    origin: dict[str, str]


def with_units(result: FitResult, rotary: bool) -> FitResult:
    """The result with the units of what declares none, and those of a rotary axis where it is one."""
    units = {
        name: axis_unit(unit or _UNITS.get(name.rpartition("/")[2], ""), rotary)
        for name, unit in result.estimate.units.items()
    }
    return replace(result, estimate=replace(result.estimate, units=units))


def origin() -> dict[str, str]:
    """Command, date and versions."""
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("jaxmodsim", "jax", "diffrax", "numpy"))
    return {
        "command": shlex.join(["jaxmodsim", *sys.argv[1:]]),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "versions": f"{versions}, Python {sys.version.split()[0]}",
    }


def headline(fitted: Fitted) -> tuple[str, ...]:
    """Lines to say aloud: what the axis is, how well it follows, the first doubt, what to expect of a new record."""
    result, records = fitted.result, fitted.result.provenance.records
    numbers = ", ".join(
        f"{name} {value:.4g}{f' {unit}' if unit else ''} (+-{error:.2g})"
        for name, value, error, _, unit in result.estimate.rows()
    )
    missed = np.concatenate([residual["measured"] for residual in result.residuals])
    spread = math.sqrt(np.mean(np.concatenate([record.measured - np.mean(record.measured) for record in records]) ** 2))
    seconds = sum(float(record.t[-1] - record.t[0]) for record in records)
    held_out = "".join(
        f"; {1e3 * score.rmse['measured']:.3g} m{fitted.unit} on {score.record.name}, where nothing but the start is"
        f" fitted, to its first {score.opening} samples"
        for score in fitted.scores
    )
    return (
        f"{fitted.model.capitalize()}: {numbers}.",
        f"Driven by the force alone for {seconds:.3g} s it misses the measured {fitted.quantity} by"
        f" {1e3 * math.sqrt(np.mean(missed**2)):.3g} m{fitted.unit}, {100 * np.std(missed) / spread:.2g} % of its"
        f" scatter{held_out}.",
        _first_doubt(fitted),
        *_new_record(fitted),
    )


def _new_record(fitted: Fitted) -> tuple[str, ...]:
    """What to expect of a record of the same motion, and whether bands held of the records that were held out."""
    miss = fitted.expected
    if miss is None:
        return ()
    held = "".join(
        f" Of {each.score.record.name} {100 * each.shares['measured']:.0f} % of the samples lie within the band for"
        f" {100 * each.level:g} %."
        for each in fitted.predictions
    )
    cannot = "One record cannot tell what changes from day to day. " if miss.records == 1 else ""
    return (
        f"{cannot}On a new record of this motion expect to miss by {1e3 * miss.unchanged:.3g} m{fitted.unit} if nothing"
        f" has changed ({1e3 * miss.model:.3g} from the model, {1e3 * miss.parameters:.3g} from unsure parameters), and"
        f" by {1e3 * miss.total:.3g} m{fitted.unit} with {miss.assumption}.{held}",
    )


def _first_doubt(fitted: Fitted) -> str:
    doubts = (*fitted.plan.notes, *differences(fitted), *start_remarks(fitted), *remarks(fitted.result))
    return f"Before you rely on it: {doubts[0]}" if doubts else "Nothing in the records speaks against it."


def differences(fitted: Fitted) -> tuple[str, ...]:
    """Parameters in which the records differ."""
    return () if fitted.agreement is None else fitted.agreement.sentences


def start_remarks(fitted: Fitted) -> tuple[str, ...]:
    """What the starts of records that were held out say of the model."""
    return tuple(remark for score in fitted.scores for remark in score.remarks)


def parameter_table(result: FitResult) -> pd.DataFrame:
    """Parameters with standard errors, 95 % intervals, start values and units."""
    intervals = result.estimate.intervals()
    rows = [
        (name, value, error, *intervals[name], start, unit)
        for name, value, error, start, unit in result.estimate.rows()
    ]
    columns = ["parameter", "value", "standard error", "95 % from", "to", "start", "unit"]
    return pd.DataFrame(rows, columns=pd.Index(columns))


def record_table(fitted: Fitted) -> pd.DataFrame:
    """Records, fitted and held out, with the root mean square of what the model misses."""
    rows = []
    for record, residuals in zip(fitted.result.provenance.records, fitted.result.residuals, strict=True):
        rows.append((record, "fitted", math.sqrt(float(np.mean(residuals["measured"] ** 2))), math.nan))
    for score in fitted.scores:
        start = math.nan if score.start_fitted is None else score.start_fitted.rmse["measured"]
        rows.append((score.record, "held out", score.rmse["measured"], start))
    return pd.DataFrame(
        {
            "record": [record.name for record, *_ in rows],
            "use": [use for _, use, *_ in rows],
            "samples": [len(record.t) for record, *_ in rows],
            "from [s]": [float(record.t[0]) for record, *_ in rows],
            "to [s]": [float(record.t[-1]) for record, *_ in rows],
            f"RMSE [m{fitted.unit}]": [1e3 * rmse for _, _, rmse, _ in rows],
            "of its spread [%]": [100 * rmse / float(np.std(record.measured) or np.nan) for record, _, rmse, _ in rows],
            f"start fitted, RMSE [m{fitted.unit}]": [1e3 * start for *_, start in rows],
        }
    )


def agreement_table(agreement: RecordAgreement) -> pd.DataFrame:
    """What is common to several records and what varies, by how much."""
    columns = ["parameter", "common", "standard error", "between records", "95 % from", "to", "p of no difference"]
    return pd.DataFrame(agreement.rows(), columns=pd.Index(columns))


def model_table(comparison: Comparison, unit: str) -> pd.DataFrame:
    """Compared models, best first; `unit` is that of the position."""
    return pd.DataFrame(
        {
            "model": [each.name for each in comparison.ranked],
            "parameters": [each.parameters for each in comparison.ranked],
            f"held back, RMSE [m{unit}]": [1e3 * each.held_back for each in comparison.ranked],
            f"standard error [m{unit}]": [1e3 * each.standard_error for each in comparison.ranked],
            f"new record, RMSE to expect [m{unit}]": [1e3 * each.expected for each in comparison.ranked],
            f"over the best [m{unit}]": [1e3 * each.over_the_best for each in comparison.ranked],
            f"its standard error [m{unit}]": [1e3 * each.over_the_best_standard_error for each in comparison.ranked],
            f"start fitted, RMSE [m{unit}]": [
                math.nan if each.start_fitted is None else 1e3 * each.start_fitted for each in comparison.ranked
            ],
            f"fitted, RMSE [m{unit}]": [1e3 * each.fitted for each in comparison.ranked],
            "not determined": [", ".join(each.undetermined) or "-" for each in comparison.ranked],
        }
    )


def design_table(findings: Findings, design: InputDesign) -> pd.DataFrame:
    """What the designed input promises."""
    units = findings.fitted.result.estimate.units
    rows = [(name, value, error, plain, units[name]) for name, value, error, plain, _ in design.rows()]
    columns = ["parameter", "value", "predicted standard error", "of a plain sine", "unit"]
    return pd.DataFrame(rows, columns=pd.Index(columns))


def sample_table(fitted: Fitted) -> pd.DataFrame:
    """All samples of all records, measured and simulated."""
    provenance = fitted.result.provenance
    outputs = [(record, seen["measured"]) for record, seen in zip(provenance.records, provenance.outputs, strict=True)]
    outputs += [(score.record, score.outputs["measured"]) for score in fitted.scores]
    held_out = {score.record.name for score in fitted.scores}
    return pd.concat(
        pd.DataFrame(
            {
                "record": record.name,
                "use": "held out" if record.name in held_out else "fitted",
                "t [s]": record.t,
                f"force [{axis_unit('N', fitted.plan.rotary)}]": record.inputs["u"],
                f"measured [{fitted.unit}]": record.measured,
                f"simulated [{fitted.unit}]": simulated,
            }
        )
        for record, simulated in outputs
    )


def summary(findings: Findings) -> dict[str, object]:
    """All but the samples, of types that JSON knows."""
    fitted, agreed = findings.fitted, findings.fitted.agreement
    return {
        "headline": list(headline(fitted)),
        "read": list(fitted.plan.notes),
        "model": fitted.model,
        "description": fitted.description,
        "equations": list(equations(fitted.scene)),
        **fitted.result.to_dict(),
        "held": fitted.held,
        "held_out": {score.record.name: score.rmse for score in fitted.scores},
        "held_out_start_fitted": {
            score.record.name: None if score.start_fitted is None else score.start_fitted.rmse
            for score in fitted.scores
        },
        "expected": None if fitted.expected is None else fitted.expected.total,
        "expected_if_unchanged": None if fitted.expected is None else fitted.expected.unchanged,
        "held_out_within_band": {each.score.record.name: each.shares for each in fitted.predictions},
        "agreement": None if agreed is None else jsonable(agreement_table(agreed).to_dict("records")),
        "differing": None if agreed is None else list(agreed.differing),
        "comparison": None if fitted.comparison is None else fitted.comparison.to_dict(),
        "substeps": fitted.substeps,
        "seconds": fitted.seconds,
        **findings.origin,
    }
