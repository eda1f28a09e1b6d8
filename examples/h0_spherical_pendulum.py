"""Spherical pendulum: precession of its ellipse, against the closed form.

A mass on a sphere in two angles; the exact motion is in Jacobi's elliptic functions.

Run it: `python examples/h0_spherical_pendulum.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxmodsim as jms
from jaxmodsim.problems import spherical_pendulum


def main(out: Path, smoke: bool = False) -> None:
    """Swing, and draw the path seen from above."""
    t1 = 5.0 if smoke else 20.0
    run = jms.simulate(
        spherical_pendulum.scene(), [2.6, 0.0], [0.0, 1.5], t1, ts=jnp.linspace(0.0, t1, 2001), rtol=1e-9, atol=1e-11
    )
    phi, theta = run.q.T
    print(f"{run.result} angular momentum kept to {float(jnp.ptp(run.momentum[:, 1])):.1e} of {run.momentum[0, 1]:.3f}")
    x, y = jnp.sin(phi) * jnp.cos(theta), jnp.sin(phi) * jnp.sin(theta)
    figure = Figure(figsize=(5.5, 5.5), layout="constrained")
    axis = figure.subplots()
    axis.plot(x, y, lw=0.8, color="#1f5fa8")
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="Spherical pendulum from above")
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "h0_spherical_pendulum.png", dpi=110)
    print(f"wrote {out / 'h0_spherical_pendulum.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
