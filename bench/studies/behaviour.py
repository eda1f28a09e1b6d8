"""Friction laws in the standard experiments, with verdicts and known limitations."""

from pathlib import Path

from bench.behaviour.experiment import Verdict, law_cases
from bench.behaviour.figure import behaviour_figure
from bench.behaviour.run import EXPERIMENTS, run_bench
from bench.figures import save
from bench.record import Result

WORDS = {"pass": "yes", "known limitation": "**no**", "n/a": "-"}


def main(smoke: bool, out: Path) -> Result:
    """Run every law through every experiment; a smoke run has two laws.

    **Raises:**

    - `RuntimeError` where a law misses a limit, and does not say why it must; then nothing is recorded.
    """
    chosen = [each for each in law_cases() if not smoke or each.name in ("Viscous", "Dahl")]
    outcomes, result = run_bench(chosen, progress=print), Result("behaviour", ("diffrax",))
    failed: list[str] = []
    for law, found in outcomes.items():
        for experiment, outcome in found.items():
            if outcome.verdict is Verdict.FAIL:
                number = f"{outcome.measured.rounded} {EXPERIMENTS[experiment].unit}"
                failed.append(f"FAIL: {law}, {experiment}, {number}: {outcome.measured.sentence}")
                continue
            words = f"{WORDS[outcome.verdict.value]} {outcome.measured.rounded}".rstrip()
            result.add("verdict", words, case=experiment, peer=law)
            result.add("finding", outcome.measured.sentence, case=experiment, peer=law)
            result.add("reason", outcome.reason or None, case=experiment, peer=law)
    if failed:
        raise RuntimeError("\n".join(failed))
    for each in EXPERIMENTS.values():
        result.add("number", each.quantity, case=each.name)
        result.add("unit", each.unit, case=each.name)
        result.add("limit", f"{'<=' if each.threshold.at_most else '>='} {each.threshold.value:g}", case=each.name)
    for name in ("memory", "creep"):  # figures of docs/laws.md
        figure = behaviour_figure(EXPERIMENTS[name], {law: of[name] for law, of in outcomes.items()})
        save(figure, out / f"behaviour_{name}.png", dpi=90)
    return result
