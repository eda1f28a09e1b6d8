"""Work-precision diagrams."""

from itertools import product

import numpy as np
from matplotlib.axes import Axes

from ..analysis import WorkPrecision
from ._style import COLOURS, GREY, RED, Figure, panel_letters, plain_ticks

_MARKERS = "osD^vPX*"
_LABELS = {
    "run": "time of one run [ms]",
    "vmap": "time of one run in a vmap of {batch} [ms]",
    "forward": "time of the gradient, forward [ms]",
    "reverse": "time of the gradient, reverse [ms]",
}


def work_precision_figure(study: WorkPrecision, *, cost: str = "run") -> Figure:
    """Plot time and evaluations of the vector field over the error: lower left is better.

    Error bars are quartiles. If the evaluations of an iterative method are unknown, steps replace them. In the grey
    band the references disagree. Dotted lines are modelling errors, which no tolerance removes. Failures are listed
    below the panels, with the reason.

    **Arguments:**

    - `study`: from `jaxmodsim.work_precision`.
    - `cost`: one of its `costs`.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.

    **Raises:**

    - `ValueError` for a cost that the study has not measured.
    """
    if cost not in study.costs:
        raise ValueError(f"cost must be one that the study has measured ({', '.join(study.costs)}), but is {cost!r}.")
    lines = [f"failed: {row.method}, {row.setting}: {row.failed}" for row in study.rows if row.failed]
    # Shortened to the width of the figure.
    failures = [line if len(line) <= 170 else f"{line[:167]}..." for line in lines]
    height = 4.4 + 0.2 * len(failures)
    figure = Figure(figsize=(11.5, height), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True)
    counted = all(row.evaluations is not None for row in study.rows if not row.failed)
    methods, handles = dict.fromkeys(row.method for row in study.rows), []
    for i, method in enumerate(methods):
        tried = [row for row in study.rows if row.method == method]
        rows = [row for row in tried if row.error is not None]
        label = method if len(rows) == len(tried) else f"{method} ({len(tried) - len(rows)} of {len(tried)} failed)"
        if not rows:
            handles += left.plot([], [], color=RED, marker="x", ls="", label=label)
            continue
        style = {"color": COLOURS[i % len(COLOURS)], "marker": _MARKERS[i % len(_MARKERS)], "ms": 6.0, "lw": 1.4}
        # Smaller errors than the disagreement of the references, or the rounding unit, are not resolved.
        errors = [max(row.error or 0.0, study.disagreement, float(np.finfo(float).eps)) for row in rows]
        timings = [row.times[cost] for row in rows if row.times is not None]
        median = 1e3 * np.array([x.median for x in timings])
        bars = 1e3 * np.array([[x.median - x.low for x in timings], [x.high - x.median for x in timings]])
        bars = np.maximum(bars, 0.0)
        handles.append(left.errorbar(errors, median, yerr=bars, capsize=2.0, elinewidth=0.8, **style, label=label))
        right.plot(errors, [row.evaluations if counted else row.steps for row in rows], **style)
        for model, axes in product({row.model for row in rows if row.model}, (left, right)):
            axes.axvline(model, color=style["color"], ls=":", lw=1.0)
    scale = f"{study.scale:.3g} {study.unit}".rstrip()
    for axes in (left, right):
        axes.set(xscale="log", yscale="log", xlabel=f"error of {study.observable}, relative to {scale} [1]")
        axes.grid(which="major", alpha=0.3)
        _mark_floor(axes, study.disagreement)
    left.set(ylabel=_LABELS[cost].format(batch=study.batch), title="Time: lower left is better")
    right.set(ylabel="evaluations of the vector field [1]" if counted else "steps [1]", title="Work")
    plain_ticks(left.yaxis, right.yaxis)
    panel_letters((left, right))
    if any(row.model for row in study.rows):
        handles += left.plot([], [], color=GREY, ls=":", label="modelling error")
    figure.legend(handles=handles, fontsize=9, frameon=False, loc="outside right upper")
    figure.suptitle(f"{study.problem}: {study.observable} {study.when}", fontsize=11)
    if failures:
        figure.supxlabel("\n".join(failures), fontsize=7, color=RED, x=0.01, ha="left")
    return figure


def _mark_floor(axes: Axes, floor: float) -> None:
    low, high = axes.get_xlim()
    if floor > low:
        axes.axvspan(low, floor, color=GREY, alpha=0.15, lw=0)
        axes.text(
            floor,
            0.98,
            " references\n disagree",
            transform=axes.get_xaxis_transform(),
            fontsize=7,
            color=GREY,
            va="top",
        )
        axes.set_xlim(low, high)
