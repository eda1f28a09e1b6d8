"""What parameters do to the outcome of runs over whole ranges of them."""

import numpy as np
from matplotlib.axes import Axes

from ..sweeps import Estimate, GlobalSensitivity
from ._figure import Figure
from ._style import BLUE, GREEN, GREY, RED, with_unit

# Of classes, in their order.
_CLASSES = (BLUE, RED, GREEN, "#b8860b", "#7b4fa3")
_AXES = {
    "S1": "part of the variance [1]; pale: with all interactions",
    "mu_star": "mean size of the change over the whole range of the parameter",
}


def indices_figure(sensitivity: GlobalSensitivity, *, caption: str = "") -> Figure:
    """Indices as bars with their intervals, a panel for each observable, a colour for each class of motion.

    Where there is more than one, all runs together are grey, as they mix the classes, and a first panel shows which
    parameters decide the motion.

    **Arguments:**

    - `sensitivity`: from `jaxmodsim.sweeps.global_sensitivity`.
    - `caption`: a line below.
    """
    index = "S1" if sensitivity.method == "sobol" else "mu_star"
    panels = {name: {"all runs": each} for name, each in sensitivity.overall.items()}
    for kind, each in sensitivity.within.items():
        for name, estimate in each.items():
            panels[name][kind] = estimate
    if sensitivity.membership:
        panels = {"kind of motion": dict(sensitivity.membership)} | panels
    colours: dict[str, str] = dict(zip(sensitivity.shares, _CLASSES * len(sensitivity.shares), strict=False))
    colours["all runs"] = GREY if len(sensitivity.shares) > 1 else BLUE
    rows = [len(sensitivity.names) * len(groups) for groups in panels.values()]
    figure = Figure(figsize=(9, 1.2 + sum(0.6 + 0.24 * n for n in rows)), layout="constrained")
    axes = figure.subplots(len(panels), 1, squeeze=False, height_ratios=[2.5 + n for n in rows])
    for axis, (name, groups) in zip(axes.flat, panels.items(), strict=True):
        _panel(axis, sensitivity.names, groups, index, colours)
        motion = name == "kind of motion"
        unit = "1" if index == "S1" or motion else sensitivity.units.get(name, "")
        axis.set_title(f"which parameters decide the {name}" if motion else name, loc="left", fontsize=10)
        axis.set_xlabel(_AXES[index] if index == "S1" else with_unit(_AXES[index], unit), fontsize=8)
    shown = {str(bar.get_label()): bar for axis in axes.flat for bar in axis.containers if bar.get_label()[0] != "_"}
    labels = [
        f"{kind}, {100 * sensitivity.shares[kind]:.0f} % of the runs" if kind in sensitivity.shares else kind
        for kind in shown
    ]
    figure.legend(list(shown.values()), labels, loc="outside lower center", ncols=2, fontsize=8)
    total = sensitivity.runs["result"].size
    kind = "Sobol' indices" if sensitivity.method == "sobol" else "Elementary effects"
    below = f"\n{caption}" if caption else ""
    interval = f"{100 * sensitivity.confidence:.0f} % intervals"
    figure.suptitle(f"{kind} from {total} runs, {interval}{below}", fontsize=11)
    return figure


def _panel(
    axis: Axes, names: tuple[str, ...], groups: dict[str, Estimate], index: str, colours: dict[str, str]
) -> None:
    height = 0.8 / len(groups)
    for i, (kind, estimate) in enumerate(groups.items()):
        at = np.arange(len(names)) + (i - 0.5 * (len(groups) - 1)) * height
        if "ST" in estimate.indices:
            axis.barh(at, estimate.indices["ST"], 0.9 * height, color=colours[kind], alpha=0.3)
            axis.errorbar(estimate.indices["ST"], at, xerr=estimate.errors["ST"], fmt="none", ecolor=GREY, lw=0.8)
        axis.barh(at, estimate.indices[index], 0.9 * height, color=colours[kind], label=kind)
        axis.errorbar(
            estimate.indices[index], at, xerr=estimate.errors[index], fmt="none", ecolor="black", capsize=2, lw=1.0
        )
        for y in at[np.isnan(estimate.indices[index])]:
            axis.text(0.0, y, " too few runs", va="center", fontsize=7, color=colours[kind])
    axis.set_yticks(range(len(names)), names, fontsize=9)
    axis.set_ylim(len(names) - 0.5, -0.5)
    axis.axvline(0.0, color=GREY, lw=0.6)
    axis.grid(axis="x", alpha=0.3)
