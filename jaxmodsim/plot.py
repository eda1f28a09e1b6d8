"""Figures. The only module that imports matplotlib; every function returns a `matplotlib.figure.Figure`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from .analysis import Sensitivity
from .behaviour import Experiment, Outcome, Verdict
from .identify import Comparison, FitResult

_BLUE, _RED, _GREY, _GREEN = "#1f5fa8", "#c2452d", "#8a8a8a", "#2e8b57"
_VERDICTS = {
    Verdict.PASS: _GREEN,
    Verdict.FAIL: _RED,
    Verdict.BY_NATURE: "#b8860b",
    Verdict.NOT_APPLICABLE: _GREY,
}


@dataclass(frozen=True)
class RampRun:
    """A run of the ramped box, ready to be drawn.

    - `label`: what was run.
    - `t`: times [s].
    - `velocity`: velocity of the box [m/s].
    - `applied`, `friction`: forces [N].
    - `note`: a sentence for the figure, such as how the run ended.
    """

    label: str
    t: np.ndarray
    velocity: np.ndarray
    applied: np.ndarray
    friction: np.ndarray
    note: str = ""


def ramp_figure(title: str, runs: Sequence[RampRun], zoom: tuple[float, float] = (0.0, 3.0)) -> Figure:
    """Velocity, velocity about zero, and applied and friction force against time, one row for each run.

    **Arguments:**

    - `title`: of the figure.
    - `runs`: the runs.
    - `zoom`: time span [s] of the second and third column, in which the stick phase lies.
    """
    figure = Figure(figsize=(14, 0.6 + 2.7 * len(runs)), layout="constrained")
    axes = figure.subplots(len(runs), 3, squeeze=False, width_ratios=(1, 1, 1.2))
    for (left, middle, right), run in zip(axes, runs, strict=True):
        for axis in (left, middle):
            axis.plot(run.t, run.velocity, color=_BLUE, lw=1.2)
            axis.axhline(0.0, color=_GREY, lw=0.6)
            axis.set(ylabel="velocity [m/s]")
        early = run.velocity[run.applied <= 1.4]
        reach = max(2.0 * float(np.max(np.abs(early), initial=0.0)), 2e-3)
        middle.set(xlim=zoom, ylim=(-reach, reach), title="about zero")
        left.set(title=run.label, xlim=(0.0, 10.0))
        right.plot(run.t, run.applied, color=_GREY, lw=1.4, ls="--", label="applied force")
        right.plot(run.t, run.friction, color=_RED, lw=1.0, label="friction force")
        inside = (run.t >= zoom[0]) & (run.t <= zoom[1])
        peak = max(float(np.max(np.abs(run.friction[inside]), initial=0.0)), 1.0)
        below = float(np.min(run.friction[inside], initial=0.0)) < -0.1 * peak
        right.set(ylabel="force [N]", xlim=zoom, ylim=(-1.4 * peak if below else -0.05 * peak, 1.6 * peak))
        right.legend(loc="lower right", fontsize=8)
        if run.note:
            left.text(0.5, 0.6, run.note, transform=left.transAxes, ha="center", fontsize=9, color=_RED)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
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
    """How LuGre's stick oscillates: friction in stick for a few parameters, and a map over sigma0 and sigma1.

    **Arguments:**

    - `t`: times [s], shape `[time]`.
    - `friction`: friction force [N] by label, shape `[time]`.
    - `applied`: applied force [N], shape `[time]`.
    - `sigma0`, `sigma1`: axes of the map [N/m], [N s/m].
    - `oscillation`: amplitude of friction about the applied force in stick [N], shape `[sigma0, sigma1]`.
    """
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1))
    inside = t <= 1.5
    for label, force in friction.items():
        left.plot(t[inside], 1e3 * (force - applied)[inside], lw=1.2, label=label)
    left.set(xlabel="time [s]", ylabel="friction - applied force [mN]", title="Stick: friction about the applied force")
    left.legend(fontsize=8)
    mesh = right.pcolormesh(
        np.arange(len(sigma1) + 1),
        np.arange(len(sigma0) + 1),
        np.log10(1e3 * np.maximum(oscillation, 1e-9)),
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
    figure.colorbar(mesh, ax=right, label="log10 of oscillation in mN")
    return figure


def fit_figure(result: FitResult, *, quantity: str = "position", unit: str = "m", caption: str = "") -> Figure:
    """Measured and simulated against time, and their difference.

    **Arguments:**

    - `result`: the fit.
    - `quantity`, `unit`: what was measured.
    - `caption`: a line for the source of the record.
    """
    record, figure = result.record, Figure(figsize=(11, 6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    above.plot(record.t, record.measured, color=_GREY, lw=2.4, label="measured")
    above.plot(record.t, result.simulated, color=_RED, lw=1.1, label="simulated, open loop")
    factor, small = _small_unit(unit)
    rmse = f"RMSE {factor * result.rmse:.3g} {small}"
    above.set(ylabel=f"{quantity} [{unit}]", title=f"{record.name}: {rmse}")
    above.legend(loc="upper right")
    below.plot(record.t, factor * (result.simulated - record.measured), color=_BLUE, lw=1.0)
    below.axhline(0.0, color=_GREY, lw=0.6)
    below.set(xlabel="time [s]", ylabel=f"simulated - measured [{small}]")
    if caption:
        figure.supxlabel(caption, fontsize=8, color=_GREY)
    return figure


def loops_figure(result: FitResult, *, caption: str = "") -> Figure:
    """Friction force against displacement, measured and modelled.

    **Arguments:**

    - `result`: a fit by `fit_law`.
    - `caption`: a line for the source of the record.
    """
    record, figure = result.record, Figure(figsize=(11, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    x = 1e6 * (record.inputs["x"] - np.mean(record.inputs["x"]))
    left.plot(x, record.measured, color=_GREY, lw=0.7, label="measured")
    left.plot(x, result.simulated, color=_RED, lw=0.7, label="modelled")
    left.set(
        xlabel="displacement about its mean [um]",
        ylabel="friction force [N]",
        title=f"{record.name}: RMSE {result.rmse:.3g} N",
    )
    left.legend(loc="upper left")
    middle = 0.5 * (record.t[0] + record.t[-1])
    inside = (record.t >= middle) & (record.t <= middle + 0.06 * (record.t[-1] - record.t[0]))
    right.plot(record.t[inside], record.measured[inside], color=_GREY, lw=2.2, label="measured")
    right.plot(record.t[inside], result.simulated[inside], color=_RED, lw=1.1, label="modelled")
    right.set(xlabel="time [s]", ylabel="friction force [N]", title="A few cycles")
    if caption:
        figure.supxlabel(caption, fontsize=8, color=_GREY)
    return figure


def sensitivity_figure(found: Sensitivity, *, most: int = 8) -> Figure:
    """Normalised sensitivities along the run beside what is observed, and their ranking as bars.

    **Arguments:**

    - `found`: from `jaxmodsim.sensitivity`. Where the observable is no function of time, the bars are all.
    - `most`: how many parameters are drawn, those that matter most.
    """
    ranking = found.ranking[:most]
    colours = {name: f"C{i}" for i, (name, _) in enumerate(ranking)}
    unit = f" [{found.unit}]" if found.unit else ""
    height = 0.9 + 0.32 * len(ranking)
    if found.over_time:
        figure = Figure(figsize=(10, 5.2 + height), layout="constrained")
        above, middle, below = figure.subplots(3, 1, height_ratios=(1.6, 3.2, height))
        above.plot(found.t, found.observable, color=_GREY, lw=1.6)
        above.set(ylabel=f"{found.label}{unit}", title=f"Sensitivity of {found.label}")
        above.tick_params(labelbottom=False)
        above.sharex(middle)
        for name, _ in ranking:
            middle.plot(found.t, found.normalised[name], color=colours[name], lw=1.3, label=name)
        middle.axhline(0.0, color=_GREY, lw=0.6)
        middle.set(xlabel="time [s]", ylabel=f"p d({found.label})/dp\nover its rms [1]")
        middle.legend(fontsize=8, ncols=2)
    else:
        figure = Figure(figsize=(8, 0.4 + height), layout="constrained")
        below: Axes = figure.subplots()
        below.set(title=f"Sensitivity of {found.label}")
    for i, (name, size) in enumerate(ranking):
        below.barh(i, size, color=colours[name])
        below.text(size, i, f" {size:.3g}", va="center", fontsize=8)
    below.set_yticks(
        range(len(ranking)),
        [f"{n} = {found.values[n]:.4g} {found.units.get(n, '')}".rstrip() for n, _ in ranking],
    )
    below.margins(x=0.12)
    below.set(xlabel="rms of relative change of the observable per relative change of the parameter [1]")
    below.invert_yaxis()
    return figure


def truth_figure(result: FitResult, truth: Mapping[str, float]) -> Figure:
    """Fitted against true parameters, each relative to the truth, with 95 % intervals.

    **Arguments:**

    - `result`: the fit.
    - `truth`: true values by the names of the fit, not zero.
    """
    figure = Figure(figsize=(7.5, 0.9 + 0.45 * len(truth)), layout="constrained")
    axis: Axes = figure.subplots()
    for i, (name, true) in enumerate(truth.items()):
        centre, half = 100 * (result.values[name] / true - 1), 196 * result.errors[name] / abs(true)
        axis.errorbar(centre, i, xerr=half, fmt="o", color=_BLUE, capsize=4)
    axis.axvline(0.0, color=_GREEN, lw=1.5, label="truth")
    axis.set_yticks(range(len(truth)), list(truth))
    axis.set(xlabel="estimate relative to truth [%], bars: 95 % interval", title="LuGre fitted to a synthetic record")
    axis.invert_yaxis()
    axis.legend(fontsize=8)
    return figure


def comparison_figure(comparison: Comparison, *, unit: str = "m", caption: str = "") -> Figure:
    """Models by their error on what was held back, beside the error of the fit to everything.

    **Arguments:**

    - `comparison`: from `compare` or `compare_laws`.
    - `unit`: of the errors; "1" where several channels were compared, in noise levels.
    - `caption`: a line for the source of the records.

    **Raises:**

    - `ValueError` if no model could be fitted.
    """
    ranked, simplest, (factor, small) = comparison.ranked, comparison.simplest, _small_unit(unit)
    figure = Figure(figsize=(9, 1.9 + 0.62 * len(ranked)), layout="constrained")
    axis: Axes = figure.subplots()
    for i, each in enumerate(ranked):
        height, colour = np.full(len(each.parts), i - 0.17), _GREEN if each.name == simplest else _BLUE
        axis.barh(i - 0.17, factor * each.held_back, 0.4, color=colour, alpha=0.75)
        (parts,) = axis.plot(factor * each.parts, height, "o", color="white", mec="black", ms=4)
        bar = axis.errorbar(
            factor * each.held_back, i - 0.17, xerr=factor * each.error, color="black", capsize=4, lw=1.2
        )
        axis.barh(i + 0.2, factor * each.fitted, 0.24, color=_GREY)
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
    bars = {"held back": _BLUE, "held back, simplest that suffices": _GREEN, "fitted to everything": _GREY}
    patches = [Patch(color=colour, label=label) for label, colour in bars.items()]
    figure.legend(handles=[*patches, *axis.get_legend_handles_labels()[0]], loc="outside lower center", ncols=3)
    return figure


def behaviour_figure(experiment: Experiment, outcomes: Mapping[str, Outcome], columns: int = 5) -> Figure:
    """An experiment on all laws, a panel for each: its curves, its verdict and its number.

    **Arguments:**

    - `experiment`: from `jaxmodsim.behaviour.EXPERIMENTS`.
    - `outcomes`: what it found, by the name of the law.
    - `columns`: panels in a row.
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
    limit = f"{'at most' if experiment.limit.at_most else 'at least'} {experiment.limit.value:g}"
    unit = "" if experiment.unit == "1" else f" [{experiment.unit}]"
    figure.suptitle(f"{experiment.title}\n{experiment.quantity}{unit}: passes with {limit}", fontsize=12)
    return figure


