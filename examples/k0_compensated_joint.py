"""A geared shoulder joint follows a slow ramp under PID control: in stairs, and with its friction compensated.

Friction falls with speed from break-away on, faster than the damping of the controller grows: the joint sticks, breaks
away and overshoots. `compensate_friction` adds the force of a fitted law on the planned motion in each cycle. It does
not change how friction falls with speed: with this little damping the error of exact compensation grows slowly.

Run it: `python examples/k0_compensated_joint.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxmodsim as jms
from jaxmodsim.control import check_observer, compensate_friction
from jaxmodsim.scene import State, replace_elements, scene_step

KP, KI, KD, SPEED, H = 60.0, 250.0, 2.0, 0.02, 1e-3
INERTIA, LOAD = 0.4, 9.0


def energy(_t, q, qd, p):
    """Kinetic energy minus potential energy [J] of the arm."""
    return 0.5 * p["J"] * qd[0] ** 2 + p["mgl"] * jnp.cos(q[0])


def motor(_t, _q, _qd, p):
    """Torque of the motor [N m]."""
    return jnp.reshape(p["u"], (1,))


def follow(joint, share, t):
    """Angle [rad] and planned angle in each cycle, with the share of the friction that is compensated."""
    zero, h = jnp.array(0.0), jnp.array(H)

    def cycle(carry, t):
        y, z, integral = carry
        plan = State((0.5 + SPEED * t)[None], jnp.array([SPEED]), z)
        force, z = compensate_friction(joint, zero, h, plan, share=share)
        error = y.q[0] - plan.q[0]
        integral = integral + h * error
        u = LOAD * jnp.sin(y.q[0]) - KP * error - KI * integral - KD * (y.qd[0] - SPEED) + force[0]
        y, _ = scene_step(replace_elements(joint, {"u": u}), zero, h, y)
        return (y, z, integral), (y.q[0], plan.q[0])

    z = joint.initial_state(jnp.zeros(1))
    start = (State(jnp.array([0.5]), jnp.zeros(1), z), z, zero)
    return jax.lax.scan(cycle, start, t)[1]


def main(out: Path, smoke: bool = False) -> None:
    """Follow the ramp with no, with exact and with wrong compensation, and draw angles and errors."""
    law = jms.LuGre(sigma0=2000.0, sigma1=60.0, sigma2=0.5, Fc=0.7, Fs=2.8, vs=0.24)
    joint = jms.Scene(energy, {"J": INERTIA, "mgl": LOAD, "u": 0.0}, (jms.AppliedForce(motor), jms.Friction(law)))
    t = np.arange(0.0, 2.0 if smoke else 10.0, H)
    run = jax.jit(lambda share: follow(joint, share, jnp.asarray(t)))
    figure = Figure(figsize=(8, 6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    colours = {0.0: "#c2452d", 0.8: "#d99a2b", 1.0: "#1f5fa8", 1.2: "#4c9a6a"}
    for share, colour in colours.items():
        angle, plan = run(share)
        error = 1e3 * np.asarray(angle - plan)
        over = "Over-compensation" in check_observer(law, INERTIA, KP, KD, KI, level=share).condition
        note = ", over-compensation" if over else ""
        print(f"share {share:.1f}: largest error after 2 s {np.abs(error[len(t) // 5 :]).max():.3f} mrad{note}")
        if share in (0.0, 1.0):
            above.plot(t, 1e3 * np.asarray(angle), color=colour, label=f"share {share:g}")
        below.plot(t, error, color=colour, label=f"share {share:g}")
    above.set(ylabel="angle [mrad]", title="Ramp of 20 mrad/s; share: compensated friction over friction")
    below.set(xlabel="time [s]", ylabel="error [mrad]", yscale="symlog")
    below.yaxis.set_major_formatter("{x:g}")
    for axes in (above, below):
        axes.legend(fontsize=9, loc="upper left")
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "k0_compensated_joint.png", dpi=110)
    print(f"wrote {out / 'k0_compensated_joint.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
