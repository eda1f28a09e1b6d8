"""Fits to the measured record of a positioning axis (EMPS), one friction model after the other.

Each fit is run again with five integration steps for every sample: what changes then would be an artefact of the
step, not the machine. The record is A. Janot, M. Gautier, M. Brunot, "Data set and reference models of EMPS",
Workshop on Nonlinear System Identification Benchmarks, 2019; it is read from where it lies and not part of this
repository.

Run it: `python examples/b0_positioning_axis.py [--record CSV] [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import jaxmodsim as jms
from jaxmodsim.identify import Continuation, FitResult, axis_models, axis_scene, fit, rough_axis, start_state
from jaxmodsim.plot import fit_figure

RECORD = Path(__file__).parents[2] / "shared" / "data" / "emps" / "train.csv"
DRIVE_GAIN = 35.15065188248547  # newtons per volt
SOURCE = "Record: A. Janot, M. Gautier, M. Brunot, EMPS, nonlinearbenchmark.org, 2019"


def resimulated(result: FitResult, substeps: int) -> float:
    """RMSE [m] of a fitted scene with more integration steps for every sample."""
    model, free = result.model, tuple(result.values)
    q0, qd0 = start_state(result.record)
    again = fit(model, result.record, free, q0=[q0], qd0=[qd0], substeps=substeps, max_steps=1)
    return again.rmse


def main(record_file: Path, out: Path, smoke: bool = False) -> None:
    """Fit each model, check the step, write figures."""
    if not record_file.exists():
        print(f"skipped: there is no record at {record_file}")
        return
    t, q, _, u = np.loadtxt(record_file, delimiter=",", skiprows=1).T
    record = jms.Record(t, q, {"u": DRIVE_GAIN * u}, name="EMPS")
    rough, (q0, qd0) = rough_axis(record), start_state(record)
    out.mkdir(parents=True, exist_ok=True)
    for name in ("coulomb",) if smoke else ("coulomb", "asymmetric", "drifting"):
        model = axis_models()[name]
        # The record starts in motion. A width that comes down from a large one does not get caught on the way.
        result = fit(
            axis_scene(model, rough),
            record,
            model.free,
            q0=[q0],
            qd0=[qd0],
            limits={"m": (0.0, None)},
            begin=Continuation("dry.width", 10.0, 2),
        )
        fine = resimulated(result, 5)
        print(f"\n{name}: {model.words}\n{result}\nwith five steps for every sample: RMSE {1e3 * fine:.4f} mm")
        fit_figure(result, caption=SOURCE).savefig(out / f"b0_emps_{name}.png", dpi=130)
    print(f"wrote figures to {out}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--record", type=Path, default=RECORD)
    parser.add_argument("--smoke", action="store_true", help="the first model alone")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    arguments = parser.parse_args()
    main(arguments.record, arguments.out, arguments.smoke)
