"""Figures of the standard experiments."""

from collections.abc import Mapping

from matplotlib.axes import Axes

from bench.behaviour.experiment import Experiment, ExperimentResult, Verdict
from bench.figures import BLUE, GREEN, GREY, RED
from jaxmodsim.plot import Figure

VERDICTS = {
    Verdict.PASS: GREEN,
    Verdict.FAIL: RED,
    Verdict.KNOWN_LIMITATION: "#b8860b",
    Verdict.NOT_APPLICABLE: GREY,
}


def behaviour_figure(experiment: Experiment, outcomes: Mapping[str, ExperimentResult], columns: int = 5) -> Figure:
    """Plot an experiment on all laws, with a panel for each: curves, verdict and number.

    **Arguments:**

    - `experiment`: from `bench.behaviour.run.EXPERIMENTS`.
    - `outcomes`: results by the name of the law.
    - `columns`: number of panels in a row.
    """
    rows = -(-len(outcomes) // columns)
    figure = Figure(figsize=(3.1 * columns, 0.9 + 2.3 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    axes[0, 0].set_ylim(experiment.window)
    for axis in axes.flat[len(outcomes) :]:
        axis.axis("off")
    for i, (axis, (law, outcome)) in enumerate(zip(axes.flat, outcomes.items(), strict=False)):
        _behaviour_panel(axis, experiment, outcome)
        axis.set_title(law, fontsize=9, loc="left", fontweight="bold")
        if i % columns == 0:
            axis.set_ylabel(experiment.axes[1])
        if i + columns >= len(outcomes):
            axis.set_xlabel(experiment.axes[0])
    handles = {line.get_label(): line for axis in axes.flat for line in axis.get_lines()}
    shown = {label: line for label, line in handles.items() if not str(label).startswith("_")}
    if shown:
        figure.legend(list(shown.values()), [str(label) for label in shown], loc="outside lower right", ncols=5)
    limit = f"{'at most' if experiment.threshold.at_most else 'at least'} {experiment.threshold.value:g}"
    unit = "" if experiment.unit == "1" else f" [{experiment.unit}]"
    figure.suptitle(f"{experiment.title}\n{experiment.quantity}{unit}: passes with {limit}", fontsize=12)
    return figure


def _behaviour_panel(axis: Axes, experiment: Experiment, outcome: ExperimentResult) -> None:
    colour = VERDICTS[outcome.verdict]
    colours = iter((BLUE, RED, GREEN, "#7b4fa3") * 2)
    seen: dict[str, str] = {}
    for line in outcome.measured.lines:
        label = line.label or "_"
        if line.reference:
            axis.plot(line.x, line.y, color="#c8c8c8", lw=4, label=label, solid_capstyle="round")
            continue
        if label not in seen:
            seen[label] = next(colours)
        first = seen[label] == BLUE
        axis.plot(line.x, line.y, color=seen[label], lw=1.3, ls="-" if first else (0, (4, 3)), label=label)
    low, high = experiment.window
    if outcome.measured.lines and not any(
        ((line.y >= low) & (line.y <= high)).any() for line in outcome.measured.lines
    ):
        axis.text(0.5, 0.5, "outside this range", transform=axis.transAxes, ha="center", fontsize=9, color=GREY)
    if experiment.log_x:
        axis.set_xscale("log")
    for side in ("top", "right", "bottom", "left"):
        axis.spines[side].set(color=colour, linewidth=1.8)
    axis.tick_params(labelsize=8)
    axis.set_title(f"{outcome.verdict.value} {outcome.measured.rounded}", fontsize=9, loc="right", color=colour)
