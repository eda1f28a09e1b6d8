"""`jaxmodsim fit`: one axis, from a record of position and applied force."""

import difflib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array

from ..effects import AbstractEffect, AppliedForce, Friction
from ..friction import Coulomb, LuGre, Regularized, Stribeck, Viscous, asymmetric
from ..identify import FitResult, Record, fit
from ..plot import fit_figure
from ..scene import Scene, replace_numbers, scene_numbers
from ._output import console, show_paths, show_table, write


@dataclass(frozen=True)
class AxisColumns:
    """Names of the record's columns, and newtons per unit of the force column."""

    time: str
    position: str
    force: str
    force_gain: float


def _axis_lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    del t, q
    return 0.5 * p["m"] * qd[0] ** 2


def _drive(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    del t, q, qd
    return jnp.reshape(p["u"] - p["offset"], (1,))


@dataclass(frozen=True)
class Rough:
    """A first idea of an axis: mass [kg], viscous [N s/m] and dry friction [N], offset [N], top speed [m/s]."""

    m: float
    Fv: float
    Fc: float
    offset: float
    top: float


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


def rough_axis(record: Record) -> Rough:
    """Start values by linear regression of the force on acceleration, velocity and its sign.

    Differentiated positions are noisy, so they are smoothed first; the simulation then does the real work.
    """
    span = max(len(record.t) // 1000, 3)
    kernel = np.hanning(2 * span + 3)[1:-1]
    kernel /= kernel.sum()
    edge = 3 * span

    def smooth(x: np.ndarray) -> np.ndarray:
        return np.convolve(np.pad(x, span, mode="edge"), kernel, mode="valid")

    velocity = smooth(np.gradient(smooth(record.measured), record.t))
    acceleration = np.gradient(velocity, record.t)
    inside = slice(edge, -edge) if len(record.t) > 4 * edge else slice(None)
    v, a, u = (x[inside] for x in (velocity, acceleration, smooth(record.inputs["u"])))
    top = float(np.max(np.abs(v)))
    if top == 0.0:
        raise ValueError(f"{record.name}: the position never changes, so nothing can be fitted.")
    moving = np.abs(v) > 0.05 * top
    columns = np.column_stack([a, v, np.sign(v), np.ones_like(v)])[moving]
    m, Fv, Fc, offset = np.linalg.lstsq(columns, u[moving], rcond=None)[0]
    scale = float(np.sqrt(np.mean(u**2))) or 1.0
    return Rough(
        m if m > 0 else scale / max(float(np.max(np.abs(a))), 1e-12),
        Fv if Fv > 0 else 0.1 * scale / top,
        Fc if Fc > 0 else 0.1 * scale,
        float(offset),
        top,
    )


def _coulomb(rough: Rough) -> tuple[AbstractEffect, ...]:
    return (
        Friction(Regularized(Coulomb(rough.Fc), 0.005 * rough.top), name="dry"),
        Friction(Viscous(rough.Fv), name="viscous"),
    )


def _asymmetric(rough: Rough) -> tuple[AbstractEffect, ...]:
    return (
        Friction(Regularized(asymmetric(Coulomb(rough.Fc), Fc=rough.Fc), 0.005 * rough.top), name="dry"),
        Friction(asymmetric(Viscous(rough.Fv), Fv=rough.Fv), name="viscous"),
    )


def _stribeck(rough: Rough) -> tuple[AbstractEffect, ...]:
    law = Stribeck(Fc=rough.Fc, Fs=1.2 * rough.Fc, vs=0.05 * rough.top, Fv=rough.Fv)
    return (Friction(Regularized(law, 0.005 * rough.top), name="friction"),)


def _lugre(rough: Rough) -> tuple[AbstractEffect, ...]:
    # A break-away distance of a few milliseconds at top speed, and a tenth of critical damping in stick.
    sigma0 = rough.Fc / (2e-3 * rough.top)
    law = LuGre(
        sigma0=sigma0,
        sigma1=0.2 * np.sqrt(rough.m * sigma0),
        sigma2=rough.Fv,
        Fc=rough.Fc,
        Fs=1.1 * rough.Fc,
        vs=0.05 * rough.top,
    )
    return (Friction(law, name="friction"),)


@dataclass(frozen=True)
class Model:
    """A model of the axis: its effects from rough values, what of it is fitted, and what it is in words."""

    effects: Callable[[Rough], tuple[AbstractEffect, ...]]
    free: tuple[str, ...]
    words: str


MODELS = {
    "coulomb": Model(
        _coulomb, ("m", "offset", "dry.Fc", "viscous.Fv"), "Coulomb friction (regularised) and viscous friction"
    ),
    "asymmetric": Model(
        _asymmetric,
        ("m", "dry.forward.Fc", "dry.backward.Fc", "viscous.forward.Fv", "viscous.backward.Fv"),
        "Coulomb (regularised) and viscous friction, each with a value for either direction; a constant offset is part"
        " of the difference of the Coulomb forces and held at zero",
    ),
    "stribeck": Model(
        _stribeck,
        ("m", "offset", "friction.Fc", "friction.Fs", "friction.vs", "friction.Fv"),
        "stiction, Stribeck effect and viscous friction (regularised)",
    ),
    "lugre": Model(
        _lugre,
        ("m", "offset", *(f"friction.{x}" for x in ("sigma0", "sigma1", "sigma2", "Fc", "Fs", "vs"))),
        "LuGre",
    ),
}


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


def axis_scene(model: Model, rough: Rough, start: dict[str, float], fixed: dict[str, float]) -> Scene:
    """Scene of the axis with start values and fixed values put in."""
    offset = 0.0 if "offset" not in model.free else rough.offset
    params = {"m": rough.m, "offset": offset, "u": 0.0}
    scene = Scene(_axis_lagrangian, params=params, effects=(AppliedForce(_drive, name="drive"), *model.effects(rough)))
    return replace_numbers(scene, {name: jnp.asarray(x, float) for name, x in (start | fixed).items()})


def run_fit(
    path: Path, columns: AxisColumns, model_name: str, start: list[str], fix: list[str], substeps: int, out: Path
) -> None:
    """Fit, print, and write figure, table and JSON to `out`."""
    if model_name not in MODELS:
        raise ValueError(f"There is no model {model_name!r}; the models are: {', '.join(MODELS)}.")
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out {out} is a file; a folder is needed.")
    model = MODELS[model_name]
    record = read_record(path, columns)
    rough = rough_axis(record)
    known = [name for name in scene_numbers(axis_scene(model, rough, {}, {})) if name != "u"]
    fixed = _assignments("--fix", fix, known)
    scene = axis_scene(model, rough, _assignments("--start", start, known), fixed)
    free = tuple(name for name in model.free if name not in fixed)
    result, seconds = fit_with_progress(scene, record, free, substeps=substeps)
    show_fit(result, f"{record.name}: {model.words}", "m")
    console.print(f"{len(record.t)} samples, {seconds:.1f} s with compilation")
    frame = pd.DataFrame({"t [s]": record.t, "measured [m]": record.measured, "simulated [m]": result.simulated})
    held = {
        name: float(x)
        for name, x in scene_numbers(scene).items()
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

        result = fit(scene, record, free, lower={"m": 0.0}, progress=progress, **options)
    return result, time.perf_counter() - started


def show_fit(result: FitResult, title: str, unit: str) -> None:
    """Print a fit's table and remarks."""
    units = {"m": "kg", "offset": "N"}
    frame = pd.DataFrame(result.rows(), columns=["parameter", "value", "standard error", "start", "unit"])
    pairs = zip(frame["parameter"], frame["unit"], strict=True)
    frame["unit"] = [given or units.get(name, "") for name, given in pairs]
    show_table(frame, title)
    console.print(f"RMSE {result.rmse:.6g} {unit}; {result.iterations} iterations, {result.ending}", highlight=False)
    for remark in result.remarks:
        console.print(f"- {remark}", highlight=False)
