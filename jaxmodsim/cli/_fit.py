"""`jaxmodsim fit`: one axis, from records of position and applied force."""

import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from .._core.progress import candidate_words, iteration_words, progress_line
from ..analysis import formulations
from ..identify import (
    AxisLimits,
    Comparison,
    FitResult,
    InputDesign,
    Profile,
    Record,
    agreement,
    compare,
    design_input,
    estimate_axis,
    fit,
    is_step_size_limited,
    predict,
    prediction_error,
    profile,
    remarks,
)
from ..plot import comparison_figure, design_figure, fit_figure, score_figure
from ..scene import Scene, scene_numbers
from ._fitted import (
    Findings,
    Fitted,
    agreement_table,
    headline,
    origin,
    parameter_table,
    record_table,
    sample_table,
    summary,
    with_units,
)
from ._options import Interrupted
from ._output import Content, say, show_paths, show_table, write
from ._plan import FitRequest, Plan, plan_of
from ._report_html import report_page

# Integration steps between two samples are raised by this factor, to so many at most.
_FINER, _MOST_SUBSTEPS = 4, 64
# Width of friction made smooth for the design of an input, in top speeds.
_SMOOTH = 1e-3
# Parameters whose likelihood a report profiles, and about how many points on either side.
_PROFILED, _POINTS = 2, 4


def run_fit(request: FitRequest) -> None:
    """Fit, print, and write what was asked for; each part as soon as it is there.

    **Raises:**

    - `ValueError` as `plan_of` does.
    - `Interrupted` after Ctrl-C, once all that was computed is written.
    """
    plan = plan_of(request)
    fitted = _fitted(plan)
    _show(fitted)
    findings = Findings(fitted, (), None, origin())
    paths = write(request.out, _files(findings))
    interrupted = fitted.interrupted
    profiles: tuple[Profile, ...] = ()
    design = None
    try:
        if request.report is not None and not interrupted:
            better, profiles = _profiled(fitted)
            if better is not fitted:
                fitted = better
                _show(fitted)
                findings = Findings(fitted, profiles, None, findings.origin)
                write(request.out, _files(findings))
        if request.next_input is not None:
            design = _designed(request, fitted)
            say(f"Next input, for {request.next_input}:\n{design}")
            paths += write(request.next_input.parent, {request.next_input.name: design})
            paths += write(request.out, {"next.png": design_figure(design), "next.json": design.to_dict()})
            interrupted = interrupted or design.ending == "was interrupted"
    except KeyboardInterrupt:
        interrupted = True
    if request.report is not None:
        findings = Findings(fitted, profiles, design, findings.origin)
        paths += write(request.report, {"report.html": report_page(findings)})
    show_paths(paths)
    if interrupted:
        raise Interrupted("interrupted; what was found until then is written")


def _fitted(plan: Plan) -> Fitted:
    """Fit the one model, or compare several; with more integration steps between samples as long as these show."""
    started = time.perf_counter()
    substeps = plan.substeps or 1
    fitted = _fitted_with(plan, substeps)
    may_refine = plan.substeps is None
    while may_refine and substeps < _MOST_SUBSTEPS and is_step_size_limited(fitted.result) and not fitted.interrupted:
        substeps *= _FINER
        fitted = _fitted_with(plan, substeps)
    judged = _judged(replace(fitted, substeps=substeps))
    return replace(judged, seconds=time.perf_counter() - started)


def _judged(fitted: Fitted) -> Fitted:
    """With predictions, the agreement of the records, and the error to expect: not for whoever pressed Ctrl-C."""
    if fitted.interrupted:
        return fitted
    agreed = agreement(fitted.result) if len(fitted.plan.records) > 1 else None
    return replace(
        fitted,
        predictions=tuple(predict(fitted.result, record, agreement=agreed) for record in fitted.plan.held_out),
        agreement=agreed,
        expected=prediction_error(fitted.result, agreement=agreed)["measured"],
    )


def _fitted_with(plan: Plan, substeps: int) -> Fitted:
    """Fit the one model, or compare several and take the simplest that is as good as the best.

    A model is fitted in the same way alone and among others, so that its numbers are the same.
    """
    if plan.compared:
        comparison = _compared(plan, substeps)
        model = comparison.simplest
        return Fitted(plan, model, with_units(comparison.results[model], plan.rotary), comparison)
    ((model, candidate),) = plan.candidates.items()
    scene, free = candidate.scene, candidate.free
    assert isinstance(scene, Scene)
    assert free is not None
    result = fit_with_progress(scene, plan.records, free, limits=plan.limits, substeps=substeps, **plan.options)
    return Fitted(plan, model, with_units(result, plan.rotary))


@contextmanager
def _ctrl_c() -> Iterator[Callable[[], None]]:
    """Ctrl-C ends all searches of a fit, where it would only end the one that goes on; yields what ends the others."""
    before = signal.getsignal(signal.SIGINT)
    pressed = threading.Event()

    def press(*_: object) -> None:
        pressed.set()
        raise KeyboardInterrupt

    def end() -> None:
        if pressed.is_set():
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, press)
    try:
        yield end
    finally:
        signal.signal(signal.SIGINT, before)


