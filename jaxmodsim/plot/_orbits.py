"""Figures of periodic orbits and their branches."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from ..orbits import Branch, PeriodicOrbit
from ..scene import quantity_of, scene_units
from ..simulation import Trajectory
from ._style import BLUE, COLOURS, GREY, RED, Figure, legend_beside, panel_letters, with_unit

_MARKERS = {
    "fold": "s",
    "period doubling": "^",
    "Neimark-Sacker": "D",
    "branch point": "P",
    "Hopf": "*",
    "onset of stick": "o",
    "loss of stick": "o",
    "grazing": "X",
    "order of modes": "x",
}
# Smallest range of a period axis, relative to the period: small changes are to look small.
_LEAST_RANGE = 0.05
# Powers of ten between which tick labels are plain numbers.
_PLAIN = (-3, 4)


def orbit_figure(orbit: PeriodicOrbit) -> Figure:
    """Plot a periodic orbit in the phase plane of each coordinate, coloured by mode.

    **Arguments:**

    - `orbit`: from `jaxmodsim.periodic_orbit`.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.
    """
    dof = len(orbit.q)
    figure = Figure(figsize=(4.6 * dof + 2.2, 4.2), layout="constrained")
    axes = figure.subplots(1, dof, squeeze=False)[0]
    for i, axis in enumerate(axes):
        _draw_orbit(axis, orbit, i, _known(orbit))
    legend_beside(axes[-1])
    figure.suptitle(f"Period {float(orbit.period):.6g} s, {orbit.stability}", fontsize=10)
    if dof > 1:
        panel_letters(axes)
    return figure


def branch_figure(branch: Branch[PeriodicOrbit], coordinate: int = 0, *, beside: Sequence[Branch] = ()) -> Figure:
    """Plot amplitude and, for autonomous scenes, period over the parameter, and three orbits in the phase plane.

    Solid lines are stable orbits, dashed lines unstable ones.

    **Arguments:**

    - `branch`: from `jaxmodsim.continue_orbits`.
    - `coordinate`: index of the coordinate.
    - `beside`: other branches over the same parameter, such as equilibria, whose amplitudes are drawn too.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.
    """
    orbits = branch.orbits
    autonomous = orbits[0].autonomous
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    heights = (2.2, 1.0) if autonomous else (1.0,)
    panels = figure.subplot_mosaic("ab;cb" if autonomous else "ab", height_ratios=heights, width_ratios=(1.3, 1.0))
    left, right = panels["a"], panels["b"]
    scene = orbits[0].runs[0].scene
    name, unit = quantity_of(scene, f"q[{coordinate}]")
    for each in (branch, *beside):
        _draw_branch(left, each, each.amplitude[:, coordinate])
        for point in each.points:
            amplitude = float(point.orbit.amplitude[coordinate])
            left.plot(point.value, amplitude, _MARKERS[point.kind], color=RED, ms=7, zorder=4, label=point.kind)
    parameter = with_unit(branch.parameter, scene_units(scene).get(branch.parameter, ""))
    left.set(xlabel="" if autonomous else parameter, ylabel=with_unit(f"amplitude of {name}", unit))
    left.ticklabel_format(axis="y", scilimits=_PLAIN)
    if autonomous:
        period = panels["c"]
        period.sharex(left)
        left.tick_params(labelbottom=False)
        period.plot(branch.values, branch.period, color=GREY, lw=1.3)
        period.set(xlabel=parameter, ylabel="period [s]")
        period.ticklabel_format(axis="y", scilimits=_PLAIN)
        middle = float(np.mean(period.get_ylim()))
        if np.ptp(period.get_ylim()) < _LEAST_RANGE * middle:
            period.set_ylim((1.0 - 0.5 * _LEAST_RANGE) * middle, (1.0 + 0.5 * _LEAST_RANGE) * middle)
    handles = dict(zip(*reversed(left.get_legend_handles_labels()), strict=True))
    left.legend(handles.values(), handles.keys(), fontsize=9, frameon=False)
    shown = sorted({0, len(orbits) // 2, len(orbits) - 1})
    known = _known(*(orbits[i] for i in shown))
    for i in shown:
        _draw_orbit(right, orbits[i], coordinate, known)
    right.legend(fontsize=9, frameon=False, loc="upper right")
    values = ", ".join(f"{branch.values[i]:.4g}" for i in shown)
    right.set_title(f"{branch.parameter} = {values}", fontsize=10)
    panel_letters(panels.values())
    return figure


def _draw_branch(axis: Axes, branch: Branch, values: np.ndarray) -> None:
    stable = branch.stable
    cuts = np.flatnonzero(stable[1:] != stable[:-1]) + 1
    for part in np.split(np.arange(len(values)), cuts):
        line = np.append(part, part[-1] + 1) if part[-1] + 1 < len(values) else part
        good = bool(stable[part[0]])
        style = {"color": BLUE, "lw": 1.6, "ls": "-" if good else "--", "label": "stable" if good else "unstable"}
        axis.plot(branch.values[line], values[line], **style)


def _draw_orbit(axis: Axes, orbit: PeriodicOrbit, i: int, known: list[str]) -> None:
    """Draw one coordinate and its velocity, with a colour for each combination of modes and thick lines in stick."""
    q, qd = (np.concatenate([np.asarray(getattr(run, name))[:, i] for run in orbit.runs]) for name in ("q", "qd"))
    combinations = _modes(orbit)
    named = set(axis.get_legend_handles_labels()[1])
    for start in range(len(q) - 1):
        modes = combinations[start]
        colour = COLOURS[known.index(modes) % len(COLOURS)]
        stuck = "stick" in modes or "closed" in modes
        label = f"_{modes}" if modes in named else modes  # one legend entry for each
        axis.plot(q[start : start + 2], qd[start : start + 2], color=colour, lw=2.6 if stuck else 1.3, label=label)
        if stuck:  # stick on ground at rest is a single point
            axis.plot(q[start], qd[start], "o", color=colour, ms=4, zorder=3)
        named.add(modes)
    (name, unit), (rate, rate_unit) = (quantity_of(orbit.runs[0].scene, f"{kind}[{i}]") for kind in ("q", "qd"))
    axis.set(xlabel=with_unit(name, unit), ylabel=with_unit(rate, rate_unit))
    axis.ticklabel_format(scilimits=_PLAIN)


def _known(*orbits: PeriodicOrbit) -> list[str]:
    """All combinations of modes, in the order of their colours."""
    return sorted({modes for orbit in orbits for modes in _modes(orbit)})


def _modes(orbit: PeriodicOrbit) -> list[str]:
    """The combination of modes from each saved time on, after the events at that time."""
    return [modes for run in orbit.runs for modes in _modes_of_run(run)]


def _modes_of_run(run: Trajectory) -> list[str]:
    if run.modes is None:
        return ["orbit"] * len(run.t)
    columns = [[run.mode_labels[name][int(x)] for x in np.asarray(mode)] for name, mode in run.mode.items()]
    if len(columns) == 1:
        return columns[0]
    return [
        ", ".join(f"{name} {mode}" for name, mode in zip(run.mode, row, strict=True))
        for row in zip(*columns, strict=True)
    ]
