"""A run against time."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes

from ..scene import quantity_of
from ..simulation import Trajectory
from ._style import COLOURS, GREY, Figure, legend_beside, panel_letters

_SHADE = "#d9d9d9"


def run(trajectory: Trajectory) -> Figure:
    """Plot coordinates, velocities and friction forces of a run against time, with stick phases shaded.

    Coordinates with one unit share a panel, as do their velocities; each friction element has its own. Stick phases are
    those of event-driven elements. They are shaded in the panel of the element, or in all panels if it is the only one.
    Names and units are those of `Scene(..., coordinates=...)`.

    **Arguments:**

    - `trajectory`: the run, saved at two or more times `ts`.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.

    **Raises:**

    - `ValueError` for a run saved at a single time, and for a batch of runs.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    run = jms.simulate(scene, [0.0], [0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 301))
    jms.plot.run(run).savefig("run.png")
    ```
    """
    scene, table = trajectory.scene, trajectory.columns
    if len(table.time) < 2:
        raise ValueError(
            f"A plot of a run needs two saved times or more, but this one has {len(table.time)}: pass the times, as in"
            " simulate(..., ts=jnp.linspace(t0, t1, 1001))."
        )
    panels: list[tuple[str, dict[str, np.ndarray]]] = []
    for kind in ("q", "qd"):
        by_unit: dict[str, dict[str, np.ndarray]] = {}
        for i in range(trajectory.q.shape[1]):
            name, unit = quantity_of(scene, f"{kind}[{i}]")
            by_unit.setdefault(unit, {})[name] = table.values[name]
        panels += by_unit.items()
    elements = list(scene.friction)
    of_element = {len(panels) + i: name for i, name in enumerate(elements)}
    for name in elements:
        parts = {key: x for key, x in table.values.items() if key == name or key.startswith(f"{name}[")}
        panels.append((table.units[next(iter(parts))], parts))
    figure = Figure(figsize=(8.0, 0.7 + 1.55 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    stick = _stick_intervals(trajectory)
    for i, (axis, (unit, lines)) in enumerate(zip(axes, panels, strict=True)):
        _draw(axis, table.time, unit, lines)
        for name, intervals in stick.items():
            if len(stick) == 1 or of_element.get(i) == name:
                for begin, end in intervals:
                    axis.axvspan(begin, end, color=_SHADE, lw=0, zorder=0, label="stick")
    axes[-1].set(xlabel="time [s]", xlim=(table.time[0], table.time[-1]))
    shaded = axes[-1].get_legend_handles_labels()
    if "stick" in shaded[1]:
        figure.legend([shaded[0][shaded[1].index("stick")]], ["stick"], loc="outside upper right", frameon=False)
    figure.align_ylabels(axes)
    panel_letters(axes)
    return figure


def _draw(axis: Axes, t: np.ndarray, unit: str, lines: Mapping[str, np.ndarray]) -> None:
    for (name, x), colour in zip(lines.items(), COLOURS * len(lines), strict=False):
        axis.plot(t, x, color=colour, lw=1.3, label=name)
    label = f" [{unit}]" if unit else ""
    if len(lines) == 1:
        axis.set_ylabel(next(iter(lines)) + label)
    else:
        axis.set_ylabel(label.strip())
        legend_beside(axis)
    axis.axhline(0.0, color=GREY, lw=0.6, zorder=1)


def _stick_intervals(trajectory: Trajectory) -> dict[str, list[tuple[float, float]]]:
    """Start and end times [s] of the stick phases of each event-driven element."""
    scene, events = trajectory.scene, trajectory.events
    intervals: dict[str, list[tuple[float, float]]] = {}
    begin, end = float(trajectory.request.t0), float(trajectory.t_end)
    for name in scene.event_driven:
        mode = trajectory.mode[name]
        own = np.asarray(events.effect) == scene.names.index(name)
        t, after = np.asarray(events.t)[own], np.asarray(events.after)[own]
        first = np.asarray(events.before)[own][0] if own.any() else int(mode[0])
        edges, modes = [begin, *t, end], [first, *after]
        intervals[name] = [(a, b) for a, b, m in zip(edges[:-1], edges[1:], modes, strict=True) if m == 0]
    return intervals
