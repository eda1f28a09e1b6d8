"""Friction models on the test bench, as `jaxmodsim testbench` runs them."""

import math
from pathlib import Path

from bench.record import Result
from jaxmodsim.problems.testbench import ramp_cases, run_ramp


def main(smoke: bool, out: Path) -> Result:
    """Run every model; a smoke run has one."""
    del out
    result = Result("friction_models", ("diffrax",))
    for case in ramp_cases()[: 1 if smoke else None]:
        found = run_ramp(case)
        about = {"case": case.part, "peer": case.label}
        result.add("break-away", None if math.isnan(found.break_away) else found.break_away, "s", **about)
        result.add("zero crossings", found.crossings, **about)
        result.add("steps", found.steps, **about)
        result.add("run", 1e-3 * found.milliseconds, "s", **about)
        result.add("ending", found.ending, **about)
    return result
