"""`jaxmodsim fit`: one axis, from a record of position and applied force."""

import difflib
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ..identify import AXIS_MODELS, FitResult, Record, axis_scene, fit, rough_axis
from ..plot import fit_figure
from ..scene import Scene, scene_numbers
from ._output import console, show_paths, show_table, write


@dataclass(frozen=True)
class AxisColumns:
    """Names of the record's columns, and newtons per unit of the force column."""

    time: str
    position: str
    force: str
    force_gain: float


def read_record(path: Path, columns: AxisColumns) -> Record:
    """Read a record from a CSV file.

    **Raises:**

    - `ValueError` naming a missing column and those that are there, a column that is no number, NaN, or times that
      do not increase; `OSError` if the file cannot be read.
    """
    if not np.isfinite(columns.force_gain) or columns.force_gain == 0:
        raise ValueError(f"--force-gain must be finite and not zero, but it is {columns.force_gain}.")
    if not path.is_file():
        raise ValueError(f"There is no file {path}.")
    try:
        frame = pd.read_csv(path)
    except (ValueError, pd.errors.ParserError) as error:
        raise ValueError(f"{path} is no CSV file with a header line: {error}") from error
    for option, name in (("time", columns.time), ("position", columns.position), ("force", columns.force)):
        if name not in frame.columns:
            near = difflib.get_close_matches(name, map(str, frame.columns), n=1)
            hint = f" Did you mean --{option} {near[0]}?" if near else ""
            raise ValueError(
                f"{path.name} has no column {name!r} (--{option}); it has: {', '.join(map(str, frame.columns))}.{hint}"
            )
        if not pd.api.types.is_numeric_dtype(frame[name]):
            bad = int(np.argmax(np.isnan(np.asarray(pd.to_numeric(frame[name], errors="coerce"), float))))
            given = frame[name].iloc[bad]
            raise ValueError(f"{path.name}: column {name!r} holds {given!r} in sample {bad}, which is no number.")
    force = columns.force_gain * frame[columns.force].to_numpy(float)
    return Record(
        frame[columns.time].to_numpy(float), frame[columns.position].to_numpy(float), {"u": force}, name=path.stem
    )


def _assignments(option: str, texts: list[str], known: list[str]) -> dict[str, float]:
    """Read NAME=VALUE options."""
    values: dict[str, float] = {}
    for text in texts:
        name, equals, number = text.partition("=")
        try:
            value = float(number)
        except ValueError:
            value = float("nan")
        if not equals or not np.isfinite(value):
            raise ValueError(f"{option} needs NAME=VALUE with a number, but {text!r} was given.")
        if name not in known:
            raise ValueError(f"{option} names {name!r}, but this model has: {', '.join(known)}.")
        values[name] = value
    return values


def run_fit(
    path: Path, columns: AxisColumns, model_name: str, start: list[str], fix: list[str], substeps: int, out: Path
) -> None:
    """Fit, print, and write figure, table and JSON to `out`."""
    if model_name not in AXIS_MODELS:
        raise ValueError(f"There is no model {model_name!r}; the models are: {', '.join(AXIS_MODELS)}.")
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out {out} is a file; a folder is needed.")
    model = AXIS_MODELS[model_name]
    record = read_record(path, columns)
    rough = rough_axis(record)
    known = [name for name in scene_numbers(axis_scene(model, rough)) if name != "u"]
    fixed = _assignments("--fix", fix, known)
    scene = axis_scene(model, rough, _assignments("--start", start, known), fixed)
    free = tuple(name for name in model.free if name not in fixed)
    result, seconds = fit_with_progress(scene, record, free, substeps=substeps)
    show_fit(result, f"{record.name}: {model.words}", "m")
    console.print(f"{len(record.t)} samples, {seconds:.1f} s with compilation")
    frame = pd.DataFrame({"t [s]": record.t, "measured [m]": record.measured, "simulated [m]": result.simulated})
    fitted = result.model
    assert isinstance(fitted, Scene)
    held = {
        name: float(x)
        for name, x in scene_numbers(fitted).items()
        if name not in free and name != "u" and not name.endswith("belt_velocity")
    }
    report = {"model": model_name, "words": model.words, **result.to_dict(), "held": held, "seconds": seconds}
    show_paths(write(out, {"fit.png": fit_figure(result), "fit.csv": frame, "fit.json": report}))


def fit_with_progress(scene: Scene, record: Record, free: tuple[str, ...], **options: Any) -> tuple[FitResult, float]:
    """`fit` of an axis with a line that shows how it goes; returns the result and the seconds it took."""
    started = time.perf_counter()
    with console.status("compiling") as status:

        def progress(step: int, rms: float, values: dict[str, float]) -> None:
            shown = ", ".join(f"{name} {value:.4g}" for name, value in values.items())
            status.update(f"iteration {step}: RMSE {rms:.6g}  {shown}")

        result = fit(scene, record, free, limits={"m": (0.0, None)}, progress=progress, **options)
    return result, time.perf_counter() - started


def show_fit(result: FitResult, title: str, unit: str) -> None:
    """Print a fit's table and remarks."""
    units = {"m": "kg", "offset": "N"}
    frame = pd.DataFrame(result.rows(), columns=["parameter", "value", "standard error", "start", "unit"])
    pairs = zip(frame["parameter"], frame["unit"], strict=True)
    frame["unit"] = [given or units.get(name, "") for name, given in pairs]
    show_table(frame, title)
    console.print(f"RMSE {result.rmse:.6g} {unit}; {result.evaluations} evaluations, {result.ending}", highlight=False)
    for remark in result.remarks:
        console.print(f"- {remark}", highlight=False)
