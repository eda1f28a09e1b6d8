"""Hunting: an axis with stiction under PID control never comes to rest, unless its damping is large enough.

In stick the integral of the error winds up until the axis breaks away, slips beyond its target, and sticks again. The
limit cycle is followed over the damping of the controller, which makes it smaller and slower. It vanishes in a fold,
where it meets an unstable cycle. With more damping the axis settles.

Run it: `python examples/g8_pid_hunting.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp

import jaxmodsim as jms
from jaxmodsim.plot import branch_figure


def lagrangian(_t, _q, qd, p):
    """Kinetic energy [J] of the axis; the integral of its position is a coordinate of mass 1."""
    return 0.5 * p["m"] * qd[0] ** 2 + 0.5 * qd[1] ** 2


def pid(_t, q, qd, p):
    """PID force on the axis [N], and the force that keeps the rate of the integral at the position."""
    force = -p["kp"] * q[0] - p["ki"] * q[1] - p["kd"] * qd[0]
    return jnp.stack([force, qd[0] + jnp.sqrt(p["kp"] / p["m"]) * (q[0] - qd[1])])


def main(out: Path, smoke: bool = False) -> None:
    """Find the limit cycle, and the damping at which it vanishes."""
    law = jms.Stribeck(Fc=2.0, Fs=3.0, vs=0.02, Fv=1.0)
    axis = jms.Scene(
        lagrangian,
        params={"m": 1.0, "kp": 100.0, "ki": 200.0, "kd": 2.0},
        effects=(jms.AppliedForce(pid), jms.Friction(law, along=lambda q: q[0], name="friction")),
        coordinates=("x [m]", "integral [m s]"),
    )
    start, span = ([0.06, 0.0], [0.0, 0.06]), (2.0, 3.0 if smoke else 40.0)
    branch = jms.continue_orbits(axis, start, "kd", span, settle=100.0, step=0.1, max_orbits=100)
    print(branch)
    print(branch.orbits[0])
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
