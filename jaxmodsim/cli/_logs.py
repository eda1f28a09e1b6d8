"""Files of loggers, whose channels have clocks of their own: MDF, TDMS, MCAP and ROS bags."""

import importlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

_NANO = 1e-9


class Channel(NamedTuple):
    """Samples with their times [s], shape `[samples]` each; one clock for all channels of a file."""

    t: np.ndarray
    values: np.ndarray


def read_mdf(path: Path) -> dict[str, object]:
    """Channels of an MDF file (.mf4, .mdf) with their units."""
    asammdf = _library("asammdf", "mdf", "MDF files")
    with asammdf.MDF(path) as file:
        signals = [each for each in file.iter_channels(skip_master=True) if _is_column(each.samples)]
        names = _labels([_with_unit(each.name, each.unit) for each in signals])
        return {
            name: Channel(np.asarray(each.timestamps, float), np.asarray(each.samples))
            for name, each in zip(names, signals, strict=True)
        }


def read_tdms(path: Path) -> dict[str, object]:
    """Channels of a TDMS file; those without a waveform clock are plain columns, of which one may be the time."""
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


def read_bag(path: Path) -> dict[str, object]:
    """Numbers in the messages of a ROS 1 or 2 bag, `topic.field[0]`, at the time of their header, or of the log."""
    highlevel = _library("rosbags.highlevel", "ros", "ROS bags")
    with highlevel.AnyReader([path]) as reader:
        messages = (
            (connection.topic, stamp, reader.deserialize(raw, connection.msgtype))
            for connection, stamp, raw in reader.messages()
        )
        return _of_messages(messages)


def read_mcap(path: Path) -> dict[str, object]:
    """Numbers in the messages of an MCAP file, written as JSON or by ROS; see `read_bag`."""
    reader = _library("mcap.reader", "ros", "MCAP files")
    with path.open("rb") as file:
        channels = reader.make_reader(file).get_summary().channels.values()
    if any(channel.message_encoding != "json" for channel in channels):
        return read_bag(path)
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
    """The names, numbered where several are alike."""
    alike, seen, labels = Counter(names), Counter(), []
    for name in names:
        seen[name] += 1
        labels.append(name if alike[name] == 1 else f"{name} #{seen[name]}")
    return labels


def _of_messages(messages: Iterable[tuple[str, int, object]]) -> dict[str, object]:
    """Channels of messages, each a topic, a time [ns], and a tree of numbers."""
    samples: dict[str, list[tuple[int, float]]] = {}
    for topic, logged, message in messages:
        stamp = _stamp(message) or logged
        for field, number in _numbers(message):
            samples.setdefault(f"{topic.lstrip('/')}{field}", []).append((stamp, number))
    first = min((stamps[0][0] for stamps in samples.values()), default=0)
    return {
        # Nanoseconds of today are beyond what a float resolves.
        name: Channel(_NANO * np.array([stamp - first for stamp, _ in pairs], float), np.array([x for _, x in pairs]))
        for name, pairs in samples.items()
    }


def _fields(message: object) -> Mapping[str, object] | None:
    if isinstance(message, Mapping):
        return message
    return getattr(message, "__dict__", None) or None


def _stamp(message: object) -> int:
    """Time of the header of a ROS message [ns]; 0 where there is none."""
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


def held_on(force: Channel, t: np.ndarray) -> np.ndarray:
    """Values that are held from sample to sample as their means over the intervals from each time of `t` to the next.

    Its integral over time stays what it is, whichever of the two clocks is faster.
    """
    end = max(float(t[-1]), float(force.t[-1])) + 1.0
    edges = np.append(force.t, end)
    integral = np.concatenate([[0.0], np.cumsum(np.diff(edges) * force.values)])
    ends = np.append(t, 2 * t[-1] - t[-2] if t.size > 1 else end)
    return np.diff(np.interp(ends, edges, integral)) / np.diff(ends)


LOG_READERS: dict[str, Callable[[Path], dict[str, object]]] = {
    ".mf4": read_mdf,
    ".mdf": read_mdf,
    ".tdms": read_tdms,
    ".mcap": read_mcap,
    ".bag": read_bag,
    ".db3": read_bag,
}
