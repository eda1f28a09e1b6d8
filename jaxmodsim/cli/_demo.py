"""`jaxmodsim demo`: the test bench, and a fit whose truth is known."""

import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas as pd

from ..friction import LuGre
from ..identify import Record, replay
from ..plot import fit_figure, truth_figure
from ..problems import braked_spring
from ._fit import fit_with_progress
from ._output import console, show_paths, show_table, write
from ._report import testbench_files

TRUTH = {"sigma0": 750.0, "sigma1": 10.0, "sigma2": 0.4, "Fc": 1.5, "Fs": 2.0, "vs": 0.05}
START = {"sigma0": 400.0, "sigma1": 3.0, "sigma2": 1.0, "Fc": 1.0, "Fs": 1.2, "vs": 0.1}
NOISE = 2e-4
SAMPLE = 2e-3


def synthetic_record() -> Record:
    """A record of the sprung mass that the package makes itself.

    The force has small cycles below break-away, slow ones through it, and fast ones in full slip, so that all six
    parameters show. Truth runs at a tenth of the step of the fit, and white noise of 0.2 mm is added to the position.
    """
    t = np.arange(0.0, 16.0, SAMPLE)
    amplitude = np.interp(t, [0.0, 3.0, 4.0, 9.0, 10.0, 16.0], [1.2, 1.2, 3.5, 3.5, 8.0, 8.0])
    frequency = np.interp(t, [0.0, 3.0, 4.0, 9.0, 10.0, 16.0], [1.0, 1.0, 0.4, 0.4, 0.8, 0.8])
    u = amplitude * np.sin(2 * np.pi * np.cumsum(frequency) * SAMPLE)
    zero = jnp.zeros(1)
    clean = replay(braked_spring.driven_spring(LuGre(**TRUTH)), jnp.asarray(t), {"u": jnp.asarray(u)}, zero, zero, 10)
    noise = NOISE * np.random.default_rng(1).standard_normal(t.size)
    return Record(t, np.asarray(clean) + noise, {"u": u}, name="synthetic record")


def run_demo(out: Path) -> None:
    """Run, print, and write everything to `out`."""
    files = testbench_files()
    record = synthetic_record()
    free = tuple(f"friction.{name}" for name in TRUTH)
    started = time.perf_counter()
    result = fit_with_progress(braked_spring.driven_spring(LuGre(**START)), record, free, q0=[0.0])
    truth = {f"friction.{name}": value for name, value in TRUTH.items()}
    frame = pd.DataFrame(
        [
            (
                name,
                true,
                result.values[name],
                result.values[name] - 1.96 * result.errors[name],
                result.values[name] + 1.96 * result.errors[name],
                result.estimate.units[name],
            )
            for name, true in truth.items()
        ],
        columns=["parameter", "truth", "estimate", "95 % from", "to", "unit"],
    )
    show_table(frame, "LuGre fitted to a synthetic record (made by the package, truth known)")
    console.print(
        f"RMSE {1e6 * result.rmse:.3g} um with noise of {1e6 * NOISE:.3g} um;"
        f" {result.diagnostics.evaluations} evaluations, {time.perf_counter() - started:.1f} s with compilation",
        highlight=False,
    )
    files["demo_fit.png"] = fit_figure(result, caption="Synthetic record, made by the package")
    files["demo_truth.png"] = truth_figure(result, truth)
    files["demo_fit.csv"] = frame
    files["demo_fit.json"] = {"synthetic": True, "truth": truth, **result.to_dict()}
    show_paths(write(out, files))
