"""Foucault's pendulum: the plane of its swings turns with the ground.

A term of the Lagrangian that is linear in the velocities; the angle after some swings agrees with the closed form. The
Earth turns 200 times faster here, so that it shows.

Run it: `python examples/h2_foucault.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxmodsim as jms
from jaxmodsim.problems import foucault_pendulum


def main(out: Path, smoke: bool = False) -> None:
    """Swing above a fast Earth."""
    Omega, t1 = 200.0 * foucault_pendulum.PARAMS["Omega"], 200.0 if smoke else 600.0
    scene = foucault_pendulum.scene(Omega=Omega)
    run = jms.simulate(scene, [3.0, 0.0], [0.0, 0.0], t1, ts=jnp.linspace(0.0, t1, 4001), rtol=1e-9, atol=1e-11)
    rate = float(foucault_pendulum.precession(Omega=Omega))
    print(f"{run.result} The plane turns by {jnp.rad2deg(abs(rate)) * t1:.0f} degrees in {t1:g} s.")
    figure = Figure(figsize=(5.5, 5.5), layout="constrained")
    axis = figure.subplots()
    axis.plot(*run.q.T, lw=0.6, color="#1f5fa8")
    axis.set(aspect="equal", xlabel="east [m]", ylabel="north [m]", title="Foucault's pendulum, Earth 200 times faster")
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "h2_foucault.png", dpi=110)
    print(f"wrote {out / 'h2_foucault.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
