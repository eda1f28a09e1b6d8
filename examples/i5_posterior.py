"""Posterior: how sure a fit is where its unknowns are no longer normal.

LuGre's six parameters from a synthetic record of a braked mass on a spring: the fit, then samples of all that is
unknown, the noise and its memory included, beside the standard errors of the fit.

Run it: `python examples/i5_posterior.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from jaxmodsim.identify import replay, sample_posterior
from jaxmodsim.plot import posterior_figure
from jaxmodsim.problems.braked_spring import driven_spring

FREE = ("friction.sigma0", "friction.sigma1", "friction.sigma2", "friction.Fc", "friction.Fs", "friction.vs")


def main(out: Path, smoke: bool = False) -> None:
    """Make a record, fit it, sample the posterior."""
    law = jms.LuGre(sigma0=1e4, sigma1=40.0, sigma2=2.0, Fc=1.0, Fs=1.5, vs=0.02)
    scene = driven_spring(law, m=1.0, k=200.0)
    t = np.arange(400 if smoke else 2000) * 2e-3
    u = 3 * np.sin(2 * np.pi * 0.7 * t) + 2 * np.sin(2 * np.pi * 1.9 * t) + 1.2 * np.sin(2 * np.pi * 0.31 * t)
    q = replay(scene, jnp.asarray(t), {"u": jnp.asarray(u)}, jnp.zeros(1), jnp.zeros(1))
    noisy = np.asarray(q) + 1e-4 * np.random.default_rng(0).standard_normal(t.size)
    result = jms.fit(scene, jms.Record(t, noisy, {"u": u}, name="spring"), FREE[3:] if smoke else FREE, q0=[0.0])
    few = {"draws": 20, "warmup": 30, "chains": 2}
    posterior = sample_posterior(result, **(few if smoke else {}))
    print(posterior)
    out.mkdir(parents=True, exist_ok=True)
    posterior_figure(posterior).savefig(out / "i5_posterior.png", dpi=110)
    print(f"wrote {out / 'i5_posterior.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