def _behaviour_panel(axis: Axes, experiment: Experiment, outcome: Outcome) -> None:
    colour = _VERDICTS[outcome.verdict]
    colours = iter((_BLUE, _RED, _GREEN, "#7b4fa3") * 2)
    seen: dict[str, str] = {}
    for line in outcome.finding.lines:
        label = line.label or "_"
        if line.reference:
            axis.plot(line.x, line.y, color="#c8c8c8", lw=4, label=label, solid_capstyle="round")
            continue
        if label not in seen:
            seen[label] = next(colours)
        first = seen[label] == _BLUE
        axis.plot(line.x, line.y, color=seen[label], lw=1.3, ls="-" if first else (0, (4, 3)), label=label)
    low, high = experiment.window
    if outcome.finding.lines and not any(((line.y >= low) & (line.y <= high)).any() for line in outcome.finding.lines):
        axis.text(0.5, 0.5, "outside this range", transform=axis.transAxes, ha="center", fontsize=9, color=_GREY)
    if experiment.log_x:
        axis.set_xscale("log")
    for side in ("top", "right", "bottom", "left"):
        axis.spines[side].set(color=colour, linewidth=1.8)
    axis.tick_params(labelsize=8)
    axis.set_title(f"{outcome.verdict.value} {outcome.finding.rounded}", fontsize=9, loc="right", color=colour)


def _small_unit(unit: str) -> tuple[float, str]:
    """Factor and name of a unit a thousand times smaller."""
    return (1e3, f"m{unit}") if unit in ("m", "N", "rad", "m/s") else (1.0, unit)
