"""Brake squeal: a pad sings as the disc slows down.

Friction that falls with slip velocity feeds the pad's vibration as soon as its slope exceeds the damping of the pad:
below a certain velocity of the disc. Stick and slip are exact, the disc is a belt whose velocity is a function of time.

Run it: `python examples/g0_brake_squeal.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxmodsim as jms

SPEED, DURATION = 0.8, 0.3  # of the disc at first [m/s], and how long it takes to stop [s]


def lagrangian(t, q, qd, p):
    """Pad on its spring [J]."""
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


def disc(t):
    """Velocity of the disc under the pad [m/s]."""
    return SPEED * (1.0 - t / DURATION)


def main(out: Path, smoke: bool = False) -> None:
    """Brake, and draw the pad's velocity below that of the disc."""
    friction = jms.Stribeck(Fc=60.0, Fs=110.0, vs=0.3, Fv=0.0)
    scene = jms.Scene(
        lagrangian,
        params={"m": 0.4, "k": 4e6},
        effects=(
            jms.Friction(friction, belt_velocity=disc, name="disc"),
            jms.Friction(jms.Viscous(8.0), name="damper"),
        ),
    )
    t1 = 0.6 * DURATION if smoke else 0.98 * DURATION
    run = jms.simulate(scene, [80.0 / 4e6], [0.0], t1, ts=jnp.linspace(0.0, t1, 4001), max_events=1024)
    print(f"{run.result} {int(run.stats['num_events'])} changes of mode")
    print(f"the pad swings at {float(jnp.sqrt(4e6 / 0.4) / (2.0 * jnp.pi)):.0f} Hz")
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(run.t, disc(run.t), color="#8a8a8a", label="disc")
    above.plot(run.t, run.qd[:, 0], lw=0.6, color="#1f5fa8", label="pad")
    above.set(ylabel="velocity [m/s]", title="A pad on a disc that slows down")
    above.legend()
    below.plot(run.t, run.forces["disc"], lw=0.6, color="#c2452d")
    below.set(ylabel="friction [N]", xlabel="time [s]")
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
