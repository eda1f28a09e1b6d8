"""`jaxmodsim hard`: the hard cases, run and judged."""

import math
from dataclasses import asdict, dataclass
from pathlib import Path

import pandas as pd

from .._core.progress import progress_line
from ..plot import hard_figure, step_limits_figure
from ..validation.hard import TRANSFORMS, CaseReport, HardCase, check_many, choose
from ._options import Interrupted
from ._output import Content, console, say, show_paths, show_table, write

_VALUES, _SLOPES = ("alone", "jit", "vmap"), ("forward", "reverse")


@dataclass(frozen=True)
class HardRequest:
    """What the command was given."""

    names: tuple[str, ...]
    list_only: bool
    transforms: str
    jobs: int
    out: Path


def report_hard(request: HardRequest) -> bool:
    """Check the cases, print the table, write everything; returns whether all pass.

    **Raises:**

    - `ValueError` for names and transforms that are none.
    - `Interrupted` after Ctrl-C, once what was found is written.
    """
    cases = choose(request.names)
    if request.list_only:
        show_table(_catalogue(list(cases.values())), f"{len(cases)} hard cases")
        return True
    transforms = TRANSFORMS if request.transforms == "all" else tuple(request.transforms.split(","))
    verdicts: dict[str, CaseReport] = {}
    stopped = False
    with progress_line("hard cases") as show:
        try:
            for verdict in check_many(request.names, transforms=transforms, jobs=request.jobs):
                verdicts[verdict.case.name] = verdict
                done = f"{len(verdicts)} of {len(cases)}: {verdict.case.name}: {'pass' if verdict.ok else 'FAIL'}"
                show(done)
                if not console.is_terminal:
                    say(done)
        except KeyboardInterrupt:
            stopped = True
    reports = [verdicts[name] for name in cases if name in verdicts]
    _report(reports, request.out, whole=not request.names and not stopped)
    if stopped:
        raise Interrupted(f"interrupted; what was found on {len(reports)} of {len(cases)} cases is written")
    return all(verdict.ok for verdict in reports)


def _report(reports: list[CaseReport], out: Path, *, whole: bool) -> None:
    if not reports:
        return
    table = hard_table(reports)
    show_table(table.drop(columns="asked"), "Hard cases: errors in what is admissible, so that 1 is the limit")
    files: dict[str, Content] = {
        "hard.csv": table,
        "hard.json": {verdict.case.name: _entry(verdict) for verdict in reports},
        "hard.png": hard_figure(reports),
    }
    if whole:
        files["hard_steps.png"] = step_limits_figure()
    show_paths(write(out, files))
    for verdict in reports:
        for finding in verdict.findings:
            if not finding.ok:
                text = f"FAIL: {verdict.case.name}, {finding.transform}, {finding.dtype}: {finding.sentence}"
                console.print(text, highlight=False, markup=False, soft_wrap=True)
    passed = sum(verdict.ok for verdict in reports)
    console.print(f"{passed} of {len(reports)} cases pass.")


def hard_table(reports: list[CaseReport]) -> pd.DataFrame:
    """A row for each case: the worst errors of values, derivatives and energy, 1 being the limit."""
    return pd.DataFrame(
        [
            {
                "family": verdict.case.family,
                "case": verdict.case.name,
                "value": _worst(verdict, "float64", _VALUES),
                "derivative": _worst(verdict, "float64", _SLOPES),
                "energy": _worst(verdict, "float64", ("energy",)),
                "value, float32": _worst(verdict, "float32", _VALUES),
                "derivative, float32": _worst(verdict, "float32", _SLOPES),
                "asked": verdict.case.asks,
                "verdict": "pass" if verdict.ok else "FAIL",
            }
            for verdict in reports
        ]
    )


def _worst(verdict: CaseReport, dtype: str, transforms: tuple[str, ...]) -> str:
    """Largest error; in words where there is none to compute."""
    ran = [each for each in verdict.findings if each.dtype == dtype and each.transform in transforms]
    if not ran:
        return "-"
    error = verdict.worst(dtype, transforms)
    if not math.isnan(error):
        return f"{error:.1g}"
    if verdict.case.undefined and transforms == _SLOPES:
        return "flagged"
    return "named" if all(each.ok for each in ran) else "FAIL"


def _entry(verdict: CaseReport) -> dict[str, object]:
    case = verdict.case
    return {
        "family": case.family,
        "why": case.why,
        "naive": case.naive,
        "asks": case.asks,
        "tolerance": case.tolerance,
        "ok": verdict.ok,
        "left out": dict(case.skips),
        "findings": [asdict(finding) for finding in verdict.findings],
    }


def _catalogue(cases: list[HardCase]) -> pd.DataFrame:
    return pd.DataFrame([{"family": each.family, "case": each.name, "why it is hard": each.why} for each in cases])
