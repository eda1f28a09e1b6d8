"""Sensitivity: which number matters, along the run.

The belt oscillator with exact stick and slip: derivatives of the position by every number, through all changes of mode.

Run it: `python examples/i1_sensitivity.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp

import jaxmodsim as jms
from jaxmodsim.plot import sensitivity_figure
from jaxmodsim.problems import belt_oscillator


def main(out: Path, smoke: bool = False) -> None:
    """Rank the numbers and draw their influence."""
    t1 = 2.0 if smoke else 6.0
    result = jms.sensitivity(
        belt_oscillator.scene(),
        "q[0]",
        ("m", "k", "friction.Fc", "friction.Fs", "friction.belt_velocity"),
        q0=[0.05],
        qd0=[0.1],
        t1=t1,
        ts=jnp.linspace(0.0, t1, 301),
    )
    print(result)
    figure = sensitivity_figure(result)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "i1_sensitivity.png", dpi=110)
    print(f"wrote {out / 'i1_sensitivity.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
