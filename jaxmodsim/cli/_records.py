"""Records of one axis from files: columns found by name, in SI units, checked, and cut at gaps in the samples."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.integrate import cumulative_trapezoid

from .._core.arguments import axis_unit, nearest
from ..identify import Record, clock_offset, sampling_gaps, unexplained_force
from ._files import Channel, Columns, read_columns
from ._units import Unit, column_unit, split_header

# Kinds of samples for --drop.
DROPS = ("nan", "repeated")
# Least number of samples of a part between two gaps.
_LEAST_PART = 20
# Interval [s], span [m] and speed [m/s] above which an unstated unit is probably not SI.
_SLOW_CLOCK, _LONG_TRAVEL, _FAST, _NEARLY_ALL = 0.1, 10.0, 20.0, 0.95
# A column is probably a velocity if it leaves more than this share of the force unexplained as a position, and this
# fraction of that share as a velocity.
_UNEXPLAINED, _BETTER = 0.05, 0.3
# Lower-case names of drive signals.
_DRIVE_NAMES = ("volt", "voltage", "current", "amp", "amps", "ampere", "i", "iq", "i_q")
# Offset [intervals] and remaining share of the residual force at which the clocks of two columns differ.
_APART, _EXPLAINS = 1.0, 0.7
# Share of repeated times above which times are probably rounded; number of faults that an error lists.
_ROUNDED, _NAMED = 0.2, 5


@dataclass(frozen=True)
class AxisColumns:
    """Names of the columns, their units from --units by `time`, `position` and `force`, and the samples to drop."""

    time: str
    position: str
    force: str
    units: Mapping[str, Unit]
    drop: frozenset[str] = frozenset()

    @property
    def names(self) -> dict[str, str]:
        """Names of the columns by their role."""
        return {"time": self.time, "position": self.position, "force": self.force}


@dataclass(frozen=True)
class AxisRecord:
    """The content of a file.

    - `parts`: the record, or its parts between gaps in the samples.
    - `rotary`: whether units imply a rotary axis; None if they imply neither kind.
    - `notes`: sentences on reading it.
    """

    parts: tuple[Record, ...]
    rotary: bool | None
    notes: tuple[str, ...]


def read_records(paths: Sequence[Path], columns: AxisColumns) -> tuple[AxisRecord, ...]:
    """Read several records, named after their files, and after their folders where two files have the same name.

    **Raises:**

    - `ValueError` as `read_record`, for a file that is listed twice, and for linear and rotary axes together.
    """
    real = [path.resolve() for path in paths]
    for i, path in enumerate(real):
        if path in real[:i]:
            raise ValueError(f"{paths[i]} is listed twice.")
    stems = [path.stem for path in real]
    names = [path.stem if stems.count(path.stem) == 1 else f"{path.parent.name}/{path.name}" for path in real]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise ValueError(f"Two files have the name {name}: rename one of them.")
    records = tuple(read_record(path, columns, name) for path, name in zip(paths, names, strict=True))
    by_kind = {record.rotary: path.name for record, path in zip(records, paths, strict=True)}
    if True in by_kind and False in by_kind:
        raise ValueError(
            f"{by_kind[True]} is of a rotary axis and {by_kind[False]} of a linear one: fit them separately."
        )
    return records


def read_record(path: Path, columns: AxisColumns, name: str | None = None) -> AxisRecord:
    """Read a record from a file; its ending names the format.

    **Raises:**

    - `ValueError` for a damaged file or an unknown format, a missing column, a column that is not numeric, NaN,
      different lengths, or times that do not increase; `OSError` if the file cannot be read.
    """
    table, name = read_columns(path), name or path.stem
    try:
        return _axis_record(table, columns, name)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error


def _axis_record(table: Columns, columns: AxisColumns, name: str) -> AxisRecord:
    notes: list[str] = []
    if any(isinstance(column, Channel) for column in table.values()):
        table, notes = _on_one_clock(table, columns)
    headers = {role: _header(table, role, wanted) for role, wanted in columns.names.items()}
    read = {role: column_unit(role, header, columns.units.get(role)) for role, header in headers.items()}
    units = {role: unit for role, (unit, _) in read.items()}
    notes += [sentence for _, sentence in read.values() if sentence]
    rotary = _rotary(headers, units)
    arrays = {role: _numbers(table, header) for role, header in headers.items()}
    lengths = {header: arrays[role].size for role, header in headers.items()}
    if len(set(lengths.values())) > 1:
        each = ", ".join(f"{length} ({header!r})" for header, length in lengths.items())
        raise ValueError(f"columns must have the same length, but they have {each}.")
    arrays = {role: units[role].factor * array for role, array in arrays.items()}
    arrays, dropped = _checked(arrays, headers, columns.drop)
    t, position, force = arrays["time"], arrays["position"], arrays["force"]
    notes += dropped
    if units["position"].velocity:
        position = cumulative_trapezoid(position, t, initial=0.0)
        notes.append(
            f"column {headers['position']!r} is a velocity; its integral is fitted as the position, which accumulates"
            " the noise of the velocity."
        )
    record = Record(t, position, {"u": force}, name=name)
    parts, gaps = _parts(record)
    notes += [*gaps, *_doubts(record, headers, units, rotary)]
    return AxisRecord(parts, rotary, tuple(f"{name}: {note}" for note in notes))


def offset_note(record: Record, force: str) -> tuple[str, ...]:
    """A sentence if the force and the motion are offset in time."""
    offset, left = clock_offset(record)
    if not (abs(offset) > _APART * float(np.median(np.diff(record.t))) and left < _EXPLAINS):
        return ()
    remedy = "fit the delay by --free +delay.u" if offset > 0 else "shift one of the two columns in time"
    return (
        f"{record.name}: the force {force!r} comes {1e3 * abs(offset):.3g} ms too {'early' if offset > 0 else 'late'}:"
        f" a shift by this time reduces the unexplained force to {100 * left:.0f} %. If it is systematic, {remedy}.",
    )


def _on_one_clock(table: Columns, columns: AxisColumns) -> tuple[Columns, list[str]]:
    """Position and force of a logger at the times of the position, within the time span of the force."""
    headers = [_header(table, role, columns.names[role]) for role in ("position", "force")]
    position, force = (table[header] for header in headers)
    if not (isinstance(position, Channel) and isinstance(force, Channel)):
        return table, []
    if np.array_equal(position.t, force.t):
        return {columns.time: position.t, headers[0]: position.values, headers[1]: force.values}, []
    last = force.t[-1] + float(np.median(np.diff(force.t))) if force.t.size > 1 else force.t[-1]
    both = (position.t >= force.t[0]) & (position.t < last)
    if np.count_nonzero(both) < _LEAST_PART:
        raise ValueError(f"{headers[0]!r} and {headers[1]!r} have almost no times in common.")
    t, q = position.t[both], position.values[both]
    resampled = held_on(force, t)
    try:
        offset = clock_offset(Record(t, q, {"u": resampled}))[0]
    except ValueError:  # wrong samples are reported later, by column
        offset = 0.0
    return {columns.time: t, headers[0]: q, headers[1]: resampled}, [
        f"{headers[1]!r} is resampled to the times of {headers[0]!r}. According to the motion, the clock of the force"
        f" is {1e3 * abs(offset):.2f} ms {'early' if offset >= 0 else 'late'} relative to that of the position."
    ]


def held_on(force: Channel, t: np.ndarray) -> np.ndarray:
    """Means of a piecewise constant signal over the intervals between the times `t`, which preserve its integral."""
    end = max(float(t[-1]), float(force.t[-1])) + 1.0
    edges = np.append(force.t, end)
    integral = np.concatenate([[0.0], np.cumsum(np.diff(edges) * force.values)])
    ends = np.append(t, 2 * t[-1] - t[-2] if t.size > 1 else end)
    return np.diff(np.interp(ends, edges, integral)) / np.diff(ends)


def _header(table: Columns, role: str, wanted: str) -> str:
    """The column of this name, with or without its unit."""
    if wanted in table:
        return wanted
    bare = {header: split_header(header)[0] for header in table}
    matches = [header for header, name in bare.items() if name == wanted]
    if len(matches) == 1:
        return matches[0]
    near = nearest(wanted, [*table, *bare.values()])
    hint = f" Did you mean --{role} {near}?" if near else ""
    other = " A velocity also works: --position NAME --units position=m/s." if role == "position" else ""
    known = ", ".join(table) or "none"
    raise ValueError(f"there is no column {wanted!r} (--{role}); the file has: {known}.{hint or other}")


def _numbers(table: Columns, header: str) -> np.ndarray:
    column = pd.Series(table[header])
    if column.empty:
        return np.zeros(0)
    if pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_complex_dtype(column):
        return column.to_numpy(float, na_value=np.nan)
    if pd.api.types.is_datetime64_any_dtype(column):
        return (column - column.iloc[0]).dt.total_seconds().to_numpy(float)
    bad = int(np.argmax(np.isnan(np.asarray(pd.to_numeric(column, errors="coerce"), float))))
    raise ValueError(f"column {header!r} holds {column.iloc[bad]!r} in sample {bad}, which is not a number.")


def _rotary(headers: Mapping[str, str], units: Mapping[str, Unit]) -> bool | None:
    """Whether the units imply a rotary axis; those of position and force must agree."""
    kinds = {unit.rotary for unit in units.values() if unit.rotary is not None}
    if len(kinds) > 1:
        raise ValueError(
            f"{headers['position']!r} is in {units['position'].text} and {headers['force']!r} in"
            f" {units['force'].text}, but a rotary axis needs an angle and a torque, a linear one a length and a force."
            " Use --units of one kind, with the factor of the gear or lever between them."
        )
    return next(iter(kinds), None)


def _checked(
    arrays: dict[str, np.ndarray], headers: Mapping[str, str], drop: frozenset[str]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The samples without those of the kinds in `drop`, and a sentence for each kind.

    **Raises:**

    - `ValueError` naming columns and samples with NaN, with repeated times, or out of order.
    """
    notes, samples = [], np.arange(arrays["time"].size)
    infinite = {role: np.flatnonzero(~np.isfinite(array)) for role, array in arrays.items()}
    for role, bad in infinite.items():
        if bad.size and "nan" not in drop:
            raise ValueError(
                f"column {headers[role]!r} has {bad.size} values that are not finite, the first in sample"
                f" {bad[0]}. Fill them, or omit these samples by --drop nan."
            )
    bad = np.unique(np.concatenate(list(infinite.values())))
    if bad.size:
        arrays = {role: np.delete(array, bad) for role, array in arrays.items()}
        samples = np.delete(samples, bad)
        notes.append(f"{bad.size} samples with values that are not finite are omitted.")
    steps = np.diff(arrays["time"])
    back, repeated = 1 + np.flatnonzero(steps < 0), 1 + np.flatnonzero(steps == 0)
    if back.size:
        k = back[0]
        raise ValueError(
            f"times must increase, but column {headers['time']!r} goes back {back.size} times, first from"
            f" {arrays['time'][k - 1]:g} s to {arrays['time'][k]:g} s in sample {samples[k]}. Sort the samples by time;"
            " if the clock was reset, save the samples after it as a separate record."
        )
    if repeated.size and "repeated" not in drop:
        named = ", ".join(str(samples[k]) for k in repeated[:_NAMED]) + (", ..." if repeated.size > _NAMED else "")
        rounded = repeated.size > _ROUNDED * samples.size
        remedy = (
            "Their times seem rounded: export more digits." if rounded else "Omit these samples by --drop repeated."
        )
        raise ValueError(
            f"times must increase, but column {headers['time']!r} has {repeated.size} samples with the"
            f" time of the sample before: {named}. {remedy}"
        )
    if repeated.size:
        arrays = {role: np.delete(array, repeated) for role, array in arrays.items()}
        notes.append(f"{repeated.size} samples with the time of the sample before are omitted.")
    return arrays, notes


