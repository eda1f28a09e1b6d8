"""`jaxmodsim fit --axis servo` and `jaxmodsim predict`: a position servo from records of command and supply."""

import math
import re
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from .._core.progress import progress_line
from ..identify import SERVO_LAWS, Record, Servo, ServoFit, ServoPrediction, fit_servo, predict_servo, servo_record
from ..plot import servo_figure
from ._files import Columns, read_columns
from ._options import FitRequest, PredictRequest
from ._output import Content, frame_of, say, show_paths, show_table, write
from ._plan import known_name, listed, number_of

# Full duty as the servo reports it; standard gravity [m/s^2].
_FULL_DUTY, _GRAVITY = 885.0, 9.80665
_GAIN_IN_NAME = re.compile(r"kp[_=]?(\d+(?:\.\d+)?)", re.IGNORECASE)


def run_servo_fit(request: FitRequest) -> None:
    """Fit one or several gear laws, rank them by the records left out, print and write the results."""
    laws, prior = _laws(request.laws), _prior(request.prior)
    mass, length = _pendulum(request.pendulum)
    records = tuple(read_servo(path, request)[0] for path in request.records)
    names = [record.name for record in records]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise ValueError(f"Two files have the name {name}: rename one of them.")
    for name in prior:
        known_name("--prior", name, dict.fromkeys(x for law in laws for x in Servo.free(law)), "parameter")
    groups, started, fits = groups_of(records), time.perf_counter(), {}
    with progress_line("fit") as show:
        for law in laws:
            own = {name: x for name, x in prior.items() if name in Servo.free(law)}
            fits[law] = fit_servo(
                records, law, inertia=mass * length**2, gravity=mass * _GRAVITY * length, groups=groups, prior=own,
                progress=lambda name, law=law: show(f"{law}, {name}"),
            )  # fmt: skip
    best = min(fits.values(), key=lambda fit: fit.left_out_error)
    assert best.result is not None
    ranking = ranking_of(fits)
    show_table(ranking, "Gear laws by the error of records that were left out")
    say(f"\n{best.law}\n{best.result}")
    for line in best.warnings:
        say(line)
    show_table(record_errors(best), f"{best.law}: mean absolute errors by record [mrad]")
    seconds = time.perf_counter() - started
    say(f"{sum(sum(x.evaluations.values()) for x in fits.values())} evaluations of the gradient, {seconds:.1f} s")
    files: dict[str, Content] = {
        f"{record.name}.png": servo_figure(predict_servo(best, record), measured=True) for record in records
    }
    files["ranking.csv"] = ranking
    files["fit.json"] = {
        "model": best.law, "servo": best.to_dict(), "warnings": list(best.warnings), "seconds": seconds,
        "ranking": ranking.to_dict("records"), "laws": {law: fit.to_dict() for law, fit in fits.items()},
    }  # fmt: skip
    show_paths(write(request.out, files))


def run_servo_prediction(request: PredictRequest) -> None:
    """Predict records, print and write the results."""
    fit, files, rows = ServoFit.load(request.fit), {}, []
    for path in request.records:
        record, measured = read_servo(path, request)
        if ("duty" in record.inputs) != fit.from_duty:
            wanted = "the measured duty: add --duty COLUMN" if fit.from_duty else "commands: omit --duty"
            raise ValueError(f"{request.fit.name} was fitted to {wanted}.")
        prediction = predict_servo(fit, record)
        table = {"t": record.t, "q": prediction.q, "lower": prediction.lower, "upper": prediction.upper}
        files[f"{record.name}.csv"] = pd.DataFrame(table)
        files[f"{record.name}.json"] = prediction_summary(fit, prediction, measured)
        files[f"{record.name}.png"] = servo_figure(prediction, measured=measured)
        errors = (1e3 * prediction.error, 100 * prediction.inside) if measured else (math.nan, math.nan)
        rows.append((record.name, len(record.t), 1e3 * prediction.half_band, *errors))
    columns = "record", "samples", "half band [mrad]", "mean absolute error [mrad]", "in the band [%]"
    show_table(frame_of(rows, *columns), f"{fit.law}, band for {100 * fit.band['level']:g} % of the samples")
    show_paths(write(request.out, files))


def prediction_summary(fit: ServoFit, prediction: ServoPrediction, measured: bool) -> dict[str, object]:
    """Law, start, band and, with a measured angle, its error, in types of JSON."""
    record = prediction.record
    summary: dict[str, object] = {
        "record": record.name, "law": fit.law, "samples": len(record.t), "q0": float(record.inputs["start.q"][0]),
        "level": prediction.level, "half_band": prediction.half_band,
    }  # fmt: skip
    if "kp" in record.inputs:
        summary["gain"] = float(record.inputs["kp"][0])
    if measured:
        summary |= {"mean_absolute_error": prediction.error, "inside": prediction.inside}
    return summary


