"""Models compared."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from ..identify import Comparison
from ._figure import Figure
from ._style import BLUE, GREEN, GREY, small_unit


def comparison_figure(comparison: Comparison, *, unit: str = "m", caption: str = "") -> Figure:
    """Models by their error on what was held back, beside the error of the fit to everything.

    **Arguments:**

    - `comparison`: from `compare` or `compare_laws`.
    - `unit`: of the errors; "1" where several channels were compared, in noise levels.
    - `caption`: a line for the source of the records.

    **Raises:**

    - `ValueError` if no model could be fitted.
    """
    ranked, simplest, (factor, small) = comparison.ranked, comparison.simplest, small_unit(unit)
    figure = Figure(figsize=(9, 1.9 + 0.62 * len(ranked)), layout="constrained")
    axis: Axes = figure.subplots()
    for i, each in enumerate(ranked):
        height, colour = np.full(len(each.parts), i - 0.17), GREEN if each.name == simplest else BLUE
        axis.barh(i - 0.17, factor * each.held_back, 0.4, color=colour, alpha=0.75)
        (parts,) = axis.plot(factor * each.parts, height, "o", color="white", mec="black", ms=4)
        bar = axis.errorbar(
            factor * each.held_back, i - 0.17, xerr=factor * each.standard_error, color="black", capsize=4, lw=1.2
        )
        axis.barh(i + 0.2, factor * each.fitted, 0.24, color=GREY)
        parts.set_label("" if i else "each part that was held back")
        bar.set_label("" if i else "standard error")
    doubts = [", some not determined" if each.undetermined else "" for each in ranked]
    names = [f"{x.name}\n{x.parameters} parameters{doubt}" for x, doubt in zip(ranked, doubts, strict=True)]
    axis.set_yticks(range(len(ranked)), names, fontsize=9)
    axis.invert_yaxis()
    errors = np.concatenate([[each.held_back, each.fitted] for each in ranked])
    if errors.max() > 20 * errors.min() > 0:
        axis.set_xscale("log")
        axis.set_xlim(left=0.5 * factor * errors.min())
    below = f"\n{caption}" if caption else ""
    axis.set(xlabel=f"root mean square error [{small}]{below}", title=f"Error on what was held back: {comparison.by}")
    axis.grid(axis="x", alpha=0.3)
    bars = {"held back": BLUE, "held back, simplest that suffices": GREEN, "fitted to everything": GREY}
    patches = [Patch(color=colour, label=label) for label, colour in bars.items()]
    figure.legend(handles=[*patches, *axis.get_legend_handles_labels()[0]], loc="outside lower center", ncols=3)
    return figure
