"""What a record cannot tell, in words."""

from typing import TYPE_CHECKING

import numpy as np

from ._solve import ENDINGS

if TYPE_CHECKING:
    from ._result import FitResult


def remarks_of(result: "FitResult") -> tuple[str, ...]:
    """Sentences on what is not determined, and on what spoils the figures."""
    remarks = []
    names, correlation = list(result.values), result.correlation
    for name, value in result.values.items():
        share = result.errors[name] / abs(value) if value else np.inf
        if not np.isfinite(result.errors[name]):
            remarks.append(f"{name} has no effect on this record.")
        elif value in result.bounds[name]:
            remarks.append(f"{name} ended on its limit {value:g}.")
        elif share > 0.5 and np.isfinite(share):
            remarks.append(
                f"{name} is not determined by this record: its standard error is {100 * share:.0f} % of its value."
            )
    for i, first in enumerate(names):
        for j in range(i):
            if abs(correlation[i, j]) > 0.98:
                remarks.append(f"{names[j]} and {first} are hardly told apart (correlation {correlation[i, j]:+.3f}).")
    if result.ending not in ENDINGS.values():
        remarks.append(f"The search {result.ending}: do not trust the standard errors.")
    if result.step_error is not None and len(result.rmse_by) == 1 and result.step_error > 0.1 * result.rmse:
        remarks.append(
            f"The integration step shows: with four times as many the output moves by {result.step_error:.2g} (root"
            f" mean square) against an RMSE of {result.rmse:.2g}. Raise substeps."
        )
    if result.single_precision:
        remarks.append("Computed in single precision: enable jax_enable_x64 for numbers that you mean to use.")
    return tuple(remarks)
