"""The figures of the test bench of friction models, as `jaxmodsim testbench` prints them, for its table."""

import json
import tempfile
from pathlib import Path

from _measure import machine_line
from _options import begin
from _report import new_result, write_result

from jaxmodsim.cli._report import report_testbench

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
    content = new_result("friction_models", options, "diffrax") | report
    table = {
        "columns": list(MODEL_COLUMNS.values()),
        "rows": [[_cell(row[key]) for key in MODEL_COLUMNS] for row in report["models"]],
        "caption": "A box of 2 kg under a force rising by 1 N/s (where not said otherwise), 10 s. Break-away: friction"
        f" falls behind the applied force by 0.05 N for good. {machine_line(content['machine'])}",
    }
    content["tables"] = [table]
    write_result(content, options)


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
