"""Coulomb friction, exact: rest is rest, until the force exceeds Fc at 1.5 s.

The same law smoothed over 1 mm/s creeps below its limit.

Run it: `python examples/f1_coulomb_exact.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax

import jaxmodsim as jms
from jaxmodsim.plot import ramp_figure
from jaxmodsim.problems.testbench import ramp_cases, run_ramp


def main(out: Path, smoke: bool = False) -> None:
    """Run the cases of part b and draw them; --smoke takes the first."""
    cases = [case for case in ramp_cases() if case.part == "b"]
    results = [run_ramp(case) for case in cases[: 1 if smoke else None]]
    for result in results:
        print(f"{result.case.label}: {result.ending}, {result.crossings} zero crossings of the velocity in 10 s")
    figure = ramp_figure("Coulomb friction, by events and smoothed", [result.run for result in results])
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "f1_coulomb_exact.png", dpi=110)
    print(f"wrote {out / 'f1_coulomb_exact.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
