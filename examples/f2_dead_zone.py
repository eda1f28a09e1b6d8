"""Karnopp's dead zone: velocities below a width count as rest, in fixed steps.

Wide, it holds a velocity of 1 m/s for rest; narrow, the chatter of sign(v) comes back.

Run it: `python examples/f2_dead_zone.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax

import jaxmodsim as jms
from jaxmodsim.plot import ramp_figure
from jaxmodsim.problems.testbench import ramp_cases, run_ramp


def main(out: Path, smoke: bool = False) -> None:
    """Run the cases of part c and draw them; --smoke takes the first."""
    cases = [case for case in ramp_cases() if case.part == "c"]
    results = [run_ramp(case) for case in cases[: 1 if smoke else None]]
    for result in results:
        print(f"{result.case.label}: {result.ending}, {result.crossings} zero crossings of the velocity in 10 s")
    figure = ramp_figure("Coulomb friction with a dead zone", [result.run for result in results])
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "f2_dead_zone.png", dpi=110)
    print(f"wrote {out / 'f2_dead_zone.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
