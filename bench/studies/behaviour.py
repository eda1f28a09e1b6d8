"""What each friction law does in the standard experiments, as `jaxmodsim testbench --laws` finds it."""

from pathlib import Path

from bench.figures import save
from bench.record import Result
from jaxmodsim.plot import behaviour_figure
from jaxmodsim.validation.behaviour import EXPERIMENTS, run_bench, specimens

WORDS = {"pass": "yes", "by nature": "**no**", "n/a": "-", "FAIL": "FAILS"}


def main(smoke: bool, out: Path) -> Result:
    """Run every law through every experiment; a small run takes two laws."""
    chosen = [each for each in specimens() if not smoke or each.name in ("Viscous", "Dahl")]
    outcomes, result = run_bench(chosen, progress=print), Result("behaviour", ("diffrax",))
    for law, found in outcomes.items():
        for experiment, outcome in found.items():
            words = f"{WORDS[outcome.verdict.value]} {outcome.finding.rounded}".rstrip()
            result.add("verdict", words, case=experiment, peer=law)
    for each in EXPERIMENTS.values():
        result.add("number", each.quantity, case=each.name)
        result.add("unit", each.unit, case=each.name)
        result.add("limit", f"{'<=' if each.limit.at_most else '>='} {each.limit.value:g}", case=each.name)
    for name in ("memory", "creep"):  # those that docs/laws.md shows
        figure = behaviour_figure(EXPERIMENTS[name], {law: of[name] for law, of in outcomes.items()})
        save(figure, out / f"behaviour_{name}.png", dpi=90)
    return result
