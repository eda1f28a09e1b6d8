"""`jaxmodsim testbench`: figures, table and sweep of the test bench."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd

from .._core.progress import progress_line
from .._core.speed import cores
from ..plot import ramp_figure, stick_figure
from ..problems.testbench import RampResult, ramp_cases, run_ramp, stick_sweep
from ._output import Content, show_paths, show_table, write

PARTS = {
    "a": "a: Coulomb friction by sign(v)",
    "b": "b: Coulomb friction, exact and regularised",
    "c": "c: Karnopp's dead zone",
    "d": "d: stiction, Stribeck effect and viscous friction, exact and regularised",
    "e": "e: LuGre",
}


def report_testbench(out: Path) -> None:
    """Run the bench, print its tables, write everything to `out`."""
    show_paths(write(out, testbench_files()))


def testbench_files() -> dict[str, Content]:
    """Run the bench and print its tables; returns figures, tables and JSON by file name."""
    cases = ramp_cases()
    with progress_line("test bench") as show, ThreadPoolExecutor(cores()) as pool:
        grid_of_runs = pool.submit(stick_sweep)  # compiles longest
        # Neighbours are alike: apart from each other, the second finds compiled what it needs.
        apart = cases[::2] + cases[1::2]
        for case, _ in zip(apart, pool.map(run_ramp, apart), strict=True):
            show(f"{case.part}: {case.label}")
        show("LuGre over sigma0 and sigma1")
        sweep = grid_of_runs.result()
    measured = [run_ramp(case) for case in cases]  # compiled by now, and timed alone
    table, grid = _table(measured), _grid(sweep)
    show_table(table, "A box of 2 kg under a force rising with time")
    show_table(grid, "LuGre in stick over sigma0 and sigma1")
    curves = _curves(measured)
    files: dict[str, Content] = {
        f"testbench_{part}.png": ramp_figure(title, [m.run for m in measured if m.case.part == part])
        for part, title in PARTS.items()
    }
    chosen = ((1, 0), (0, 0), (1, 2), (2, 0))
    gaps = {
        f"sigma0 {sweep['sigma0'][i]:g}, sigma1 {sweep['sigma1'][j]:g}": sweep["gap"][i, j] + sweep["t"]
        for i, j in chosen
    }
    files["testbench_stick.png"] = stick_figure(
        sweep["t"], gaps, sweep["t"], sweep["sigma0"], sweep["sigma1"], sweep["oscillation"]
    )
    files["testbench.csv"] = table
    files["testbench_stick.csv"] = grid
    files["testbench_curves.csv"] = curves
    files["testbench.json"] = {"models": table.to_dict("records"), "stick": grid.to_dict("records")}
    return files


def _table(measured: list[RampResult]) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "part": [m.case.part for m in measured],
            "model": [m.case.label for m in measured],
            "away [s]": [m.break_away for m in measured],
            "crossings": [m.crossings for m in measured],
            "v(10 s) [m/s]": [float(m.run.velocity[-1]) if m.ok else float("nan") for m in measured],
            "steps": [m.steps for m in measured],
            "run [ms]": [round(m.milliseconds, 2) for m in measured],
            "ending": [m.ending for m in measured],
        }
    )


def _grid(sweep: dict[str, np.ndarray]) -> pd.DataFrame:
    sigma0, sigma1 = np.meshgrid(sweep["sigma0"], sweep["sigma1"], indexing="ij")
    return pd.DataFrame(
        {
            "sigma0 [N/m]": sigma0.ravel(),
            "sigma1 [N s/m]": sigma1.ravel(),
            "oscillation [mN]": 1e3 * sweep["oscillation"].ravel(),
            "creep until 1.5 s [mm]": 1e3 * sweep["creep"].ravel(),
            "v(10 s) [m/s]": sweep["speed10"].ravel(),
            "steps": sweep["steps"].ravel(),
        }
    )


def _curves(measured: list[RampResult]) -> pd.DataFrame:
    """Every curve of the figures, one row for each model and time."""
    return pd.concat(
        pd.DataFrame(
            {
                "part": m.case.part,
                "model": m.case.label,
                "t [s]": m.run.t,
                "velocity [m/s]": m.run.velocity,
                "applied [N]": m.run.applied,
                "friction [N]": m.run.friction,
            }
        )
        for m in measured
    )
