"""Where stick-slip begins: a mass on a belt, over stiffness and belt velocity, in 100 000 runs.

A mass m on a spring k with a damper c beside it lies on a belt that moves at `belt`, with exact Coulomb friction: at
most Fs in stick, Fc < Fs in slip. Each run starts in stick, just before it breaks away. Then it either comes to rest
while the belt slides under it, or its velocity reaches that of the belt once more and it sticks. As every slip begins
in the same state, the second happens for ever or never: a run that sticks again after its first slip is stick-slip.

The boundary between the two is known: after break-away the mass swings freely, and on the boundary the next maximum of
its velocity just reaches that of the belt. That is one equation for (Fs - Fc)/(belt sqrt(k m)) at a given
zeta = c/(2 sqrt(k m)), derived at `jaxmodsim.problems.belt_oscillator.onset_speed`. For small zeta it gives
belt = (Fs - Fc)/sqrt(4 pi zeta k m).

Run it: `python examples/d0_stick_slip_map.py [--smoke] [--out DIR]`.
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from jaxmodsim.plot import map2d
from jaxmodsim.problems import belt_oscillator

# Mass [kg], damping [N s/m], friction in slip and at most in stick [N].
M, C, FC, FS = 1.0, 2.0, 5.0, 8.0


def first_slip(k, belt):
    """From stick, a tenth of a radian of the free swing before it breaks away, over one cycle of it."""
    scene = belt_oscillator.scene(jms.Coulomb(FC, FS), m=M, k=k, belt=belt, c=C)
    radian = jnp.sqrt(M / k)
    q0 = (FS - C * belt) / k - 0.1 * radian * belt
    return jms.simulate(scene, jnp.stack([q0]), jnp.stack([belt]), 8.0 * radian, throw=False)


def sticks_again(run):
    """Whether a second mode change, from slip to stick, follows the first one, which is break-away."""
    return run.stats["num_events"] >= 2


def main(out: Path, smoke: bool = False) -> None:
    """Sweep, compare with the boundary, and draw."""
    k = np.geomspace(5.0, 1e4, 20 if smoke else 400)
    belt = np.geomspace(0.04, 0.4, 16 if smoke else 250)
    started = time.perf_counter()
    runs = jms.sweep(first_slip, {"belt": belt, "k": k}, {"motion": sticks_again}, progress=True)
    elapsed = time.perf_counter() - started
    count = runs["result"].size
    print(f"{count} runs in {elapsed:.1f} s with compilation: {count / elapsed:,.0f} a second")

    runs["k"].attrs.update(units="N/m", long_name="stiffness k")
    runs["belt"].attrs.update(units="m/s", long_name="belt velocity")
    limit = belt_oscillator.onset_speed(m=M, k=k, c=C, Fc=FC, Fs=FS)
    agree = runs["motion"] == (runs["belt"].values[:, None] < np.asarray(limit)[None, :])
    print(f"{int(agree.sum())} of {count} agree with the boundary; failed: {int((runs['result'] != 0).sum())}")

    zeta = C / (2.0 * np.sqrt(k * M))
    figure = map2d(
        runs,
        "motion",
        title=f"{count:,} runs: does a mass of {M:g} kg on a belt stick again?\n"
        f"damping {C:g} N s/m, friction {FC:g} N in slip and at most {FS:g} N in stick",
        classes={0: "slides steadily", 1: "sticks and slips"},
        boundary={
            "boundary, exact": (k, limit),
            "for small damping: (Fs - Fc)/sqrt(4 pi zeta k m)": (k, (FS - FC) / np.sqrt(4.0 * np.pi * zeta * k * M)),
        },
    )
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "d0_stick_slip_map.png", dpi=130)
    print(f"wrote {out / 'd0_stick_slip_map.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    arguments = parser.parse_args()
    main(arguments.out, arguments.smoke)
