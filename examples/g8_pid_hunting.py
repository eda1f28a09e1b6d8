"""Hunting: a positioning axis under PID control and stiction never comes to rest.

In stick the integral of the error winds up until the axis breaks away, slips beyond its target, and sticks again. The
integral is a coordinate of its own, whose velocity follows the error. Its limit cycle is found by shooting and followed
over the damping of the controller, which makes it smaller and slower, but does not end it.

Run it: `python examples/g8_pid_hunting.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp

import jaxmodsim as jms
from jaxmodsim.plot import branch_figure


def lagrangian(t, q, qd, p):
    """Axis, and a coordinate of mass one for the integral of its position [J]."""
    return 0.5 * p["m"] * qd[0] ** 2 + 0.5 * qd[1] ** 2


def controller(t, q, qd, p):
    """PID force on the axis [N]; and what keeps the velocity of the integral at the position, as it is at first."""
    force = -p["kp"] * q[0] - p["ki"] * q[1] - p["kd"] * qd[0]
    return jnp.stack([force, qd[0] + p["rate"] * (q[0] - qd[1])])


def axis(q):
    """Displacement in the guide [m]."""
    return q[0]


def main(out: Path, smoke: bool = False) -> None:
    """Find the limit cycle, and follow it over the damping."""
    scene = jms.Scene(
        lagrangian,
        params={"m": 1.0, "kp": 100.0, "ki": 200.0, "kd": 2.0, "rate": 20.0},
        effects=(
            jms.AppliedForce(controller),
            jms.Friction(jms.Stribeck(Fc=2.0, Fs=3.0, vs=0.02, Fv=1.0), along=axis, name="guide"),
        ),
        coordinates=("x [m]", "integral [m s]"),
    )
    orbit = jms.periodic_orbit(scene, ([0.05, 0.0], [0.0, 0.05]), settle=60.0)
    print(orbit)
    last = 3.0 if smoke else 20.0
    branch = jms.continue_orbits(scene, orbit, "kd", (2.0, last), step=0.5 if smoke else 0.05)
    print(branch)
    out.mkdir(parents=True, exist_ok=True)
    branch_figure(branch).savefig(out / "g8_pid_hunting.png", dpi=110)
    print(f"wrote {out / 'g8_pid_hunting.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
