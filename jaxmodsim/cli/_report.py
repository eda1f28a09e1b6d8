"""The report on a fit: one HTML page with its figures inside, no scripts, no network."""

import base64
import io

import jinja2
import pandas as pd

from ..identify import InputDesign, residual_tests, warnings_for
from ..plot import Figure, comparison_figure, design_figure, fit_figure, profile_figure, result_figure, score_figure
from ._outcome import FitOutcome, agreement_table, record_table
from ._output import frame_of

# Magnitude of a correlation above which its cell is marked.
_STRONG = 0.9


def report_page(outcome: FitOutcome) -> str:
    """The page. All text that comes from files or the command line is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxmodsim.cli", "."), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"html": _html, "png": _png}
    result, measured = outcome.result, outcome.measured
    first, *others = result.provenance.records
    figures = [(first.name, result_figure(result, units={"measured": measured["unit"]}))]
    figures += [(record.name, fit_figure(result, record=i, **measured)) for i, record in enumerate(others, 1)]
    intervals = result.estimate.intervals()
    parameters = [
        (name, value, error, *intervals[name], start, unit)
        for name, value, error, start, unit in result.estimate.rows()
    ]
    return environment.get_template("report.html.jinja").render(
        outcome=outcome,
        result=result,
        records=record_table(outcome),
        parameters=frame_of(parameters, "parameter", "value", "standard error", "95 % from", "to", "start", "unit"),
        remarks=warnings_for(result),
        held=", ".join(f"{name} = {value:.6g}" for name, value in outcome.held.items()),
        figures=figures,
        residual_tests=residual_tests(result),
        strong=_STRONG,
        scores=[(f"{x.score.record.name}, held out", score_figure(x, **measured), x) for x in outcome.predictions],
        agreement=None if outcome.agreement is None else agreement_table(outcome.agreement),
        comparison=_comparison(outcome),
        profiles=[(profile, profile_figure(profile)) for profile in outcome.profiles],
        design=None if outcome.design is None else _design(outcome.design, measured["unit"]),
    )


def _comparison(outcome: FitOutcome) -> dict[str, object] | None:
    compared, unit = outcome.comparison, f"RMSE [{outcome.measured['unit']}]"
    if compared is None:
        return None
    columns = {
        "name": "model",
        "parameters": "parameters",
        "held_back": f"held out, {unit}",
        "standard_error": "standard error",
        "expected": f"new record, {unit}",
        "over_the_best": "above the best",
        "over_the_best_standard_error": "its standard error",
        "start_fitted": f"start fitted, {unit}",
        "fitted": f"fitted, {unit}",
        "undetermined": "not determined",
    }
    table = pd.DataFrame(compared.table[: len(compared.ranked)])[list(columns)].astype({"start_fitted": float})
    table["undetermined"] = [", ".join(each.undetermined) or "-" for each in compared.ranked]
    table.columns = pd.Index(columns.values())
    sentences = [compared.conclusion, f"Held out: {compared.by}."]
    sentences += [f"{name} failed: {reason}" for name, reason in compared.failures.items()]
    sentences += [f"{name} was not finished." for name in compared.left]
    return {"table": table, "sentences": sentences, "drawing": comparison_figure(compared)}


def _design(design: InputDesign, unit: str) -> dict[str, object]:
    t, used = design.best.t, ", ".join(f"{name} {100 * share:.0f} %" for name, share in design.used.items())
    sentences = [
        f"{len(t)} samples over {t[-1] - t[0]:g} s; limits: {design.limits}; used: {used}.",
        f"Assumed noise: {1e3 * design.noise:.4g} m{unit}, the residual of this fit.",
        *design.remarks,
    ]
    table = frame_of(design.rows(), "parameter", "value", "predicted standard error", "of a plain sine", "unit")
    return {"table": table, "sentences": sentences, "drawing": design_figure(design)}


def _html(frame: pd.DataFrame) -> str:
    with pd.option_context("display.max_colwidth", None):
        return frame.to_html(index=False, border=0, na_rep="-", float_format="{:.5g}".format)


def _png(figure: Figure) -> str:
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=110)
    return base64.b64encode(drawn.getvalue()).decode("ascii")
