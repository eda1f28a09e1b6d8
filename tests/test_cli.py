"""The command line, as a user meets it: what it writes, and how it refuses."""

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from jaxmodsim.cli import _app, _output
from jaxmodsim.cli._demo import START, TRUTH, sprung_scene, synthetic_record
from jaxmodsim.cli._fit import AxisColumns, read_record
from jaxmodsim.cli._testbench import cases, run_case, stick_sweep
from jaxmodsim.friction import LuGre
from jaxmodsim.identify import fit, rough_axis
from jaxmodsim.plot import fit_figure, ramp_figure, truth_figure

DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture
def command(monkeypatch, capsys):
    """Run a command line in this process; gives its exit code, output and errors."""

    def start_nothing():
        # The tests have started JAX already, in double precision.
        return None

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(_app, "_start", start_nothing)
        monkeypatch.setattr(sys, "argv", ["jaxmodsim", *arguments])
        with pytest.raises(SystemExit) as ending:
            _app.run()
        captured = capsys.readouterr()
        return int(ending.value.code or 0), captured.out, captured.err

    return run


@pytest.fixture
def axis_file(tmp_path):
    """A record of an axis of 5 kg with 3 N of friction and 8 N s/m, from a plain Euler simulation."""
    t = np.arange(0.0, 6.0, 2e-3)
    u = 0.5 * np.sign(np.sin(1.1 * t)) + np.sin(2.3 * t)
    q, v = np.zeros_like(t), 0.0
    for k in range(1, t.size):
        for _ in range(20):
            v += 1e-4 * (12.0 * u[k - 1] - 0.7 - 3.0 * np.tanh(v / 1e-3) - 8.0 * v) / 5.0
            q[k] += 1e-4 * v
        q[k] += q[k - 1]
    path = tmp_path / "axis.csv"
    pd.DataFrame({"time": t, "pos": q + 1e-6 * np.random.default_rng(0).standard_normal(t.size), "volt": u}).to_csv(
        path, index=False
    )
    return path


COLUMNS = ("--time", "time", "--position", "pos", "--force", "volt", "--force-gain", "12.0")


def test_fit_writes_figure_table_and_json(command, axis_file, tmp_path):
    out = tmp_path / "out"
    code, text, _ = command("fit", str(axis_file), *COLUMNS, "--fix", "dry.width=1e-3", "--out", str(out))
    assert code == 0
    assert sorted(path.name for path in out.iterdir()) == ["fit.csv", "fit.json", "fit.png"]
    report = json.loads((out / "fit.json").read_text())
    values = {name: entry["value"] for name, entry in report["parameters"].items()}
    # Euler steps of 0.1 ms made the record: their error is well below a per cent, noise and quantisation below that.
    assert values["m"] == pytest.approx(5.0, rel=0.01)
    assert values["dry.Fc"] == pytest.approx(3.0, rel=0.01)
    assert values["viscous.Fv"] == pytest.approx(8.0, rel=0.01)
    assert values["offset"] == pytest.approx(0.7, abs=0.03)
    assert "dry.Fc" in text
    assert "fit.png" in text
    assert len(pd.read_csv(out / "fit.csv")) == 3000


def test_rough_values_come_from_the_record(axis_file):
    rough = rough_axis(read_record(axis_file, AxisColumns("time", "pos", "volt", 12.0)))
    assert rough.m == pytest.approx(5.0, rel=0.1)
    assert rough.Fc == pytest.approx(3.0, rel=0.3)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (("--position", "poss"), "no column 'poss' .*time, pos, volt.* Did you mean --position pos"),
        (("--model", "coulom"), "no model 'coulom'; the models are: coulomb, asymmetric, stribeck, lugre"),
        (("--start", "m"), "--start needs NAME=VALUE"),
        (("--start", "m=heavy"), "--start needs NAME=VALUE"),
        (("--fix", "mass=2"), "--fix names 'mass'"),
        (("--fix", "m=-2"), "m must be finite and > 0, but it is -2"),
        (("--fix", "dry.Fc=-1"), "Fc must be finite and >= 0"),
        (("--force-gain", "0"), "--force-gain must be finite and not zero"),
        (("--substeps", "0"), "substeps must be at least 1"),
        (("--time", "volt"), "times must increase"),
    ],
)
def test_wrong_options_are_one_sentence_and_exit_code_two(command, axis_file, tmp_path, change, text):
    out = tmp_path / "out"
    code, _, errors = command("fit", str(axis_file), *COLUMNS, *change, "--out", str(out))
    assert code == 2
    assert errors.startswith("jaxmodsim: ")
    assert errors.count("\n") == 1
    assert pd.Series([errors]).str.contains(text).all(), errors
    assert not out.exists()


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("", "no CSV file with a header line"),
        ("time,pos,volt\n0,1,2\n1,x,2\n", "'pos' holds 'x' in sample 1"),
        ("time,pos,volt\n0,1,2\n1,,2\n", "not finite, the first in sample 1"),
        ("time,pos,volt\n0,1,2\n0,1,2\n", "times must increase, but sample 1"),
        ("time,pos,volt\n0,1,2\n", "two samples or more"),
        ("time,pos,volt\n0,1,2\n1,1,2\n2,1,3\n", "the position never changes"),
    ],
)
def test_bad_files_are_one_sentence_and_exit_code_two(command, tmp_path, content, text):
    path, out = tmp_path / "bad.csv", tmp_path / "out"
    path.write_text(content)
    code, _, errors = command("fit", str(path), *COLUMNS, "--out", str(out))
    assert code == 2
    assert text in errors
    assert "Traceback" not in errors
    assert not out.exists()


