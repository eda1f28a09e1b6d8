"""A turbine blade with a dry damper: the load of the damper that makes its resonance smallest.

The damper gives way elastically and then slips, here by Dahl's law: all the time under a small load, hardly under a
large one; either way the blade resonates. In between friction takes most energy out of it. Each curve is a branch of
periodic orbits over the frequency of the excitation, with Floquet multipliers that say whether they are stable.

Run it: `python examples/g9_turbine_blade.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import jaxmodsim as jms

# Mass [kg], stiffness [N/m] and damping [N s/m] of the blade, amplitude of the force [N].
BLADE = {"m": 1.0, "k": 1e4, "c": 4.0, "F": 10.0}
DAMPER = 5e3  # stiffness of the damper [N/m]


def lagrangian(t, q, qd, p):
    """Blade as one mode [J]."""
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


def force(t, q, qd, p):
    """Excitation and damping of the blade [N]."""
    return jnp.stack([p["F"] * jnp.cos(p["W"] * t) - p["c"] * qd[0]])


def period(p):
    """That of the excitation [s]."""
    return 2.0 * jnp.pi / p["W"]


def scene(load, W):
    """Blade and damper, which slips at the friction force `load` [N]."""
    damper = jms.Friction(jms.Dahl(sigma0=DAMPER, Fc=load), name="damper")
    return jms.Scene(lagrangian, {**BLADE, "W": W}, (jms.AppliedForce(force), damper), coordinates=("tip [m]",))


def main(out: Path, smoke: bool = False) -> None:
    """Follow the response over the frequency for some loads, and draw it."""
    low, high = (100.0, 102.0) if smoke else (80.0, 145.0)
    figure, axes = plt.subplots(figsize=(5.5, 3.4), layout="constrained")
    for load in (20.0,) if smoke else (5.0, 10.0, 20.0, 40.0, 200.0):
        start = ([0.0], [0.0])
        branch = jms.continue_orbits(
            scene(load, low), start, "W", (low, high), period=period, settle=2.0, step=0.1, rtol=1e-9
        )
        worst = branch.amplitude[:, 0].argmax()
        peak, at = 1e3 * branch.amplitude[worst, 0], branch.values[worst]
        print(f"load {load:g} N: at most {peak:.2f} mm, at {at:.1f} rad/s, {branch.stable.sum()} orbits stable")
        axes.plot(branch.values, 1e3 * branch.amplitude[:, 0], label=f"{load:g} N")
    axes.set(xlabel="frequency of the excitation [rad/s]", ylabel="amplitude of the tip [mm]")
    axes.legend(title="load of the damper", frameon=False)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "g9_turbine_blade.png", dpi=110)
    print(f"wrote {out / 'g9_turbine_blade.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
