"""What parameters do to the outcome of runs over whole ranges of them."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from .._core.system import extra
from ._estimates import Estimate

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


@dataclass(frozen=True)
class GlobalSensitivity:
    """Indices of each observable by each parameter, over all runs and within each class of motion.

    Printed as a table with intervals; drawn by `jaxmodsim.plot.indices_figure`.

    - `method`: "sobol" or "morris"; `names`: of the parameters; `confidence`: of the intervals.
    - `overall`: indices over all runs, by observable.
    - `shares`: part of the runs in each class of motion, largest first; empty where runs were not classed.
    - `membership`: indices of being in a class (1) or not (0), by class: which parameters decide the motion. Of two
      classes both have the same, and only the larger is here.
    - `within`: indices within each class, by class and observable. Classes with less than 5 % of the runs have none.
    - `crossings`: share of the steps of each parameter that lead into another class, shape `[parameters]`; None where
      the method takes no steps, or there are no two classes.
    - `units`: of the observables that have one.
    - `failed`: number of runs that failed. `dropped`: number of runs that were left out for them.
    - `runs`: all runs, from `sweep`.
    - `remarks`: what else is to be said.
    """

    method: str
    names: tuple[str, ...]
    confidence: float
    overall: dict[str, Estimate]
    shares: dict[str, float]
    membership: dict[str, Estimate]
    within: dict[str, dict[str, Estimate]]
    crossings: Float[np.ndarray, " parameters"] | None
    units: dict[str, str]
    failed: int
    dropped: int
    runs: "xr.Dataset"
    remarks: tuple[str, ...]

    def groups(self) -> dict[tuple[str, str], Estimate]:
        """All indices by observable and runs, in the order of the table; of membership the observable is "motion"."""
        groups = {(name, "all runs"): estimate for name, estimate in self.overall.items()}
        groups |= {("motion", f"is {kind!r}"): estimate for kind, estimate in self.membership.items()}
        for kind, each in self.within.items():
            groups |= {(name, f"within {kind!r}"): estimate for name, estimate in each.items()}
        return groups

    def table(self) -> "pd.DataFrame":
        """A row for each observable, group of runs and parameter; half widths of intervals in columns `_conf`."""
        rows = []
        for (name, runs), estimate in self.groups().items():
            for j, parameter in enumerate(self.names):
                row: dict[str, object] = {"observable": name, "runs": runs, "parameter": parameter}
                for index, values in estimate.indices.items():
                    row[index] = float(values[j])
                    if index in estimate.errors:
                        row[f"{index}_conf"] = float(estimate.errors[index][j])
                rows.append(row | {"samples": int(estimate.samples[j])})
        return extra("pandas").DataFrame(rows)

    def __str__(self) -> str:
        """Tables of all groups, the classes, and the remarks."""
        words = {"sobol": "Sobol' indices", "morris": "elementary effects (Morris)"}
        total = self.runs["result"].size
        lines = [f"{words[self.method]} of {len(self.names)} parameters from {total} runs, {self.failed} failed"]
        if self.shares:
            lines.append("motion: " + ", ".join(f"{kind} {100 * share:.0f} %" for kind, share in self.shares.items()))
        width = max(map(len, self.names))
        for (name, runs), estimate in self.groups().items():
            lines += ["", *self._block(name, runs, estimate, width)]
        if self.crossings is not None:
            steps = (f"{name} {100 * x:.0f} %" for name, x in zip(self.names, self.crossings, strict=True))
            lines += ["", "steps into another class: " + ", ".join(steps)]
        return "\n".join([*lines, *(f"- {remark}" for remark in self.remarks)])

    def _block(self, name: str, runs: str, estimate: Estimate, width: int) -> list[str]:
        unit = self.units.get(name, "")
        unit = f" [{unit}]" if unit and "mu_star" in estimate.indices else ""
        samples = "effects each" if self.method == "morris" else "runs"
        low, high = int(estimate.samples.min()), int(estimate.samples.max())
        count = f"{low}" if low == high else f"{low} to {high}"
        lines = [f"{name}{unit}, {runs} ({count} {samples})"]
        if all(np.isnan(x).all() for x in estimate.indices.values()):
            return [f"{lines[0]}: no indices"]
        lines.append(" " * width + "".join(f"  {index:>21}" for index in estimate.indices))
        for j, parameter in enumerate(self.names):
            cells = []
            for index, values in estimate.indices.items():
                error = f" +- {estimate.errors[index][j]:8.2g}" if index in estimate.errors else ""
                cells.append(f"  {f'{values[j]:.3g}{error}':>21}")
            lines.append(f"{parameter:{width}}{''.join(cells)}")
        return lines
