"""The plan of `jaxmodsim fit`: its options, checked, and its records, read."""

import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._core.arguments import as_float, as_whole, did_you_mean
from ..identify import (
    AxisModel,
    Candidate,
    Cauchy,
    Huber,
    MultiStart,
    Record,
    SquaredLoss,
    Staged,
    axis_models,
    axis_scene,
    estimate_axis,
)
from ..scene import scene_numbers
from ._options import FitRequest
from ._records import DROPS, AxisColumns, offset_note, read_records
from ._units import parse_units

_LOSSES = {"squares": SquaredLoss, "huber": Huber, "cauchy": Cauchy}
_INITIALIZERS = {"regression": (), "staged": (Staged(),)}
# Free parameters beside the numbers of the scene: the state at the first sample of each record, the delay of the force.
_ALSO_FREE = ("q0", "qd0", "z0", "delay.u")

Limits = dict[str, tuple[float | None, float | None]]


@dataclass(frozen=True)
class FitPlan:
    """The arguments of a fit or a comparison.

    - `candidates`: models by name; a single one where nothing is compared.
    - `compared`: whether models are compared, or one is cross-validated. `folds`: how many; None for the default.
    - `records`, `held_out`: records to fit, and records for validation.
    - `options`: further arguments of `fit`.
    - `substeps`: None to refine them. `rotary`: whether the axis is rotary. `notes`: sentences on reading the files.
    """

    candidates: dict[str, Candidate]
    compared: bool
    folds: int | None
    records: tuple[Record, ...]
    held_out: tuple[Record, ...]
    options: dict[str, Any]
    substeps: int | None
    rotary: bool
    notes: tuple[str, ...]


def plan_of(request: FitRequest) -> FitPlan:
    """Check all options and read the records; notes on reading them go to stderr.

    **Raises:**

    - `ValueError` for an unknown name in an option, and for options that exclude each other; as `read_records`.
    """
    _check(request)
    models = _models(request)
    options = {
        "loss": _LOSSES[known_name("--loss", request.loss, _LOSSES)](),
        "initializer": [
            *_INITIALIZERS[known_name("--initializer", request.initializer, _INITIALIZERS)],
            *([MultiStart(request.starts)] if request.starts > 1 else []),
        ],
        "max_steps": request.max_steps,
    }
    units = parse_units(request.units)
    dropped = frozenset(known_name("--drop", kind, DROPS, "kind of sample") for kind in listed(request.drop))
    columns = AxisColumns(request.time, request.position, request.force, units, dropped)
    files = read_records([*request.records, *request.held_out], columns)
    records, held_out = (
        tuple(part for file in some for part in file.parts)
        for some in (files[: len(request.records)], files[len(request.records) :])
    )
    notes = [note for file in files for note in file.notes]
    if not any("delay.u" in text for text in request.free):
        notes += [note for record in (*records, *held_out) for note in offset_note(record, columns.force)]
    for note in notes:
        sys.stderr.write(f"Note: {note}\n")
    # A record that stands still, or that nothing drives, is useful only beside others.
    for record in (*records, *held_out):
        if np.ptp(record.measured) > 0 and np.ptp(record.inputs["u"]) > 0:
            estimate_axis(record)
    axis = estimate_axis(max(records, key=lambda record: len(record.t)))
    axis = replace(axis, start=min(float(record.t[0]) for record in records))
    # Neither the input nor the velocity of a belt, which an axis does not have, can be set.
    numbers = {
        name: [x for x in scene_numbers(axis_scene(model, axis)) if x != "u" and not x.endswith("belt_velocity")]
        for name, model in models.items()
    }
    known = dict.fromkeys(name for own in numbers.values() for name in own)
    start, fixed = _values("--start", request.start, known), _values("--fix", request.fix, known)
    chosen = [name for name in listed(request.free) if not name.startswith("+")]
    added = [name.removeprefix("+") for name in listed(request.free) if name.startswith("+")]
    for name in (*chosen, *added):
        known_name("--free", name, (*next(iter(numbers.values())), *_ALSO_FREE), stem=name.split("[")[0].split(".")[0])
    for option, others in (("--start", start), ("--free", (*chosen, *added))):
        if both := sorted(set(fixed) & set(others)):
            raise ValueError(f"{both[0]} stands in {option} and in --fix: it can be fitted or fixed, not both.")
    candidates = {}
    for name, model in models.items():
        own = [{key: x for key, x in values.items() if key in numbers[name]} for values in (start, fixed)]
        free = tuple(dict.fromkeys(x for x in (*(chosen or model.free), *added) if x not in fixed))
        candidates[name] = Candidate(axis_scene(model, axis, *own), free, model.description)
    return FitPlan(
        candidates,
        compared=len(models) > 1 or request.folds is not None,
        folds=request.folds,
        records=records,
        held_out=held_out,
        options=options | {"limits": {"m": (0.0, None)} | _limits(request.limit, known)},
        substeps=request.substeps,
        rotary=any(file.rotary for file in files),
        notes=tuple(notes),
    )


