"""The figures of the test bench of friction models, as `jaxmodsim testbench` prints them."""

import json
import tempfile
from pathlib import Path

from bench.record import Result
from jaxmodsim.cli._report import report_testbench

QUANTITIES = {
    "away [s]": ("break-away", "s"),
    "crossings": ("zero crossings", "1"),
    "steps": ("steps", "1"),
    "run [ms]": ("run", "ms"),
    "ending": ("ending", "1"),
}


def main(smoke: bool, out: Path) -> Result:
    """Run the test bench, which is small."""
    del smoke, out
    result = Result("friction_models", ("diffrax",))
    with tempfile.TemporaryDirectory() as folder:
        report_testbench(Path(folder))
        report = json.loads((Path(folder) / "testbench.json").read_text())
    for row in report["models"]:
        for name, (quantity, unit) in QUANTITIES.items():
            result.add(quantity, row[name], unit, case=row["part"], peer=row["model"])
    return result
