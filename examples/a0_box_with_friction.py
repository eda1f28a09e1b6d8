"""A box on a table with LuGre friction: the page of code of the README, with its figure.

Run it: `python examples/a0_box_with_friction.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from jaxmodsim.plot import ramp_figure
from jaxmodsim.problems.testbench import RampRun


def lagrangian(t, q, qd, p):
    """Kinetic energy of the box [J]."""
    return 0.5 * p["m"] * qd[0] ** 2


def pull(t, q, qd, p):
    """A force that rises by 1 N each second [N]."""
    return jnp.array([1.0 * t])


def main(out: Path, smoke: bool = False) -> None:
    """Simulate, differentiate, sweep and draw."""
    scene = jms.Scene(
        lagrangian,
        params={"m": 2.0},
        effects=(
            jms.AppliedForce(pull),
            jms.Friction(jms.LuGre(sigma0=750.0, sigma1=0.0, sigma2=0.1, Fc=1.5, Fs=1.75, vs=0.2)),
        ),
    )
    run = jms.simulate(scene, q0=[0.0], qd0=[0.0], t1=10.0, ts=jnp.linspace(0.0, 10.0, 201 if smoke else 2001))
    print(f"{run.result}: v(10 s) = {run.qd[-1, 0]:.6f} m/s in {run.stats['num_steps']} steps")
    print(f"energy balance off by at most {float(jnp.max(jnp.abs(run.energy.balance))):.1e} J")

    def speed(scene):
        return jms.simulate(scene, q0=[0.0], qd0=[0.0], t1=10.0).qd[-1, 0]

    gradient = jax.grad(speed)(scene)
    law = gradient.effects[1].law
    print(
        "dv(10 s)/d: " + ", ".join(f"{name} {float(getattr(law, name)):.3g}" for name in ("sigma0", "Fc", "Fs", "vs"))
    )

    masses = jnp.linspace(1.0, 4.0, 4 if smoke else 64)
    speeds = jax.vmap(lambda m: speed(jms.Scene(lagrangian, {"m": m}, scene.effects)))(masses)
    print(f"masses {masses[0]:g} to {masses[-1]:g} kg: v(10 s) from {speeds[0]:.2f} to {speeds[-1]:.2f} m/s")

    drawn = RampRun(
        "LuGre, sigma0 750 N/m",
        np.asarray(run.t),
        np.asarray(run.qd[:, 0]),
        np.asarray(run.forces["applied"][:, 0]),
        np.asarray(run.forces["friction"]),
    )
    out.mkdir(parents=True, exist_ok=True)
    ramp_figure("Box of 2 kg under a force of 1 N/s", [drawn]).savefig(out / "a0_box.png", dpi=130)
    print(f"wrote {out / 'a0_box.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    arguments = parser.parse_args()
    main(arguments.out, arguments.smoke)
