"""Robot joint: LuGre friction under a controller, with and without compensation.

A link follows a slow sine by a PD controller. Friction makes it stand still at every reversal; adding the steady
friction of the wanted velocity, known from a fit, takes most of the error away.

Run it: `python examples/g2_robot_joint.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxmodsim as jms


def lagrangian(t, q, qd, p):
    """A link in a vertical plane, angle from straight down [J]."""
    return 0.5 * p["J"] * qd[0] ** 2 + p["mgl"] * jnp.cos(q[0])


def wanted(t):
    """Angle [rad] that the link is to follow, and its velocity [rad/s]."""
    return 0.5 * jnp.sin(0.8 * t), 0.4 * jnp.cos(0.8 * t)


def controller(t, q, qd, p):
    """Gravity, PD, and a share `p["compensation"]` of steady friction [N m]."""
    angle, velocity = wanted(t)
    friction = (4.0 + 2.5 * jnp.exp(-((velocity / 0.05) ** 2))) * jnp.tanh(velocity / 0.01) + 3.0 * velocity
    feedback = 200.0 * (angle - q[0]) + 25.0 * (velocity - qd[0])
    return jnp.stack([p["mgl"] * jnp.sin(q[0]) + feedback + p["compensation"] * friction])


def main(out: Path, smoke: bool = False) -> None:
    """Follow the sine without and with compensation; one compiled program, two numbers."""
    joint = jms.LuGre(sigma0=8000.0, sigma1=60.0, sigma2=3.0, Fc=4.0, Fs=6.5, vs=0.05)
    t1 = 4.0 if smoke else 16.0
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for share, colour in ((0.0, "#c2452d"), (1.0, "#1f5fa8")):
        params = {"J": 0.8, "mgl": 12.0, "compensation": share}
        scene = jms.Scene(lagrangian, params, (jms.AppliedForce(controller, name="motor"), jms.Friction(joint)))
        run = jms.simulate(scene, [0.0], [0.4], t1, ts=jnp.linspace(0.0, t1, 1601))
        error = 1e3 * (run.q[:, 0] - wanted(run.t)[0])
        name = "with compensation" if share else "without"
        print(f"{name}: largest error {float(jnp.max(jnp.abs(error[200:]))):.2f} mrad")
        above.plot(run.t, error, color=colour, label=name)
        below.plot(run.t, run.forces["friction"], color=colour)
    above.set(ylabel="error [mrad]", title="A joint that follows a sine")
    above.legend()
    below.set(ylabel="friction [N m]", xlabel="time [s]")
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "g2_robot_joint.png", dpi=110)
    print(f"wrote {out / 'g2_robot_joint.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
