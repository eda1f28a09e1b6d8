"""Self-locking gear: a motor lifts a load through an elastic gear and is switched off.

Friction in the gear grows with the torque that it transmits, more for back-driving than for driving. With a coefficient
of back-driving below one the load turns the motor back; from one on the gear locks itself, and lowering the load takes
a push of the motor. The third panel has friction over the transmitted torque, by events and by a bristle.

Run it: `python examples/g7_self_locking_gear.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxmodsim as jms

# When the motor is switched [s], and to which torque [N m]: up, off, a push down, off.
SWITCHED, TORQUES = [0.0, 1.0, 2.0, 2.5], [1.4, 0.0, -0.5, 0.0]


def lagrangian(t, q, qd, p):
    """Motor and load with a spring between them [J]."""
    return 0.5 * p["J1"] * qd[0] ** 2 + 0.5 * p["J2"] * qd[1] ** 2 - 0.5 * p["k"] * (q[0] - q[1]) ** 2


def torque(t, q, qd, p):
    """What the gear transmits [N m]."""
    return p["k"] * (q[0] - q[1])


def outside(t, q, qd, p):
    """Torque of the motor; weight and damping of the load [N m]."""
    return jnp.stack([p["u"], -p["weight"] - p["d"] * qd[1]])


def motor_angle(q):
    """Where friction acts [rad]."""
    return q[0]


def joint(back, bristle=None):
    """The drive with a coefficient of back-driving; its friction by events, or by a bristle over an angle [rad]."""
    law = jms.Geared(jms.Coulomb(0.02), drive=0.3, torque=torque, back=back)
    friction = jms.Friction(law if bristle is None else jms.Bristle(law, bristle), along=motor_angle, name="gear")
    motor = jms.Signal(np.array(SWITCHED), np.array(TORQUES))
    params = {"J1": 2e-3, "J2": 2e-2, "k": 30.0, "d": 0.1, "weight": 0.8, "u": motor}
    effects = (jms.AppliedForce(outside), friction)
    return jms.Scene(lagrangian, params, effects, coordinates=("motor [rad]", "load [rad]"))


def main(out: Path, smoke: bool = False) -> None:
    """Three gears, over time and over the torque."""
    t1 = 1.2 if smoke else 3.0
    ts = jnp.linspace(0.0, t1, int(500 * t1) + 1)
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    angles, frictions, curve = figure.subplots(1, 3)
    for back, colour in ((0.4, "#1f5fa8"), (0.9, "#c98a1b"), (1.2, "#b03a2e")):
        run = jms.simulate(joint(back), [0.8 / 30.0, 0.0], [0.0, 0.0], t1, ts=ts, max_events=512)
        print(f"back-driving coefficient {back:g}: {run.result} The load ends at {float(run.q[-1, 1]):.3f} rad")
        angles.plot(run.t, run.q[:, 1], color=colour, label=f"mu_back {back:g}")
        frictions.plot(run.t, run.forces["gear"], color=colour)
    for bristle, style in ((None, "-"), (5e-3, ":")):
        run = jms.simulate(joint(0.9, bristle), [0.8 / 30.0, 0.0], [0.0, 0.0], t1, ts=ts, max_events=512)
        label = "by events" if bristle is None else f"bristle over {bristle:g} rad"
        curve.plot(30.0 * (run.q[:, 0] - run.q[:, 1]), run.forces["gear"], style, color="#c98a1b", label=label)
    tau = np.linspace(0.0, 2.0, 50)
    curve.plot(tau, 0.02 + 0.3 * tau, "--", color="#8a8a8a", lw=0.8, label="limits")
    curve.plot(tau, -0.02 - 0.9 * tau, "--", color="#8a8a8a", lw=0.8)
    angles.set(xlabel="time [s]", ylabel="load [rad]", title="Lifted, let go, pushed down")
    angles.legend()
    frictions.set(xlabel="time [s]", ylabel="friction [N m]", title="Friction on the motor")
    curve.set(xlabel="transmitted torque [N m]", ylabel="friction [N m]", title="mu_drive 0.3, mu_back 0.9")
    curve.legend()
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "g7_self_locking_gear.png", dpi=110)
    print(f"wrote {out / 'g7_self_locking_gear.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
