"""Columns of files: CSV, Parquet, MATLAB, and logger files whose channels have their own clocks."""

import importlib
import io
import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import NamedTuple, TypeAlias

import numpy as np
import pandas as pd

from ._options import check_exists

# Columns by name, as in the file.
Columns: TypeAlias = Mapping[str, object]
# Bytes and lines of a CSV file that show its separators.
_HEAD_BYTES, _HEAD_LINES = 2**16, 50
_COMMA_NUMBER = re.compile(r"\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*")
_POINT_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*")
_NANO = 1e-9


class Channel(NamedTuple):
    """Samples with their times [s], shape `[samples]` each; one clock for all channels of a file."""

    t: np.ndarray
    values: np.ndarray


def read_columns(path: Path) -> Columns:
    """Read all columns of a file; its ending names the format.

    **Raises:**

    - `ValueError` for a file that is missing, damaged or of an unknown format; `OSError` if it cannot be read.
    """
    bag = path.is_dir() and (path / "metadata.yaml").is_file()
    if path.is_dir() and not bag:
        raise ValueError(f"{path} is a folder; a file is needed.")
    check_exists(path)
    ending = ".bag" if bag else path.suffix.lower()
    if ending in _TABLE_READERS:
        return _TABLE_READERS[ending](path)
    if ending not in _LIBRARY_READERS:
        endings = ", ".join((*_TABLE_READERS, *_LIBRARY_READERS))
        raise ValueError(f"{path.name}: the ending must be one of {endings}, as it names the format.")
    try:
        return _LIBRARY_READERS[ending](path)
    except ImportError as error:
        raise ValueError(str(error)) from error
    except Exception as error:  # the readers raise anything for damaged files
        raise ValueError(f"{path} is damaged or not a {ending} file: {_one_line(error)}") from error


def _csv(path: Path) -> Columns:
    raw = path.read_bytes()
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if b"\x00" in raw:
            raise ValueError(f"{path} is not a CSV file with a header line: {_one_line(error)}") from error
        text = raw.decode("latin-1")  # the usual encoding of degree and micro signs
    separator, decimal = _separators(text[:_HEAD_BYTES])
    try:
        frame = pd.read_csv(io.StringIO(text), sep=separator, decimal=decimal, skipinitialspace=True)
    except (ValueError, pd.errors.ParserError) as error:
        raise ValueError(f"{path} is not a CSV file with a header line: {_one_line(error)}") from error
    names = [str(name).strip() for name in frame.columns]
    if not isinstance(frame.index, pd.RangeIndex):  # pandas takes the first cells of longer rows as labels
        if frame.index.nlevels > 1 or frame.iloc[:, -1].notna().any():
            cells = len(names) + frame.index.nlevels
            raise ValueError(f"{path.name}: rows have {cells} cells, but the header names {len(names)} columns.")
        frame = frame.reset_index()  # every row ends with a separator
    if names and all(_POINT_NUMBER.fullmatch(name) for name in names):
        raise ValueError(
            f"{path} is not a CSV file with a header line: the first line holds numbers. Add the names of the columns"
            " above them."
        )
    return {name: frame.iloc[:, i] for i, name in enumerate(names)}


def _separators(text: str) -> tuple[str, str]:
    """Separator of columns, from the header, and decimal sign, from the numbers; a comma is only one of them."""
    header, *lines = text.splitlines()[: _HEAD_LINES + 1] or [""]
    separator = next((each for each in (";", "\t", ",", "|") if each in header), None)
    if separator is None:
        separator = r"\s+" if len(header.split()) > 1 else ","
    if separator == ",":
        return separator, "."
    cells = [cell.strip('" ') for line in lines for cell in re.split(separator.replace("|", r"\|"), line)]
    comma = any(_COMMA_NUMBER.fullmatch(cell) for cell in cells)
    point = any("." in cell and _POINT_NUMBER.fullmatch(cell) for cell in cells)
    return separator, "," if comma and not point else "."


