"""Periodic orbits and branches of them."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from ..orbits import Branch, PeriodicOrbit
from ..scene import quantity_of, scene_units
from ..simulation import Trajectory
from ._figure import Figure
from ._style import BLUE, COLOURS, GREY, RED, legend_beside, panel_letters, with_unit

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
# Range of an axis of periods, in the period, that is not made larger: what hardly changes should look so.
_LEAST_RANGE = 0.05
# Powers of ten of numbers that are written out.
_PLAIN = (-3, 4)


def orbit_figure(orbit: PeriodicOrbit) -> Figure:
    """A periodic orbit in the phase plane of each coordinate, coloured by the modes.

    **Arguments:**

    - `orbit`: from `jaxmodsim.periodic_orbit`.
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
    """A branch: amplitude and, where it changes by itself, period over the parameter; and orbits in the phase plane.

    Lines are full where orbits are stable, dashed where they are not.

    **Arguments:**

    - `branch`: from `jaxmodsim.continue_orbits`.
    - `coordinate`: index of the coordinate.
    - `beside`: branches over the same parameter whose amplitudes are drawn too, of equilibria for instance.
    """
    orbits = branch.orbits
    autonomous = orbits[0].autonomous
    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1.0))
    scene = orbits[0].runs[0].scene
    name, unit = quantity_of(scene, f"q[{coordinate}]")
    for each in (branch, *beside):
        _draw_branch(left, each, each.amplitude[:, coordinate])
        for point in each.points:
            amplitude = float(point.orbit.amplitude[coordinate])
            left.plot(point.value, amplitude, _MARKERS[point.kind], color=RED, ms=7, zorder=4, label=point.kind)
    parameter = with_unit(branch.parameter, scene_units(scene).get(branch.parameter, ""))
    left.set(xlabel=parameter, ylabel=with_unit(f"amplitude of {name}", unit))
    left.ticklabel_format(axis="y", scilimits=_PLAIN)
    if autonomous:
        of_period = left.twinx()
        of_period.plot(branch.values, branch.period, color=GREY, lw=0.9, label="period")
        of_period.set_ylabel("period [s]", color=GREY)
        middle = np.mean(of_period.get_ylim())
        if np.ptp(of_period.get_ylim()) < _LEAST_RANGE * middle:
            of_period.set_ylim((1.0 - 0.5 * _LEAST_RANGE) * middle, (1.0 + 0.5 * _LEAST_RANGE) * middle)
    handles = dict(zip(*reversed(left.get_legend_handles_labels()), strict=True))
    left.legend(handles.values(), handles.keys(), fontsize=9, frameon=False)
    shown = sorted({0, len(orbits) // 2, len(orbits) - 1})
    known = _known(*(orbits[i] for i in shown))
    for i in shown:
        _draw_orbit(right, orbits[i], coordinate, known)
    right.legend(fontsize=9, frameon=False, loc="upper right")
    values = ", ".join(f"{branch.values[i]:.4g}" for i in shown)
    right.set_title(f"{branch.parameter} = {values}", fontsize=10)
    panel_letters((left, right))
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
    """One coordinate and its velocity; a colour for each combination of modes, the stuck ones thick."""
    q, qd = (np.concatenate([np.asarray(getattr(run, name))[:, i] for run in orbit.runs]) for name in ("q", "qd"))
    combinations = _modes_in_words(orbit)
    named = set(axis.get_legend_handles_labels()[1])
    for start in range(len(q) - 1):
        words = combinations[start]
        colour = COLOURS[known.index(words) % len(COLOURS)]
        stuck = "stick" in words or "closed" in words
        label = f"_{words}" if words in named else words  # once in a legend
        axis.plot(q[start : start + 2], qd[start : start + 2], color=colour, lw=2.6 if stuck else 1.3, label=label)
        if stuck:  # on the ground it is a point
            axis.plot(q[start], qd[start], "o", color=colour, ms=4, zorder=3)
        named.add(words)
    (name, unit), (rate, rate_unit) = (quantity_of(orbit.runs[0].scene, f"{kind}[{i}]") for kind in ("q", "qd"))
    axis.set(xlabel=with_unit(name, unit), ylabel=with_unit(rate, rate_unit))
    axis.ticklabel_format(scilimits=_PLAIN)


def _known(*orbits: PeriodicOrbit) -> list[str]:
    """All combinations of modes, in the order of their colours."""
    return sorted({words for orbit in orbits for words in _modes_in_words(orbit)})


def _modes_in_words(orbit: PeriodicOrbit) -> list[str]:
    """Modes on each piece between two times of the runs, after the events at its begin."""
    return [words for run in orbit.runs for words in _modes_of_run(run)]


def _modes_of_run(run: Trajectory) -> list[str]:
    words = run.mode_labels
    if run.modes is None:
        return ["orbit"] * len(run.t)
    columns = [[words[name][int(x)] for x in np.asarray(mode)] for name, mode in run.mode.items()]
    alone = len(columns) == 1
    names = list(run.mode)
    return [
        row[0] if alone else ", ".join(f"{name} {mode}" for name, mode in zip(names, row, strict=True))
        for row in zip(*columns, strict=True)
    ]
