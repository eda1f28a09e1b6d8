"""Brake squeal: at which speeds of the disc a pad sings, how loud, and what a damper changes.

Friction that falls with slip velocity feeds the vibration of the pad as soon as its slope exceeds the damping: below a
Hopf point of steady sliding. The orbits that begin there are unstable and go back to higher speeds, until the pad comes
to stick to the disc; from there they are stable, and loud. Between the two speeds a pad that slides goes on sliding,
and one that squeals goes on squealing, as runs show: from near steady sliding, and from stick.

Run it: `python examples/g0_brake_squeal.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp

import jaxmodsim as jms
from jaxmodsim.plot import branch_figure

FAST = 2.2  # speed of the disc [m/s]
PAD = {"m": 0.4, "k": 4e6}  # [kg], [N/m]


def lagrangian(t, q, qd, p):
    """Pad on its spring [J]."""
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


def brake(speed, damping=8.0):
    """A pad with a damper [N s/m] on a disc of this speed [m/s]."""
    pad = jms.Stribeck(Fc=60.0, Fs=110.0, vs=0.3)
    effects = (
        jms.Friction(pad, belt_velocity=speed, name="disc"),
        jms.Friction(jms.Viscous(damping), name="damper"),
    )
    return jms.Scene(lagrangian, PAD, effects, coordinates=("x [m]",))


def amplitudes(speeds, starts, smoke):
    """Amplitude of the pad at these speeds of the disc, after a while from these velocities of the pad [m/s]."""
    t1 = 0.1 if smoke else 1.0

    def run(speed, start):
        ts = jnp.linspace(0.95 * t1, t1, 1001)
        q = jms.simulate(brake(speed), [15e-6], start[None], t1, ts=ts, max_events=2048, max_steps=2**17).q
        return 0.5 * jnp.ptp(q)

    return jax.jit(jax.vmap(run))(speeds, starts)


def main(out: Path, smoke: bool = False) -> None:
    """Follow steady sliding and squeal over the speed of the disc."""
    name, span = "disc.belt_velocity", (FAST, 0.05)
    for damping in (8.0,) if smoke else (40.0, 20.0, 8.0):
        sliding = jms.continue_equilibria(brake(FAST, damping), [0.0], name, span, step=0.1)
        start = sliding.points[0]
        squeal = jms.continue_orbits(brake(FAST, damping), start, name, span, step=0.2, max_orbits=5 if smoke else 500)
        print(
            f"damper {damping:g} N s/m: {1 / start.orbit.period:.0f} Hz, begins below {start.value:.3f} m/s,"
            f" lasts up to {squeal.values.max():.3f} m/s, amplitude up to {1e6 * squeal.amplitude.max():.0f} um"
        )
    print(squeal)
    figure = branch_figure(squeal, beside=(sliding,))
    speeds = jnp.linspace(0.1, FAST, 4 if smoke else 22)
    for start, mark, label in ((0.01 + 0 * speeds, "v", "run, from sliding"), (speeds, "^", "run, from stick")):
        amplitude = amplitudes(speeds, start, smoke)
        figure.axes[0].plot(speeds, amplitude, mark, ms=4, color="#8a8a8a", label=label)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    figure.axes[0].legend(once.values(), once.keys(), fontsize=9, frameon=False)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "g0_brake_squeal.png", dpi=110)
    print(f"wrote {out / 'g0_brake_squeal.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
