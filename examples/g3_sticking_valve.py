"""Sticking valve: dead band and slip-jump of a control valve.

The diaphragm's force goes up and down slowly; the stem waits, jumps, and waits again. This staircase is what makes
control loops hunt. Mass, spring and friction are of the size of a process valve's.

Run it: `python examples/g3_sticking_valve.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxmodsim as jms


def lagrangian(t, q, qd, p):
    """Stem on its spring [J]."""
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


def diaphragm(t, q, qd, p):
    """Force of the air on the diaphragm, up and down in `period` [N]."""
    return jnp.stack([p["force"] * jnp.sin(2.0 * jnp.pi * t / p["period"]) ** 2])


def main(out: Path, smoke: bool = False) -> None:
    """Two strokes, drawn over time and over the force."""
    packing = jms.Stribeck(Fc=1400.0, Fs=1700.0, vs=1e-3, Fv=600.0)
    params = {"m": 1.4, "k": 52500.0, "force": 6000.0, "period": 40.0}
    scene = jms.Scene(lagrangian, params, (jms.AppliedForce(diaphragm, name="air"), jms.Friction(packing)))
    t1 = 10.0 if smoke else 40.0
    run = jms.simulate(scene, [0.0], [0.0], t1, ts=jnp.linspace(0.0, t1, 4001), max_events=512)
    jumps = int(jnp.sum(jnp.isfinite(run.events.t)))
    print(f"{run.result} {jumps} changes between stick and slip in {int(run.stats['num_steps'])} steps")
    figure = Figure(figsize=(10, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    air, x = run.forces["air"][:, 0], 1e3 * run.q[:, 0]
    left.plot(run.t, air / params["k"] * 1e3, color="#8a8a8a", ls="--", label="without friction")
    left.plot(run.t, x, color="#1f5fa8", label="stem")
    left.set(xlabel="time [s]", ylabel="position [mm]", title="Stem of a valve")
    left.legend()
    right.plot(1e-3 * air, x, color="#1f5fa8")
    right.set(xlabel="force of the air [kN]", ylabel="position [mm]", title="Dead band")
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "g3_sticking_valve.png", dpi=110)
    print(f"wrote {out / 'g3_sticking_valve.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
