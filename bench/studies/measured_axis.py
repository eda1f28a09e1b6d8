"""`jaxmodsim fit` on the measured EMPS record of a positioning axis: errors and undetermined parameters.

One command fits all models to the whole record and to three of its four parts in turn, including start-up and
compilation. Each fitted model is then run with five integration steps per sample, to check that the error does not
depend on the step. Each third of the record is predicted by fits to the other two.
"""

import json
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from bench.record import Result, command
from jaxmodsim.identify import (
    agreement,
    axis_models,
    axis_scene,
    estimate_axis,
    fit,
    predict,
    prediction_error,
    replay,
)

# Outside the repository: A. Janot, M. Gautier, M. Brunot, "Data set and reference models of EMPS",
# Workshop on Nonlinear System Identification Benchmarks, 2019.
EMPS, EMPS_GAIN = Path(__file__).parents[3] / "shared" / "data" / "emps" / "train.csv", 35.15065188248547
THIRDS = ("first", "middle", "last")


def main(smoke: bool, out: Path) -> Result | None:
    """Fit and check; a smoke run fits one model to a part. Without the record there is no result."""
    del out
    if not EMPS.exists():
        print(f"skipped: there is no record at {EMPS}")
        return None
    result = Result("measured_axis", ("scipy",), {"goal": 1.65})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record.csv"
        path.write_text("".join(EMPS.read_text().splitlines(keepends=True)[: 1501 if smoke else None]))
        t, q, _, u = np.loadtxt(path, delimiter=",", skiprows=1).T
        record = jms.Record(t, q, {"u": EMPS_GAIN * u}, name="EMPS")
        result.settings["samples"] = len(t)
        how = ("--laws", "coulomb" if smoke else "all", "--free", "+q0,+qd0")
        started = time.perf_counter()
        command("fit", str(path), *how, "--units", f"force={EMPS_GAIN}", "--out", folder)
        result.settings["seconds"] = round(time.perf_counter() - started)
        report = json.loads((Path(folder) / "fit.json").read_text())
    if smoke:
        result.add("RMSE with 5 steps a sample", _rmse(record, "coulomb", report["parameters"], 2), "m", peer="coulomb")
        _add_thirds(result, record, ("coulomb",), ("last",))
        return result
    for each in report["comparison"]["models"]:
        name = each["name"]
        result.add("parameters", each["parameters"], peer=name)
        for quantity, key in (("RMSE", "fitted"), ("held-out error", "held_out"), ("standard error", "standard_error")):
            result.add(quantity, each[key], "m", peer=name)
        fine = _rmse(record, name, report["comparison"]["fits"][name]["parameters"], 5)
        result.add("RMSE with 5 steps a sample", fine, "m", peer=name)
        result.add("not determined", ", ".join(each["undetermined"]) or "-", peer=name)
    _add_thirds(result, record, tuple(each["name"] for each in report["comparison"]["models"]), THIRDS)
    return result


def _add_thirds(result: Result, record: jms.Record, models: tuple[str, ...], held_out: tuple[str, ...]) -> None:
    """Thirds of the record, each predicted by a fit to the other two as two records."""
    count = len(record.t) // len(THIRDS)
    parts = {name: record.samples(i * count, (i + 1) * count, name) for i, name in enumerate(THIRDS)}
    for name in models:
        model = axis_models()[name]
        for held in held_out:
            fitted = [x for key, x in parts.items() if key != held]
            scene = axis_scene(model, estimate_axis(fitted[0]))
            found = fit(scene, fitted, model.free, limits={"m": (0.0, None)})
            agreed = agreement(found)
            predicted = predict(found, parts[held], agreement=agreed)
            half = 0.5 * (predicted.upper["measured"] - predicted.lower["measured"])[predicted.counts]
            row = {"peer": name, "at": f"{held} third"}
            result.add("error", predicted.score.rmse["measured"], "m", **row)
            result.add("expected error", prediction_error(found, agreement=agreed)["measured"].total, "m", **row)
            result.add("half band", float(np.sqrt(np.mean(half**2))), "m", **row)
            result.add("samples in the band", 100 * predicted.shares["measured"], "%", **row)


def _rmse(record: jms.Record, model: str, parameters: dict[str, Any], substeps: int) -> float:
    """RMSE [m] of a fitted model with `substeps` integration steps for every sample."""
    values = {name: x["value"] for name, x in parameters.items()}
    q0, qd0 = (jnp.asarray([values.pop(name)]) for name in ("q0[0]", "qd0[0]"))
    scene = axis_scene(axis_models()[model], estimate_axis(record), values)
    inputs = {name: jnp.asarray(x) for name, x in record.inputs.items()}
    run = jax.jit(replay, static_argnums=5)
    position = run(scene, jnp.asarray(record.t), inputs, q0, qd0, substeps)
    return float(jnp.sqrt(jnp.mean((position - record.measured) ** 2)))
