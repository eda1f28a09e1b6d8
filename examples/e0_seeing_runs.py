"""Runs to look at: a figure and a film of a pendulum, a four-bar, a slider-crank and a block on a belt.

Run it: `python examples/e0_seeing_runs.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp

import jaxmodsim as jms
from jaxmodsim import plot, problems


def at(length, angle):
    """A vector of this length, counterclockwise from the x axis [m]."""
    return length * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def pendulum(q, p):
    """Pivot and bob [m]; the angle is from straight down."""
    return jnp.stack([jnp.zeros(2), at(p["l"], q[0] - 0.5 * jnp.pi)])


def four_bar(q, p):
    """From the bearing of the crank to that of the rocker [m]."""
    crank, ground = at(p["a"], q[0]), jnp.stack([p["d"], 0.0 * p["d"]])
    return jnp.stack([jnp.zeros(2), crank, crank + at(p["b"], q[1]), ground])


def slider_crank(q, p):
    """Bearing, end of the crank, slider [m]."""
    return jnp.stack([jnp.zeros(2), at(p["r"], q[0]), q[2:]])


def belt(q):
    """The spring from its wall to the block, and the block [m]."""
    corners = 0.05 * jnp.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    block = jnp.stack([q[0], 0.0 * q[0]])
    return jnp.stack([jnp.array([-0.8, 0.0]), block]), block + corners


def main(out: Path, smoke: bool = False) -> None:
    """Run each, draw it, film it, and write its table."""
    ts = jnp.linspace(0.0, 2.0 if smoke else 6.0, 101 if smoke else 1201)
    cases = {
        "pendulum": (problems.stick_slip_pendulum.scene(), ([1.2], [0.0]), pendulum),
        "four_bar": (problems.four_bar.scene(), problems.four_bar.state(0.7, 8.0), four_bar),
        "slider_crank": (
            problems.slider_crank.scene(mu=None if smoke else 0.1),
            problems.slider_crank.state(0.6, 9.0),
            slider_crank,
        ),
        "belt": (problems.belt_oscillator.scene(), ([0.0], [0.0]), belt),
    }
    out.mkdir(parents=True, exist_ok=True)
    for name, (scene, (q0, qd0), points) in cases.items():
        run = jms.simulate(scene, q0, qd0, float(ts[-1]), ts=ts)
        plot.run(run).savefig(out / f"e0_{name}.png", dpi=130)
        film = plot.animate(run, points, fps=5 if smoke else 25)
        film.save(out / f"e0_{name}.gif")
        run.to_dataframe().to_csv(out / f"e0_{name}.csv")
        print(f"{name}: {', '.join(run.to_dataframe().columns)}")
    film.save(out / "e0_belt.html")
    print(f"wrote figures, films and tables to {out}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    arguments = parser.parse_args()
    main(arguments.out, arguments.smoke)
