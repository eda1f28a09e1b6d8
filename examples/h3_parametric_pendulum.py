"""Parametric pendulum: it stands upright on a pivot that shakes.

The pivot moves up and down as a function of time, in the Lagrangian. Above a frequency of sqrt(2 g l)/amplitude the
upright position is stable (Kapitza).

Run it: `python examples/h3_parametric_pendulum.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxmodsim as jms

AMPLITUDE, LENGTH, G = 0.03, 0.4, 9.81  # [m, m, m/s^2]


def bob(t, q, p):
    """Position of the bob [m], angle from upright."""
    return jnp.stack([LENGTH * jnp.sin(q[0]), LENGTH * jnp.cos(q[0]) + AMPLITUDE * jnp.cos(p["w"] * t)])


def lagrangian(t, q, qd, p):
    """Kinetic less potential energy of a mass of 1 kg, the pivot's motion included [J]."""
    _, velocity = jax.jvp(lambda t, q: bob(t, q, p), (t, q), (jnp.ones_like(t), qd))
    return 0.5 * velocity @ velocity - G * bob(t, q, p)[1]


def main(out: Path, smoke: bool = False) -> None:
    """Shake below and above the limit, from a lean of 0.2 rad, with friction in the pivot."""
    limit = float(jnp.sqrt(2.0 * G * LENGTH)) / AMPLITUDE
    t1 = 1.0 if smoke else 4.0
    figure = Figure(figsize=(8, 4), layout="constrained")
    axis = figure.subplots()
    for factor, colour in ((0.8, "#c2452d"), (1.5, "#1f5fa8")):
        scene = jms.Scene(lagrangian, {"w": factor * limit}, (jms.Friction(jms.Viscous(0.3)),))
        run = jms.simulate(scene, [0.2], [0.0], t1, ts=jnp.linspace(0.0, t1, 2001))
        print(f"{factor:g} times the limit: the angle ends at {run.q[-1, 0]:.3f} rad")
        axis.plot(run.t, run.q[:, 0], lw=0.9, color=colour, label=f"{factor:g} x {limit:.0f} rad/s")
    axis.set(xlabel="time [s]", ylabel="angle from upright [rad]", title="A pendulum on a shaking pivot")
    axis.legend()
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "h3_parametric_pendulum.png", dpi=110)
    print(f"wrote {out / 'h3_parametric_pendulum.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
