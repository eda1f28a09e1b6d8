"""What `jaxmodsim fit` found, as tables."""

import math
import shlex
import sys
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib import metadata

import numpy as np
import pandas as pd

from ..identify import Comparison, FitResult, InputDesign, Profile, Score
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
    - `scores`: on the records that were held out.
    - `seconds`: that all took.
    """

    plan: Plan
    model: str
    result: FitResult
    comparison: Comparison | None
    scores: tuple[Score, ...]
    seconds: float

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


def with_units(result: FitResult) -> FitResult:
    """The result with the units of what declares none."""
    units = {name: unit or _UNITS.get(name.rpartition("/")[2], "") for name, unit in result.estimate.units.items()}
    return replace(result, estimate=replace(result.estimate, units=units))


def origin() -> dict[str, str]:
    """Command, date and versions."""
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("jaxmodsim", "jax", "diffrax", "numpy"))
    return {
        "command": shlex.join(["jaxmodsim", *sys.argv[1:]]),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "versions": f"{versions}, Python {sys.version.split()[0]}",
    }


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
        rows.append((record, "fitted", residuals["measured"]))
    for score in fitted.scores:
        rows.append((score.record, "held out", score.residuals["measured"]))
    return pd.DataFrame(
        {
            "record": [record.name for record, _, _ in rows],
            "use": [use for _, use, _ in rows],
            "samples": [len(record.t) for record, _, _ in rows],
            "from [s]": [float(record.t[0]) for record, _, _ in rows],
            "to [s]": [float(record.t[-1]) for record, _, _ in rows],
            "RMSE [mm]": [1e3 * math.sqrt(float(np.mean(residual**2))) for _, _, residual in rows],
            "of its spread [%]": [
                100 * float(np.std(residual) / (np.std(record.measured) or np.nan)) for record, _, residual in rows
            ],
        }
    )


def model_table(comparison: Comparison) -> pd.DataFrame:
    """Compared models, best first."""
    return pd.DataFrame(
        {
            "model": [each.name for each in comparison.ranked],
            "parameters": [each.parameters for each in comparison.ranked],
            "held back, RMSE [mm]": [1e3 * each.held_back for each in comparison.ranked],
            "standard error [mm]": [1e3 * each.error for each in comparison.ranked],
            "over the best [mm]": [1e3 * each.over for each in comparison.ranked],
            "its standard error [mm]": [1e3 * each.over_error for each in comparison.ranked],
            "fitted, RMSE [mm]": [1e3 * each.fitted for each in comparison.ranked],
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
                "force [N]": record.inputs["u"],
                "measured [m]": record.measured,
                "simulated [m]": simulated,
            }
        )
        for record, simulated in outputs
    )


def summary(findings: Findings) -> dict[str, object]:
    """All but the samples, of types that JSON knows."""
    fitted = findings.fitted
    return {
        "model": fitted.model,
        "description": fitted.description,
        "equations": list(equations(fitted.scene)),
        **fitted.result.to_dict(),
        "held": fitted.held,
        "held_out": {score.record.name: score.rmse for score in fitted.scores},
        "comparison": None if fitted.comparison is None else fitted.comparison.to_dict(),
        "seconds": fitted.seconds,
        **findings.origin,
    }
