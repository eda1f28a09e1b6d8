"""What each friction law does in the standard experiments, as `jaxmodsim testbench --laws` finds it, for the README."""

import argparse
import tempfile
from pathlib import Path

import jax
from _measure import describe_machine, machine_line, write_json

import jaxmodsim as jms
from jaxmodsim.behaviour import EXPERIMENTS, Outcome, run_bench, specimens
from jaxmodsim.plot import behaviour_figure

HERE = Path(__file__).parent
# The figures that the README shows.
SHOWN = ("memory", "creep")
WORDS = {"pass": "yes", "by nature": "**no**", "n/a": "-", "FAIL": "FAILS"}


def main() -> None:
    """Run the bench, and write `behaviour.json` and the figures."""
    parser = argparse.ArgumentParser(description="Friction laws in the standard experiments.")
    parser.add_argument("--smoke", action="store_true", help="two laws, to a temporary folder")
    parser.add_argument("--out", type=Path, default=None, help="folder of the result; default bench/results")
    options = parser.parse_args()
    out = options.out or (Path(tempfile.mkdtemp()) if options.smoke else HERE / "results")
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
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
    write_json(out / "behaviour.json", content)
    for name in SHOWN:
        figure = behaviour_figure(EXPERIMENTS[name], {law: of[name] for law, of in outcomes.items()})
        figure.savefig(out / f"behaviour_{name}.png", dpi=90)
        print(f"written: {out / f'behaviour_{name}.png'}")


def cell(outcome: Outcome) -> str:
    """Verdict and number."""
    return f"{WORDS[outcome.verdict.value]} {outcome.finding.rounded}".rstrip()


if __name__ == "__main__":
    main()
