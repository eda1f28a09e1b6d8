"""`jaxmodsim fit` on the measured record of a positioning axis (EMPS): error, time, and what is left open.

Each model is fitted by the command line in a process of its own, start-up and compilation included. The fitted model
is then run once more with five integration steps for every sample: an error that changed would be an artefact of
the step. The record is A. Janot, M. Gautier, M. Brunot, "Data set and reference models of EMPS", Workshop on Nonlinear
System Identification Benchmarks, 2019; it lies beside the repository and not in it.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _measure import describe_machine, machine_line, write_json
from _options import begin

import jaxmodsim as jms
from jaxmodsim.identify import AXIS_MODELS, axis_scene, first_coordinate, replay, rough_axis, start_state

HERE = Path(__file__).parent
RECORD = HERE.parents[1] / "shared" / "data" / "emps" / "train.csv"
DRIVE_GAIN = 35.15065188248547
GOALS = {"coulomb": 2.65, "asymmetric": 1.80}


def main() -> None:
    """Fit, check, and write `measured_axis.json`."""
    options = begin(
        "jaxmodsim fit on a measured record.",
        smoke="the first model alone, into a temporary folder",
        record=RECORD,
    )
    if not options.record.exists():
        print(f"skipped: there is no record at {options.record}")
        return
    t, q, _, u = np.loadtxt(options.record, delimiter=",", skiprows=1).T
    record = jms.Record(t, q, {"u": DRIVE_GAIN * u}, name="EMPS")
    fits = {}
    for model in ("coulomb",) if options.smoke else AXIS_MODELS:
        fits[model] = run_command(options.record, model)
        fits[model]["rmse_fine"] = rmse_with_substeps(record, fits[model], 5)
        print(model, fits[model]["rmse"]["measured"], fits[model]["rmse_fine"], fits[model]["whole_seconds"])
    machine = describe_machine("jax", "jaxlib", "optimistix", "jaxmodsim")
    content = {"name": "measured_axis", "smoke": options.smoke, "machine": machine, "fits": fits, "goals_mm": GOALS}
    content["table"] = table(fits)
    content["caption"] = (
        f"EMPS record, 24 841 samples, open-loop simulation error of the position. {machine_line(machine)}"
    )
    write_json(options.out / "measured_axis.json", content)


def run_command(record: Path, model: str) -> dict[str, Any]:
    """One fit by the command line, timed from outside."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", "from jaxmodsim.cli import main; main()", "fit", str(record)]
        command += ["--force-gain", str(DRIVE_GAIN), "--model", model, "--out", folder]
        started = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        seconds = time.perf_counter() - started
        return json.loads((Path(folder) / "fit.json").read_text()) | {"whole_seconds": seconds}


def rmse_with_substeps(record: jms.Record, report: dict[str, Any], substeps: int) -> float:
    """RMSE [m] of a fitted model with `substeps` integration steps for every sample."""
    values = {name: entry["value"] for name, entry in report["parameters"].items()} | report["held"]
    scene = axis_scene(AXIS_MODELS[report["model"]], rough_axis(record), values)
    inputs = {name: jnp.asarray(x) for name, x in record.inputs.items()}
    q0, qd0 = (jnp.asarray([x]) for x in start_state(record))
    run = jax.jit(replay, static_argnums=(5, 6))
    position = run(scene, jnp.asarray(record.t), inputs, q0, qd0, substeps, first_coordinate)
    return float(jnp.sqrt(jnp.mean((position - record.measured) ** 2)))


def table(fits: dict[str, Any]) -> dict[str, Any]:
    """One row for each model."""
    rows = []
    for model, report in fits.items():
        open_ends = [
            remark.split(" is not determined")[0] for remark in report["remarks"] if "not determined" in remark
        ]
        rows.append(
            [
                model,
                f"{len(report['parameters'])}",
                f"{1e3 * report['rmse']['measured']:.2f}",
                f"{1e3 * report['rmse_fine']:.2f}",
                f"{GOALS[model]:.2f}" if model in GOALS else "",
                f"{report['whole_seconds']:.1f}",
                ", ".join(open_ends) or "-",
            ]
        )
    columns = ["model", "parameters", "RMSE [mm]", "with 5 steps a sample [mm]", "goal [mm]", "whole command [s]"]
    return {"columns": [*columns, "not determined by the record"], "rows": rows}


if __name__ == "__main__":
    main()