def _parts(record: Record) -> tuple[tuple[Record, ...], list[str]]:
    """The record, cut at gaps in the samples, where the force is unknown."""
    gaps = sampling_gaps(record)
    edges = [0, *(last + 1 for last in gaps), len(record.t)]
    spans = [(a, b) for a, b in pairwise(edges) if b - a >= _LEAST_PART]
    if not gaps or not spans:
        return (record,), []
    parts = tuple(record.samples(a, b, f"{record.name} part {i + 1}") for i, (a, b) in enumerate(spans))
    where = ", ".join(f"from {record.t[k]:g} to {record.t[k + 1]:g} s" for k in gaps[:_NAMED])
    more = f" and {len(gaps) - _NAMED} more" if len(gaps) > _NAMED else ""
    left = len(record.t) - sum(len(part.t) for part in parts)
    short = f" {left} samples in parts of fewer than {_LEAST_PART} are left out." if left else ""
    return parts, [
        f"samples are missing {where}{more}; the parts are fitted as {len(parts)} record{'s' * (len(parts) > 1)}, each"
        f" with its own initial state.{short}"
    ]


def _doubts(record: Record, headers: Mapping[str, str], units: Mapping[str, Unit], rotary: bool | None) -> list[str]:
    """Sentences on unstated units that are probably wrong."""
    unit, sentences, doubts = axis_unit("m", bool(rotary)), [], []
    if not units["position"].text:
        left = unexplained_force(record)
        as_velocity = Record(record.t, cumulative_trapezoid(record.measured, record.t, initial=0.0), record.inputs)
        if left > _UNEXPLAINED and unexplained_force(as_velocity) < _BETTER * left:
            sentences.append(
                f"the force depends on {headers['position']!r} as on a velocity, not as on a position."
                " If it is a velocity, use --units position=m/s."
            )
    if not units["force"].text and headers["force"].lower() in _DRIVE_NAMES:
        sentences.append(
            f"{headers['force']!r} is read as a force in SI units. If it is a drive signal, state the"
            " newtons (or N m) per unit, as in --units force=12.5: mass and friction scale with it."
        )
    interval, span = float(np.median(np.diff(record.t))), float(np.ptp(record.measured))
    speed = float(np.quantile(np.abs(np.diff(record.measured) / np.diff(record.t)), _NEARLY_ALL))
    if not units["time"].text and interval >= _SLOW_CLOCK:
        doubts.append(("time", f"samples are {interval:g} s apart", "ms"))
    if not units["position"].text and (span > _LONG_TRAVEL or speed > _FAST):
        doubts.append(("position", f"positions span {span:.3g} {unit} at up to {speed:.3g} {unit}/s", "mm"))
    if doubts:
        names = " and ".join(f"{headers[role]!r}" for role, _, _ in doubts)
        sentences.append(
            f"{' and '.join(symptom for _, symptom, _ in doubts)}, with {names} in SI units. For other"
            f" units use --units {','.join(f'{role}={other}' for role, _, other in doubts)}."
        )
    return sentences
