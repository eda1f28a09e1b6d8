"""One HTML file on a fit that needs nothing else: figures inside, no scripts, no network."""

import base64
import io
from collections.abc import Iterator

import jinja2
import pandas as pd
from markupsafe import Markup

from ..identify import Comparison, InputDesign, remarks, residual_tests
from ..plot import Figure, comparison_figure, design_figure, fit_figure, profile_figure, result_figure, score_figure
from ._equations import equations
from ._fitted import (
    Findings,
    Fitted,
    agreement_table,
    design_table,
    differences,
    headline,
    model_table,
    parameter_table,
    record_table,
)
from ._output import cell

# Magnitude of a correlation above which its cell is marked.
_STRONG = 0.9


def report_page(findings: Findings) -> str:
    """The page. All that comes from files or the command line is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxmodsim.cli", "."), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"head_and_rows": _head_and_rows, "png": _png}
    fitted = findings.fitted
    result = fitted.result
    return environment.get_template("report.html.jinja").render(
        title=f"Fit of {', '.join(record.name for record in result.provenance.records)}: {fitted.model}",
        result=result,
        headline=headline(fitted),
        notes=fitted.plan.notes,
        unit=fitted.unit,
        quantity=fitted.quantity,
        origin=findings.origin,
        records=record_table(fitted),
        parameters=parameter_table(result),
        model=f"{fitted.description[:1].upper()}{fitted.description[1:]}.",
        remarks=remarks(result),
        equations=equations(fitted.scene),
        held=", ".join(f"{name} = {value:.6g}" for name, value in fitted.held.items()),
        simulated=list(_simulated(fitted)),
        residual_tests=residual_tests(result),
        strong=_STRONG,
        scores=[
            (f"{each.score.record.name}, held out", score_figure(each, **fitted.measured))
            for each in fitted.predictions
        ],
        bands=[str(each) for each in fitted.predictions],
        agreement=None if fitted.agreement is None else agreement_table(fitted.agreement),
        differing=differences(fitted),
        comparison=None if fitted.comparison is None else _compared(fitted.comparison, fitted.unit),
        profiles=[(str(profile), profile.name, profile_figure(profile)) for profile in findings.profiles],
        design=None if findings.design is None else _designed(findings, findings.design),
    )


def _simulated(fitted: Fitted) -> Iterator[tuple[str, Figure]]:
    """The first record with all that belongs to a fit, the others with their residuals."""
    first, *others = fitted.result.provenance.records
    yield first.name, result_figure(fitted.result, units={"measured": fitted.unit})
    for i, record in enumerate(others, 1):
        yield record.name, fit_figure(fitted.result, record=i, **fitted.measured)


def _compared(comparison: Comparison, unit: str) -> dict[str, object]:
    sentences = [comparison.conclusion, f"Held back: {comparison.by}."]
    sentences += [f"{name} failed: {reason}" for name, reason in comparison.failures.items()]
    sentences += [f"{name} was not finished." for name in comparison.left]
    return {"table": model_table(comparison, unit), "sentences": sentences, "drawing": comparison_figure(comparison)}


def _designed(findings: Findings, design: InputDesign) -> dict[str, object]:
    t, used = design.best.t, ", ".join(f"{name} {100 * share:.0f} %" for name, share in design.used.items())
    sentences = [
        f"{len(t)} samples over {t[-1] - t[0]:g} s; limits: {design.limits}; used: {used}.",
        f"Noise reckoned with: {1e3 * design.noise:.4g} m{findings.fitted.unit}, the residual of this fit.",
        *design.remarks,
    ]
    return {"table": design_table(findings, design), "sentences": sentences, "drawing": design_figure(design)}


def _head_and_rows(frame: pd.DataFrame) -> tuple[list[tuple[str, str]], list[list[tuple[str, str]]]]:
    """Texts of a table, each with the attribute of its cell."""
    numeric = [pd.api.types.is_numeric_dtype(frame[column]) for column in frame.columns]
    kinds = [Markup(' class="number"') if number else "" for number in numeric]
    head = [(str(column), kind) for column, kind in zip(frame.columns, kinds, strict=True)]
    rows = frame.itertuples(index=False)
    return head, [[(cell(x), kind) for x, kind in zip(row, kinds, strict=True)] for row in rows]


def _png(figure: Figure) -> str:
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=110)
    return base64.b64encode(drawn.getvalue()).decode("ascii")
