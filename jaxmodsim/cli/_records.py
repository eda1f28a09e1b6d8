"""Records of one axis from files: columns found by name, in SI units, checked, cut where samples are missing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd

from .._core.arguments import nearest
from .._core.units import axis_unit
from ..identify import Record, clock_offset, sampling_gaps, unexplained_force
from ._files import Channel, Columns, read_columns
from ._units import Unit, column_unit, split_header

# What --drop may name.
DROPS = ("nan", "repeated")
# Samples that a part of a record between two gaps must have to be fitted.
_LEAST_PART = 20
# Intervals [s], spans [m] and speeds [m/s] from which on another unit is more likely, where none was stated.
_SLOW_CLOCK, _LONG_TRAVEL, _FAST, _NEARLY_ALL = 0.1, 10.0, 20.0, 0.95
# Share of the force that is left unexplained by a position, and by a velocity, where the column must be the latter.
_UNEXPLAINED, _BETTER = 0.05, 0.3
# Names of drive signals.
_DRIVE_NAMES = ("volt", "voltage", "current", "amp", "amps", "ampere", "i", "iq", "i_q")
# An offset of so many intervals, and with so small a share of the residual force left, is one between clocks.
_APART, _EXPLAINS = 1.0, 0.7
# Share of samples at the time of the sample before from which on times are rounded, and how many faults are named.
_ROUNDED, _NAMED = 0.2, 5


@dataclass(frozen=True)
class AxisColumns:
    """Names of the record's columns, the units that were given by `time`, `position` and `force`, and what to drop."""

    time: str
    position: str
    force: str
    units: Mapping[str, Unit]
    drop: frozenset[str] = frozenset()

    @property
    def names(self) -> dict[str, str]:
        """Column by what it holds."""
        return {"time": self.time, "position": self.position, "force": self.force}


@dataclass(frozen=True)
class AxisRecord:
    """What a file holds.

    - `parts`: the record, or what is left of it between gaps in its samples.
    - `rotary`: whether the axis is one, as units say; None where none does.
    - `notes`: sentences on how it was read.
    """

    parts: tuple[Record, ...]
    rotary: bool | None
    notes: tuple[str, ...]


def read_records(paths: Sequence[Path], columns: AxisColumns) -> tuple[AxisRecord, ...]:
    """Read several records, named after their files; with their folder before where two files are called the same.

    **Raises:**

    - `ValueError` as `read_record` does, for a file that is given twice, and for linear and rotary axes together.
    """
    real = [path.resolve() for path in paths]
    for i, path in enumerate(real):
        if path in real[:i]:
            raise ValueError(f"{paths[i]} is given twice.")
    stems = [path.stem for path in real]
    names = [path.stem if stems.count(path.stem) == 1 else f"{path.parent.name}/{path.name}" for path in real]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise ValueError(f"Two files are called {name}: rename one of them.")
    records = tuple(read_record(path, columns, name) for path, name in zip(paths, names, strict=True))
    by_kind = {record.rotary: path.name for record, path in zip(records, paths, strict=True)}
    if True in by_kind and False in by_kind:
        raise ValueError(f"{by_kind[True]} is of a rotary axis and {by_kind[False]} of a linear one: fit each alone.")
    return records


