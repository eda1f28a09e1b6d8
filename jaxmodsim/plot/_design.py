"""A designed input."""

import numpy as np
from matplotlib.axes import Axes

from ..identify import InputDesign
from ._figure import Figure
from ._style import BLUE, GREY, RED, panel_letters, small_unit


def design_figure(design: InputDesign, *, caption: str = "") -> Figure:
    """A designed input with its limits, and the errors it promises beside those of a plain sine.

    **Arguments:**

    - `design`: from `jaxmodsim.identify.design_input`.
    - `caption`: a line below.
    """
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1.35, 1))[0]
    axes = left.subplots(3, 1, sharex=True)
    limits, best, sine = design.limits, design.best, design.baseline
    quantity, unit, force = ("angle", "rad", "N m") if limits.rotary else ("position", "m", "N")
    factor, small = small_unit(unit)
    panels = (
        (quantity, small, factor, best.q_ref, sine.q_ref, limits.travel, best.q_ref[0]),
        ("velocity", f"{unit}/s", 1.0, best.qd_ref, sine.qd_ref, limits.speed, 0.0),
        ("torque" if limits.rotary else "force", force, 1.0, best.force, sine.force, limits.force, 0.0),
    )
    for axis, (quantity, unit, scale, designed, baseline, limit, middle) in zip(axes, panels, strict=True):
        axis.plot(best.t, scale * baseline, color="#c8c8c8", lw=1.2, label="plain sine")
        axis.plot(best.t, scale * designed, color=BLUE, lw=1.3, label="designed")
        for side in (-1.0, 1.0) if limit is not None else ():
            level = scale * (middle + side * (limit or 0.0))
            axis.axhline(level, color=RED, lw=1.0, ls="--", label="limit" if side > 0 else "_")
        axis.set(ylabel=f"{quantity} [{unit}]")
    axes[-1].set_xlabel("time [s]")
    panel_letters(axes)
    handles = {str(line.get_label()): line for axis in axes for line in axis.get_lines()}
    shown = {label: line for label, line in handles.items() if not label.startswith("_")}
    left.legend(list(shown.values()), list(shown), loc="outside upper center", ncols=3, fontsize=9)
    _error_bars(right.subplots(), design)
    if caption:
        figure.supxlabel(caption, fontsize=8, color=GREY)
    return figure


def _error_bars(axis: Axes, design: InputDesign) -> None:
    """Predicted relative errors, designed against plain; a number that is zero has none and is left out."""
    names = [name for name, value in design.values.items() if value]
    pairs = (("plain sine", "#c8c8c8", design.baseline.errors, 0.2), ("designed", BLUE, design.best.errors, -0.2))
    finite = [
        100 * errors[name] / abs(design.values[name])
        for _, _, errors, _ in pairs
        for name in names
        if np.isfinite(errors[name])
    ]
    low, high = 0.3 * min(finite, default=1.0), 8.0 * max(finite, default=1.0)
    for label, colour, errors, offset in pairs:
        shares = [100 * errors[name] / abs(design.values[name]) for name in names]
        places = np.arange(len(names)) - offset
        axis.barh(places, np.minimum(shares, high), height=0.38, color=colour, label=label)
        for place, share in zip(places, shares, strict=True):
            text = f" {share:.2g} %" if np.isfinite(share) else " nothing learned"
            axis.text(min(share, 0.25 * high), place, text, va="center", fontsize=8)
    axis.set_xscale("log")
    axis.set_yticks(range(len(names)), names)
    axis.set(xlim=(low, high), xlabel="predicted standard error [% of the value]")
    axis.set_title(f"{design.best.t[-1] - design.best.t[0]:g} s, noise {design.noise:g}", fontsize=10)
    axis.invert_yaxis()
