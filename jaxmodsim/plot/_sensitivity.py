"""What matters to an observable along a run."""

from matplotlib.axes import Axes

from ..analysis import Sensitivity
from ._figure import Figure
from ._style import COLOURS, GREY, legend_beside, panel_letters


def sensitivity_figure(sensitivity: Sensitivity, *, most: int = 8) -> Figure:
    """Normalised sensitivities along the run beside what is observed, and their ranking as bars.

    **Arguments:**

    - `sensitivity`: from `jaxmodsim.sensitivity`. Where the observable is no function of time, the bars are all.
    - `most`: how many parameters are drawn, those that matter most.
    """
    ranking = sensitivity.ranking[:most]
    colours = {name: COLOURS[i % len(COLOURS)] for i, (name, _) in enumerate(ranking)}
    styles = {name: ("-", "--", ":", "-.")[i // len(COLOURS) % 4] for i, name in enumerate(colours)}
    unit = f" [{sensitivity.unit}]" if sensitivity.unit else ""
    height = 0.9 + 0.32 * len(ranking)
    if sensitivity.over_time:
        figure = Figure(figsize=(10, 5.2 + height), layout="constrained")
        above, middle, below = figure.subplots(3, 1, height_ratios=(1.6, 3.2, height))
        above.plot(sensitivity.t, sensitivity.observable, color=GREY, lw=1.6)
        above.set(ylabel=f"{sensitivity.label}{unit}", title=f"Sensitivity of {sensitivity.label}")
        above.tick_params(labelbottom=False)
        above.sharex(middle)
        for name, _ in ranking:
            middle.plot(
                sensitivity.t, sensitivity.normalised[name], color=colours[name], ls=styles[name], lw=1.3, label=name
            )
        middle.axhline(0.0, color=GREY, lw=0.6)
        middle.set(xlabel="time [s]", ylabel=f"p d({sensitivity.label})/dp\nover its rms [1]")
        legend_beside(middle)
        panel_letters((above, middle, below))
    else:
        figure = Figure(figsize=(8, 0.4 + height), layout="constrained")
        below: Axes = figure.subplots()
        below.set(title=f"Sensitivity of {sensitivity.label}")
    for i, (name, size) in enumerate(ranking):
        below.barh(i, size, color=colours[name])
        below.text(size, i, f" {size:.3g}", va="center", fontsize=8)
    below.set_yticks(
        range(len(ranking)),
        [f"{n} = {sensitivity.values[n]:.4g} {sensitivity.units.get(n, '')}".rstrip() for n, _ in ranking],
    )
    below.margins(x=0.12)
    below.set(xlabel="rms of relative change of the observable per relative change of the parameter [1]")
    below.invert_yaxis()
    return figure
