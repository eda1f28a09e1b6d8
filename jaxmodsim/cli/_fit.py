"""`jaxmodsim fit`: fit one axis to records of position and applied force."""

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
)
from ..plot import comparison_figure, design_figure, fit_figure, score_figure
from ..scene import Scene, scene_numbers
from ._options import FitRequest, Interrupted
from ._outcome import FitOutcome, record_table, sample_table, with_units
from ._output import Content, say, show_paths, show_table, write
from ._plan import FitPlan, plan_of
from ._report import report_page

# Factor by which integration steps between two samples are refined, and their largest number.
_FINER, _MOST_SUBSTEPS = 4, 64
# Width of the smooth friction for the design of an input, in top speeds.
_SMOOTH = 1e-3
# Number of parameters that a report profiles, and of points on either side.
_PROFILED, _POINTS = 2, 4


def run_fit(request: FitRequest) -> None:
    """Fit, print and write the results, each part as soon as it is computed.

    **Raises:**

    - `ValueError` as `plan_of`.
    - `Interrupted` after Ctrl-C, once all results are written.
    """
    outcome = _outcome_of(plan_of(request))
    _show(outcome)
    paths = write(request.out, _files(outcome))
    interrupted = outcome.interrupted
    try:
        if request.report is not None and not interrupted:
            fitted, outcome = outcome.result, _profiled(outcome)
            if outcome.result is not fitted:
                _show(outcome)
                write(request.out, _files(outcome))
        if request.next is not None:
            design = _designed(request, outcome)
            outcome = replace(outcome, design=design)
            say(f"Next input, for {request.next}:\n{design}")
            paths += write(request.next.parent, {request.next.name: design})
            paths += write(request.out, {"next.png": design_figure(design), "next.json": design.to_dict()})
            interrupted = interrupted or design.ending == "was interrupted"
    except KeyboardInterrupt:
        interrupted = True
    if request.report is not None:
        paths += write(request.report, {"report.html": report_page(outcome)})
    show_paths(paths)
    if interrupted:
        raise Interrupted("interrupted; the results so far are written")


def _outcome_of(plan: FitPlan) -> FitOutcome:
    """Fit the model, or compare several; refine the integration steps between samples until they have no effect."""
    started = time.perf_counter()
    substeps = plan.substeps or 1
    outcome = _fitted(plan, substeps)
    while plan.substeps is None and is_step_size_limited(outcome.result) and not outcome.interrupted:
        if substeps >= _MOST_SUBSTEPS:
            break
        substeps *= _FINER
        outcome = _fitted(plan, substeps)
    outcome = _validated(replace(outcome, substeps=substeps))
    return replace(outcome, seconds=time.perf_counter() - started)


def _fitted(plan: FitPlan, substeps: int) -> FitOutcome:
    """Fit the one model, or compare several and take the simplest one that is as good as the best.

    A model is fitted alone in the same way as among others, so that its numbers are the same.
    """
    options = {**plan.options, "substeps": substeps}
    if plan.compared:
        validation: dict[str, Any] = {"hold_out": plan.held_out} if plan.folds is None else {"folds": plan.folds}
        with _progress("compare", candidate_words) as report:
            comparison = compare(plan.candidates, plan.records, progress=report, **validation, **options)
        model = comparison.simplest
        return FitOutcome(plan, model, with_units(comparison.results[model], plan.rotary), comparison)
    ((model, candidate),) = plan.candidates.items()
    scene, free = candidate.scene, candidate.free
    assert isinstance(scene, Scene)
    assert free is not None
    return FitOutcome(plan, model, with_units(fit_with_progress(scene, plan.records, free, **options), plan.rotary))


def _validated(outcome: FitOutcome) -> FitOutcome:
    """Add predictions, the agreement of the records and the expected error, unless Ctrl-C was pressed."""
    if outcome.interrupted:
        return outcome
    agreed = agreement(outcome.result) if len(outcome.plan.records) > 1 else None
    return replace(
        outcome,
        predictions=tuple(predict(outcome.result, record, agreement=agreed) for record in outcome.plan.held_out),
        agreement=agreed,
        expected=prediction_error(outcome.result, agreement=agreed)["measured"],
    )


