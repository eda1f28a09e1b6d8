"""Records as they come: each is fitted right, or what is wrong with it is named."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from jaxmodsim.cli._options import FitRequest
from jaxmodsim.cli._plan import plan_of
from jaxmodsim.cli._records import AxisColumns, read_record
from jaxmodsim.cli._units import Unit, known_unit, parse_units, split_header
from jaxmodsim.identify import Record, axis_models, clock_offset, sampling_gaps

from ..helpers.axis_records import GAIN, TRUTH, axis_frame

FRAME, RANDOM = axis_frame(), np.random.default_rng(1)
T, Q, U = (FRAME[name].to_numpy() for name in ("time", "pos", "volt"))
COLUMNS = ("--time", "time", "--position", "pos", "--force", "volt")
FORCE = ("--units", f"force={GAIN}")
MODEL = ("--substeps", "1")
SPIKES = np.where(RANDOM.random(T.size) < 0.005, 0.05 * RANDOM.standard_normal(T.size), 0.0)
QUICK_CLOCK = "--units", f"time=ms,position=mm,force={GAIN}"
VELOCITY = np.gradient(Q, T)


class Read:
    """What a user reads of a fit."""

    def __init__(self, run_command: Callable[..., tuple[int, str, str]], folder: Path, *options: str):
        code, self.out, self.errors = run_command("fit", *options, "--out", str(folder / "out"))
        assert code == 0, self.errors
        self.found = json.loads((folder / "out" / "fit.json").read_text())
        self.values = {name: entry["value"] for name, entry in self.found["parameters"].items()}
        self.headline = self.out.splitlines()[:3]

    @property
    def right(self) -> bool:
        """Whether the numbers are those of the record."""
        return all(abs(self.values[name] / true - 1) < 0.03 for name, true in TRUTH.items())


def changed(**columns: np.ndarray) -> pd.DataFrame:
    return FRAME.assign(**columns)


RIGHT = {
    "clock at 1300 s": (changed(time=T + 1290.0), FORCE, ""),
    "milliseconds and millimetres": (changed(time=1e3 * T, pos=1e3 * Q), QUICK_CLOCK, ""),
    "units in the header": (
        changed(time=1e3 * T, pos=1e3 * Q).rename(columns={"time": "time_ms", "pos": "pos [mm]"}), FORCE, ""
    ),
    "velocity": (changed(pos=VELOCITY), ("--units", f"position=m/s,force={GAIN}"), "'pos' is a velocity; its integral"),
    "encoder": (changed(pos=np.round(Q / 1e-4) * 1e-4), FORCE, ""),
    "jitter": (changed(time=T + 2e-5 * RANDOM.standard_normal(T.size)), FORCE, ""),
    "outliers, robust": (changed(pos=Q + SPIKES), (*FORCE, "--loss", "huber"), ""),
    "other unit given": (
        FRAME.rename(columns={"pos": "pos [mm]"}), ("--units", f"position=m,force={GAIN}"),
        r"column 'pos [mm]' says mm, but --units position=m takes precedence",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", RIGHT)
def test_these_are_fitted_right(run_command, tmp_path, name):
    frame, options, note = RIGHT[name]
    frame.to_csv(tmp_path / "run.csv", index=False)
    read = Read(run_command, tmp_path, str(tmp_path / "run.csv"), *COLUMNS, *MODEL, *options)
    assert read.right, read.out
    assert read.errors.count("Note: ") == bool(note)
    assert note in read.errors


NAMED = {
    "milliseconds": (changed(time=1e3 * (T - 10.0), pos=1e3 * Q), FORCE, "use --units time=ms,position=mm."),
    "velocity": (changed(pos=VELOCITY), FORCE, "'pos' as on a velocity, not as on a position"),
    "drive signal": (FRAME, (), "'volt' is read as a force in SI units. If it is a drive signal"),
    "early force": (changed(volt=np.roll(U, -6)), FORCE, r"'volt' comes 15 ms too early"),
    "late force": (changed(volt=np.roll(U, 6)), FORCE, r"'volt' comes 15 ms too late"),
    "outliers": (changed(pos=Q + SPIKES), FORCE, "stand far out from their neighbours"),
}  # fmt: skip


@pytest.mark.parametrize("name", NAMED)
def test_what_is_wrong_is_named_in_the_first_lines(run_command, tmp_path, name):
    frame, options, text = NAMED[name]
    frame.to_csv(tmp_path / "run.csv", index=False)
    read = Read(run_command, tmp_path, str(tmp_path / "run.csv"), *COLUMNS, *MODEL, *options)
    assert text in read.headline[2]
    assert read.headline[2].startswith("Before you rely on it: run: ")


def test_a_rotary_axis_has_its_units(run_command, tmp_path):
    changed(pos=np.rad2deg(Q)).rename(columns={"pos": "phi_deg"}).to_csv(tmp_path / "run.csv", index=False)
    columns = ("--time", "time", "--position", "phi", "--force", "volt")
    read = Read(run_command, tmp_path, str(tmp_path / "run.csv"), *columns, *FORCE, *MODEL)
    assert read.right
    units = {name: entry["unit"] for name, entry in read.found["parameters"].items()}
    assert units == {"m": "kg m^2", "offset": "N m", "dry.Fc": "N m", "viscous.Fv": "N m s/rad"}
    assert "the model misses the measured angle by" in read.headline[1]
    assert read.headline[0].startswith("Coulomb: m ")
    assert "kg m^2 (+-" in read.headline[0]
    assert list(pd.read_csv(tmp_path / "out" / "fit.csv").columns)[3:] == [
        "force [N m]",
        "measured [rad]",
        "simulated [rad]",
    ]


def test_integration_steps_are_raised_until_they_no_longer_show(run_command, tmp_path):
    changed(pos=Q + 5e-5 * RANDOM.standard_normal(T.size)).to_csv(tmp_path / "run.csv", index=False)
    options = (*COLUMNS, *FORCE, "--max-steps", "12", "--laws", "lugre")  # whose bristle is stiff
    read = Read(run_command, tmp_path, str(tmp_path / "run.csv"), *options)
    assert read.values["m"] == pytest.approx(TRUTH["m"], rel=0.03)
    assert read.found["substeps"] > 1
    assert "integration step shows" not in read.out
    # What is in the table is where the first search started.
    assert read.found["parameters"]["m"]["start"] != pytest.approx(read.values["m"], rel=1e-4)


def names(units: str = f"force={GAIN}", *drop: str) -> AxisColumns:
    return AxisColumns("time", "pos", "volt", parse_units([units]), frozenset(drop))


def written(folder: Path, frame: pd.DataFrame, sep: str = ",", decimal: str = ".", encoding: str = "utf-8") -> Path:
    frame.to_csv(folder / "run.csv", index=False, sep=sep, decimal=decimal, encoding=encoding)
    return folder / "run.csv"


@pytest.mark.parametrize(("sep", "decimal"), [(";", ","), (";", "."), ("\t", ","), ("\t", "."), ("|", "."), (" ", ",")])
def test_separators_are_told_from_the_text(tmp_path, sep, decimal):
    (record,) = read_record(written(tmp_path, FRAME, sep=sep, decimal=decimal), names()).parts
    np.testing.assert_allclose(record.measured, Q, rtol=1e-12)
    np.testing.assert_allclose(record.inputs["u"], GAIN * U, rtol=1e-12)


@pytest.mark.parametrize(("sep", "decimal"), [(",", "."), (";", ",")])
def test_rows_that_end_with_a_separator_keep_their_columns(tmp_path, sep, decimal):
    path = written(tmp_path, FRAME.assign(temperature=25.0), sep, decimal)
    header, *rows = path.read_text().splitlines()
    path.write_text("\n".join([header, *(row + sep for row in rows)]))
    (record,) = read_record(path, names()).parts
    np.testing.assert_allclose(record.t, T, rtol=1e-12)
    np.testing.assert_allclose(record.inputs["u"], GAIN * U, rtol=1e-12)
    path.write_text("\n".join([header, *(f"{row}{sep}7" for row in rows)]))
    with pytest.raises(ValueError, match=r"rows have 5 cells, but the header names 4 columns"):
        read_record(path, names())


def test_an_unknown_unit_is_named(tmp_path):
    path = written(tmp_path, FRAME.rename(columns={"pos": "pos [inch]"}))
    (note,) = read_record(path, AxisColumns("time", "pos [inch]", "volt", parse_units([f"force={GAIN}"]))).notes
    assert note == "run: 'pos [inch]': [inch] is no known unit, so SI is assumed; give --units position=UNIT."


@pytest.mark.parametrize("encoding", ["utf-8-sig", "latin-1"])
def test_signs_of_units_are_read_in_any_encoding(tmp_path, encoding):
    path = written(tmp_path, FRAME.rename(columns={"pos": "pos [°]", "time": "time [µs]"}), encoding=encoding)
    read = read_record(path, names())
    assert read.rotary
    np.testing.assert_allclose(read.parts[0].measured, np.deg2rad(Q), rtol=1e-12)
    np.testing.assert_allclose(read.parts[0].t, 1e-6 * T, rtol=1e-12)


def test_a_record_is_cut_where_samples_are_missing(tmp_path):
    read = read_record(written(tmp_path, FRAME.loc[(T < 11) | (T > 11.5)]), names())
    assert [part.name for part in read.parts] == ["run part 1", "run part 2"]
    assert read.parts[0].t[-1] < 11
    assert read.parts[1].t[0] > 11.5
    (note,) = read.notes
    assert note.startswith("run: samples are missing from 10.9975 to 11.5025 s; the parts are fitted as 2 records")
    (note,) = read_record(written(tmp_path, FRAME.loc[(T[10] > T) | (T[10] + 0.5 < T)]), names()).notes
    assert note.endswith(
        "fitted as 1 record, each with its own initial state. 10 samples in parts of fewer than 20 are left out."
    )
    # Times that jitter, or differ throughout, are no gaps.
    for steps in (1.0 + RANDOM.random(99), RANDOM.exponential(size=99)):
        assert not sampling_gaps(Record(np.cumsum(steps), steps, {"u": steps}))


def test_samples_without_values_or_of_no_new_time_are_left_out(tmp_path):
    hollow = FRAME.copy()
    hollow.loc[[20, 33, 34], "pos"] = np.nan
    hollow.loc[[33], "volt"] = np.inf
    read = read_record(written(tmp_path, hollow), names(f"force={GAIN}", "nan"))
    assert len(read.parts[0].t) == len(FRAME) - 3
    assert read.notes == ("run: 3 samples with values that are not finite are omitted.",)
    twice = pd.concat([FRAME.iloc[:100], FRAME.iloc[99:]])
    read = read_record(written(tmp_path, twice), names(f"force={GAIN}", "nan", "repeated"))
    np.testing.assert_array_equal(read.parts[0].t, T)
    assert read.notes == ("run: 1 samples with the time of the sample before are omitted.",)


def test_dates_are_times(tmp_path):
    frame = FRAME.assign(time=pd.Timestamp("2025-01-31 10:00") + pd.to_timedelta(np.arange(T.size) * 2.5, unit="ms"))
    frame.to_parquet(tmp_path / "run.parquet")
    (record,) = read_record(tmp_path / "run.parquet", names()).parts
    np.testing.assert_allclose(record.t, T - T[0], atol=1e-9)


@pytest.mark.parametrize(
    ("header", "name", "factor"),
    [
        ("phi [deg]", "phi", np.pi / 180), ("phi (°)", "phi", np.pi / 180), ("phi_deg", "phi", np.pi / 180),
        ("x_mm", "x", 1e-3), ("t [µs]", "t", 1e-6), ("v_mm_s", "v", 1e-3), ("n [1/min]", "n", np.pi / 30),
        ("tau [N m]", "tau", 1.0), ("tau_Nm", "tau", 1.0), ("F [kN]", "F", 1e3), ("motor x [mm/s]", "motor x", 1e-3),
        # No units: a measured q, the least force, a warning.
        ("q_m", "q_m", None), ("F_min", "F_min", None), ("x (raw)", "x (raw)", None), ("_s", "_s", None),
        ("", "", None),
    ],
)  # fmt: skip
def test_units_in_headers(header, name, factor):
    found, unit = split_header(header)
    assert found == name
    assert (unit is None) == (factor is None)
    assert unit is None or unit.factor == pytest.approx(factor)


def test_units_that_are_given():
    units = parse_units(["time=ms, position = 2 deg", "force=-1.5e2"])
    assert {role: unit.factor for role, unit in units.items()} == pytest.approx(
        {"time": 1e-3, "position": np.pi / 90, "force": -150.0}
    )
    assert units["position"].rotary
    assert parse_units(["force=35.15 N/V"])["force"] == Unit(35.15, "force", "35.15 N/V")
    assert known_unit("mNm") == known_unit("mN m") or known_unit("mN·m")
    assert known_unit("furlong") is None


@pytest.mark.parametrize("ticks", [0, 3, 14, 150, -22])
def test_the_offset_between_clocks_is_found_to_a_tenth_of_a_millisecond(ticks):
    """A record of 1 kHz whose position was sampled on a clock that is late by so many ticks of 0.1 ms."""
    t = 1e-4 * np.arange(50_000)
    u = np.repeat(GAIN * (0.8 * np.sign(np.sin(5.1 * t)) + 1.5 * np.sin(9.3 * t))[::10], 10)
    q, v = np.zeros_like(t), 0.0
    for k in range(1, t.size):
        v += 1e-4 * (u[k - 1] - 0.7 - 3.0 * np.tanh(v / 5e-3) - 8.0 * v) / 5.0
        q[k] = q[k - 1] + 1e-4 * v
    samples = np.arange(300, t.size - 300, 10)
    noise = 1e-6 * np.random.default_rng(0).standard_normal(samples.size)
    offset, _ = clock_offset(Record(t[samples], q[samples - ticks] + noise, {"u": u[samples]}))
    assert offset == pytest.approx(1e-4 * ticks, abs=1e-4)


def test_a_current_becomes_a_force_by_a_factor(run_command, tmp_path):
    path = written(tmp_path, FRAME.rename(columns={"volt": "volt [mA]"}))
    code, _, errors = run_command("fit", str(path), *COLUMNS, "--out", str(tmp_path / "out"))
    assert code == 2
    assert errors.startswith("jaxmodsim: run.csv: column 'volt [mA]': mA is a unit of current, which needs a factor")
    np.testing.assert_allclose(read_record(path, names()).parts[0].inputs["u"], GAIN * U, rtol=1e-12)


@pytest.mark.parametrize("free", [(), ("+delay.u",)])
def test_a_parameter_can_be_added_to_those_of_the_law(capsys, tmp_path, free):
    path = written(tmp_path, changed(volt=np.roll(U, -6)))
    request = FitRequest(
        records=[path], time="time", position="pos", force="volt", units=[FORCE[1]], laws="coulomb,lugre", free=[*free]
    )
    plan = plan_of(request)
    for name, candidate in plan.candidates.items():
        assert candidate.free == (*axis_models()[name].free, *(each.removeprefix("+") for each in free))
    # What is fitted is no surprise.
    assert len(plan.notes) == 1 - len(free)
    assert capsys.readouterr().err.count("Note: ") == len(plan.notes)