def read_record(path: Path, columns: AxisColumns, name: str | None = None) -> AxisRecord:
    """Read a record from a file, as its ending says.

    **Raises:**

    - `ValueError` naming a file that is damaged or of an unknown kind, a missing column and those that are there, a
      column that holds no numbers, NaN, lengths that differ, or times that do not increase; `OSError` if the file
      cannot be read.
    """
    table, notes = read_columns(path), []
    if any(isinstance(column, Channel) for column in table.values()):
        table, notes = _on_one_clock(table, path, columns)
    headers = {role: _header(table, path, role, wanted) for role, wanted in columns.names.items()}
    try:
        read = {role: column_unit(role, header, columns.units.get(role)) for role, header in headers.items()}
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error
    units = {role: unit for role, (unit, _) in read.items()}
    notes += [f"{path.name}: {sentence}" for _, sentence in read.values() if sentence]
    rotary = _rotary(path, headers, units)
    arrays = {role: _numbers(table, path, header) for role, header in headers.items()}
    lengths = {header: arrays[role].size for role, header in headers.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(
            f"{path.name}: columns must have one length, but they have"
            f" {', '.join(f'{length} ({header!r})' for header, length in lengths.items())}."
        )
    arrays = {role: units[role].factor * array for role, array in arrays.items()}
    arrays, dropped = _checked(path, arrays, headers, columns.drop)
    t, position, force = arrays["time"], arrays["position"], arrays["force"]
    name = name or path.stem
    if units["position"].velocity:
        position = _integral(t, position)
        notes.append(
            f"{name}: column {headers['position']!r} is a velocity; its integral is fitted as the position, so that the"
            " noise of the velocity adds up."
        )
    record = Record(t, position, {"u": force}, name=name)
    parts, gaps = _parts(record)
    return AxisRecord(parts, rotary, (*notes, *dropped, *gaps, *_doubts(record, headers, units, rotary)))


def offset_note(record: Record, force: str) -> tuple[str, ...]:
    """A sentence where the force goes with the motion of another time."""
    offset, left = clock_offset(record)
    if not (abs(offset) > _APART * float(np.median(np.diff(record.t))) and left < _EXPLAINS):
        return ()
    mend = "fit the delay by --free +delay.u" if offset > 0 else "shift one of the two columns in time"
    return (
        f"{record.name}: the force {force!r} comes {1e3 * abs(offset):.3g} ms too {'early' if offset > 0 else 'late'}:"
        f" shifted by that it explains the motion best, with {100 * left:.0f} % of the force that is left without. If"
        f" it is no accident, {mend}.",
    )


def _on_one_clock(table: Columns, path: Path, columns: AxisColumns) -> tuple[Columns, list[str]]:
    """Position and force of a logger at the times of the position, where the force was logged as well."""
    headers = [_header(table, path, role, columns.names[role]) for role in ("position", "force")]
    position, force = (table[header] for header in headers)
    if not (isinstance(position, Channel) and isinstance(force, Channel)):
        return table, []
    if np.array_equal(position.t, force.t):
        return {columns.time: position.t, headers[0]: position.values, headers[1]: force.values}, []
    last = force.t[-1] + float(np.median(np.diff(force.t))) if force.t.size > 1 else force.t[-1]
    both = (position.t >= force.t[0]) & (position.t < last)
    if np.count_nonzero(both) < _LEAST_PART:
        raise ValueError(f"{path.name}: {headers[0]!r} and {headers[1]!r} were hardly logged at the same time.")
    t, q = position.t[both], position.values[both]
    resampled = held_on(force, t)
    try:
        offset = clock_offset(Record(t, q, {"u": resampled}))[0]
    except ValueError:  # what is wrong with the samples is said later, in words of the user's
        offset = 0.0
    return {columns.time: t, headers[0]: q, headers[1]: resampled}, [
        f"{path.name}: {headers[1]!r} is resampled to the times of {headers[0]!r}. As the motion shows, the clock of"
        f" the force is {1e3 * abs(offset):.2f} ms {'early' if offset >= 0 else 'late'} against that of the position."
    ]


def held_on(force: Channel, t: np.ndarray) -> np.ndarray:
    """Values that are held from sample to sample as their means over the intervals from each time of `t` to the next.

    Its integral over time stays what it is, whichever of the two clocks is faster.
    """
    end = max(float(t[-1]), float(force.t[-1])) + 1.0
    edges = np.append(force.t, end)
    integral = np.concatenate([[0.0], np.cumsum(np.diff(edges) * force.values)])
    ends = np.append(t, 2 * t[-1] - t[-2] if t.size > 1 else end)
    return np.diff(np.interp(ends, edges, integral)) / np.diff(ends)


def _header(table: Columns, path: Path, role: str, wanted: str) -> str:
    """The column of this name, or the one that is called so but for its unit."""
    if wanted in table:
        return wanted
    bare = {header: split_header(header)[0] for header in table}
    alike = [header for header, name in bare.items() if name == wanted]
    if len(alike) == 1:
        return alike[0]
    near = nearest(wanted, [*table, *bare.values()])
    hint = f" Did you mean --{role} {near}?" if near else ""
    other = " A velocity will do, too: --position NAME --units position=m/s." if role == "position" else ""
    raise ValueError(
        f"{path.name} has no column {wanted!r} (--{role}); it has: {', '.join(table) or 'none'}.{hint or other}"
    )


def _numbers(table: Columns, path: Path, header: str) -> np.ndarray:
    given = pd.Series(table[header])
    if given.empty:
        return np.zeros(0)
    if pd.api.types.is_numeric_dtype(given) and not pd.api.types.is_complex_dtype(given):
        return given.to_numpy(float, na_value=np.nan)
    if pd.api.types.is_datetime64_any_dtype(given):
        return (given - given.iloc[0]).dt.total_seconds().to_numpy(float)
    bad = int(np.argmax(np.isnan(np.asarray(pd.to_numeric(given, errors="coerce"), float))))
    raise ValueError(f"{path.name}: column {header!r} holds {given.iloc[bad]!r} in sample {bad}, which is no number.")


def _rotary(path: Path, headers: Mapping[str, str], units: Mapping[str, Unit]) -> bool | None:
    """Whether the axis is rotary, as position and force say in one voice."""
    said = {role: unit.rotary for role, unit in units.items() if unit.rotary is not None}
    if len(set(said.values())) > 1:
        raise ValueError(
            f"{path.name}: {headers['position']!r} is in {units['position'].text} and {headers['force']!r} in"
            f" {units['force'].text}, but a rotary axis needs an angle and a torque, a linear one a length and a force."
            " Give --units of one kind, with a factor where a gear or a lever lies between."
        )
    return next(iter(said.values()), None)


def _checked(
    path: Path, arrays: dict[str, np.ndarray], headers: Mapping[str, str], drop: frozenset[str]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The samples without those that `drop` names, and a sentence for each kind of them.

    **Raises:**

    - `ValueError` naming columns and samples with NaN, at repeated times, or out of order.
    """
    notes, samples = [], np.arange(arrays["time"].size)
    holes = {role: np.flatnonzero(~np.isfinite(array)) for role, array in arrays.items()}
    for role, bad in holes.items():
        if bad.size and "nan" not in drop:
            raise ValueError(
                f"{path.name}: column {headers[role]!r} has {bad.size} values that are not finite, the first in sample"
                f" {bad[0]}. Fill them, or leave such samples out by --drop nan."
            )
    hollow = np.unique(np.concatenate(list(holes.values())))
    if hollow.size:
        arrays = {role: np.delete(array, hollow) for role, array in arrays.items()}
        samples = np.delete(samples, hollow)
        notes.append(f"{path.name}: {hollow.size} samples with values that are not finite are left out.")
    steps = np.diff(arrays["time"])
    back, still = 1 + np.flatnonzero(steps < 0), 1 + np.flatnonzero(steps == 0)
    if back.size:
        k = back[0]
        raise ValueError(
            f"{path.name}: times must increase, but column {headers['time']!r} goes back {back.size} times, first from"
            f" {arrays['time'][k - 1]:g} s to {arrays['time'][k]:g} s in sample {samples[k]}. Sort the samples by time;"
            " where the clock was set anew, save what follows as a record of its own."
        )
    if still.size and "repeated" not in drop:
        named = ", ".join(str(samples[k]) for k in still[:_NAMED]) + (", ..." if still.size > _NAMED else "")
        mend = (
            "The times seem to be rounded: export them with more digits."
            if still.size > _ROUNDED * samples.size
            else "Leave such samples out by --drop repeated."
        )
        raise ValueError(
            f"{path.name}: times must increase, but column {headers['time']!r} has {still.size} samples at the time of"
            f" the one before: {named}. {mend}"
        )
    if still.size:
        arrays = {role: np.delete(array, still) for role, array in arrays.items()}
        notes.append(f"{path.name}: {still.size} samples at the time of the one before are left out.")
    return arrays, notes


def _parts(record: Record) -> tuple[tuple[Record, ...], list[str]]:
    """The record cut where samples are missing: what the force did there is not known."""
    gaps = sampling_gaps(record)
    if not gaps:
        return (record,), []
    edges = [0, *(last + 1 for last in gaps), len(record.t)]
    spans = [(a, b) for a, b in pairwise(edges) if b - a >= _LEAST_PART]
    if not spans:
        return (record,), []
    parts = tuple(record.samples(a, b, f"{record.name} part {i + 1}") for i, (a, b) in enumerate(spans))
    where = ", ".join(f"from {record.t[k]:g} to {record.t[k + 1]:g} s" for k in gaps[:_NAMED])
    more = f" and {len(gaps) - _NAMED} more" if len(gaps) > _NAMED else ""
    return parts, [
        f"{record.name}: samples are missing {where}{more}; the parts between are fitted as {len(parts)} records, each"
        " from a start state of its own."
    ]


def _integral(t: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(0.5 * np.diff(t) * (v[1:] + v[:-1]))])


def _sounds_like_another(record: Record, headers: Mapping[str, str], units: Mapping[str, Unit]) -> list[str]:
    """Whether what nobody stated to be a position is a velocity, and to be a force a drive signal."""
    sentences = []
    if not units["position"].text:
        left = unexplained_force(record)
        as_velocity = Record(record.t, _integral(record.t, record.measured), record.inputs)
        if left > _UNEXPLAINED and unexplained_force(as_velocity) < _BETTER * left:
            sentences.append(
                f"{record.name}: the force goes with {headers['position']!r} as with a velocity, not as with a"
                " position. If it is one, say so: --units position=m/s."
            )
    if not units["force"].text and headers["force"].lower() in _DRIVE_NAMES:
        sentences.append(
            f"{record.name}: {headers['force']!r} is read as a force in SI units. If it is a drive signal, give the"
            " newtons (or N m) for each unit of it, as in --units force=12.5: mass and friction are in proportion."
        )
    return sentences


def _doubts(record: Record, headers: Mapping[str, str], units: Mapping[str, Unit], rotary: bool | None) -> list[str]:
    """Whether units that nobody stated look like others."""
    unit, doubts = axis_unit("m", bool(rotary)), []
    interval, span = float(np.median(np.diff(record.t))), float(np.ptp(record.measured))
    speed = float(np.quantile(np.abs(np.diff(record.measured) / np.diff(record.t)), _NEARLY_ALL))
    if not units["time"].text and interval >= _SLOW_CLOCK:
        doubts.append(("time", f"samples are {interval:g} s apart", "ms"))
    if not units["position"].text and (span > _LONG_TRAVEL or speed > _FAST):
        doubts.append(("position", f"positions span {span:.3g} {unit} at up to {speed:.3g} {unit}/s", "mm"))
    sentences = _sounds_like_another(record, headers, units)
    if not doubts:
        return sentences
    names = " and ".join(f"{headers[role]!r}" for role, _, _ in doubts)
    return [
        *sentences,
        f"{record.name}: {' and '.join(what for _, what, _ in doubts)}, as {names} are read in SI units. If they are in"
        f" others, say so: --units {','.join(f'{role}={other}' for role, _, other in doubts)}.",
    ]
