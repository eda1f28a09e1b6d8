"""Fits to the measured record of a positioning axis (EMPS), one friction model after the other, and their comparison.

One of the models is defined here: the drift of this drive's offset, which no model of the library has.

Each fit is run again with five integration steps for every sample: what changes then would be an artefact of the
step, not the machine. The record is A. Janot, M. Gautier, M. Brunot, "Data set and reference models of EMPS",
Workshop on Nonlinear System Identification Benchmarks, 2019; it is read from where it lies and not part of this
repository.

Run it: `python examples/b0_positioning_axis.py [--record CSV] [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxmodsim as jms
from jaxmodsim.identify import (
    AxisModel,
    Candidate,
    axis_models,
    axis_scene,
    compare,
    estimate_axis,
    fit,
)
from jaxmodsim.plot import fit_figure

RECORD = Path(__file__).parents[2] / "shared" / "data" / "emps" / "train.csv"
DRIVE_GAIN = 35.15065188248547  # newtons per volt
# Time [s] over which the offset of the drive dies away, where a record does not tell. On this drive, which warms up
# over 25 s, 8 s or a straight line follow it as well.
DRIFT_TIME = 20.0
SOURCE = "Record: A. Janot, M. Gautier, M. Brunot, EMPS, nonlinearbenchmark.org, 2019"


def drift_force(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    """Part of the drive's offset [N] that dies away from the first sample on, `-drift exp(-(t - t0)/tau)`."""
    del q, qd
    since = jnp.maximum(t - p["t0"], 0.0)
    return jnp.reshape(-p["drift"] * jnp.exp(-since / p["tau"]), (1,))


def models() -> dict[str, AxisModel]:
    """Two models of the library, and the second with the drift."""
    asymmetric = axis_models()["asymmetric"]
    drifting = AxisModel(
        effects=lambda estimate: (jms.AppliedForce(drift_force, name="drift"), *asymmetric.effects(estimate)),
        free=("m", "drift", *(name for name in asymmetric.free if name != "m")),
        description="as asymmetric, with a part of the drive's offset that dies away over the time tau",
        params=lambda estimate: {"drift": 0.0, "tau": DRIFT_TIME, "t0": estimate.start},
    )
    return {"coulomb": axis_models()["coulomb"], "asymmetric": asymmetric, "drifting": drifting}


def main(record_file: Path, out: Path, smoke: bool = False) -> None:
    """Fit each model, check the step, write figures."""
    if not record_file.exists():
        print(f"skipped: there is no record at {record_file}")
        return
    t, q, _, u = np.loadtxt(record_file, delimiter=",", skiprows=1).T
    record = jms.Record(t, q, {"u": DRIVE_GAIN * u}, name="EMPS")
    estimate = estimate_axis(record)
    out.mkdir(parents=True, exist_ok=True)
    fitted = models()
    for name in ("coulomb",) if smoke else fitted:
        model = fitted[name]
        result = fit(
            axis_scene(model, estimate),
            record,
            model.free,
            limits={"m": (0.0, None)},
        )
        moved = 1e3 * result.diagnostics.step_error["measured"]
        print(f"\n{name}: {model.description}\n{result}\nfour steps for every sample move it by {moved:.4f} mm")
        fit_figure(result, caption=SOURCE).savefig(out / f"b0_emps_{name}.png", dpi=130)
    if not smoke:
        candidates = {name: Candidate(axis_scene(x, estimate), x.free, x.description) for name, x in fitted.items()}
        print(f"\n{compare(candidates, record, limits={'m': (0.0, None)})}")
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
