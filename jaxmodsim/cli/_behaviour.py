"""`jaxmodsim testbench --laws`: every friction law in the standard experiments."""

from pathlib import Path

import pandas as pd

from .._core.progress import progress_line
from ..plot import Figure, behaviour_figure
from ..validation.behaviour import EXPERIMENTS, ExperimentResult, Verdict, run_bench
from ._output import Content, console, show_paths, show_table, write


def report_behaviour(out: Path) -> bool:
    """Run the bench, print its table, write everything to `out`; returns whether no law failed."""
    with progress_line("laws") as show:
        outcomes = run_bench(progress=lambda name: show(f"{name} is done"))
    show_table(_table(outcomes), "Friction laws in the standard experiments: verdict and number")
    show_table(_limits(), "The numbers and what they must keep to pass")
    files: dict[str, Content] = {
        f"behaviour_{name.replace('-', '_')}.png": _figure(name, outcomes) for name in EXPERIMENTS
    }
    files["behaviour.csv"] = _long(outcomes)
    files["behaviour.json"] = _nested(outcomes)
    show_paths(write(out, files))
    failed = [
        (law, name, outcome.measured)
        for law, of in outcomes.items()
        for name, outcome in of.items()
        if outcome.verdict is Verdict.FAIL
    ]
    for law, name, finding in failed:
        number = f"{finding.rounded} {EXPERIMENTS[name].unit}"
        console.print(f"FAIL: {law}, {name}, {number}: {finding.sentence}", highlight=False, markup=False)
    return not failed


def _figure(name: str, outcomes: dict[str, dict[str, ExperimentResult]]) -> Figure:
    return behaviour_figure(EXPERIMENTS[name], {law: of[name] for law, of in outcomes.items()})


def _cell(outcome: ExperimentResult) -> str:
    word = outcome.verdict.value.removesuffix(" limitation")
    return f"{word} {outcome.measured.rounded}".rstrip()


def _table(outcomes: dict[str, dict[str, ExperimentResult]]) -> pd.DataFrame:
    """Laws as rows, experiments as columns."""
    rows = [{"law": law} | {name: _cell(of[name]) for name in EXPERIMENTS} for law, of in outcomes.items()]
    return pd.DataFrame(rows)


def _limits() -> pd.DataFrame:
    return pd.DataFrame(
        {
            "experiment": [each.name for each in EXPERIMENTS.values()],
            "number": [each.quantity for each in EXPERIMENTS.values()],
            "unit": [each.unit for each in EXPERIMENTS.values()],
            "passes": [
                f"{'<=' if each.threshold.at_most else '>='} {each.threshold.value:g}" for each in EXPERIMENTS.values()
            ],
        }
    )


def _entry(name: str, outcome: ExperimentResult) -> dict[str, object]:
    experiment = EXPERIMENTS[name]
    return {
        "verdict": outcome.verdict.value,
        "number": outcome.measured.number,
        "unit": experiment.unit,
        "threshold": experiment.threshold.value,
        "side": "at most" if experiment.threshold.at_most else "at least",
        "finding": outcome.measured.sentence,
        "reason": outcome.reason,
    }


def _long(outcomes: dict[str, dict[str, ExperimentResult]]) -> pd.DataFrame:
    """One row for each law and experiment."""
    return pd.DataFrame(
        [
            {"law": law, "experiment": name} | _entry(name, outcome)
            for law, of in outcomes.items()
            for name, outcome in of.items()
        ]
    )


def _nested(outcomes: dict[str, dict[str, ExperimentResult]]) -> dict[str, object]:
    return {law: {name: _entry(name, outcome) for name, outcome in of.items()} for law, of in outcomes.items()}