def test_a_file_that_is_not_there_and_a_folder_that_is_none(command, axis_file, tmp_path):
    code, _, errors = command("fit", str(tmp_path / "none.csv"))
    assert code == 2
    assert "There is no file" in errors
    code, _, errors = command("fit", str(axis_file), *COLUMNS, "--out", str(axis_file))
    assert code == 2
    assert "is a file; a folder is needed" in errors


def test_help_and_usage_errors(command):
    assert command("--help")[0] == 0
    assert command("fit")[0] == 2
    assert command("simulate")[0] == 2


def test_an_output_that_fails_leaves_nothing_half_written(tmp_path, monkeypatch):
    def fail(self, *arguments, **options):
        del self, arguments, options
        raise OSError("disk full")

    monkeypatch.setattr(Figure, "savefig", fail)
    with pytest.raises(OSError, match="disk full"):
        _output.write(tmp_path, {"a.json": {"x": float("inf")}, "b.png": Figure()})
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    assert json.loads((tmp_path / "a.json").read_text()) == {"x": None}


@pytest.fixture(scope="module")
def measured():
    return {case.label: run_case(case) for case in cases()}


def test_testbench_models_do_what_the_exercise_says(measured):
    by_part = {part: [m for m in measured.values() if m.case.part == part] for part in "abcde"}
    adaptive, slow, steep = by_part["a"]
    assert not adaptive.ok
    assert slow.crossings > 2 * steep.crossings > 10
    # Coulomb level 1.5 N and stiction 1.75 N under 1 N/s; the gap that counts as broken away is worth 0.05 s.
    for part, limit in (("b", 1.5), ("d", 1.75)):
        exact, smooth = by_part[part]
        assert exact.break_away == pytest.approx(limit, abs=1e-9)
        stuck = exact.run.t < limit - 1e-6
        np.testing.assert_array_equal(exact.run.velocity[stuck], 0.0)
        np.testing.assert_allclose(exact.run.friction[stuck], exact.run.applied[stuck], atol=1e-12)
        assert smooth.break_away == pytest.approx(limit + 0.05, abs=0.02)
    at_rest, held, narrow = by_part["c"]
    assert at_rest.break_away == pytest.approx(1.55, abs=0.02)
    stuck = (held.run.t > 1.02) & (held.run.t < 1.5)
    assert np.ptp(held.run.velocity[stuck]) < 1e-12
    assert held.run.velocity[stuck][0] == pytest.approx(-1.0, abs=0.02)
    assert narrow.crossings > 5
    assert by_part["e"][1].break_away == pytest.approx(1.78, abs=0.05)


def test_larger_sigma1_damps_the_oscillation_in_stick():
    sweep = stick_sweep()
    assert (np.diff(sweep["oscillation"], axis=1) < 0).all()
    # The steady creep in stick is ramp/sigma0, so a stiffer bristle gives less of it.
    assert (np.diff(sweep["creep"], axis=0) < 0).all()
    row = np.flatnonzero(sweep["sigma0"] == 750.0)[0]
    assert sweep["speed10"][row, 0] == pytest.approx(15.694099521, rel=1e-6)


def test_demo_fit_covers_the_truth_and_figures_have_labelled_axes(measured):
    names = tuple(f"friction.{name}" for name in TRUTH)
    result = fit(sprung_scene(LuGre(**START)), synthetic_record(), names, q0=[0.0])
    for name, true in TRUTH.items():
        # Beyond four standard errors one draw in 16 000.
        assert abs(result.values[f"friction.{name}"] - true) < 4 * result.errors[f"friction.{name}"]
    truth = {f"friction.{name}": value for name, value in TRUTH.items()}
    runs = [m.run for m in measured.values()][:2]
    for figure in (fit_figure(result), truth_figure(result, truth), ramp_figure("box", runs)):
        texts = [axis.get_xlabel() + axis.get_ylabel() for axis in figure.axes]
        assert all("[" in text for text in texts)
