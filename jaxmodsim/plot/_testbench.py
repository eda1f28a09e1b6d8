"""Figures of the test bench."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.colors import LogNorm

from ..problems.testbench import RampRun
from ._style import BLUE, COLOURS, GREY, RED, Figure, panel_letters


def ramp_figure(title: str, runs: Sequence[RampRun], zoom: tuple[float, float] = (0.0, 3.0)) -> Figure:
    """Plot velocity, velocity near zero, and applied and friction force against time, one row for each run.

    **Arguments:**

    - `title`: of the figure.
    - `runs`: one row each.
    - `zoom`: time span [s] of the second and third column, which contains the stick phase.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.
    """
    figure = Figure(figsize=(14, 0.6 + 2.7 * len(runs)), layout="constrained")
    axes = figure.subplots(len(runs), 3, squeeze=False, width_ratios=(1, 1, 1.2))
    for (left, middle, right), run in zip(axes, runs, strict=True):
        for axis in (left, middle):
            axis.plot(run.t, run.velocity, color=BLUE, lw=1.2)
            axis.axhline(0.0, color=GREY, lw=0.6)
            axis.set(ylabel="velocity [m/s]")
        early = run.velocity[run.applied <= 1.4]
        reach = max(2.0 * float(np.max(np.abs(early), initial=0.0)), 2e-3)
        middle.set(xlim=zoom, ylim=(-reach, reach), title="near zero")
        left.set(title=run.label, xlim=(0.0, 10.0))
        right.plot(run.t, run.applied, color=GREY, lw=1.4, ls="--", label="applied force")
        right.plot(run.t, run.friction, color=RED, lw=1.0, label="friction force")
        inside = (run.t >= zoom[0]) & (run.t <= zoom[1])
        peak = max(float(np.max(np.abs(run.friction[inside]), initial=0.0)), 1.0)
        below = float(np.min(run.friction[inside], initial=0.0)) < -0.1 * peak
        right.set(ylabel="force [N]", xlim=zoom, ylim=(-1.4 * peak if below else -0.05 * peak, 1.6 * peak))
        if run.note:
            left.text(0.5, 0.6, run.note, transform=left.transAxes, ha="center", fontsize=9, color=RED)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    panel_letters(axes.flat)
    figure.legend(*axes[0, 2].get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False)
    figure.suptitle(title)
    return figure


def stick_figure(
    t: np.ndarray,
    friction: Mapping[str, np.ndarray],
    applied: np.ndarray,
    sigma0: np.ndarray,
    sigma1: np.ndarray,
    oscillation: np.ndarray,
) -> Figure:
    """Plot the oscillation of LuGre friction in stick: against time, and its amplitude over sigma0 and sigma1.

    **Arguments:**

    - `t`: times [s], shape `[time]`.
    - `friction`: friction force [N] by label, shape `[time]`.
    - `applied`: applied force [N], shape `[time]`.
    - `sigma0`, `sigma1`: axes of the map [N/m], [N s/m].
    - `oscillation`: amplitude [N] of friction about the applied force in stick, shape `[sigma0, sigma1]`.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.
    """
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1))
    inside = t <= 1.5
    left.set_prop_cycle(color=COLOURS, linestyle=("-", "--", "-.", ":", (0, (6, 1))))
    for label, force in friction.items():
        left.plot(t[inside], 1e3 * (force - applied)[inside], lw=1.2, label=label)
    left.set(xlabel="time [s]", ylabel="friction - applied force [mN]", title="Stick: friction about the applied force")
    left.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, frameon=False)
    mesh = right.pcolormesh(
        np.arange(len(sigma1) + 1),
        np.arange(len(sigma0) + 1),
        1e3 * np.maximum(oscillation, 1e-9),
        norm=LogNorm(),
        cmap="viridis",
    )
    for i in range(len(sigma0)):
        for j in range(len(sigma1)):
            value = 1e3 * oscillation[i, j]
            shade = "black" if oscillation[i, j] > 0.3 * oscillation.max() else "white"
            right.text(j + 0.5, i + 0.5, f"{value:.2g}", ha="center", va="center", color=shade, fontsize=9)
    right.set_xticks(np.arange(len(sigma1)) + 0.5, [f"{x:g}" for x in sigma1])
    right.set_yticks(np.arange(len(sigma0)) + 0.5, [f"{x:g}" for x in sigma0])
    right.set(xlabel="sigma1 [N s/m]", ylabel="sigma0 [N/m]", title="Amplitude of the oscillation in stick [mN]")
    figure.colorbar(mesh, ax=right, label="amplitude [mN]")
    panel_letters((left, right))
    return figure
