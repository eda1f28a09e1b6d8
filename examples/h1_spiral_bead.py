"""Bead on a spherical spiral: free, and braked by drag.

One coordinate, the angle; the curve alone says all of the mechanics.

Run it: `python examples/h1_spiral_bead.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxmodsim as jms
from jaxmodsim.problems import spiral_bead


def main(out: Path, smoke: bool = False) -> None:
    """Let the bead slide without and with drag; --smoke changes nothing."""
    spiral = spiral_bead.SphericalSpiral(R=1.0, a=0.2)
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    space, speed = figure.add_subplot(1, 2, 1, projection="3d"), figure.add_subplot(1, 2, 2)
    for k, colour in ((0.0, "#1f5fa8"), (0.3, "#c2452d")):
        scene = spiral_bead.scene(a=0.2, k=k)
        run = jms.simulate(scene, [1.0], [1.0], 8.0, ts=jnp.linspace(0.0, 8.0, 2001))
        x, velocity = jax.vmap(lambda q, qd: jax.jvp(spiral, (q,), (qd,)))(run.q, run.qd)
        v = jnp.linalg.norm(velocity, axis=1)
        print(f"drag {k:g} N s/m: after 8 s at a height of {x[-1, 2]:.3f} m with {v[-1]:.2f} m/s")
        space.plot(*x.T, color=colour, lw=0.8)
        speed.plot(run.t, v, color=colour, label=f"drag {k:g} N s/m")
    space.set(title="path", aspect="equal")
    speed.set(xlabel="time [s]", ylabel="speed [m/s]", title="speed")
    speed.legend()
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "h1_spiral_bead.png", dpi=110)
    print(f"wrote {out / 'h1_spiral_bead.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