def read_servo(path: Path, request: FitRequest | PredictRequest) -> tuple[Record, bool]:
    """A record of a servo from a file, and whether it has the measured angle.

    A prediction needs no angle; if only its first samples have one, the first is the start.

    **Raises:**

    - `ValueError` naming the file, for a missing column, values that are not finite, or an unknown gain.
    """
    table, q, q0 = read_columns(path), None, None
    try:
        t, goal = _column(table, request.time, "--time"), _column(table, request.goal, "--goal")
        volts = _column(table, request.supply, "--supply")
        on = _column(table, request.enable, "--enable") if request.enable in table else np.ones_like(t)
        if isinstance(request, FitRequest):
            q = _column(table, request.position, "--position")
        elif request.position in table:
            angle = _numbers(table, request.position)
            q = angle if np.isfinite(angle).all() else None
            q0 = float(angle[0]) if np.isfinite(angle[0]) else None
        if isinstance(request, PredictRequest) and request.q0 is not None:
            q0 = request.q0
        duty = None if request.duty is None else _column(table, request.duty, "--duty") / _FULL_DUTY
        kp = _gain(table, path, request.gain) if duty is None else None
        return servo_record(t, q, goal, volts, on, kp=kp, duty=duty, q0=q0, name=path.stem), q is not None
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error


def groups_of(records: Sequence[Record]) -> dict[str, tuple[str, ...]]:
    """Records to leave out together: of one gain, and of one trajectory, which is the name without the gain.

    Each record alone if neither is shared.
    """
    gains: dict[str, list[str]] = {}
    trajectories: dict[str, list[str]] = {}
    for record in records:
        if "kp" in record.inputs:
            gains.setdefault(f"gain {record.inputs['kp'][0]:g}", []).append(record.name)
        stem = _GAIN_IN_NAME.sub("", record.name).strip("_- ")
        trajectories.setdefault(f"trajectory {stem}", []).append(record.name)
    groups = {}
    for kind in (trajectories, gains):
        if 1 < len(kind) < len(records):
            groups |= {name: tuple(group) for name, group in kind.items()}
    return groups or {record.name: (record.name,) for record in records}


def ranking_of(fits: dict[str, ServoFit]) -> pd.DataFrame:
    """Laws by their mean absolute error [mrad] on records left out, by trajectory and by gain."""
    rows = []
    for fit in sorted(fits.values(), key=lambda fit: fit.left_out_error):
        by = {kind: [np.mean(list(x.values())) for name, x in fit.left_out.items() if name.startswith(kind)]
              for kind in ("trajectory", "gain")}  # fmt: skip
        own = [1e3 * float(np.mean(by[kind])) if by[kind] else math.nan for kind in by]
        fitted = 1e3 * float(np.mean(list(fit.fitted.values())))
        counts = fit.evaluations.values()
        errors = fitted, 1e3 * fit.left_out_error, *own
        rows.append((fit.law, len(Servo.free(fit.law)), *errors, max(counts), sum(counts)))
    return frame_of(
        rows, "law", "parameters", "fitted [mrad]", "left out [mrad]", "trajectory left out", "gain left out",
        "evaluations of a fit", "of all fits",
    )  # fmt: skip


def record_errors(fit: ServoFit) -> pd.DataFrame:
    """Errors [mrad] of each record, fitted, and left out with each of its groups."""
    rows = []
    for name, error in fit.fitted.items():
        out = [1e3 * group[name] for group in fit.left_out.values() if name in group]
        rows.append((name, 1e3 * error, *(out + [math.nan] * 2)[:2]))
    return frame_of(rows, "record", "fitted", "trajectory left out", "gain left out")


def _numbers(table: Columns, name: str) -> np.ndarray:
    return np.asarray(pd.to_numeric(pd.Series(np.asarray(table[name])), errors="coerce"), float)


def _column(table: Columns, name: str, option: str) -> np.ndarray:
    if name not in table:
        raise ValueError(f"there is no column {name!r} ({option}); the file has: {', '.join(table)}.")
    numbers = _numbers(table, name)
    if not np.isfinite(numbers).all():
        raise ValueError(f"column {name!r} has no finite number in sample {int(np.argmin(np.isfinite(numbers)))}.")
    return numbers


def _gain(table: Columns, path: Path, gain: str | None) -> float:
    """The gain of the position loop, one number for a record."""
    column = "kp" if gain is None else gain
    if column in table:
        values = _column(table, column, "--gain")
        if np.ptp(values) > 0:
            raise ValueError(f"column {column!r} changes: a record has one gain.")
        return float(values[0])
    if gain is None:
        match = _GAIN_IN_NAME.search(path.stem)
        if match is None:
            raise ValueError("the gain of the position loop is unknown: add a column kp, or --gain NUMBER.")
        return float(match.group(1))
    value = number_of(gain)
    if value is None or value <= 0:
        raise ValueError(f"--gain must be a number > 0 or a column, but {gain!r} was given.")
    return value


def _laws(text: str | None) -> tuple[str, ...]:
    names = ["all"] if text is None else listed([text])
    if names == ["all"]:
        return tuple(SERVO_LAWS)
    return tuple(known_name("--laws", name, SERVO_LAWS, "servo law") for name in names or [""])


def _pendulum(text: str) -> tuple[float, float]:
    mass, length = map(number_of, text.partition(",")[::2])
    if mass is None or length is None or min(mass, length) <= 0:
        raise ValueError(f"--pendulum needs MASS,LENGTH, two numbers > 0, but {text!r} was given.")
    return mass, length


def _prior(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Parse NAME=MEAN:DEVIATION."""
    prior = {}
    for text in texts:
        name, _, numbers = text.partition("=")
        mean, deviation = map(number_of, numbers.partition(":")[::2])
        if mean is None or deviation is None or deviation <= 0:
            raise ValueError(f"--prior needs NAME=MEAN:DEVIATION with a deviation > 0, but {text!r} was given.")
        prior[name] = (mean, deviation)
    return prior
