"""What a fit found, with how sure it is."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ._least_squares import Estimate
from ._record import Record


@dataclass(frozen=True)
class FitResult:
    """A fitted model.

    - `values`, `errors`, `start`: parameters, their standard errors and start values by name. The errors take the
      correlation of the residual in time into account; they hold for the model being right but for noise.
    - `units`: unit of each parameter that declares one.
    - `correlation`: of the parameters, shape `[free, free]`, in the order of `values`.
    - `model`: the scene or law with the fitted numbers.
    - `record`: what was fitted.
    - `simulated`: the model's output at the record's times, shape `[samples]`.
    - `rmse`: root mean square of `simulated - record.measured`, in the record's unit.
    - `iterations`, `ending`: how the search went and ended.
    - `step_error`: root mean square by which `simulated` moves with four times as many integration steps; None where
      there are none.
    - `single_precision`: whether it was computed in float32.
    """

    values: dict[str, float]
    errors: dict[str, float]
    start: dict[str, float]
    units: dict[str, str]
    correlation: Float[np.ndarray, "free free"]
    model: eqx.Module
    record: Record
    simulated: Float[np.ndarray, " samples"]
    rmse: float
    iterations: int
    ending: str
    step_error: float | None
    single_precision: bool

    @staticmethod
    def of(
        estimate: Estimate,
        model: eqx.Module,
        record: Record,
        units: dict[str, str],
        step_error: float | None = None,
    ) -> "FitResult":
        """From an estimate whose residual is simulated minus measured."""
        errors = np.sqrt(np.maximum(np.diag(estimate.covariance), 0.0))
        safe = np.where((errors > 0) & np.isfinite(errors), errors, 1.0)
        known = np.isfinite(estimate.covariance) & np.isfinite(np.add.outer(errors, errors))
        correlation = np.where(known, np.where(known, estimate.covariance, 0.0) / np.outer(safe, safe), 0.0)
        np.fill_diagonal(correlation, 1.0)
        return FitResult(
            dict(zip(estimate.names, estimate.values.tolist(), strict=True)),
            dict(zip(estimate.names, errors.tolist(), strict=True)),
            dict(zip(estimate.names, estimate.start.tolist(), strict=True)),
            {name: units.get(name, "") for name in estimate.names},
            correlation,
            model,
            record,
            record.measured + estimate.residual,
            float(np.sqrt(np.mean(estimate.residual**2))),
            estimate.iterations,
            estimate.ending,
            step_error,
            jnp.result_type(float) == jnp.float32,
        )

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the record can not tell, in words."""
        remarks = []
        for name, value in self.values.items():
            share = self.errors[name] / abs(value) if value else np.inf
            if not np.isfinite(share):
                remarks.append(f"{name} has no effect on this record.")
            elif share > 0.5:
                remarks.append(
                    f"{name} is not determined by this record: its standard error is {100 * share:.0f} % of its value."
                )
        names = list(self.values)
        for i, first in enumerate(names):
            for j in range(i):
                if abs(self.correlation[i, j]) > 0.98:
                    remarks.append(
                        f"{names[j]} and {first} are hardly told apart (correlation {self.correlation[i, j]:+.3f})."
                    )
        if self.ending != "converged":
            remarks.append(f"The search {self.ending}: do not trust the standard errors.")
        if self.step_error is not None and self.step_error > 0.1 * self.rmse:
            remarks.append(
                f"The integration step shows: with four times as many the output moves by {self.step_error:.2g} (root"
                f" mean square) against an RMSE of {self.rmse:.2g}. Raise substeps."
            )
        if self.single_precision:
            remarks.append("Computed in single precision: enable jax_enable_x64 for numbers that you mean to use.")
        return tuple(remarks)

    def rows(self) -> list[tuple[str, float, float, float, str]]:
        """Rows of a table: name, value, standard error, start, unit."""
        return [
            (name, value, self.errors[name], self.start[name], self.units[name]) for name, value in self.values.items()
        ]

    def to_dict(self) -> dict[str, Any]:
        """All but the samples and the model, of types that JSON knows."""
        return {
            "record": self.record.name,
            "samples": len(self.record.t),
            "rmse": self.rmse,
            "parameters": {
                name: {"value": value, "standard_error": error, "start": start, "unit": unit}
                for name, value, error, start, unit in self.rows()
            },
            "correlation": {"names": list(self.values), "matrix": self.correlation.tolist()},
            "iterations": self.iterations,
            "ending": self.ending,
            "step_error": self.step_error,
            "remarks": list(self.remarks),
        }

    def __str__(self) -> str:
        """A table of the parameters, and what the record cannot tell."""
        width = max(len(name) for name in self.values)
        lines = [f"{'':{width}}  {'value':>13}  {'std. error':>11}  unit"]
        lines += [
            f"{name:{width}}  {value:13.6g}  {error:11.2g}  {unit}" for name, value, error, _, unit in self.rows()
        ]
        return "\n".join([*lines, f"RMSE {self.rmse:.6g}, {self.iterations} iterations, {self.ending}", *self.remarks])
