"""Figures of identification: fits, predictions, comparisons of models, designed inputs."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from ..identify import (
    Comparison,
    FitResult,
    InputDesign,
    Record,
    RecordPrediction,
    Score,
    ServoPrediction,
    residual_tests,
)
from ._style import (
    BLUE,
    COLOURS,
    GREEN,
    GREY,
    RED,
    Figure,
    legend_above,
    legend_beside,
    panel_letters,
    small_unit,
    with_unit,
)


def fit_figure(
    result: FitResult, *, record: int = 0, quantity: str = "position", unit: str = "m", caption: str = ""
) -> Figure:
    """Plot the measured and the simulated channel against time, and their difference.

    **Arguments:**

    - `result`: the fit of one channel.
    - `record`: index of the record.
    - `quantity`, `unit`: name and unit of the measured channel.
    - `caption`: line below the figure, such as the source of the record.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.
    """
    (residual,) = result.residuals[record].values()
    rmse = float(np.sqrt(np.mean(residual**2)))
    shown = result.provenance.records[record]
    return _followed(shown, residual, rmse, "simulated, open loop", quantity, unit, caption)


def score_figure(
    score: Score | RecordPrediction, *, quantity: str = "position", unit: str = "m", caption: str = ""
) -> Figure:
    """Plot a fitted model on a record outside the fit: measured, simulated, and their difference.

    **Arguments:**

    - `score`: from `jaxmodsim.identify.evaluate_on` or `predict`, of one channel; a prediction with its band.
    - `quantity`, `unit`: name and unit of the measured channel.
    - `caption`: line below the figure, such as the source of the record.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.
    """
    prediction = score if isinstance(score, RecordPrediction) else None
    shown = score.score if isinstance(score, RecordPrediction) else score
    (residual,), (rmse,) = shown.residuals.values(), shown.rmse.values()
    figure = _followed(shown.record, residual, rmse, "simulated, initial state fitted", quantity, unit, caption)
    if prediction is not None:
        _add_band(figure, prediction, small_unit(unit)[0])
    return figure


def _add_band(figure: Figure, prediction: RecordPrediction, factor: float) -> None:
    """Draw the band of a prediction: around the simulation in the upper panel, around the error in the lower one."""
    (lower,), (upper,), (share,) = prediction.lower.values(), prediction.upper.values(), prediction.shares.values()
    (above, below), (output,) = figure.axes, prediction.score.outputs.values()
    t, level = prediction.score.record.t, 100 * prediction.level
    label = f"{level:g} % prediction band: contains {100 * share:.0f} % of the samples"
    above.fill_between(t, lower, upper, color=GREEN, alpha=0.25, lw=0, label=label)
    below.fill_between(t, factor * (lower - output), factor * (upper - output), color=GREEN, alpha=0.25, lw=0)
    above.legend(loc="upper right")


def servo_figure(prediction: ServoPrediction, *, measured: bool = True, caption: str = "") -> Figure:
    """Plot the predicted angle of a servo with its band, the command, and the measured angle.

    **Arguments:**

    - `prediction`: from `jaxmodsim.identify.predict_servo`.
    - `measured`: whether the record has the measured angle.
    - `caption`: line below the figure, such as the source of the record.

    **Returns:**

    The figure.
    """
    record = prediction.record
    figure = Figure(figsize=(11, 5), layout="constrained")
    axis = figure.subplots()
    band = f"band for {100 * prediction.level:g} % of the samples"
    axis.fill_between(record.t, prediction.lower, prediction.upper, color=GREEN, alpha=0.25, lw=0, label=band)
    if measured:
        axis.plot(record.t, record.measured, color=GREY, lw=2.4, label="measured")
    axis.plot(record.t, prediction.q, color=RED, lw=1.1, label="simulated, open loop")
    low, high = float(np.min(prediction.lower)), float(np.max(prediction.upper))
    axis.plot(record.t, np.clip(record.inputs["q_goal"], low, high), color=BLUE, lw=0.7, label="command, clipped")
    error = f": mean absolute error {1e3 * prediction.error:.3g} mrad" if measured else ""
    figure.suptitle(f"{record.name}{error}")
    axis.set(xlabel="time [s]", ylabel="angle [rad]")
    legend_above(axis)
    if caption:
        figure.supxlabel(caption, fontsize=8, color=GREY)
    return figure


def _followed(
    record: Record, residual: np.ndarray, rmse: float, label: str, quantity: str, unit: str, caption: str
) -> Figure:
    figure = Figure(figsize=(11, 6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    above.plot(record.t, record.measured, color=GREY, lw=2.4, label="measured")
    above.plot(record.t, record.measured + residual, color=RED, lw=1.1, label=label)
    factor, small = small_unit(unit)
    above.set_ylabel(f"{quantity} [{unit}]")
    figure.suptitle(f"{record.name}: RMSE {factor * rmse:.3g} {small}")
    legend_above(above)
    below.plot(record.t, factor * residual, color=BLUE, lw=1.0)
    below.axhline(0.0, color=GREY, lw=0.6)
    below.set(xlabel="time [s]", ylabel=f"simulated - measured [{small}]")
    panel_letters((above, below))
    if caption:
        figure.supxlabel(caption, fontsize=8, color=GREY)
    return figure


def loops_figure(result: FitResult, *, caption: str = "") -> Figure:
    """Plot the measured and the modelled friction force against displacement.

    **Arguments:**

    - `result`: a fit by `fit_law`.
    - `caption`: line below the figure, such as the source of the record.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.
    """
    record, figure = result.record, Figure(figsize=(11, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    x = 1e6 * (record.inputs["x"] - np.mean(record.inputs["x"]))
    left.plot(x, record.measured, color=GREY, lw=0.7, label="measured")
    left.plot(x, result.simulated, color=RED, lw=0.7, label="modelled")
    left.set(xlabel="displacement about its mean [um]", ylabel="friction force [N]")
    legend_above(left)
    figure.suptitle(f"{record.name}: RMSE {result.rmse:.3g} N")
    middle = 0.5 * (record.t[0] + record.t[-1])
    inside = (record.t >= middle) & (record.t <= middle + 0.06 * (record.t[-1] - record.t[0]))
    right.plot(record.t[inside], record.measured[inside], color=GREY, lw=2.2, label="measured")
    right.plot(record.t[inside], result.simulated[inside], color=RED, lw=1.1, label="modelled")
    right.set(xlabel="time [s]", ylabel="friction force [N]", title="a few cycles")
    panel_letters((left, right))
    if caption:
        figure.supxlabel(caption, fontsize=8, color=GREY)
    return figure


def truth_figure(result: FitResult, truth: Mapping[str, float]) -> Figure:
    """Plot the error of each fitted parameter relative to its true value, with 95 % confidence intervals.

    **Arguments:**

    - `result`: the fit.
    - `truth`: true values, not zero, by the parameter names of the fit.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.
    """
    figure = Figure(figsize=(7.5, 0.9 + 0.45 * len(truth)), layout="constrained")
    axis: Axes = figure.subplots()
    for i, (name, true) in enumerate(truth.items()):
        centre, half = 100 * (result.values[name] / true - 1), 196 * result.errors[name] / abs(true)
        axis.errorbar(centre, i, xerr=half, fmt="o", color=BLUE, capsize=4)
    axis.axvline(0.0, color=GREEN, lw=1.5, label="truth")
    axis.set_yticks(range(len(truth)), list(truth))
    axis.set(xlabel="error [% of the truth]", title="LuGre fitted to a synthetic record, 95 % intervals")
    axis.invert_yaxis()
    legend_beside(axis)
    return figure


def result_figure(result: FitResult, *, record: int = 0, units: Mapping[str, str] | None = None) -> Figure:
    """Plot a fit on one page: record, residual, its autocorrelation, confidence intervals, and correlation matrix.

    **Arguments:**

    - `result`: the fit.
    - `record`: index of the record.
    - `units`: units of the channels by name, for the axes.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.

    **Raises:**

    - `ValueError` for an unknown record or channel.
    """
    if not 0 <= record < len(result.provenance.records):
        raise ValueError(f"record must be 0 to {len(result.provenance.records) - 1}, but it is {record}.")
    channels = list(result.provenance.outputs[record])
    units = dict(units or {})
    if set(units) - set(result.diagnostics.rmse):
        raise ValueError(f"units names {', '.join(units)}, but the channels are: {', '.join(result.diagnostics.rmse)}.")
    figure = Figure(figsize=(14, 3.0 + 3.4 * max(len(channels), 2)), layout="constrained")
    left, right = np.ravel(figure.subfigures(1, 2, squeeze=False, width_ratios=(1.25, 1)))
    rows = left.subplots(2 * len(channels), 1, sharex=True, squeeze=False, height_ratios=(2, 1) * len(channels))[:, 0]
    for channel, above, below in zip(channels, rows[::2], rows[1::2], strict=True):
        _channel_panels(above, below, result, record, channel, units.get(channel, ""))
    rows[-1].set_xlabel("time [s]")
    size = 0.6 + 0.32 * len(result.values)
    panels = right.subplots(3, 1, height_ratios=(2.0, size, 1.3 * size + 1.0))
    _autocorrelation_panel(panels[0], result, record)
    _interval_panel(panels[1], result)
    _correlation_panel(panels[2], result)
    panel_letters((*rows, *panels))
    ending = f"{result.diagnostics.ending}, {result.diagnostics.evaluations} evaluations"
    figure.suptitle(f"{result.provenance.records[record].name}: {ending}")
    return figure


def _channel_panels(above: Axes, below: Axes, result: FitResult, number: int, channel: str, unit: str) -> None:
    record, residual = result.provenance.records[number], result.residuals[number][channel]
    factor, small = small_unit(unit)
    name = channel if channel != "measured" else "output"
    above.plot(record.t, record.channels[channel], color="#b4b4b4", lw=3.2, label="measured")
    above.plot(record.t, result.provenance.outputs[number][channel], color=RED, lw=1.1, label="simulated")
    rmse = factor * float(np.sqrt(np.mean(residual**2)))
    above.set(ylabel=with_unit(name, unit), title=f"RMSE {rmse:.3g} {small}".rstrip())
    legend_above(above)
    below.plot(record.t, factor * residual, color=BLUE, lw=0.8)
    below.axhline(0.0, color=GREY, lw=0.6)
    below.set(ylabel=with_unit("residual", small))


def _autocorrelation_panel(axis: Axes, result: FitResult, number: int) -> None:
    """Draw the autocorrelation of the residuals with the 95 % band of white noise."""
    record = result.provenance.records[number]
    interval = float(np.median(np.diff(record.t)))
    tests = [each for each in residual_tests(result).channels if each.record == record.name]
    for each, colour in zip(tests, COLOURS * (1 + len(tests)), strict=False):
        lags = interval * np.arange(len(each.autocorrelation))
        label = f"{each.channel}: p = {each.whiteness:.2g} (white)"
        axis.plot(lags, each.autocorrelation, color=colour, lw=1.0, label=label)
    band = 1.96 / np.sqrt(len(record.t))
    axis.axhspan(-band, band, color=GREY, alpha=0.3, lw=0, label="95 % of white noise")
    axis.axhline(0.0, color=GREY, lw=0.6)
    axis.set(xlabel="lag [s]", ylabel="autocorrelation", title="Residual: autocorrelation")
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2, fontsize=9, frameon=False)


def _interval_panel(axis: Axes, result: FitResult) -> None:
    """Draw the half-widths of the intervals relative to the values, on a logarithmic axis, beside the numbers."""
    names, intervals = list(result.values), result.estimate.intervals()
    shares = []
    for name in names:
        scale = abs(result.values[name]) or abs(result.estimate.start[name]) or 1.0
        low, high = intervals[name]
        shares.append(100 * max(result.values[name] - low, high - result.values[name]) / scale)
    known = [x for x in shares if np.isfinite(x) and x > 0]
    # The bars take the left half, the numbers the right half.
    first, last = (float(np.log10(x)) for x in (min(known, default=1.0), max(known, default=1.0)))
    first, last = np.floor(first - 0.3), np.ceil(last + 0.1)
    for i, (name, share) in enumerate(zip(names, shares, strict=True)):
        open_ = not np.isfinite(share)
        colour = RED if open_ or share > 100 else "#b8860b" if share > 20 else GREEN
        axis.barh(i, 10.0**last if open_ else max(share, 10.0**first), left=0.0, color=colour, height=0.6)
        value, (low, high) = result.values[name], intervals[name]
        text = f"{value:.5g} (-{value - low:.2g}, +{high - value:.2g}) {result.estimate.units[name]}"
        axis.text(0.41, i, "no interval: has no effect" if open_ else text, va="center", fontsize=8,
                  transform=axis.get_yaxis_transform())  # fmt: skip
    axis.set_xscale("log")
    decades = np.arange(first, last + 1, max(np.ceil((last - first) / 3), 1))
    axis.set_xticks(10.0**decades, [f"$10^{{{x:.0f}}}$" for x in decades])
    axis.minorticks_off()
    axis.set_yticks(range(len(names)), names, fontsize=8)
    edges = 10.0**first, 10.0 ** (last + 1.6 * (last - first))
    axis.set(xlim=edges, ylim=(len(names) - 0.4, -0.6), xlabel="half-width of the 95 % interval [% of the value]")
    axis.set_title("Parameters: value and 95 % interval")


def _correlation_panel(axis: Axes, result: FitResult) -> None:
    names, correlation = list(result.values), result.estimate.correlation
    image = axis.imshow(correlation, vmin=-1, vmax=1, cmap="RdBu_r", aspect="auto")
    axis.set_xticks(range(len(names)), names, rotation=30, ha="right", fontsize=8)
    axis.set_yticks(range(len(names)), names, fontsize=8)
    if len(names) <= 12:
        for i, row in enumerate(correlation):
            for j, x in enumerate(row):
                shade = "white" if abs(x) > 0.6 else "black"
                axis.text(j, i, f"{x:+.2f}", ha="center", va="center", fontsize=8, color=shade)
    axis.set_title("Correlation of the parameters")
    axis.figure.colorbar(image, ax=axis, label="correlation")


def comparison_figure(comparison: Comparison, *, unit: str = "m", caption: str = "") -> Figure:
    """Plot the held-out error of each model beside the error of its fit to all data.

    **Arguments:**

    - `comparison`: from `compare`.
    - `unit`: unit of the errors; "1" for several channels, whose errors are in noise levels.
    - `caption`: line below the figure, such as the source of the records.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.

    **Raises:**

    - `ValueError` if no model could be fitted.
    """
    ranked, simplest, (factor, small) = comparison.ranked, comparison.simplest, small_unit(unit)
    figure = Figure(figsize=(9, 1.9 + 0.62 * len(ranked)), layout="constrained")
    axis: Axes = figure.subplots()
    for i, each in enumerate(ranked):
        height, colour = np.full(len(each.parts), i - 0.17), GREEN if each.name == simplest else BLUE
        axis.barh(i - 0.17, factor * each.held_out, 0.4, color=colour, alpha=0.75)
        (parts,) = axis.plot(factor * each.parts, height, "o", color="white", mec="black", ms=4)
        bar = axis.errorbar(
            factor * each.held_out, i - 0.17, xerr=factor * each.standard_error, color="black", capsize=4, lw=1.2
        )
        axis.barh(i + 0.2, factor * each.fitted, 0.24, color=GREY)
        parts.set_label("" if i else "each held-out part")
        bar.set_label("" if i else "standard error")
    doubts = [", some undetermined" if each.undetermined else "" for each in ranked]
    names = [f"{x.name}\n{x.parameters} parameters{doubt}" for x, doubt in zip(ranked, doubts, strict=True)]
    axis.set_yticks(range(len(ranked)), names, fontsize=9)
    axis.invert_yaxis()
    errors = np.concatenate([[each.held_out, each.fitted] for each in ranked])
    if errors.max() > 20 * errors.min() > 0:
        axis.set_xscale("log")
        axis.set_xlim(left=0.5 * factor * errors.min())
    below = f"\n{caption}" if caption else ""
    axis.set(xlabel=f"root mean square error [{small}]{below}", title=f"Held-out error: {comparison.by}")
    axis.grid(axis="x", alpha=0.3)
    bars = {"held out": BLUE, "held out, simplest adequate model": GREEN, "fitted to all data": GREY}
    patches = [Patch(color=colour, label=label) for label, colour in bars.items()]
    figure.legend(handles=[*patches, *axis.get_legend_handles_labels()[0]], loc="outside lower center", ncols=3)
    return figure


def design_figure(design: InputDesign, *, caption: str = "") -> Figure:
    """Plot a designed input with its limits, and its predicted standard errors beside those of a plain sine.

    **Arguments:**

    - `design`: from `jaxmodsim.identify.design_input`.
    - `caption`: line below the figure.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.
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
    """Draw predicted relative errors, designed against plain. Zero values have no relative error and are left out."""
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
        heights = np.arange(len(names)) - offset
        axis.barh(heights, np.minimum(shares, high), height=0.38, color=colour, label=label)
        for height, share in zip(heights, shares, strict=True):
            text = f" {share:.2g} %" if np.isfinite(share) else " not determined"
            axis.text(min(share, 0.25 * high), height, text, va="center", fontsize=8)
    axis.set_xscale("log")
    axis.set_yticks(range(len(names)), names)
    axis.set(xlim=(low, high), xlabel="predicted standard error [% of the value]")
    axis.set_title(f"{design.best.t[-1] - design.best.t[0]:g} s, noise {design.noise:g}", fontsize=10)
    axis.invert_yaxis()