def _check(request: FitRequest) -> None:
    for option, path in (("--out", request.out), ("--report", request.report)):
        if path is not None and path.exists() and not path.is_dir():
            raise ValueError(f"{option} {path} is a file; a folder is needed.")
    counts = {"--starts": request.starts, "--max-steps": request.max_steps, "--substeps": request.substeps}
    for option, count in (counts | {"--folds": request.folds}).items():
        if count is not None:
            as_whole(count, name=option, least=2 if option == "--folds" else 1)
    if request.folds is not None and request.held_out:
        raise ValueError("--folds and --held-out exclude each other: a model is validated by one of them.")
    numbers = {"force": request.max_force, "speed": request.max_speed, "travel": request.max_travel}
    for option, number in ({f"--max-{x}": n for x, n in numbers.items()} | {"--duration": request.duration}).items():
        if number is not None and request.next is None:
            raise ValueError(f"{option} belongs to --next FILE.csv, which is missing.")
        if number is not None:
            as_float(number, name=option, lower=0.0)
    if request.next is not None and request.next.is_dir():
        raise ValueError(f"--next {request.next} is a folder; a file is needed.")


def _models(request: FitRequest) -> dict[str, AxisModel]:
    """The models that --laws names."""
    known, names = axis_models(), listed(["coulomb" if request.laws is None else request.laws])
    if not names:
        raise ValueError(f"--laws needs a law, several as A,B, or `all`, but {request.laws!r} was given.")
    names = list(known) if "all" in names else [known_name("--laws", name, known, "law") for name in names]
    if len(names) > 1 and any(not name.strip().startswith("+") for text in request.free for name in text.split(",")):
        raise ValueError(
            "--free excludes several --laws, each of which has its own parameters: use --fix, or --free +NAME."
        )
    return {name: known[name] for name in names}


def listed(texts: Sequence[str]) -> list[str]:
    """Names that are separated by commas, each once."""
    return list(dict.fromkeys(name.strip() for text in texts for name in text.split(",") if name.strip()))


def known_name(option: str, name: str, known: Iterable[str], noun: str = "name", stem: str | None = None) -> str:
    """The name, if it or its stem is known."""
    known = tuple(known)
    if name in known or stem in known:
        return name
    raise ValueError(
        f"{option}: there is no {noun} {name!r}; the {noun}s are: {', '.join(known)}.{did_you_mean(name, known)}"
    )


def _values(option: str, texts: Sequence[str], known: Iterable[str]) -> dict[str, float]:
    """Parse NAME=VALUE."""
    values: dict[str, float] = {}
    for text in texts:
        name, equals, number = text.partition("=")
        value = number_of(number)
        if not equals or value is None:
            raise ValueError(f"{option} needs NAME=VALUE with a number, but {text!r} was given.")
        values[known_name(option, name, known, "parameter")] = value
    return values


def _limits(texts: Sequence[str], known: Iterable[str]) -> Limits:
    """Parse NAME=LOW:HIGH, where either side may be omitted."""
    limits: Limits = {}
    for text in texts:
        name, _, span = text.partition("=")
        low, colon, high = span.partition(":")
        least, most = (number_of(side) if side.strip() else None for side in (low, high))
        wrong = (low.strip() and least is None) or (high.strip() and most is None)
        if not colon or wrong or (least is None and most is None):
            raise ValueError(
                f"--limit needs NAME=LOW:HIGH with numbers, one of which may be omitted, but {text!r} was given."
            )
        if least is not None and most is not None and not least < most:
            raise ValueError(f"--limit {text}: the lower limit must be below the upper one.")
        known_name("--limit", name, known, "parameter")
        limits[name] = (0.0 if name == "m" and least is None else least, most)
    return limits


def number_of(text: str) -> float | None:
    """The finite number in a text; None for another text."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
