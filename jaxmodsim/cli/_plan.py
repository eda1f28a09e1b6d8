"""What `jaxmodsim fit` was asked for: as it was typed, and checked."""

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..identify import (
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
from ..scene import Scene, scene_numbers
from ._read import DROPS, AxisColumns, offset_note, read_records
from ._units import given_units, option_hint

_LOSSES = {"squares": SquaredLoss, "huber": Huber, "cauchy": Cauchy}
_INITIALIZERS = ("rough", "staged")
# Beside the numbers of the scene: the state at the first sample of each record, and the delay of the force.
_ALSO_FREE = ("q0", "qd0", "z0", "delay.u")


@dataclass(frozen=True)
class FitRequest:
    """The arguments of `jaxmodsim fit`, as they were typed; see its --help."""

    records: Sequence[Path]
    columns: tuple[str, str, str]
    units: Sequence[str]
    drop: Sequence[str]
    laws: str
    free: Sequence[str]
    start: Sequence[str]
    fix: Sequence[str]
    limit: Sequence[str]
    held_out: Sequence[Path]
    folds: int | None
    loss: str
    begin: str
    starts: int
    max_steps: int
    substeps: int | None
    out: Path
    report: Path | None
    next_input: Path | None
    max_force: float | None
    max_speed: float | None
    max_travel: float | None
    duration: float | None


@dataclass(frozen=True)
class Plan:
    """What is to be fitted.

    - `candidates`: models by name, one where there is nothing to compare.
    - `compared`: whether they are compared, or one is scored on folds. `folds`: how many, None for the default.
    - `records`, `held_out`: records that are fitted, and that are not.
    - `limits`: of parameters, for `fit`. `options`: further arguments of it.
    - `substeps`: None for as many as it takes. `rotary`: whether the axis is. `notes`: how the files were read.
    """

    candidates: dict[str, Candidate]
    compared: bool
    folds: int | None
    records: tuple[Record, ...]
    held_out: tuple[Record, ...]
    limits: dict[str, tuple[float | None, float | None]]
    options: dict[str, Any]
    substeps: int | None
    rotary: bool
    notes: tuple[str, ...]


def plan_of(request: FitRequest) -> Plan:
    """Read the records and check everything; what is to be known of how they were read goes to stderr at once.

    **Raises:**

    - `ValueError` for an option that names something unknown, or that does not go with another one; as `read_records`.
    """
    _check(request)
    names = _laws(request)
    loss = _LOSSES[_known("--loss", request.loss, _LOSSES)]()
    _known("--begin", request.begin, _INITIALIZERS)
    columns = AxisColumns(*request.columns, given_units(request.units), _drops(request.drop))
    read = read_records([*request.records, *request.held_out], columns)
    records, held_out = (
        tuple(part for file in files for part in file.parts)
        for files in (read[: len(request.records)], read[len(request.records) :])
    )
    together = (*records, *held_out)
    notes = [note for file in read for note in file.notes]
    if not any("delay.u" in text for text in request.free):
        notes += [note for record in together for note in offset_note(record, columns.force)]
    for note in notes:
        sys.stderr.write(f"Note: {note}\n")
    # A record that stands still, or that nothing drives, may go beside others that do not.
    driven = [record for record in together if np.ptp(record.measured) > 0 and np.ptp(record.inputs["u"]) > 0]
    for record in driven:
        estimate_axis(record)
    rough = estimate_axis(max(records, key=lambda record: len(record.t)))
    rough = replace(rough, start=min(float(record.t[0]) for record in records))
    numbers = {name: _numbers(axis_scene(axis_models()[name], rough)) for name in names}
    fixed, start = _values("--fix", request.fix, numbers), _values("--start", request.start, numbers)
    listed = tuple(name.strip() for text in request.free for name in text.split(",") if name.strip())
    chosen = tuple(name for name in listed if not name.startswith("+"))
    added = tuple(name.removeprefix("+") for name in listed if name.startswith("+"))
    for name in (*chosen, *added):
        _known("--free", name, (*next(iter(numbers.values())), *_ALSO_FREE), listed=name.split("[")[0].split(".")[0])
    for option, others in (("--start", start), ("--free", (*chosen, *added))):
        both = sorted(set(fixed) & set(others))
        if both:
            raise ValueError(f"{both[0]} stands in {option} and in --fix: it can be fitted or fixed, not both.")
    candidates = {}
    for name in names:
        model = axis_models()[name]
        own = [{key: x for key, x in given.items() if key in numbers[name]} for given in (start, fixed)]
        free = tuple(dict.fromkeys(each for each in (*(chosen or model.free), *added) if each not in fixed))
        candidates[name] = Candidate(axis_scene(model, rough, *own), free, model.description)
    limits = {"m": (0.0, None)} | _limits(request.limit, numbers)
    options = {"loss": loss, "initializer": _initializers(request), "max_steps": request.max_steps}
    compared = len(names) > 1 or request.folds is not None
    rotary = any(file.rotary for file in read)
    return Plan(
        candidates, compared, request.folds, records, held_out, limits, options, request.substeps, rotary, tuple(notes)
    )


def _initializers(request: FitRequest) -> list[Staged | MultiStart]:
    """Where a search starts."""
    staged = [Staged()] if request.begin == "staged" else []
    return [*staged, *([MultiStart(request.starts)] if request.starts > 1 else [])]


def _check(request: FitRequest) -> None:
    for option, path in (("--out", request.out), ("--report", request.report)):
        if path is not None and path.exists() and not path.is_dir():
            raise ValueError(f"{option} {path} is a file; a folder is needed.")
    if request.starts < 1:
        raise ValueError(f"--starts must be at least 1, but it is {request.starts}.")
    if request.max_steps < 1:
        raise ValueError(f"--max-steps must be at least 1, but it is {request.max_steps}.")
    if request.substeps is not None and request.substeps < 1:
        raise ValueError(f"--substeps must be at least 1, but it is {request.substeps}.")
    if request.folds is not None and request.folds < 2:
        raise ValueError(f"--folds must be at least 2, but it is {request.folds}.")
    if request.folds is not None and request.held_out:
        raise ValueError("--folds and --held-out do not go together: a model is judged by one of them.")
    numbers = {"force": request.max_force, "speed": request.max_speed, "travel": request.max_travel}
    given = {f"--max-{name}": x for name, x in numbers.items()} | {"--duration": request.duration}
    for option, number in given.items():
        if number is not None and request.next_input is None:
            raise ValueError(f"{option} belongs to --next FILE.csv, which is missing.")
        if number is not None and not (math.isfinite(number) and number > 0):
            raise ValueError(f"{option} must be finite and > 0, but it is {number}.")
    if request.next_input is not None and request.next_input.is_dir():
        raise ValueError(f"--next {request.next_input} is a folder; a file is needed.")


def _laws(request: FitRequest) -> tuple[str, ...]:
    given = dict.fromkeys(name.strip() for name in request.laws.split(",") if name.strip())
    names = tuple(axis_models()) if "all" in given else tuple(given)
    if not names:
        raise ValueError(f"--laws needs a law, several as A,B, or `all`, but {request.laws!r} was given.")
    for name in names:
        _known("--laws", name, axis_models(), "law")
    if len(names) > 1 and any(not name.strip().startswith("+") for text in request.free for name in text.split(",")):
        raise ValueError(
            "--free does not go with several --laws, each of which has its own parameters: use --fix, or --free +NAME."
        )
    return names


def _drops(texts: Sequence[str]) -> frozenset[str]:
    kinds = [kind.strip() for text in texts for kind in text.split(",") if kind.strip()]
    return frozenset(_known("--drop", kind, DROPS, "kind of sample") for kind in kinds)


def _numbers(scene: Scene) -> tuple[str, ...]:
    """Names of the numbers that may be given: neither the input nor the velocity of a belt, which an axis has not."""
    return tuple(name for name in scene_numbers(scene) if name != "u" and not name.endswith("belt_velocity"))


def _known(option: str, name: str, known: Iterable[str], noun: str = "name", listed: str | None = None) -> str:
    """The name, if there is such a one."""
    known = tuple(known)
    if name in known or listed in known:
        return name
    hint = option_hint(name, known)
    raise ValueError(f"{option}: there is no {noun} {name!r}; the {noun}s are: {', '.join(known)}.{hint}")


def _of_any(option: str, name: str, numbers: Mapping[str, Sequence[str]]) -> str:
    return _known(option, name, dict.fromkeys(each for own in numbers.values() for each in own), "parameter")


def _values(option: str, texts: Sequence[str], numbers: Mapping[str, Sequence[str]]) -> dict[str, float]:
    """Read NAME=VALUE; a name must be one of a model at least."""
    values: dict[str, float] = {}
    for text in texts:
        name, equals, number = text.partition("=")
        value = _number(number)
        if not equals or value is None:
            raise ValueError(f"{option} needs NAME=VALUE with a number, but {text!r} was given.")
        values[_of_any(option, name, numbers)] = value
    return values


def _limits(texts: Sequence[str], numbers: Mapping[str, Sequence[str]]) -> dict[str, tuple[float | None, float | None]]:
    """Read NAME=LOW:HIGH, where either may be left out."""
    limits: dict[str, tuple[float | None, float | None]] = {}
    for text in texts:
        name, _, span = text.partition("=")
        low, colon, high = span.partition(":")
        least, most = (_number(side) if side.strip() else None for side in (low, high))
        wrong = (low.strip() and least is None) or (high.strip() and most is None)
        if not colon or wrong or (least is None and most is None):
            raise ValueError(
                f"--limit needs NAME=LOW:HIGH with numbers, one of which may be left out, but {text!r} was given."
            )
        if least is not None and most is not None and not least < most:
            raise ValueError(f"--limit {text}: the lower limit must be below the upper one.")
        limits[_of_any("--limit", name, numbers)] = (0.0 if name == "m" and least is None else least, most)
    return limits


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
