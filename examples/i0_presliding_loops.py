"""Presliding loops: what each law does before it breaks away.

A displacement that goes back and forth, with a small loop within the large one. Only Maxwell slip returns to where it
left the large loop: non-local memory.

Run it: `python examples/i0_presliding_loops.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxmodsim as jms


def displacement(t):
    """Out and back by 20 um, with an excursion back and forth on the way [m]."""
    corners = jnp.array([0.0, 20.0, -20.0, 8.0, -4.0, 20.0, -20.0])
    return 1e-6 * jnp.interp(t, jnp.arange(7.0), corners)


def main(out: Path, smoke: bool = False) -> None:
    """The force of each law under the same displacement; --smoke changes nothing."""
    t = jnp.linspace(0.0, 6.0, 3001)
    x = displacement(t)
    laws = {
        "Dahl": jms.Dahl(sigma0=2e5, Fc=1.0),
        "LuGre": jms.LuGre(sigma0=2e5, sigma1=10.0, sigma2=0.0, Fc=1.0, Fs=1.4, vs=1e-3),
        "MaxwellSlip": jms.MaxwellSlip(k=[1e5, 6e4, 4e4], Fc=[0.25, 0.35, 0.4]),
    }
    figure = Figure(figsize=(11, 4), layout="constrained")
    for axis, (name, law) in zip(figure.subplots(1, 3, sharey=True), laws.items(), strict=True):
        force = jms.identify.law_force(law, t, x)
        print(f"{name}: largest force {float(force.max()):.3f} N")
        axis.plot(1e6 * x, force, lw=1.0, color="#1f5fa8")
        axis.set(title=name, xlabel="displacement [um]", ylabel="force [N]" if name == "Dahl" else "")
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "i0_presliding_loops.png", dpi=110)
    print(f"wrote {out / 'i0_presliding_loops.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
