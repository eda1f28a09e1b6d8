"""The report on a fit: one HTML page with its figures inside, no scripts, no network."""

import base64
import io

import jinja2
import pandas as pd

from .._core.readable import table_of
from ..identify import residual_tests, warnings_for
from ..plot import Figure, comparison_figure, design_figure, fit_figure, profile_figure, result_figure, score_figure
from ._outcome import FitOutcome, record_table
from ._output import frame_of

# Magnitude of a correlation above which its cell is marked.
_STRONG = 0.9


def report_page(outcome: FitOutcome) -> str:
    """The page. All text that comes from files or the command line is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxmodsim.cli", "."), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"html": _html, "png": _png, "own_table": table_of}
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
        warnings=warnings_for(result),
        held=", ".join(f"{name} = {value:.6g}" for name, value in outcome.held.items()),
        figures=figures,
        residual_tests=residual_tests(result),
        strong=_STRONG,
        scores=[(f"{x.score.record.name}, held out", score_figure(x, **measured), x) for x in outcome.predictions],
        comparison=outcome.comparison and comparison_figure(outcome.comparison),
        profiles=[(profile, profile_figure(profile)) for profile in outcome.profiles],
        design=outcome.design and design_figure(outcome.design),
    )


def _html(frame: pd.DataFrame) -> str:
    with pd.option_context("display.max_colwidth", None):
        return frame.to_html(index=False, border=0, na_rep="-", float_format="{:.5g}".format)


def _png(figure: Figure) -> str:
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=110)
    return base64.b64encode(drawn.getvalue()).decode("ascii")
