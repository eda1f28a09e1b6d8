"""Drill string: the bit sticks while the table above turns on.

A kilometre of pipe is a soft torsional spring. At low speed the bit stops, the pipe winds up, and the bit breaks loose
at more than twice the speed of the table; above a certain speed it turns evenly.

Run it: `python examples/g1_drill_string.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxmodsim as jms


def lagrangian(t, q, qd, p):
    """Bit below a pipe whose upper end turns at `speed` [J]."""
    return 0.5 * p["J"] * qd[0] ** 2 - 0.5 * p["k"] * (p["speed"] * t - q[0]) ** 2


def main(out: Path, smoke: bool = False) -> None:
    """Drill at three speeds of the table, in one vmap."""
    rock = jms.Stribeck(Fc=4000.0, Fs=7000.0, vs=1.0, Fv=40.0)  # torque [N m], velocity [rad/s]
    t1, speeds = (10.0 if smoke else 40.0), jnp.array([4.0, 8.0, 16.0])

    def drill(speed):
        params = {"J": 470.0, "k": 860.0, "speed": speed}
        scene = jms.Scene(lagrangian, params, (jms.Friction(rock, name="rock"),))
        run = jms.simulate(scene, [0.0], [0.0], t1, ts=jnp.linspace(0.0, t1, 2001))
        return run.t, run.qd[:, 0], run.mode["rock"]

    t, bit, mode = jax.jit(jax.vmap(drill))(speeds)
    figure = Figure(figsize=(9, 6), layout="constrained")
    for axis, speed, v, m in zip(figure.subplots(3, 1, sharex=True), speeds, bit, mode, strict=True):
        share = float(jnp.mean(m == 0))
        print(f"table at {speed:4.1f} rad/s: bit at most {v.max():5.1f} rad/s, stuck {100 * share:.0f} % of the time")
        axis.plot(t[0], v, color="#1f5fa8", label="bit")
        axis.axhline(speed, color="#8a8a8a", ls="--", label="table")
        axis.set(ylabel="speed [rad/s]", title=f"table at {speed:g} rad/s")
    axis.set_xlabel("time [s]")
    axis.legend()
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "g1_drill_string.png", dpi=110)
    print(f"wrote {out / 'g1_drill_string.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
