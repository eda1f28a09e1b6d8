"""Hunting: a positioning axis under PID control and stiction never comes to rest, unless it is damped enough.

In stick the integral of the error winds up until the axis breaks away, slips beyond its target, and sticks again. The
limit cycle is followed over the damping of the controller, which makes it smaller and slower, to where it vanishes: it
meets an unstable cycle there, in a fold.

Run it: `python examples/g8_pid_hunting.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax

import jaxmodsim as jms
from jaxmodsim.plot import branch_figure


def main(out: Path, smoke: bool = False) -> None:
    """Find the limit cycle, and the damping at which it vanishes."""
    law = jms.Stribeck(Fc=2.0, Fs=3.0, vs=0.02, Fv=1.0)
    result = jms.hunting(law, "kd", 3.0 if smoke else 40.0, m=1.0, kp=100.0, ki=200.0, kd=2.0)
    print(result)
    print(result.orbit)
    out.mkdir(parents=True, exist_ok=True)
    branch_figure(result.branch).savefig(out / "g8_pid_hunting.png", dpi=110)
    print(f"wrote {out / 'g8_pid_hunting.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