def _mat(path: Path) -> Columns:
    # In a separate process, as some damaged files crash the reader.
    reading = subprocess.run([sys.executable, "-c", _MAT, str(path.resolve())], capture_output=True, check=False)
    if reading.returncode == _HDF5:
        raise ValueError(
            f"{path.name} is a MATLAB 7.3 file (HDF5), which is not supported: save it in MATLAB with"
            f" save('{path.name}', ..., '-v7'), or as CSV or Parquet."
        )
    if reading.returncode != 0:
        last = reading.stderr.decode(errors="replace").strip().splitlines()[-1:]
        why = " ".join(last) if reading.returncode > 0 else "the reader crashes"
        raise ValueError(f"{path} is damaged or not a MATLAB file: {why}")
    with np.load(io.BytesIO(reading.stdout), allow_pickle=False) as arrays:
        # MATLAB has no vectors, only matrices with a single row or column.
        vectors = {name[1:]: np.ravel(x) for name, x in arrays.items() if x.size == max(x.shape, default=0)}
    return {name: x for name, x in vectors.items() if not name.startswith("__")}


# Reads variables of numbers and text only.
_HDF5 = 3
_MAT = f"""
import sys, numpy, scipy.io
try:
    arrays = scipy.io.loadmat(sys.argv[1])
except NotImplementedError:
    sys.exit({_HDF5})
kept = {{"_" + name: x for name, x in arrays.items() if getattr(getattr(x, "dtype", None), "kind", "O") in "biufcU"}}
numpy.savez(sys.stdout.buffer, **kept)
"""


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _read_parquet(path: Path) -> dict[str, object]:
    _library("pyarrow", "cli", "Parquet files")
    frame = pd.read_parquet(path)
    return {str(name): frame[name] for name in frame.columns}


def _read_mdf(path: Path) -> dict[str, object]:
    """Channels of an MDF file (.mf4, .mdf) with their units."""
    asammdf = _library("asammdf", "mdf", "MDF files")
    with asammdf.MDF(path) as file:
        signals = [each for each in file.iter_channels(skip_master=True) if _is_column(each.samples)]
        names = _labels([_with_unit(each.name, each.unit) for each in signals])
        return {
            name: Channel(np.asarray(each.timestamps, float), np.asarray(each.samples))
            for name, each in zip(names, signals, strict=True)
        }


def _read_tdms(path: Path) -> dict[str, object]:
    """Channels of a TDMS file; those without a waveform clock are plain columns, one of which may be the time."""
    nptdms = _library("nptdms", "tdms", "TDMS files")
    with path.open("rb") as opened, nptdms.TdmsFile.open(opened) as file:
        channels = [channel for group in file.groups() for channel in group.channels() if _is_column(channel[:])]
        starts = [channel.properties.get("wf_start_time") for channel in channels]
        first = min((start for start in starts if start is not None), default=None)
        units = [str(channel.properties.get("unit_string") or "") for channel in channels]
        names = _labels([_with_unit(channel.name, unit) for channel, unit in zip(channels, units, strict=True)])
        columns: dict[str, object] = {}
        for name, channel, start in zip(names, channels, starts, strict=True):
            if "wf_increment" not in channel.properties:
                columns[name] = np.asarray(channel[:])
                continue
            later = 0.0 if start is None else float((start - first) / np.timedelta64(1, "ns")) * _NANO
            columns[name] = Channel(later + np.asarray(channel.time_track(), float), np.asarray(channel[:]))
        return columns


def _read_bag(path: Path) -> dict[str, object]:
    """Numbers in the messages of a ROS 1 or 2 bag, `topic.field[0]`, at the time in their header or of the log."""
    highlevel = _library("rosbags.highlevel", "ros", "ROS bags")
    with highlevel.AnyReader([path]) as reader:
        messages = (
            (connection.topic, stamp, reader.deserialize(raw, connection.msgtype))
            for connection, stamp, raw in reader.messages()
        )
        return _of_messages(messages)


