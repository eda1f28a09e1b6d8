"""Drill string: the bit sticks while the table above turns on, unless the table turns fast enough.

A kilometre of pipe is a soft torsional spring, which winds up while the bit sticks. The coordinate is by how much the
bit lags behind the table: it returns, where the angles turn on. Stick-slip is a branch of periodic orbits over the
speed of the table, even turning a branch of equilibria. Stick-slip goes on up to speeds far above that at which even
turning becomes stable: a driller who comes from below needs the higher one to be rid of it, or lifts the bit.

Run it: `python examples/g1_drill_string.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import jaxmodsim as jms
from jaxmodsim.plot import branch_figure

SLOW, FAST = 1.0, 16.0  # speed of the table [rad/s]
RPM = 60.0 / (2.0 * np.pi)


def lagrangian(t, q, qd, p):
    """Bit below a pipe that is twisted by its lag, seen from the table [J]."""
    return 0.5 * p["J"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


def drill(table):
    """The lag of the bit; the rock passes below it at the speed of the table [rad/s]."""
    rock = jms.Stribeck(Fc=4000.0, Fs=7000.0, vs=1.0, Fv=40.0)  # torque [N m], velocity [rad/s]
    effects = (jms.Friction(rock, belt_velocity=table, name="rock"),)
    return jms.Scene(lagrangian, {"J": 470.0, "k": 860.0}, effects, coordinates=("lag [rad]",))


def main(out: Path, smoke: bool = False) -> None:
    """Follow even turning, and stick-slip from where that loses its stability, over the speed of the table."""
    name, span = "rock.belt_velocity", (FAST, SLOW)
    even = jms.continue_equilibria(drill(FAST), [0.0], name, span, step=0.1)
    (start,) = even.points
    branch = jms.continue_orbits(drill(FAST), start, name, span, step=0.2, max_orbits=5 if smoke else 500)
    print(branch)
    last = branch.values.max()
    print(f"even turning is stable above {start.value:.2f} rad/s ({RPM * start.value:.0f} rpm),")
    print(f"stick-slip is there below {last:.2f} rad/s ({RPM * last:.0f} rpm)")
    for value, orbit in list(zip(branch.values, branch.orbits, strict=True))[-1::-4]:
        if orbit.stable:
            fastest = value - float(np.min(np.asarray(orbit.run.qd)))
            stuck = 100.0 * orbit.stick["rock"]
            print(f"table at {value:5.2f} rad/s: bit at most {fastest:5.1f} rad/s, stuck {stuck:.0f} % of the time")
    out.mkdir(parents=True, exist_ok=True)
    branch_figure(branch, beside=(even,)).savefig(out / "g1_drill_string.png", dpi=110)
    print(f"wrote {out / 'g1_drill_string.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
