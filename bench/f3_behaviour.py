"""What each friction law does in the standard experiments, as `jaxmodsim testbench --laws` finds it, for the README."""

from pathlib import Path

from _measure import describe_machine, machine_line, write_json
from _options import begin

from jaxmodsim.behaviour import EXPERIMENTS, Outcome, run_bench, specimens
from jaxmodsim.plot import behaviour_figure

HERE = Path(__file__).parent
# The figures that the README shows.
SHOWN = ("memory", "creep")
WORDS = {"pass": "yes", "by nature": "**no**", "n/a": "-", "FAIL": "FAILS"}


def main() -> None:
    """Run the bench, and write `behaviour.json` and the figures."""
    options = begin(
        "Friction laws in the standard experiments.",
        smoke="two laws, to a temporary folder",
    )
    chosen = [each for each in specimens() if not options.smoke or each.name in ("Viscous", "Dahl")]
    outcomes = run_bench(chosen, progress=print)
    machine = describe_machine("jax", "jaxlib", "diffrax", "jaxmodsim")
    verdicts = {
        "columns": ["law", *EXPERIMENTS],
        "rows": [[law, *(cell(each) for each in of.values())] for law, of in outcomes.items()],
        "caption": "Whether each law keeps the limit of each experiment, and its number; **no**: it misses it by its"
        f" nature. {machine_line(machine)}",
    }
    limits = {
        "columns": ["experiment", "number", "unit", "yes if"],
        "rows": [
            [each.name, each.quantity, each.unit, f"{'<=' if each.limit.at_most else '>='} {each.limit.value:g}"]
            for each in EXPERIMENTS.values()
        ],
    }
    content = {"name": "behaviour", "smoke": options.smoke, "machine": machine, "tables": [verdicts, limits]}
    write_json(options.out / "behaviour.json", content)
    for name in SHOWN:
        figure = behaviour_figure(EXPERIMENTS[name], {law: of[name] for law, of in outcomes.items()})
        figure.savefig(options.out / f"behaviour_{name}.png", dpi=90)
        print(f"written: {options.out / f'behaviour_{name}.png'}")


def cell(outcome: Outcome) -> str:
    """Verdict and number."""
    return f"{WORDS[outcome.verdict.value]} {outcome.finding.rounded}".rstrip()


if __name__ == "__main__":
    main()