@contextmanager
def _progress(title: str, text_of: Callable[..., str]) -> Iterator[Callable[..., None]]:
    """A function that shows its reports in a line; Ctrl-C ends all searches, and not only the one in progress."""
    before, pressed = signal.getsignal(signal.SIGINT), threading.Event()

    def press(*_: object) -> None:
        pressed.set()
        raise KeyboardInterrupt

    with progress_line(title) as show:

        def report(*progress: Any) -> None:
            show(text_of(*progress))
            if pressed.is_set():
                raise KeyboardInterrupt

        signal.signal(signal.SIGINT, press)
        try:
            yield report
        finally:
            signal.signal(signal.SIGINT, before)


def fit_with_progress(
    scene: Scene, records: Record | Sequence[Record], free: Sequence[str], **options: Any
) -> FitResult:
    """`fit` with a progress line."""
    with _progress("fit", iteration_words) as report:
        return fit(scene, records, free, progress=report, **options)


def _show(outcome: FitOutcome) -> None:
    records = outcome.result.provenance.records
    for line in outcome.headline():
        say(line)
    if outcome.comparison is not None:
        say(str(outcome.comparison))
    say(f"\n{outcome.title}\n{outcome.result}")
    if len(records) + len(outcome.scores) > 1:
        show_table(record_table(outcome), "Records")
    if outcome.agreement is not None:
        say(f"\nAgreement of the records\n{outcome.agreement}")
    steps = f"{outcome.substeps} integration step{'s' if outcome.substeps > 1 else ''} from one to the next"
    samples = sum(len(record.t) for record in records)
    say(f"{samples} samples, {steps}; {outcome.seconds:.1f} s with compilation")


def _files(outcome: FitOutcome) -> dict[str, Content]:
    """Figures, tables, JSON and the result by file name."""
    result, files = outcome.result, {}
    for i, record in enumerate(result.provenance.records):
        name = "fit.png" if len(result.provenance.records) == 1 else f"fit_{_numbered(i, record)}.png"
        files[name] = fit_figure(result, record=i, **outcome.measured)
    for i, held_out in enumerate(outcome.predictions):
        files[f"held_out_{_numbered(i, held_out.score.record)}.png"] = score_figure(held_out, **outcome.measured)
    if outcome.comparison is not None:
        files["comparison.png"] = comparison_figure(outcome.comparison)
    return files | {"fit.csv": sample_table(outcome), "fit.json": outcome.summary(), "fit.npz": result}


def _numbered(i: int, record: Record) -> str:
    """A part of a file name, similar to the name of the record and unique."""
    similar = re.sub(r"[^\w.-]+", "_", record.name)
    return f"{i + 1}_{similar}"


def _profiled(outcome: FitOutcome) -> FitOutcome:
    """Add profiles of the least certain parameters; of a better fit, if a profile finds one."""
    profiles: list[Profile] = []
    for name in _least_certain(outcome):
        with progress_line("likelihood profile", name):
            profiles.append(profile(outcome.result, name, points=_POINTS))
        if profiles[-1].result is not outcome.result:
            say(f"{profiles[-1].notes[-1]} This is the fit from here on:")
            return _profiled(_validated(replace(outcome, result=profiles[-1].result)))
    return replace(outcome, profiles=tuple(profiles))


def _least_certain(outcome: FitOutcome) -> list[str]:
    """Parameters of the scene with the largest finite relative standard errors, except those at a limit."""
    result, numbers = outcome.result, scene_numbers(outcome.scene)
    shares = {
        name: result.errors[name] / abs(value)
        for name, value in result.values.items()
        if name in numbers and value and value not in result.estimate.bounds[name]
    }
    known = [name for name, share in shares.items() if 0 < share < np.inf]
    return sorted(known, key=lambda name: -shares[name])[:_PROFILED]


def _designed(request: FitRequest, outcome: FitOutcome) -> InputDesign:
    """An input for the next record, with the noise of the fit; limits and duration default to those of the records."""
    result, records = outcome.result, outcome.result.provenance.records
    positions = np.concatenate([record.measured for record in records])
    low, high = float(np.min(positions)), float(np.max(positions))
    top = request.max_speed or max(estimate_axis(record).top for record in records if np.ptp(record.measured) > 0)
    limits = AxisLimits(
        request.max_force or max(float(np.max(np.abs(record.inputs["u"]))) for record in records),
        top,
        request.max_travel or 0.5 * (high - low),
        rotary=outcome.plan.rotary,
    )
    numbers, scene = scene_numbers(outcome.scene), outcome.scene
    if scene.event_driven:  # a design needs derivatives of all samples, which events do not have
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
