"""The figures of the test bench of friction models, as `jaxmodsim testbench` prints them, for the README."""

import json
import tempfile
from pathlib import Path

from _measure import describe_machine, machine_line, write_json
from _options import begin

from jaxmodsim.cli._report import report_testbench

HERE = Path(__file__).parent
MODEL_COLUMNS = {
    "model": "model",
    "part": "part",
    "away [s]": "break-away [s]",
    "crossings": "zero crossings",
    "steps": "steps",
    "run [ms]": "run [ms]",
    "ending": "ending",
}


def main() -> None:
    """Run the test bench, and write `friction_models.json`."""
    options = begin(
        "The test bench of friction models.",
        smoke="into a temporary folder; the bench itself is small",
    )
    with tempfile.TemporaryDirectory() as folder:
        report_testbench(Path(folder))
        report = json.loads((Path(folder) / "testbench.json").read_text())
    machine = describe_machine("jax", "jaxlib", "diffrax", "jaxmodsim")
    table = {
        "columns": list(MODEL_COLUMNS.values()),
        "rows": [[_cell(row[key]) for key in MODEL_COLUMNS] for row in report["models"]],
    }
    caption = (
        "A box of 2 kg under a force rising by 1 N/s (where not said otherwise), 10 s. Break-away: friction falls"
        f" behind the applied force by 0.05 N for good. {machine_line(machine)}"
    )
    found = {"machine": machine, "table": table, "caption": caption, **report}
    write_json(options.out / "friction_models.json", {"name": "friction_models", "smoke": options.smoke, **found})


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
