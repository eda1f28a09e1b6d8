"""Records of loggers, in files that the libraries of their formats have written."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxmodsim.cli._files import Channel
from jaxmodsim.cli._records import AxisColumns, held_on, read_record
from jaxmodsim.cli._units import parse_units

from ..helpers.axis_records import GAIN

# Ticks of 0.1 ms. The force is held for 1 ms; the position is sampled at 1 kHz, 0.3 ms after it.
TICK, HELD, SHIFT = 1e-4, 10, 3
T = TICK * np.arange(30_000)
FORCE = GAIN * (0.8 * np.sign(np.sin(5.1 * T)) + 1.5 * np.sin(9.3 * T))[::HELD]


def motion() -> np.ndarray:
    q, v = np.zeros_like(T), 0.0
    for k in range(1, T.size):
        v += TICK * (FORCE[(k - 1) // HELD] - 0.7 - 3.0 * np.tanh(v / 5e-3) - 8.0 * v) / 5.0
        q[k] = q[k - 1] + TICK * v
    return q


Q = motion()[SHIFT::HELD]
TQ, TU = T[SHIFT::HELD], T[::HELD]
# By how much the clock of the force is wrong in the file [s].
EARLY = 4e-3


def mdf(path: Path, u: np.ndarray, tu: np.ndarray) -> tuple[Path, dict[str, str]]:
    asammdf: Any = pytest.importorskip("asammdf")
    file = asammdf.MDF(version="4.10")
    file.append([asammdf.Signal(samples=1e3 * Q, timestamps=TQ, name="pos", unit="mm")])
    file.append([asammdf.Signal(samples=u, timestamps=tu, name="drive", unit="N")])
    saved = file.save(path / "run.mf4", overwrite=True)
    file.close()
    return Path(saved), {"position": "pos", "force": "drive"}


def tdms(path: Path, u: np.ndarray, tu: np.ndarray) -> tuple[Path, dict[str, str]]:
    nptdms: Any = pytest.importorskip("nptdms")
    begin = np.datetime64("2025-01-31T10:00:00", "us")

    def clock(t: np.ndarray) -> dict[str, Any]:
        start = begin + np.timedelta64(round(1e6 * t[0]), "us")
        return {"wf_start_time": start, "wf_start_offset": 0.0, "wf_increment": 1e-3, "wf_samples": t.size}

    with nptdms.TdmsWriter(path / "run.tdms") as writer:
        writer.write_segment([
            nptdms.ChannelObject("axis", "pos", 1e3 * Q, properties={**clock(TQ), "unit_string": "mm"}),
            nptdms.ChannelObject("drive", "force", u, properties={**clock(tu), "unit_string": "N"}),
        ])  # fmt: skip
    return path / "run.tdms", {"position": "pos", "force": "force"}


def mcap(path: Path, u: np.ndarray, tu: np.ndarray) -> tuple[Path, dict[str, str]]:
    writing: Any = pytest.importorskip("mcap.writer")
    with (path / "run.mcap").open("wb") as stream:
        writer = writing.Writer(stream)
        writer.start()
        schema = writer.register_schema(name="any", encoding="jsonschema", data=b"{}")
        for topic, t, field, values in (("/axis", TQ, "pos_mm", 1e3 * Q), ("/drive", tu, "forces", u)):
            channel = writer.register_channel(topic=topic, message_encoding="json", schema_id=schema)
            for time, x in zip(t, values, strict=True):
                text = {
                    "header": {"seq": 1},
                    field: [float(x)] if field == "forces" else float(x),
                    "ok": True,
                    "id": "a",
                }
                stamp = 1_700_000_000_000_000_000 + round(1e9 * time)
                writer.add_message(
                    channel_id=channel, log_time=stamp, publish_time=stamp, data=json.dumps(text).encode()
                )
        writer.finish()
    return path / "run.mcap", {"position": "axis.pos", "force": "drive.forces[0]"}


def ros(kind: str) -> Callable[[Path, np.ndarray, np.ndarray], tuple[Path, dict[str, str]]]:
    def write(path: Path, u: np.ndarray, tu: np.ndarray) -> tuple[Path, dict[str, str]]:
        rosbag2: Any = pytest.importorskip("rosbags.rosbag2")
        typesys: Any = pytest.importorskip("rosbags.typesys")
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        state, header, time = (
            store.types[name]
            for name in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
        )
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        with rosbag2.Writer(path / "bag", version=9, storage_plugin=plugin) as writer:
            for topic, t, q, torque in (("/joint", TQ, Q, np.zeros(Q.size)), ("/command", tu, np.zeros(u.size), u)):
                connection = writer.add_connection(topic, state.__msgtype__, typestore=store)
                for now, x, effort in zip(t, q, torque, strict=True):
                    stamp = 1_700_000_000_000_000_000 + round(1e9 * now)
                    message = state(
                        header(time(stamp // 10**9, stamp % 10**9), "base"), ["elbow"],
                        np.array([x]), np.zeros(1), np.array([effort]),
                    )  # fmt: skip
                    # The log is written at another pace than the samples were taken.
                    writer.write(connection, stamp + 2_000_000, store.serialize_cdr(message, state.__msgtype__))
        names = {"position": "joint.position[0]", "force": "command.effort[0]"}
        if kind == "mcap":
            return next((path / "bag").glob("*.mcap")), names
        return path / "bag", names

    return write


FORMATS = {"mdf": mdf, "tdms": tdms, "mcap": mcap, "ros in mcap": ros("mcap"), "ros in sqlite": ros("sqlite")}


@pytest.mark.parametrize("kind", FORMATS)
def test_clocks_are_brought_together_and_their_offset_is_reported(kind, tmp_path):
    path, names = FORMATS[kind](tmp_path, FORCE, TU)
    read = read_record(path, AxisColumns("t", names["position"], names["force"], {}))
    (record,) = read.parts
    np.testing.assert_allclose(np.diff(record.t), 1e-3, rtol=1e-6)
    np.testing.assert_allclose(record.measured, Q, rtol=1e-12)
    # Held means: 0.7 of a sample and 0.3 of the next.
    np.testing.assert_allclose(record.inputs["u"][:-1], 0.7 * FORCE[:-1] + 0.3 * FORCE[1:], rtol=1e-5, atol=1e-5)
    assert offset_of(read.notes[0]) == pytest.approx(0.0, abs=0.1)
    assert f"{names['force'].split('[')[0]}" in read.notes[0]


@pytest.mark.parametrize("kind", FORMATS)
def test_a_clock_that_is_wrong_shows(kind, tmp_path):
    path, names = FORMATS[kind](tmp_path, FORCE, TU + 0.1 - EARLY)
    read = read_record(path, AxisColumns("t", names["position"], names["force"], parse_units([])))
    assert offset_of(read.notes[0]) == pytest.approx(1e3 * (EARLY - 0.1), abs=0.1)


def offset_of(note: str) -> float:
    """Milliseconds by which the note calls the force early."""
    match = re.search(r"clock of the force is ([\d.]+) ms (early|late) relative", note)
    assert match is not None, note
    return float(match[1]) * (1 if match[2] == "early" else -1)


def test_a_held_force_keeps_its_integral():
    rng = np.random.default_rng(0)
    t, held = np.sort(rng.uniform(0.0, 1.0, 50)), np.sort(rng.uniform(-0.1, 1.1, 400))
    held[0], held[-1] = -0.2, 1.2
    values = rng.standard_normal(400)
    means = held_on(Channel(held, values), t)
    fine = np.linspace(t[0], t[-1], 2_000_001)
    exact = np.mean(values[np.searchsorted(held, 0.5 * (fine[1:] + fine[:-1]), side="right") - 1]) * (t[-1] - t[0])
    assert float(means[:-1] @ np.diff(t)) == pytest.approx(exact, abs=1e-5)
    np.testing.assert_allclose(held_on(Channel(t, values[:50]), t)[:-1], values[:49], rtol=1e-6)


@pytest.mark.parametrize(
    ("ending", "module", "extra"),
    [(".mf4", "asammdf", "mdf"), (".tdms", "nptdms", "tdms"), (".mcap", "mcap", "ros"), (".bag", "rosbags", "ros")],
)
def test_what_is_missing_to_read_them_is_named(ending, module, extra, tmp_path, monkeypatch):
    for name in (module, f"{module}.reader", f"{module}.highlevel"):
        monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / f"run{ending}").write_bytes(b"")
    with pytest.raises(ValueError, match=rf"needs {module}: pip install 'jaxmodsim\[{extra}\]'"):
        read_record(tmp_path / f"run{ending}", AxisColumns("t", "q", "u", {}))


@pytest.mark.parametrize(
    ("ending", "module"), [(".mf4", "asammdf"), (".tdms", "nptdms"), (".mcap", "mcap"), (".db3", "rosbags")]
)
def test_damaged_logs_are_refused(ending, module, tmp_path):
    pytest.importorskip(module)
    (tmp_path / f"run{ending}").write_bytes(b"no such thing" * 20)
    with pytest.raises(ValueError, match=rf"run{ending} is damaged or not a {ending} file"):
        read_record(tmp_path / f"run{ending}", AxisColumns("t", "q", "u", {}))
