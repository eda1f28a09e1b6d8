"""The command line, as a user meets it: what it writes, and how it refuses."""

import json

import numpy as np
import pytest

from jaxmodsim.cli import _output
from jaxmodsim.cli._demo import START, TRUTH, synthetic_record
from jaxmodsim.friction import LuGre
from jaxmodsim.identify import fit
from jaxmodsim.plot import Figure, fit_figure, ramp_figure, truth_figure
from jaxmodsim.problems import braked_spring
from jaxmodsim.problems.testbench import ramp_cases, run_ramp, stick_sweep


def test_help_and_usage_errors(run_command):
    assert run_command("--help")[0] == 0
    assert run_command("fit")[0] == 2
    assert run_command("simulate")[0] == 2


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("fit", "fit.csv"), "fit.csv would replace a file that is read"),
        (("fit", "run.csv", "--next", "run.csv"), "run.csv would replace a file that is read"),
        (("predict", "fit.json", "run.csv"), "run.csv would replace a file that is read"),
        (("predict", "fit.json", "a/fit.csv"), "fit.json would replace a file that is read"),
        (("predict", "a/fit.json", "a/run.csv", "b/run.csv"), "run.csv would replace a result of another record"),
    ],
)
def test_no_output_replaces_an_input_or_another_output(run_command, tmp_path, monkeypatch, arguments, text):
    monkeypatch.chdir(tmp_path)
    code, _, errors = run_command(*arguments, "--out", ".")
    assert code == 2
    assert text in errors


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
    return {case.label: run_ramp(case) for case in ramp_cases()}


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
    result = fit(braked_spring.driven_spring(LuGre(**START)), synthetic_record(), names, q0=[0.0])
    for name, true in TRUTH.items():
        # Beyond four standard errors one draw in 16 000.
        assert abs(result.values[f"friction.{name}"] - true) < 4 * result.errors[f"friction.{name}"]
    truth = {f"friction.{name}": value for name, value in TRUTH.items()}
    runs = [m.run for m in measured.values()][:2]
    for figure in (fit_figure(result), truth_figure(result, truth), ramp_figure("box", runs)):
        texts = [axis.get_xlabel() + axis.get_ylabel() for axis in figure.axes]
        assert all("[" in text for text in texts)
