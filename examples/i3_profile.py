"""Profile likelihood: how sure a fit is, beyond the parabola.

LuGre's sigma0 and Fc from a synthetic presliding record with noise; then the fit is repeated with one of them held.

Run it: `python examples/i3_profile.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from jaxmodsim.identify import law_force, profile
from jaxmodsim.plot import profile_figure


def main(out: Path, smoke: bool = False) -> None:
    """Make a record, fit it, follow the likelihood."""
    t = np.linspace(0.0, 4.0, 401 if smoke else 2001)
    x = 15e-6 * np.sin(2.0 * np.pi * t) * np.minimum(1.0, t)
    truth = jms.LuGre(sigma0=2e5, sigma1=10.0, sigma2=0.0, Fc=1.0, Fs=1.0, vs=1e-3)
    force = np.asarray(law_force(truth, jnp.asarray(t), jnp.asarray(x)))
    noisy = force + 0.02 * np.random.default_rng(0).standard_normal(t.size)
    start = jms.LuGre(sigma0=5e4, sigma1=10.0, sigma2=0.0, Fc=0.6, Fs=0.6, vs=1e-3)
    result = jms.fit_law(start, jms.Record(t, noisy, {"x": x}, name="loops"), ("sigma0", "Fc"))
    print(result)
    curve = profile(result, "sigma0")
    print(curve)
    figure = profile_figure(curve)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "i3_profile.png", dpi=110)
    print(f"wrote {out / 'i3_profile.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
