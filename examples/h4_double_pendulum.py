"""Double pendulum: 64 starts that differ by a millionth part in ways.

One vmap. They stay together for some seconds and then lose each other: what a simulation can and cannot predict.

Run it: `python examples/h4_double_pendulum.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxmodsim as jms
from jaxmodsim.problems import n_link_pendulum


def main(out: Path, smoke: bool = False) -> None:
    """Run them side by side and draw how far they are apart."""
    count, t1 = (8, 10.0) if smoke else (64, 25.0)
    scene, ts = n_link_pendulum.double_pendulum(), jnp.linspace(0.0, t1, 1001)

    def swing(nudge):
        return jms.simulate(scene, jnp.stack([2.0, 2.0 + nudge]), [0.0, 0.0], t1, ts=ts, rtol=1e-10, atol=1e-12).q

    q = jax.jit(jax.vmap(swing))(1e-6 * jnp.linspace(-1.0, 1.0, count))
    spread = jnp.max(jnp.ptp(q, axis=0), axis=1)
    lost = ts[jnp.argmax(spread > 0.1)]
    print(f"{count} runs: apart by more than 0.1 rad from {float(lost):.1f} s on")
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(ts, q[:, :, 1].T, lw=0.4, color="#1f5fa8", alpha=0.5)
    above.set(ylabel="second angle [rad]", title=f"{count} double pendulums, starts 1e-6 rad apart")
    below.semilogy(ts, spread, color="#c2452d")
    below.set(ylabel="spread [rad]", xlabel="time [s]")
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "h4_double_pendulum.png", dpi=110)
    print(f"wrote {out / 'h4_double_pendulum.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
