"""Indices of a global sensitivity analysis."""

import numpy as np

from ..sweeps import GlobalSensitivity
from ._figure import Figure
from ._style import BLUE, GREY, with_unit

_AXES = {
    "S1": "share of the variance [1]; pale: with all interactions",
    "mu_star": "mean magnitude of the change over the whole range of the parameter",
}


def indices_figure(sensitivity: GlobalSensitivity, *, caption: str = "") -> Figure:
    """Indices as bars with their confidence intervals, a panel for each observable.

    **Arguments:**

    - `sensitivity`: from `jaxmodsim.sweeps.global_sensitivity`.
    - `caption`: a line below.
    """
    index, names = "S1" if sensitivity.method == "sobol" else "mu_star", sensitivity.names
    panels, at = sensitivity.indices, np.arange(len(names))
    figure = Figure(figsize=(9, 1.2 + len(panels) * (0.6 + 0.24 * len(names))), layout="constrained")
    for axis, (name, indices) in zip(figure.subplots(len(panels), 1, squeeze=False).flat, panels.items(), strict=True):
        values, errors = indices.values, indices.errors
        if "ST" in values:
            axis.barh(at, values["ST"], 0.72, color=BLUE, alpha=0.3)
            axis.errorbar(values["ST"], at, xerr=errors["ST"], fmt="none", ecolor=GREY, lw=0.8)
        axis.barh(at, values[index], 0.72, color=BLUE)
        axis.errorbar(values[index], at, xerr=errors[index], fmt="none", ecolor="black", capsize=2, lw=1.0)
        for y in at[np.isnan(values[index])]:
            axis.text(0.0, y, " too few runs", va="center", fontsize=7, color=BLUE)
        axis.set_yticks(at, names, fontsize=9)
        axis.set_ylim(len(names) - 0.5, -0.5)
        axis.axvline(0.0, color=GREY, lw=0.6)
        axis.grid(axis="x", alpha=0.3)
        axis.set_title(name, loc="left", fontsize=10)
        label = _AXES[index] if index == "S1" else with_unit(_AXES[index], sensitivity.units.get(name, ""))
        axis.set_xlabel(label, fontsize=8)
    method = "Sobol' indices" if sensitivity.method == "sobol" else "Elementary effects"
    below = f"\n{caption}" if caption else ""
    interval = f"{100 * sensitivity.confidence:.0f} % intervals"
    figure.suptitle(f"{method} from {sensitivity.runs['result'].size} runs, {interval}{below}", fontsize=11)
    return figure
