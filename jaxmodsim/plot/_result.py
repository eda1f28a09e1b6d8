"""A fit on one page."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes

from ..identify import FitResult, residual_tests
from ._figure import Figure
from ._style import BLUE, COLOURS, GREEN, GREY, RED, legend_above, panel_letters, small_unit, with_unit


def result_figure(result: FitResult, *, record: int = 0, units: Mapping[str, str] | None = None) -> Figure:
    """A fit on one page: record and residual, its autocorrelation, how sure the parameters are, and their correlation.

    **Arguments:**

    - `result`: the fit.
    - `record`: number of the record that is drawn.
    - `units`: of the channels by name, for the axes.

    **Raises:**

    - `ValueError` if there is no such record or channel.
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
    memory, sure, alike = right.subplots(3, 1, height_ratios=(2.0, size, 1.3 * size + 1.0))
    _memory_panel(memory, result, record)
    _interval_panel(sure, result)
    _correlation_panel(alike, result)
    panel_letters((*rows, memory, sure, alike))
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


def _memory_panel(axis: Axes, result: FitResult, number: int) -> None:
    """Autocorrelation of the residuals with the band that white noise would stay in."""
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
    """Half-widths of the intervals relative to the values, in a logarithm, with the figures beside."""
    names, intervals = list(result.values), result.estimate.intervals()
    shares = []
    for name in names:
        scale = abs(result.values[name]) or abs(result.estimate.start[name]) or 1.0
        low, high = intervals[name]
        shares.append(100 * max(result.values[name] - low, high - result.values[name]) / scale)
    known = [x for x in shares if np.isfinite(x) and x > 0]
    # Bars in the left half, figures in the right one.
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
