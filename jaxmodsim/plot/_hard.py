"""Hard cases: errors in what is admissible, and the largest stable steps."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from ..validation.hard import CaseReport, largest_steps
from ._figure import Figure
from ._style import BLUE, COLOURS, GREEN, GREY, RED

_KINDS = {
    "value, float64": ("float64", ("alone", "jit", "vmap"), BLUE, "o"),
    "derivative, float64": ("float64", ("forward", "reverse"), GREEN, "s"),
    "energy balance": ("float64", ("energy",), COLOURS[3], "D"),
    "value or derivative, float32": ("float32", ("alone", "jit", "vmap", "forward", "reverse"), GREY, "v"),
}
# What is exact is drawn at the edge.
_LEAST = 1e-12


def hard_figure(verdicts: Sequence[CaseReport]) -> Figure:
    """Errors of hard cases in what is admissible, so that 1 is the limit; cases without a number have none.

    **Arguments:**

    - `verdicts`: of `jaxmodsim.validation.hard.check`.
    """
    figure = Figure(figsize=(8.5, 1.4 + 0.19 * len(verdicts)), layout="constrained")
    axis = figure.subplots()
    rows = np.arange(len(verdicts))
    for label, (dtype, transforms, colour, marker) in _KINDS.items():
        errors = np.array([verdict.worst(dtype, transforms) for verdict in verdicts])
        axis.plot(np.maximum(errors, _LEAST), rows, marker, color=colour, ms=5, label=label, alpha=0.85)
    for row, verdict in zip(rows, verdicts, strict=True):
        if not verdict.ok:
            axis.axhspan(row - 0.5, row + 0.5, color=RED, alpha=0.2, lw=0)
        elif all(math.isnan(each.error) for each in verdict.findings):
            axis.text(_LEAST, float(row), " says why there is no answer", va="center", fontsize=9, color=GREY)
    axis.axvline(1.0, color=RED, lw=1.2)
    axis.set(xscale="log", xlabel="error over what is admissible [1]", yticks=rows, xlim=(0.5 * _LEAST, 10.0))
    axis.set_yticklabels([verdict.case.name for verdict in verdicts], fontsize=9)
    axis.set_ylim(len(verdicts) - 0.4, -0.6)
    axis.grid(axis="x", color="#e4e4e4", lw=0.6)
    _families(axis, verdicts)
    passed = sum(verdict.ok for verdict in verdicts)
    figure.suptitle(f"Hard cases: {passed} of {len(verdicts)} pass (line: the limit)", fontsize=12)
    figure.legend(loc="outside lower center", ncols=2, fontsize=10, frameon=False)
    return figure


def _families(axis: Axes, verdicts: Sequence[CaseReport]) -> None:
    """Lines between families, and their names at the right."""
    names = [verdict.case.family for verdict in verdicts]
    for row, name in enumerate(names):
        if row == 0 or names[row - 1] != name:
            axis.axhline(row - 0.5, color="black", lw=0.6)
            axis.text(
                1.01, row - 0.4, name, transform=axis.get_yaxis_transform(), va="top", fontsize=10, fontweight="bold"
            )


def step_limits_figure() -> Figure:
    """Largest stable fixed steps, found by running, over those of theory; runs the cases."""
    figure = Figure(figsize=(7.5, 4.2), layout="constrained")
    axis = figure.subplots()
    limits = largest_steps()
    for colour, marker, (name, here) in zip(COLOURS, "osDv", limits.items(), strict=False):
        axis.plot(*zip(*here.values(), strict=True), marker, color=colour, label=name, ms=7, alpha=0.8)
    predicted = [x for here in limits.values() for x, _ in here.values()]
    span = [0.5 * min(predicted), 2.0 * max(predicted)]
    axis.plot(span, span, color="#c8c8c8", lw=3, zorder=0, label="equal")
    axis.set(xscale="log", yscale="log", xlabel="largest stable step by theory [s]", ylabel="found by bisection [s]")
    axis.set_title(f"Stability of fixed explicit steps: {', '.join(next(iter(limits.values())))}", fontsize=10)
    axis.legend(fontsize=9, frameon=False)
    return figure
