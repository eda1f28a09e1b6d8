"""Figures. The only module that imports matplotlib; every function returns a `matplotlib.figure.Figure`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from .analysis import Sensitivity
from .behaviour import Experiment, Outcome, Verdict
from .identify import Comparison, FitResult, InputDesign, Profile, Record, Score

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


def fit_figure(
    result: FitResult, *, record: int = 0, quantity: str = "position", unit: str = "m", caption: str = ""
) -> Figure:
    """Measured and simulated against time, and their difference.

    **Arguments:**

    - `result`: the fit of one channel.
    - `record`: number of the record that is drawn.
    - `quantity`, `unit`: what was measured.
    - `caption`: a line for the source of the record.
    """
    (residual,) = result.residuals[record].values()
    return _followed(result.records[record], residual, "simulated, open loop", quantity, unit, caption)


def score_figure(score: Score, *, quantity: str = "position", unit: str = "m", caption: str = "") -> Figure:
    """A fitted model on a record that it was not fitted to: measured and simulated, and their difference.

    **Arguments:**

    - `score`: from `FitResult.score`, of one channel.
    - `quantity`, `unit`: what was measured.
    - `caption`: a line for the source of the record.
    """
    (residual,) = score.residuals.values()
    return _followed(score.record, residual, "simulated, not fitted to it", quantity, unit, caption)


def _followed(record: Record, residual: np.ndarray, label: str, quantity: str, unit: str, caption: str) -> Figure:
    figure = Figure(figsize=(11, 6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    above.plot(record.t, record.measured, color=_GREY, lw=2.4, label="measured")
    above.plot(record.t, record.measured + residual, color=_RED, lw=1.1, label=label)
    factor, small = _small_unit(unit)
    rmse = f"RMSE {factor * float(np.sqrt(np.mean(residual**2))):.3g} {small}"
    above.set(ylabel=f"{quantity} [{unit}]", title=f"{record.name}: {rmse}")
    above.legend(loc="upper right")
    below.plot(record.t, factor * residual, color=_BLUE, lw=1.0)
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


def design_figure(design: InputDesign, *, caption: str = "") -> Figure:
    """A designed input with its limits, and the errors it promises beside those of a plain sine.

    **Arguments:**

    - `design`: from `jaxmodsim.identify.design_input`.
    - `caption`: a line below.
    """
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1.35, 1))[0]
    axes = left.subplots(3, 1, sharex=True)
    (factor, small), limits, start = _small_unit("m"), design.limits, design.q_ref[0]
    panels = (
        ("position", small, factor, design.q_ref, design.plain.q_ref, limits.travel, start),
        ("velocity", "m/s", 1.0, design.qd_ref, design.plain.qd_ref, limits.speed, 0.0),
        ("force", "N", 1.0, design.force, design.plain.force, limits.force, 0.0),
    )
    for axis, (quantity, unit, scale, best, plain, limit, middle) in zip(axes, panels, strict=True):
        axis.plot(design.t, scale * plain, color="#c8c8c8", lw=1.2, label="plain sine")
        axis.plot(design.t, scale * best, color=_BLUE, lw=1.3, label="designed")
        for side in (-1.0, 1.0) if limit is not None else ():
            level = scale * (middle + side * (limit or 0.0))
            axis.axhline(level, color=_RED, lw=1.0, ls="--", label="limit" if side > 0 else "_")
        axis.set(ylabel=f"{quantity} [{unit}]")
    axes[-1].set_xlabel("time [s]")
    handles = {str(line.get_label()): line for axis in axes for line in axis.get_lines()}
    shown = {label: line for label, line in handles.items() if not label.startswith("_")}
    left.legend(list(shown.values()), list(shown), loc="outside upper center", ncols=3, fontsize=9)
    _error_bars(right.subplots(), design)
    if caption:
        figure.supxlabel(caption, fontsize=8, color=_GREY)
    return figure


def _error_bars(axis: Axes, design: InputDesign) -> None:
    """Predicted relative errors, designed against plain; a number that is zero has none and is left out."""
    names = [name for name, value in design.values.items() if value]
    pairs = (("plain sine", "#c8c8c8", design.plain.errors, 0.2), ("designed", _BLUE, design.errors, -0.2))
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
    axis.set_title(f"{design.t[-1] - design.t[0]:g} s, noise {design.noise:g}", fontsize=10)
    axis.invert_yaxis()


def result_figure(result: FitResult, *, record: int = 0, units: Mapping[str, str] | None = None) -> Figure:
    """A fit on one page: record and residual, its autocorrelation, how sure the parameters are, and their correlation.

    **Arguments:**

    - `result`: the fit.
    - `record`: number of the record that is drawn.
    - `units`: of the channels by name, for the axes.

    **Raises:**

    - `ValueError` if there is no such record or channel.
    """
    if not 0 <= record < len(result.records):
        raise ValueError(f"record must be 0 to {len(result.records) - 1}, but it is {record}.")
    channels = list(result.outputs[record])
    units = dict(units or {})
    if set(units) - set(result.rmse_by):
        raise ValueError(f"units names {', '.join(units)}, but the channels are: {', '.join(result.rmse_by)}.")
    figure = Figure(figsize=(14, 3.0 + 3.4 * max(len(channels), 2)), layout="constrained")
    left, right = np.ravel(figure.subfigures(1, 2, squeeze=False, width_ratios=(1.25, 1)))
    rows = left.subplots(2 * len(channels), 1, sharex=True, squeeze=False, height_ratios=(2, 1) * len(channels))[:, 0]
    for channel, above, below in zip(channels, rows[::2], rows[1::2], strict=True):
        _channel_panels(above, below, result, record, channel, units.get(channel, ""))
    rows[-1].set_xlabel("time [s]")
    size = 0.6 + 0.32 * len(result.values)
    memory, sure, alike = right.subplots(3, 1, height_ratios=(2.0, size, 1.3 * size + 1.0))
    _memory_panel(memory, result, record)
    _interval_panel(sure, result)
    _correlation_panel(alike, result)
    figure.suptitle(f"{result.records[record].name}: {result.ending}, {result.evaluations} evaluations")
    return figure


def _channel_panels(above: Axes, below: Axes, result: FitResult, number: int, channel: str, unit: str) -> None:
    record, residual = result.records[number], result.residuals[number][channel]
    factor, small = _small_unit(unit)
    name = channel if channel != "measured" else "output"
    above.plot(record.t, record.channels[channel], color="#b4b4b4", lw=3.2, label="measured")
    above.plot(record.t, result.outputs[number][channel], color=_RED, lw=1.1, label="simulated")
    rmse = factor * float(np.sqrt(np.mean(residual**2)))
    above.set(ylabel=_with_unit(name, unit), title=f"{name}: RMSE {rmse:.3g} {small}".rstrip())
    above.legend(loc="upper right", fontsize=8)
    below.plot(record.t, factor * residual, color=_BLUE, lw=0.8)
    below.axhline(0.0, color=_GREY, lw=0.6)
    below.set(ylabel=_with_unit("residual", small))


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _memory_panel(axis: Axes, result: FitResult, number: int) -> None:
    """Autocorrelation of the residuals with the band that white noise would stay in."""
    record = result.records[number]
    interval = float(np.median(np.diff(record.t)))
    colours = (_BLUE, _RED, _GREEN, "#7b4fa3", "#b8860b")
    tests = [each for each in result.residual_tests().channels if each.record == record.name]
    for each, colour in zip(tests, colours * (1 + len(tests) // len(colours)), strict=False):
        lags = interval * np.arange(len(each.autocorrelation))
        label = f"{each.channel}: p = {each.whiteness:.2g} (white)"
        axis.plot(lags, each.autocorrelation, color=colour, lw=1.0, label=label)
    band = 1.96 / np.sqrt(len(record.t))
    axis.axhspan(-band, band, color=_GREY, alpha=0.3, lw=0, label="95 % of white noise")
    axis.axhline(0.0, color=_GREY, lw=0.6)
    axis.set(xlabel="lag [s]", ylabel="autocorrelation", title="Residual: autocorrelation")
    axis.legend(loc="upper right", fontsize=8)


def _interval_panel(axis: Axes, result: FitResult) -> None:
    """Half-widths of the intervals relative to the values, in a logarithm, with the figures beside."""
    names, intervals = list(result.values), result.intervals()
    shares = []
    for name in names:
        scale = abs(result.values[name]) or abs(result.start[name]) or 1.0
        low, high = intervals[name]
        shares.append(100 * max(result.values[name] - low, high - result.values[name]) / scale)
    known = [x for x in shares if np.isfinite(x) and x > 0]
    # Bars in the left half, figures in the right one.
    first, last = (float(np.log10(x)) for x in (min(known, default=1.0), max(known, default=1.0)))
    first, last = np.floor(first - 0.3), np.ceil(last + 0.1)
    for i, (name, share) in enumerate(zip(names, shares, strict=True)):
        open_ = not np.isfinite(share)
        colour = _RED if open_ or share > 100 else "#b8860b" if share > 20 else _GREEN
        axis.barh(i, 10.0**last if open_ else max(share, 10.0**first), left=0.0, color=colour, height=0.6)
        value, (low, high) = result.values[name], intervals[name]
        text = f"{value:.5g} (-{value - low:.2g}, +{high - value:.2g}) {result.units[name]}"
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
    names, correlation = list(result.values), result.correlation
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


def profile_figure(profile: Profile) -> Figure:
    """The profile likelihood of a parameter, and the other parameters along it.

    **Arguments:**

    - `profile`: from `FitResult.profile`.
    """
    others = {name: x for name, x in profile.others.items() if x.size}
    figure = Figure(figsize=(8, 4.0 + (2.6 if others else 0.0)), layout="constrained")
    axes = figure.subplots(2 if others else 1, 1, sharex=True, squeeze=False)[:, 0]
    above = axes[0]
    above.plot(profile.values, profile.ratio, color=_BLUE, marker=".", label="profile")
    if np.isfinite(profile.error) and profile.error > 0:
        low, over = profile.floor or 0.0, profile.estimate - (profile.floor or 0.0)
        if profile.floor is None:
            x = np.linspace(profile.values[0], profile.values[-1], 200)
            shift = x - profile.estimate
        else:
            x = low + np.geomspace(profile.values[0] - low, profile.values[-1] - low, 200)
            shift = over * np.log((x - low) / over)
        above.plot(x, (shift / profile.error) ** 2, color=_GREY, ls="--", lw=1.0, label="linear model (standard error)")
    above.axhline(profile.threshold, color=_RED, lw=1.0, label=f"{100 * profile.level:g} % level")
    low, high = (min(max(x, profile.values[0]), profile.values[-1]) for x in profile.interval)
    above.axvspan(low, high, color=_GREEN, alpha=0.15, lw=0, label="interval")
    top = max(1.6 * profile.threshold, 1.05 * float(np.min(profile.ratio[[0, -1]])))
    above.set(ylim=(min(-0.03 * top, float(np.min(profile.ratio))), top), ylabel="likelihood ratio")
    above.set_title("\n".join([f"Profile of {profile.name}", *profile.notes]), fontsize=10)
    above.legend(fontsize=8)
    here = int(np.argmin(np.abs(profile.values - profile.estimate)))
    for name, x in others.items():
        scale = abs(x[here]) or 1.0
        axes[-1].plot(profile.values, 100 * (x - x[here]) / scale, marker=".", ms=4, lw=1.0, label=name)
    if others:
        axes[-1].set_ylabel("others, change [%]")
        if max(float(np.max(np.abs(x / (x[here] or 1.0) - 1))) for x in others.values()) > 10:
            axes[-1].set_yscale("symlog", linthresh=10.0)
        axes[-1].legend(fontsize=8)
    ratio = profile.values[-1] / profile.values[0] if profile.values[0] > 0 else 0.0
    if ratio > 20:
        above.set_xscale("log")
    axes[-1].set_xlabel(_with_unit(profile.name, profile.unit))
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
