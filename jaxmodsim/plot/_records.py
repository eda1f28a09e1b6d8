"""Records against models."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes

from ..identify import FitResult, Record, RecordPrediction, Score
from ._figure import Figure
from ._style import BLUE, GREEN, GREY, RED, legend_above, legend_beside, panel_letters, small_unit


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
    rmse = float(np.sqrt(np.mean(residual**2)))
    shown = result.provenance.records[record]
    return _followed(shown, residual, rmse, "simulated, open loop", quantity, unit, caption)


def score_figure(
    score: Score | RecordPrediction, *, quantity: str = "position", unit: str = "m", caption: str = ""
) -> Figure:
    """A fitted model on a record that it was not fitted to: measured and simulated, and their difference.

    **Arguments:**

    - `score`: from `jaxmodsim.identify.evaluate_on` or `predict`, of one channel; the latter with its band.
    - `quantity`, `unit`: what was measured.
    - `caption`: a line for the source of the record.
    """
    prediction = score if isinstance(score, RecordPrediction) else None
    shown = score.score if isinstance(score, RecordPrediction) else score
    (residual,), (rmse,) = shown.residuals.values(), shown.rmse.values()
    figure = _followed(shown.record, residual, rmse, "simulated, only its start fitted", quantity, unit, caption)
    if prediction is not None:
        _add_band(figure, prediction, small_unit(unit)[0])
    return figure


def _add_band(figure: Figure, prediction: RecordPrediction, factor: float) -> None:
    """The band of a prediction, in both panels; in the lower one around the measured values."""
    (lower,), (upper,), (share,) = prediction.lower.values(), prediction.upper.values(), prediction.shares.values()
    (above, below), (output,) = figure.axes, prediction.score.outputs.values()
    t, level = prediction.score.record.t, 100 * prediction.level
    label = f"band for {level:g} % of the samples: it holds {100 * share:.0f} %"
    above.fill_between(t, lower, upper, color=GREEN, alpha=0.25, lw=0, label=label)
    below.fill_between(t, factor * (lower - output), factor * (upper - output), color=GREEN, alpha=0.25, lw=0)
    above.legend(loc="upper right")


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
    """Friction force against displacement, measured and modelled.

    **Arguments:**

    - `result`: a fit by `fit_law`.
    - `caption`: a line for the source of the record.
    """
    record, figure = result.record, Figure(figsize=(11, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    x = 1e6 * (record.inputs["x"] - np.mean(record.inputs["x"]))
    left.plot(x, record.measured, color=GREY, lw=0.7, label="measured")
    left.plot(x, result.simulated, color=RED, lw=0.7, label="modelled")
    left.set(
        xlabel="displacement about its mean [um]",
        ylabel="friction force [N]",
    )
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
    """Fitted against true parameters, each relative to the truth, with 95 % intervals.

    **Arguments:**

    - `result`: the fit.
    - `truth`: true values by the names of the fit, not zero.
    """
    figure = Figure(figsize=(7.5, 0.9 + 0.45 * len(truth)), layout="constrained")
    axis: Axes = figure.subplots()
    for i, (name, true) in enumerate(truth.items()):
        centre, half = 100 * (result.values[name] / true - 1), 196 * result.errors[name] / abs(true)
        axis.errorbar(centre, i, xerr=half, fmt="o", color=BLUE, capsize=4)
    axis.axvline(0.0, color=GREEN, lw=1.5, label="truth")
    axis.set_yticks(range(len(truth)), list(truth))
    axis.set(xlabel="estimate relative to truth [%], bars: 95 % interval", title="LuGre fitted to a synthetic record")
    axis.invert_yaxis()
    legend_beside(axis)
    return figure