def _read_mcap(path: Path) -> dict[str, object]:
    """Numbers in the messages of an MCAP file, written as JSON or by ROS; see `_read_bag`."""
    reader = _library("mcap.reader", "ros", "MCAP files")
    with path.open("rb") as file:
        channels = reader.make_reader(file).get_summary().channels.values()
    if any(channel.message_encoding != "json" for channel in channels):
        return _read_bag(path)
    with path.open("rb") as file:
        messages = (
            (channel.topic, message.log_time, json.loads(message.data))
            for _, channel, message in reader.make_reader(file).iter_messages()
        )
        return _of_messages(messages)


def _library(name: str, extra: str, what: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.split(".")[0]
        raise ImportError(f"Reading {what} needs {package}: pip install 'jaxmodsim[{extra}]'.") from error


def _is_column(values: object) -> bool:
    array = np.asarray(values)
    return array.ndim == 1 and array.size > 0 and array.dtype.kind in "iuf"


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit.strip() else name


def _labels(names: Sequence[str]) -> list[str]:
    """The names, with a number for those that are not unique."""
    total, seen, labels = Counter(names), Counter(), []
    for name in names:
        seen[name] += 1
        labels.append(name if total[name] == 1 else f"{name} #{seen[name]}")
    return labels


def _of_messages(messages: Iterable[tuple[str, int, object]]) -> dict[str, object]:
    """Channels of messages; each message is a topic, a time [ns] and a tree of numbers."""
    samples: dict[str, list[tuple[int, float]]] = {}
    for topic, logged, message in messages:
        stamp = _stamp(message) or logged
        for field, number in _numbers(message):
            samples.setdefault(f"{topic.lstrip('/')}{field}", []).append((stamp, number))
    first = min((stamps[0][0] for stamps in samples.values()), default=0)
    return {
        # Subtracted as integers: a float does not resolve nanoseconds since 1970.
        name: Channel(_NANO * np.array([stamp - first for stamp, _ in pairs], float), np.array([x for _, x in pairs]))
        for name, pairs in samples.items()
    }


def _fields(message: object) -> Mapping[str, object] | None:
    if isinstance(message, Mapping):
        return message
    return getattr(message, "__dict__", None) or None


def _stamp(message: object) -> int:
    """Time in the header of a ROS message [ns]; 0 without one."""
    tree: object = message
    for level in ("header", "stamp"):
        tree = (_fields(tree) or {}).get(level)
    seconds = _fields(tree) or {}
    sec, nanosec = seconds.get("sec"), seconds.get("nanosec")
    return sec * 1_000_000_000 + nanosec if isinstance(sec, int) and isinstance(nanosec, int) else 0


def _numbers(message: object, path: str = "") -> Iterator[tuple[str, float]]:
    """All numbers in a message with their paths, `.position[0]`."""
    if isinstance(message, bool | str | bytes):
        return
    if isinstance(message, int | float | np.number):
        yield path, float(message)
    elif isinstance(message, list | tuple | np.ndarray):
        for i, each in enumerate(message):
            yield from _numbers(each, f"{path}[{i}]")
    else:
        for name, each in (_fields(message) or {}).items():
            if name != "header" and not name.startswith("__"):
                yield from _numbers(each, f"{path}.{name}")


_TABLE_READERS: dict[str, Callable[[Path], Columns]] = {".csv": _csv, ".txt": _csv, ".mat": _mat}
_LIBRARY_READERS: dict[str, Callable[[Path], Columns]] = {
    ".parquet": _read_parquet,
    ".mf4": _read_mdf,
    ".mdf": _read_mdf,
    ".tdms": _read_tdms,
    ".mcap": _read_mcap,
    ".bag": _read_bag,
    ".db3": _read_bag,
}
