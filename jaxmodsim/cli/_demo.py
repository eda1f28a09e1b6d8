"""`jaxmodsim testbench` and `jaxmodsim demo`: the test bench, and a fit with known parameters."""

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas as pd

from .._core.progress import progress_line
from .._core.speed import cores
from ..friction import LuGre
from ..identify import Record, replay
from ..plot import fit_figure, ramp_figure, stick_figure, truth_figure
from ..problems import braked_spring
from ..problems.testbench import ramp_cases, run_ramp, stick_sweep
from ._fit import fit_with_progress
from ._output import Content, frame_of, say, show_paths, show_table, write

PARTS = {
    "a": "a: Coulomb friction by sign(v)",
    "b": "b: Coulomb friction, exact and regularised",
    "c": "c: Karnopp's dead zone",
    "d": "d: stiction, Stribeck effect and viscous friction, exact and regularised",
    "e": "e: LuGre",
}
# Runs of the stick figure, as indices into sigma0 and sigma1.
_STICK_RUNS = ((1, 0), (0, 0), (1, 2), (2, 0))

TRUTH = {"sigma0": 750.0, "sigma1": 10.0, "sigma2": 0.4, "Fc": 1.5, "Fs": 2.0, "vs": 0.05}
START = {"sigma0": 400.0, "sigma1": 3.0, "sigma2": 1.0, "Fc": 1.0, "Fs": 1.2, "vs": 0.1}
NOISE = 2e-4
SAMPLE = 2e-3


def report_testbench(out: Path) -> None:
    """Run the bench, print its tables and write everything to `out`."""
    show_paths(write(out, _testbench_files()))


def _testbench_files() -> dict[str, Content]:
    """Run the bench and print its tables; returns figures, tables and JSON by file name."""
    cases = ramp_cases()
    with progress_line("test bench") as show, ThreadPoolExecutor(cores()) as pool:
        grid_of_runs = pool.submit(stick_sweep)  # has the longest compilation
        # Neighbours share compiled code: run apart, the second finds it.
        apart = cases[::2] + cases[1::2]
        for case, _ in zip(apart, pool.map(run_ramp, apart), strict=True):
            show(f"{case.part}: {case.label}")
        show("LuGre over sigma0 and sigma1")
        sweep = grid_of_runs.result()
    results = [run_ramp(case) for case in cases]  # already compiled, and timed alone
    table = pd.DataFrame(
        {
            "part": x.case.part,
            "model": x.case.label,
            "away [s]": x.break_away,
            "crossings": x.crossings,
            "v(10 s) [m/s]": float(x.run.velocity[-1]) if x.ok else np.nan,
            "steps": x.steps,
            "run [ms]": round(x.milliseconds, 2),
            "ending": x.ending,
        }
        for x in results
    )
    show_table(table, "A box of 2 kg under a force rising with time")
    sigma0, sigma1 = np.meshgrid(sweep["sigma0"], sweep["sigma1"], indexing="ij")
    grid = {
        "sigma0 [N/m]": sigma0,
        "sigma1 [N s/m]": sigma1,
        "oscillation [mN]": 1e3 * sweep["oscillation"],
        "creep until 1.5 s [mm]": 1e3 * sweep["creep"],
        "v(10 s) [m/s]": sweep["speed10"],
        "steps": sweep["steps"],
    }
    stick = pd.DataFrame({name: values.ravel() for name, values in grid.items()})
    show_table(stick, "LuGre in stick over sigma0 and sigma1")
    curves = pd.concat(
        pd.DataFrame(
            {
                "part": x.case.part,
                "model": x.case.label,
                "t [s]": x.run.t,
                "velocity [m/s]": x.run.velocity,
                "applied [N]": x.run.applied,
                "friction [N]": x.run.friction,
            }
        )
        for x in results
    )
    gaps = {
        f"sigma0 {sweep['sigma0'][i]:g}, sigma1 {sweep['sigma1'][j]:g}": sweep["gap"][i, j] + sweep["t"]
        for i, j in _STICK_RUNS
    }
    axes = (sweep["t"], sweep["sigma0"], sweep["sigma1"])
    figures = {
        f"testbench_{part}.png": ramp_figure(title, [x.run for x in results if x.case.part == part])
        for part, title in PARTS.items()
    }
    return figures | {
        "testbench_stick.png": stick_figure(sweep["t"], gaps, *axes, sweep["oscillation"]),
        "testbench.csv": table,
        "testbench_stick.csv": stick,
        "testbench_curves.csv": curves,
        "testbench.json": {"models": table.to_dict("records"), "stick": stick.to_dict("records")},
    }


def synthetic_record() -> Record:
    """A simulated record of the sprung mass.

    The force has small cycles below break-away, slow ones through it, and fast ones in full slip, so that the record
    determines all six parameters. The simulation takes a tenth of the step of the fit, and white noise of 0.2 mm is
    added to the position.
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
    """Run the bench and the fit, print them and write everything to `out`."""
    files = _testbench_files()
    record, truth = synthetic_record(), {f"friction.{name}": value for name, value in TRUTH.items()}
    started = time.perf_counter()
    result = fit_with_progress(braked_spring.driven_spring(LuGre(**START)), record, tuple(truth), q0=[0.0])
    rows = [
        (name, truth[name], value, value - 1.96 * error, value + 1.96 * error, unit)
        for name, value, error, _, unit in result.estimate.rows()
    ]
    table = frame_of(rows, "parameter", "truth", "estimate", "95 % from", "to", "unit")
    show_table(table, "LuGre fitted to a synthetic record (simulated, with known parameters)")
    say(
        f"RMSE {1e6 * result.rmse:.3g} um with noise of {1e6 * NOISE:.3g} um;"
        f" {result.diagnostics.evaluations} evaluations, {time.perf_counter() - started:.1f} s with compilation"
    )
    files |= {
        "demo_fit.png": fit_figure(result, caption="Synthetic record, simulated"),
        "demo_truth.png": truth_figure(result, truth),
        "demo_fit.csv": table,
        "demo_fit.json": {"synthetic": True, "truth": truth, **result.to_dict()},
    }
    show_paths(write(out, files))
