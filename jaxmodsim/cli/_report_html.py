"""One HTML file on a fit that needs nothing else: figures inside, no scripts, no network."""

import base64
import io
import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import numpy as np
import pandas as pd

from ..identify import Comparison, FitResult, InputDesign, Profile, Score, remarks, residual_tests
from ..plot import Figure, comparison_figure, design_figure, fit_figure, profile_figure, result_figure, score_figure
from ._equations import equations
from ._fitted import Findings, Fitted, design_table, model_table, parameter_table, record_table

# Correlations from which on a cell is marked.
_STRONG = 0.9

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c1c1c; max-width: 62rem; margin: 2rem auto; padding: 0 1rem }
h1 { font-size: 1.6rem; margin-bottom: .2rem }
h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid #ccc }
table { display: block; overflow-x: auto }
table { border-collapse: collapse; margin: .8rem 0; font-size: .85rem; font-variant-numeric: tabular-nums }
th, td { padding: .2rem .7rem; border-bottom: 1px solid #e2e2e2; text-align: left }
td { white-space: nowrap }
th { border-bottom: 1px solid #888 }
td.number, th.number { text-align: right }
td.strong { background: #f6ddd6; font-weight: 600 }
pre { background: #f5f5f5; padding: .7rem; white-space: pre-wrap; font-size: .8rem }
figure { margin: 1rem 0; break-inside: avoid }
img { max-width: 100% }
figcaption, .small { color: #555; font-size: .85rem }
h2 { break-after: avoid }
@media print { body { font-size: 11px; margin: 0; max-width: none } }
"""


def report_page(findings: Findings) -> str:
    """The page. All that comes from files or the command line is escaped."""
    fitted = findings.fitted
    result = fitted.result
    title = f"Fit of {', '.join(record.name for record in result.provenance.records)}: {fitted.model}"
    parts = [
        _head(findings),
        _section("Records", _frame(record_table(fitted)), _note(_start_words(fitted))),
        _section("Model", *_model(fitted)),
        _section("Parameters", _frame(parameter_table(result)), _note(_sure_words(result))),
        _section("What the records cannot tell", _list(remarks(result), "Nothing to remark.")),
        _section("Measured and simulated", *_followed(result)),
        _section("What is left in the residual", *_residuals(result)),
        _section("Correlation of the parameters", _correlation(result)),
    ]
    if fitted.scores:
        parts.append(_section("Records that were held out", *_held_out(fitted.scores)))
    if fitted.comparison is not None:
        parts.append(_section("Comparison of models", *_compared(fitted.comparison)))
    if findings.profiles:
        parts.append(_section("Profile likelihood of the least known parameters", *_profiles(findings.profiles)))
    if findings.design is not None:
        parts.append(_section("The next record", *_next(findings, findings.design)))
    body = "\n".join(parts)
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n<h1>{escape(title)}</h1>\n{body}\n</body>\n</html>\n"
    )


def _head(findings: Findings) -> str:
    result, origin = findings.fitted.result, findings.origin
    rmse = (
        f"RMSE {1e3 * result.rmse:.4g} mm; {result.diagnostics.evaluations} evaluations, {result.diagnostics.ending}."
    )
    lines = [f"<p><strong>{escape(rmse)}</strong></p>", _pre(origin["command"])]
    return "\n".join([*lines, f'<p class="small">{escape(origin["date"])}. {escape(origin["versions"])}.</p>'])


def _start_words(fitted: Fitted) -> str:
    words = (
        "RMSE: root mean square of simulated less measured position, open loop. Each record starts from the position"
        " and velocity that its first 20 samples show."
    )
    if not fitted.scores:
        return words
    return words + " Of a record that was held out nothing is fitted but this start state."


def _sure_words(result: FitResult) -> str:
    return (
        "Standard errors allow for the correlation of the residual in time; they hold if the model is right but for"
        f" noise. Noise level: {1e3 * result.diagnostics.noise['measured']:.4g} mm."
    )


def _model(fitted: Fitted) -> list[str]:
    words = f"{fitted.description[:1].upper()}{fitted.description[1:]}."
    held = ", ".join(f"{name} = {value:.6g}" for name, value in fitted.held.items())
    equation = _pre("\n".join(equations(fitted.scene)))
    return [f"<p>{escape(words)}</p>", equation, _note(f"Not fitted: {held or 'nothing'}.")]


def _followed(result: FitResult) -> list[str]:
    """The first record with all that belongs to a fit, the others with their residuals."""
    first = _figure(result_figure(result, units={"measured": "m"}), result.provenance.records[0].name)
    others = range(1, len(result.provenance.records))
    return [first, *(_figure(fit_figure(result, record=i), result.provenance.records[i].name) for i in others)]


def _residuals(result: FitResult) -> list[str]:
    tests = residual_tests(result)
    parts = []
    for each in tests.channels:
        sentences = each.remarks or ("It looks like noise.",)
        parts.append(f"<p>{escape(each.record)}:</p>{_list(sentences)}")
    return [*parts, f"<details><summary>All tests</summary>{_pre(str(tests))}</details>"]


def _correlation(result: FitResult) -> str:
    names, matrix = list(result.values), result.estimate.correlation
    head = "".join(f'<th class="number">{escape(name)}</th>' for name in names)
    rows = []
    for i, name in enumerate(names):
        cells = [_shaded(float(matrix[i, j]), i != j) for j in range(i + 1)]
        rows.append(f"<tr><th>{escape(name)}</th>{''.join(cells)}{'<td></td>' * (len(names) - i - 1)}</tr>")
    return f"<table><tr><th></th>{head}</tr>{''.join(rows)}</table>"


def _shaded(correlation: float, off: bool) -> str:
    strong = " strong" if off and abs(correlation) > _STRONG else ""
    return f'<td class="number{strong}">{correlation:+.3f}</td>'


def _held_out(scores: Iterable[Score]) -> list[str]:
    return [_figure(score_figure(score), f"{score.record.name}, never fitted") for score in scores]


def _profiles(profiles: Sequence[Profile]) -> list[str]:
    return [part for each in profiles for part in (_pre(str(each)), _figure(profile_figure(each), each.name))]


def _compared(comparison: Comparison) -> list[str]:
    told = [comparison.conclusion, f"Held back: {comparison.by}."]
    told += [f"{name} failed: {reason}" for name, reason in comparison.failures.items()]
    told += [f"{name} was not finished." for name in comparison.left]
    drawn = _figure(comparison_figure(comparison), "Root mean square errors of the models")
    return [_frame(model_table(comparison)), _list(told), drawn]


def _next(findings: Findings, design: InputDesign) -> list[str]:
    used = ", ".join(f"{name} {100 * share:.0f} %" for name, share in design.used.items())
    told = [
        f"{len(design.t)} samples over {design.t[-1] - design.t[0]:g} s; limits: {design.limits}; used: {used}.",
        f"Noise reckoned with: {1e3 * design.noise:.4g} mm, the residual of this fit.",
        *design.remarks,
    ]
    drawn = _figure(design_figure(design), "Designed input: position, velocity and force")
    return [_frame(design_table(findings, design)), _list(told), drawn]


def _section(title: str, *parts: str) -> str:
    body = "\n".join(parts)
    return f"<section>\n<h2>{escape(title)}</h2>\n{body}\n</section>"


def _figure(figure: Figure, caption: str) -> str:
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=110)
    data = base64.b64encode(drawn.getvalue()).decode("ascii")
    words = escape(caption)
    return f'<figure><img alt="{words}" src="data:image/png;base64,{data}"><figcaption>{words}</figcaption></figure>'


def _frame(frame: pd.DataFrame) -> str:
    kinds = ["number" if pd.api.types.is_numeric_dtype(frame[column]) else "" for column in frame.columns]
    head = "".join(f'<th class="{kind}">{escape(str(c))}</th>' for c, kind in zip(frame.columns, kinds, strict=True))
    rows = []
    for row in frame.itertuples(index=False):
        cells = (f'<td class="{kind}">{escape(_cell(x))}</td>' for x, kind in zip(row, kinds, strict=True))
        rows.append(f"<tr>{''.join(cells)}</tr>")
    return f"<table><tr>{head}</tr>{''.join(rows)}</table>"


def _cell(x: Any) -> str:
    if isinstance(x, float | np.floating):
        return "-" if math.isnan(x) else f"{x:.5g}"
    return str(x)


def _list(sentences: Iterable[str], without: str = "") -> str:
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
    return f"<ul>{items}</ul>" if items else f"<p>{escape(without)}</p>"


def _pre(text: str) -> str:
    return f"<pre>{escape(text)}</pre>"


def _note(text: str) -> str:
    return f'<p class="small">{escape(text)}</p>'
