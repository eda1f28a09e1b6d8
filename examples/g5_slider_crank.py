"""Slider-crank: a loop closed by constraints, and the force that the guide must bear.

Crank, rod and slider under gravity, with friction of the guide by its own reaction (left out by --smoke, which saves
most of the compilation).

Run it: `python examples/g5_slider_crank.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxmodsim as jms
from jaxmodsim.problems import slider_crank


def main(out: Path, smoke: bool = False) -> None:
    """Turn it by hand and let it run."""
    scene = slider_crank.scene(mu=None if smoke else 0.1)
    q0, qd0 = slider_crank.state(0.6, 12.0)
    run = jms.simulate(scene, q0, qd0, 2.0, ts=jnp.linspace(0.0, 2.0, 1001))
    guide = run.reactions["guide"].multiplier[:, 0]
    print(f"{run.result} The guide bears {float(guide.min()):.1f} to {float(guide.max()):.1f} N.")
    figure = Figure(figsize=(9, 6), layout="constrained")
    above, middle, below = figure.subplots(3, 1, sharex=True)
    above.plot(run.t, run.qd[:, 0], color="#1f5fa8")
    above.set(ylabel="crank [rad/s]", title="A slider-crank that runs out")
    middle.plot(run.t, run.q[:, 2], color="#1f5fa8")
    middle.set(ylabel="slider [m]")
    below.plot(run.t, guide, color="#c2452d")
    below.set(ylabel="guide [N]", xlabel="time [s]")
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "g5_slider_crank.png", dpi=110)
    print(f"wrote {out / 'g5_slider_crank.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
