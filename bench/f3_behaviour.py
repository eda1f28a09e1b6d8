"""What each friction law does in the standard experiments, as `jaxmodsim testbench --laws` finds it, for its tables."""

from _measure import machine_line
from _options import begin
from _report import new_result, write_figure, write_result

from jaxmodsim.plot import behaviour_figure
from jaxmodsim.validation.behaviour import EXPERIMENTS, Outcome, law_cases, run_bench

# The figures that docs/laws.md shows.
SHOWN = ("memory", "creep")
WORDS = {"pass": "yes", "by nature": "**no**", "n/a": "-", "FAIL": "FAILS"}


def main() -> None:
    """Run the bench, and write `behaviour.json` and the figures."""
    options = begin(
        "Friction laws in the standard experiments.",
        smoke="two laws, to a temporary folder",
    )
    chosen = [each for each in law_cases() if not options.smoke or each.name in ("Viscous", "Dahl")]
    outcomes = run_bench(chosen, progress=print)
    content = new_result("behaviour", options, "diffrax")
    verdicts = {
        "columns": ["law", *EXPERIMENTS],
        "rows": [[law, *(cell(each) for each in of.values())] for law, of in outcomes.items()],
        "caption": "Whether each law keeps the limit of each experiment, and its number; **no**: it misses it by its"
        f" nature. {machine_line(content['machine'])}",
    }
    limits = {
        "columns": ["experiment", "number", "unit", "yes if"],
        "rows": [
            [each.name, each.quantity, each.unit, f"{'<=' if each.limit.at_most else '>='} {each.limit.value:g}"]
            for each in EXPERIMENTS.values()
        ],
        "caption": "What the experiments find, and their limits.",
    }
    content["tables"] = [verdicts, limits]
    write_result(content, options)
    for name in SHOWN:
        figure = behaviour_figure(EXPERIMENTS[name], {law: of[name] for law, of in outcomes.items()})
        write_figure(figure, options.out / f"behaviour_{name}.png", dpi=90)


def cell(outcome: Outcome) -> str:
    """Verdict and number."""
    return f"{WORDS[outcome.verdict.value]} {outcome.finding.rounded}".rstrip()


if __name__ == "__main__":
    main()
