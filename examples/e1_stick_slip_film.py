"""Stick-slip film: a block on a belt, held by a spring, with the friction force beside it.

The belt carries the block until the spring breaks it away at `Fs`; the block slips back under `Fc` and sticks again. In
stick the force follows the spring, in slip it is constant, and at each change it jumps at the exact instant.

Run it: `python examples/e1_stick_slip_film.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp

import jaxmodsim as jms
from jaxmodsim import plot, problems

BELT = -0.1  # velocity of the belt: to the left [m/s]


def drawing(q, p):
    """Middle of the block, the block, the spring to its wall, the belt with its teeth, and the wall [m]."""
    side, wall = 0.025, 0.16
    middle = jnp.stack([q[0], 0.0 * q[0] + side])
    block = middle + side * jnp.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    turns = jnp.array([0.0, 0.0, *(0.008 * (-1.0) ** i for i in range(14)), 0.0, 0.0])
    spring = jnp.stack([jnp.linspace(q[0] + side, wall, 18), side + turns], axis=1)
    steps = jnp.array([[0.0, -0.01], [0.01, -0.01], [0.01, 0.0], [0.02, 0.0]])
    starts = -0.13 + 0.02 * jnp.arange(14) + p["belt"] % 0.02  # as one tooth leaves, another one comes
    belt = (jnp.stack([starts, 0.0 * starts], axis=1)[:, None] + steps).reshape(-1, 2) + jnp.array([0.0, -0.002])
    return middle[None], block, spring, belt, jnp.array([[wall, -0.012], [wall, 0.075]])


def main(out: Path, smoke: bool = False) -> None:
    """Run four cycles, film them and draw them."""
    period = float(problems.belt_oscillator.cycle(**problems.belt_oscillator.PARAMS).period)  # [s]
    end = (1.0 if smoke else 4.0) * period
    machine = problems.belt_oscillator.scene(belt=BELT)
    belt = jms.Signal([0.0, end], [0.0, BELT * end], linear=True)
    scene = jms.Scene(machine.lagrangian, {**machine.params, "belt": belt}, machine.effects, coordinates=("x [m]",))
    run = jms.simulate(scene, [-0.05], [BELT], end, ts=jnp.linspace(0.0, end, 2001), rtol=1e-8)
    film = plot.animate(run, drawing, signals=("friction",), fps=5 if smoke else 25)
    out.mkdir(parents=True, exist_ok=True)
    film.save(out / "e1_stick_slip.gif")
    plot.run(run).savefig(out / "e1_stick_slip.png", dpi=100)
    print(f"{len(run.mode_changes)} mode changes in {end:.2f} s")
    print(f"wrote {out / 'e1_stick_slip.gif'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    arguments = parser.parse_args()
    main(arguments.out, arguments.smoke)