def _compared(plan: Plan, substeps: int) -> Comparison:
    judged: dict[str, Any] = {"hold_out": plan.held_out} if plan.folds is None else {"folds": plan.folds}
    with progress_line("compare") as show, _ctrl_c() as end:

        def progress(name: str, fold: int | None, step: int, rms: float) -> None:
            show(candidate_words(name, fold, step, rms))
            end()

        options = {**judged, **plan.options, "substeps": substeps, "progress": progress}
        return compare(plan.candidates, plan.records, limits=plan.limits, **options)


def fit_with_progress(
    scene: Scene, records: Record | Sequence[Record], free: Sequence[str], **options: Any
) -> FitResult:
    """`fit` with a line that shows how it goes."""
    with progress_line("fit") as show, _ctrl_c() as end:

        def progress(step: int, rms: float, values: dict[str, float]) -> None:
            show(iteration_words(step, rms, values))
            end()

        return fit(scene, records, free, progress=progress, **options)


def _show(fitted: Fitted) -> None:
    result = fitted.result
    for line in headline(fitted):
        say(line)
    if fitted.comparison is not None:
        say(str(fitted.comparison))
    names = ", ".join(record.name for record in result.provenance.records)
    show_table(parameter_table(result), f"{names}: {fitted.model}, {fitted.description}")
    if len(result.provenance.records) + len(fitted.scores) > 1:
        show_table(record_table(fitted), "Records")
    if fitted.agreement is not None:
        show_table(agreement_table(fitted.agreement), "What the records have in common, and what varies")
    how = result.diagnostics
    say(f"RMSE {result.rmse:.6g} {fitted.unit}; {how.evaluations} evaluations, {how.ending}")
    for remark in remarks(result):
        say(f"- {remark}")
    samples = sum(len(record.t) for record in result.provenance.records)
    steps = f"{fitted.substeps} integration step{'s' if fitted.substeps > 1 else ''} from one to the next"
    say(f"{samples} samples, {steps}; {fitted.seconds:.1f} s with compilation")


def _files(findings: Findings) -> dict[str, Content]:
    """Figures, tables, JSON and the result by file name."""
    fitted, result = findings.fitted, findings.fitted.result
    files: dict[str, Content] = {}
    single, seen = len(result.provenance.records) == 1, fitted.measured
    for i, record in enumerate(result.provenance.records):
        files["fit.png" if single else f"fit_{_numbered(i, record)}.png"] = fit_figure(result, record=i, **seen)
    for i, held_out in enumerate(fitted.predictions):
        files[f"held_out_{_numbered(i, held_out.score.record)}.png"] = score_figure(held_out, **seen)
    if fitted.comparison is not None:
        files["comparison.png"] = comparison_figure(fitted.comparison)
    return {
        **files,
        "fit.csv": sample_table(fitted),
        "fit.json": summary(findings),
        "fit.npz": result,
    }


def _numbered(i: int, record: Record) -> str:
    """A part of a file name that is like the record's, and differs from all others."""
    alike = re.sub(r"[^\w.-]+", "_", record.name)
    return f"{i + 1}_{alike}"


def _profiled(fitted: Fitted) -> tuple[Fitted, tuple[Profile, ...]]:
    """Profiles of the least known parameters, and the fit that they are of: a better one, where one came upon it."""
    profiles: list[Profile] = []
    for name in _least_known(fitted):
        with progress_line("likelihood profile", name):
            profiles.append(profile(fitted.result, name, points=_POINTS))
        if profiles[-1].result is not fitted.result:
            say(f"{profiles[-1].notes[-1]} This is the fit from here on:")
            return _profiled(_judged(replace(fitted, result=profiles[-1].result)))
    return fitted, tuple(profiles)


def _least_known(fitted: Fitted) -> list[str]:
    """Parameters of the scene with the largest relative standard errors that are finite and off their limits."""
    result = fitted.result
    numbers = scene_numbers(fitted.scene)
    shares = {
        name: result.errors[name] / abs(value)
        for name, value in result.values.items()
        if name in numbers and value and value not in result.estimate.bounds[name]
    }
    known = [name for name, share in shares.items() if 0 < share < np.inf]
    return sorted(known, key=lambda name: -shares[name])[:_PROFILED]


def _designed(request: FitRequest, fitted: Fitted) -> InputDesign:
    """An input for the next record: limits and duration by default those of the records, the noise that of the fit."""
    result, records = fitted.result, fitted.result.provenance.records
    positions = np.concatenate([record.measured for record in records])
    low, high = float(np.min(positions)), float(np.max(positions))
    top = request.max_speed or max(estimate_axis(record).top for record in records if np.ptp(record.measured) > 0)
    limits = AxisLimits(
        request.max_force or max(float(np.max(np.abs(record.inputs["u"]))) for record in records),
        top,
        request.max_travel or 0.5 * (high - low),
        rotary=fitted.plan.rotary,
    )
    numbers, scene = scene_numbers(fitted.scene), fitted.scene
    if scene.event_driven:  # which a design by derivatives of all samples cannot pass
        scene = formulations(scene, width=_SMOOTH * top)["Regularized"]
    design = design_input(
        scene,
        [name for name in result.values if name in numbers],
        limits,
        duration=request.duration or max(float(record.t[-1] - record.t[0]) for record in records),
        noise=result.diagnostics.noise["measured"],
        dt=float(np.median(np.diff(records[0].t))),
        q0=[0.5 * (low + high)],
        progress=True,
    )
    return replace(design, units={name: result.estimate.units[name] for name in design.values})
