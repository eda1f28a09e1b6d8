"""`jaxmodsim fit`, as a user meets it: what it reads, what it writes, how it refuses."""

import base64
import json
import signal
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy.io

from jaxmodsim.cli import _fit
from jaxmodsim.cli._records import AxisColumns, read_record, read_records
from jaxmodsim.cli._units import parse_units
from jaxmodsim.identify import FitResult, Record, axis_models, axis_scene, estimate_axis, fit, warnings_for
from jaxmodsim.identify.model._axis import AxisEstimate

from ..helpers.axis_records import GAIN, TRUTH, axis_frame

COLUMNS = ("--time", "time", "--position", "pos", "--force", "volt", "--units", f"force={GAIN}")
MODEL = ("--limit", "m=:50", "--initializer", "staged")
NAMES = AxisColumns("time", "pos", "volt", parse_units([f"force={GAIN}"]))


def write_mat(path: Path, columns: dict[Any, Any]) -> None:
    scipy.io.savemat(path, columns)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Three records: two in CSV and Parquet, the second of which starts in motion, and one in a MATLAB file."""
    folder = tmp_path_factory.mktemp("records")
    paths = [folder / name for name in ("run <b>1.csv", "run2.parquet", "test.mat")]
    axis_frame(0).to_csv(paths[0], index=False)
    axis_frame(1, 0.4).to_parquet(paths[1])
    write_mat(paths[2], {name: column.to_numpy() for name, column in axis_frame(2).items()})
    return [str(path) for path in paths]


class Page(HTMLParser):
    """Tags, images and text of a page."""

    def __init__(self, page: str):
        super().__init__()
        self.tags: list[str] = []
        self.images: list[Any] = []
        self.links: list[Any] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.images += [value for name, value in attrs if name == "src"]
        self.links += [value for name, value in attrs if name == "href"]

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="module")
def fitted(run_command, files, tmp_path_factory):
    """The fit of two records with a third held out, and a report."""
    out = tmp_path_factory.mktemp("fit")
    command = ("fit", *files[:2], *COLUMNS, *MODEL, "--held-out", files[2])
    code, text, errors = run_command(*command, "--out", str(out), "--report", str(out / "report"))
    assert code == 0, errors
    return out, text


def test_several_records_are_fitted_together_and_a_held_out_one_is_scored(fitted):
    out, text = fitted
    found = json.loads((out / "fit.json").read_text())
    values = {name: entry["value"] for name, entry in found["parameters"].items()}
    # The parabola leaves an error of 0.3 mm/s in the velocity that the second record starts at.
    assert values == pytest.approx(TRUTH, rel=0.03)
    assert found["records"] == ["run <b>1", "run2"]
    assert found["parameters"]["m"]["unit"] == "kg"
    # From rest the second record would be off by up to 0.4 m/s * m/Fv = 0.25 m.
    assert found["rmse"]["measured"] < 2e-4
    assert found["held_out"]["test"]["measured"] < 4e-4
    assert "held out" in text
    # The same friction in all three; the band allows for a level that varies, and is wide.
    assert found["headline"][3].startswith("On a new record of this motion expect an error of ")
    assert "as these 2 records show" in found["headline"][3]
    assert "Of test 100 % of the samples lie within the band for 90 %." in found["headline"][3]
    assert found["held_out_within_band"]["test"]["measured"] == 1.0
    assert {row["parameter"] for row in found["agreement"]} == set(TRUTH)
    assert "Agreement of the records" in text
    assert sorted(path.name for path in out.iterdir()) == [
        "fit.csv", "fit.json", "fit.npz", "fit_1_run_b_1.png", "fit_2_run2.png", "held_out_1_test.png", "report",
    ]  # fmt: skip


def test_samples_and_result_are_kept(fitted):
    out, _ = fitted
    frame = pd.read_csv(out / "fit.csv")
    assert frame.groupby("record").size().to_dict() == {"run <b>1": 800, "run2": 800, "test": 800}
    assert set(frame["record"][frame["use"] == "held out"]) == {"test"}
    error = frame["simulated [m]"] - frame["measured [m]"]
    found = json.loads((out / "fit.json").read_text())
    assert float(np.sqrt(np.mean(error[frame["use"] == "fitted"] ** 2))) == pytest.approx(found["rmse"]["measured"])
    loaded = FitResult.load(out / "fit.npz")
    assert loaded.values == {name: entry["value"] for name, entry in found["parameters"].items()}


def test_a_report_is_one_page_that_needs_nothing_else(fitted):
    out, _ = fitted
    page = Page((out / "report" / "report.html").read_text())
    assert not {"script", "link", "b", "iframe"} & set(page.tags)
    assert not page.links
    # Two records, one held out, two profiles.
    assert len(page.images) == 5
    for source in page.images:
        kind, data = source.split(",", 1)
        assert kind == "data:image/png;base64"
        assert base64.b64decode(data).startswith(b"\x89PNG")
    for text in ("run <b>1", "run2", "test", "m q'' = u - offset - F_dry - F_viscous", "Fc sign(v)", "N s/m",
                 "jaxmodsim fit", "jax 0.", "95 %", "Agreement of the records",
                 "90 % band", "Correlation", "likelihood"):  # fmt: skip
        assert text in page.text, text
    result = json.loads((out / "fit.json").read_text())
    for warning in result["warnings"]:
        assert warning in page.text
    for name in TRUTH:
        assert f"{result['parameters'][name]['value']:.5g}" in page.text


def test_a_better_fit_that_a_profile_comes_upon_is_the_fit(run_command, files, tmp_path, monkeypatch):
    fit = _fit.fit
    monkeypatch.setattr(_fit, "fit", lambda *arguments, **options: fit(*arguments, **{**options, "max_steps": 2}))
    monkeypatch.setattr(_fit, "_POINTS", 2)
    out = tmp_path / "out"
    code, text, errors = run_command(
        "fit", files[0], *COLUMNS, "--substeps", "1", "--out", str(out), "--report", str(out)
    )
    assert code == 0, errors
    found = json.loads((out / "fit.json").read_text())
    stopped, after = text.split("This is the fit from here on:")
    assert "stopped at the limit of 2 iterations (max_steps)" in stopped
    assert found["ending"] in after
    assert "continued once from a better value of" in found["ending"]
    assert "continued from there in" in " ".join(stopped.split())
    assert found["ending"] in Page((out / "report.html").read_text()).text


def test_ctrl_c_keeps_what_was_found(run_command, files, tmp_path, monkeypatch):
    fit, seen = _fit.fit, []

    def stopped(*arguments, progress, **options):
        def press(step, rms, values):
            seen.append(step)
            if len(seen) == 2:
                signal.raise_signal(signal.SIGINT)
            progress(step, rms, values)

        return fit(*arguments, progress=press, **options)

    monkeypatch.setattr(_fit, "fit", stopped)
    out = tmp_path / "out"
    command = ("fit", *files[:2], *COLUMNS, *MODEL, "--held-out", files[2])
    code, _, errors = run_command(*command, "--out", str(out), "--report", str(out))
    assert code == 130
    progress, said = errors.splitlines()
    assert progress.startswith("fit 0:")
    assert said == "jaxmodsim: interrupted; the results so far are written"
    found = json.loads((out / "fit.json").read_text())
    assert found["ending"].startswith("interrupted")
    assert seen == [1, 2]
    assert found["evaluations"] == 2
    assert "do not trust" in Page((out / "report.html").read_text()).text
    assert FitResult.load(out / "fit.npz").diagnostics.evaluations == 2


def test_models_are_compared(run_command, files, tmp_path):
    out = tmp_path / "out"
    command = ("fit", files[0], *COLUMNS, *MODEL[:-2], "--laws", "coulomb,asymmetric", "--folds", "2")
    code, text, errors = run_command(*command, "--out", str(out), "--report", str(out))
    assert code == 0, errors
    found = json.loads((out / "fit.json").read_text())
    # Friction is the same in both directions, so the second model has a parameter more for nothing.
    assert found["model"] == found["comparison"]["simplest"] == "coulomb"
    assert [row["name"] for row in found["comparison"]["models"]] in (
        ["coulomb", "asymmetric"],
        ["asymmetric", "coulomb"],
    )
    assert found["headline"][3].startswith("A single record cannot show changes from day to day. On a new record")
    assert "a friction level that varies by 4 % from record to record (assumed)" in text.splitlines()[3]
    assert found["comparison"]["conclusion"] in text
    assert (out / "comparison.png").stat().st_size > 10_000
    page = Page((out / "report.html").read_text())
    assert "Comparison of models" in page.text
    assert found["comparison"]["conclusion"] in page.text


def test_one_record_and_law_give_one_fit_whatever_else_is_asked(run_command, files, tmp_path):
    found = []
    for i, more in enumerate(((), ("--report", str(tmp_path)), ("--laws", "coulomb,asymmetric", "--folds", "2"))):
        out = tmp_path / str(i)
        code, _, errors = run_command("fit", files[0], *COLUMNS, "--limit", "m=:50", *more, "--out", str(out))
        assert code == 0, errors
        found.append(json.loads((out / "fit.json").read_text())["parameters"])
    for other in found[1:]:
        for name, entry in found[0].items():
            assert other[name]["value"] == pytest.approx(entry["value"], abs=0.01 * entry["standard_error"])
            assert other[name]["standard_error"] == pytest.approx(entry["standard_error"], rel=0.01)


def test_the_next_input_is_written(run_command, files, tmp_path, monkeypatch):
    out = tmp_path / "out"
    monkeypatch.setattr(_fit, "design_input", partial(_fit.design_input, max_steps=2))
    limits = ("--max-force", "30", "--max-travel", "0.1", "--duration", "1.5")
    command = ("fit", *files[:2], *COLUMNS, *MODEL, "--held-out", files[2])
    code, text, errors = run_command(*command, "--next", str(out / "next.csv"), *limits, "--out", str(out))
    assert code == 0, errors
    frame = pd.read_csv(out / "next.csv")
    assert list(frame.columns) == ["t", "q_ref", "qd_ref", "force"]
    t, q_ref, _, force = frame.to_numpy().T
    assert t[-1] == pytest.approx(1.5)
    reach = np.max(np.abs(q_ref - q_ref[0]))
    assert np.max(np.abs(force)) <= 30
    assert reach <= 0.1
    # One of the limits is all but reached.
    assert np.max(np.abs(force)) > 29 or reach > 0.095 or "What limits it: speed" in text
    positions = np.concatenate([axis_frame(0)["pos"], axis_frame(1, 0.4)["pos"]])
    assert q_ref[0] == pytest.approx(0.5 * (positions.min() + positions.max()), abs=1e-8)
    assert "plain sine" in text
    assert (out / "next.png").is_file()


@pytest.mark.parametrize("kind", ["csv", "CSV", "txt", "parquet", "column.mat", "row.mat"])
def test_every_kind_of_file_gives_the_same_record(tmp_path, kind):
    frame, path = axis_frame(), tmp_path / f"axis.{kind}"
    if kind == "parquet":
        frame.to_parquet(path)
    elif kind.endswith("mat"):
        turn = (-1, 1) if kind == "column.mat" else (1, -1)
        columns = {name: column.to_numpy().reshape(turn) for name, column in frame.items()}
        write_mat(path, {**columns, "matrix": np.eye(3), "label": np.array(["EMPS"])})
    else:
        frame.to_csv(path, index=False)
    (record,) = read_record(path, NAMES).parts
    np.testing.assert_allclose(record.t, frame["time"], rtol=1e-15)
    np.testing.assert_allclose(record.measured, frame["pos"], rtol=1e-12)
    np.testing.assert_allclose(record.inputs["u"], GAIN * frame["volt"], rtol=1e-12)
    assert record.name == path.stem


def test_records_of_one_name_are_told_apart_by_their_folders(tmp_path):
    paths = [tmp_path / name / "run.csv" for name in ("a", "b")]
    for path in paths:
        path.parent.mkdir()
        axis_frame().to_csv(path, index=False)
    assert [record.parts[0].name for record in read_records(paths, NAMES)] == ["a/run.csv", "b/run.csv"]
    with pytest.raises(ValueError, match=r"run\.csv is listed twice"):
        read_records([paths[0], tmp_path / "b" / ".." / "a" / "run.csv"], NAMES)


def test_rough_values_come_from_the_record(files):
    rough = estimate_axis(read_record(Path(files[0]), NAMES).parts[0])
    assert rough.m == pytest.approx(TRUTH["m"], rel=0.2)
    assert rough.Fc == pytest.approx(TRUTH["dry.Fc"], rel=0.5)


def record_of(frame: pd.DataFrame, **columns: Any) -> Record:
    t, q, u = (columns.get(name, frame[name].to_numpy()) for name in ("time", "pos", "volt"))
    return Record(t, q, {"u": GAIN * u})


FRAME = axis_frame()
STILL = np.zeros(len(FRAME))


@pytest.mark.parametrize(
    ("columns", "text"),
    [
        ({"volt": -FRAME["volt"].to_numpy()}, "force goes against the motion.*change the sign of one"),
        ({"pos": -FRAME["pos"].to_numpy()}, "force goes against the motion.*change the sign of one"),
        ({"volt": STILL}, r"the force never changes \(it is 0 throughout\).* Is it the right column"),
        ({"volt": STILL + 0.5}, r"the force never changes \(it is 6 throughout\)"),
        ({"pos": STILL}, r"the position never changes \(it is 0 throughout\)"),
        ({"pos": STILL + 1.3}, r"the position never changes \(it is 1.3 throughout\)"),
    ],
    ids=["sign", "sign of position", "no force", "constant force", "still", "still elsewhere"],
)
def test_records_from_which_no_axis_can_be_told_are_refused(run_command, tmp_path, columns, text):
    with pytest.raises(ValueError, match=text):
        estimate_axis(record_of(FRAME, **columns))
    FRAME.assign(**columns).to_csv(tmp_path / "run.csv", index=False)
    check_refusal(run_command, tmp_path / "out", text, str(tmp_path / "run.csv"), *COLUMNS)


def test_every_record_is_checked_for_its_sign(run_command, files, tmp_path):
    FRAME.assign(volt=-FRAME["volt"]).to_csv(tmp_path / "other.csv", index=False)
    text = "other: the force goes against the motion"
    check_refusal(run_command, tmp_path / "out", text, files[0], str(tmp_path / "other.csv"), *COLUMNS)


@pytest.mark.parametrize("kind", ["noise", "slow", "forward"])
def test_records_that_tell_little_are_not_refused_for_their_sign(kind):
    """The force has nothing to do with the motion, or the motion is slow, or goes one way only."""
    rng, t = np.random.default_rng(3), FRAME["time"].to_numpy() - 10.0
    q = {"noise": np.sin(3.0 * t), "slow": 1e-3 * np.sin(0.5 * t), "forward": 0.1 * t + 1e-3 * np.sin(2.0 * t)}[kind]
    v = np.gradient(q, t)
    friction = 3.0 * np.sign(v) + 8.0 * v
    u = rng.standard_normal(t.size) if kind == "noise" else friction + 5.0 * np.gradient(v, t) + 0.7
    rough = estimate_axis(Record(t, q + 1e-7 * rng.standard_normal(t.size), {"u": u}))
    assert min(rough.m, rough.Fc, rough.Fv) > 0


@pytest.mark.parametrize("volt", [-FRAME["volt"].to_numpy(), STILL], ids=["sign", "no force"])
def test_a_fit_that_follows_nothing_says_so(volt):
    """With start values of one's own the search goes on, to a model that stands still."""
    record, rough = record_of(FRAME, volt=volt), AxisEstimate(5.0, 8.0, 3.0, 0.7, 0.5)
    model = axis_models()["coulomb"]
    result = fit(axis_scene(model, rough), record, model.free, limits={"m": (0.0, 50.0)})
    assert any("the model follows nothing of the record" in warning for warning in warnings_for(result))
    assert str(result)


@pytest.mark.parametrize("name", axis_models())
def test_the_clock_of_a_record_makes_no_difference(name):
    model, t = axis_models()[name], FRAME["time"].to_numpy() - 10.0

    def values(start: float) -> dict[str, float]:
        record = record_of(FRAME, time=t + start)
        scene = axis_scene(model, estimate_axis(record))
        limits = {"m": (0.0, 50.0)}
        return fit(scene, record, model.free, limits=limits, substeps=2, max_steps=4).values

    expected = values(0.0)
    for start in (1300.0, -40.0):
        assert values(start) == pytest.approx(expected, rel=1e-5, abs=1e-8)


def check_refusal(run_command, out: Path, text: str, *command: str) -> None:
    code, _, errors = run_command("fit", *command, "--out", str(out))
    assert code == 2
    assert errors.startswith("jaxmodsim: ")
    assert errors.count("\n") == 1
    assert pd.Series([errors]).str.contains(text).all(), errors
    assert not out.exists()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (("--position", "poss"), "no column 'poss' .*time, pos, volt.* Did you mean --position pos"),
        (("--laws", "coulom"), "no law 'coulom'; the laws are: coulomb, asymmetric.* Did you mean 'coulomb'"),
        (("--laws", "coulomb,lugr"), "no law 'lugr'.* Did you mean 'lugre'"),
        (("--laws", " ,"), "--laws needs a law, several as A,B, or `all`, but ' ,' was given"),
        (("--laws", "all", "--free", "m"), "--free excludes several --laws"),
        (("--free", "m,dry.Fs"), "no name 'dry.Fs'; .* Did you mean 'dry.Fc'"),
        (("--free", "m", "--fix", "m=2"), "m stands in --free and in --fix"),
        (("--start", "m"), "--start needs NAME=VALUE"),
        (("--start", "m=heavy"), "--start needs NAME=VALUE"),
        (("--fix", "mass=2"), "--fix: there is no parameter 'mass'"),
        (("--fix", "m=-2"), "m must be finite and > 0, but it is -2"),
        (("--fix", "dry.Fc=-1"), "Fc must be finite and >= 0"),
        (("--limit", "m=80"), "--limit needs NAME=LOW:HIGH"),
        (("--limit", "m=:"), "--limit needs NAME=LOW:HIGH"),
        (("--limit", "m=9:8"), "the lower limit must be below"),
        (("--limit", "mass=1:9"), "--limit: there is no parameter 'mass'"),
        (("--limit", "dry.Fc=100:200"), "dry.Fc must be .*but it is"),
        (("--units", "force=0"), "--units force=0: the factor must be finite and not zero"),
        (("--units", "force=12", "--units", "mass=kg"), "--units needs COLUMN=UNIT .*but 'mass=kg' was given"),
        (("--units", "position=mmm"), "no unit 'mmm'; the units are: m, mm.* Did you mean 'mm'"),
        (("--units", "time=mm"), "mm is a unit of length; the units are: s, ms"),
        (("--units", "force=mA"), "mA is a unit of current, .*as in --units force=12.5"),
        (("--units", "position=deg,force=N"), "'pos' is in deg and 'volt' in N, but a rotary axis needs"),
        (("--drop", "zero"), "no kind of sample 'zero'; the kind of samples are: nan, repeated"),
        (("--max-steps", "0"), "--max-steps must be a positive integer"),
        (("--substeps", "0"), "--substeps must be a positive integer"),
        (("--starts", "0"), "--starts must be a positive integer"),
        (("--folds", "1"), "--folds must be an integer >= 2"),
        (("--loss", "absolute"), "no name 'absolute'; the names are: squares, huber, cauchy"),
        (("--initializer", "stage"), "no name 'stage'; .* Did you mean 'staged'"),
        (("--time", "volt"), "times must increase, but column 'volt'"),
        (("--max-force", "3"), "--max-force belongs to --next"),
        (("--fix", "dry.width=1e-6"), "there is no parameter 'dry.width'; the parameters are: m, offset, dry.Fc"),
        (("--next", "n.csv", "--duration", "-1"), "--duration must be one finite number > 0"),
        (("--held-out", "nowhere.csv"), "There is no file nowhere.csv"),
    ],
)
def test_wrong_options_are_one_sentence_and_exit_code_two(run_command, files, tmp_path, change, text):
    check_refusal(run_command, tmp_path / "out", text, files[0], *COLUMNS, *change)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("", "not a CSV file with a header line"),
        ("time,pos,volt\n0,1,2\n1,x,2\n", "'pos' holds 'x' in sample 1"),
        ("time,pos,volt\n0,1,2\n1,,2\n", "'pos' has 1 values that are not finite, the first in sample 1.*--drop nan"),
        (
            "time,pos,volt\n0,1,2\n0,1,2\n1,1,2\n",
            "'time' has 1 samples with the time of the sample before: 1. Their times",
        ),
        ("time,pos,volt\n" + "".join(f"{max(k, 1)},1,2\n" for k in range(9)), "before: 1. Omit .*--drop repeated"),
        ("time,pos,volt\n1,1,2\n2,1,2\n0,1,2\n", "'time' goes back 1 times, first from 2 s to 0 s in sample 2"),
        ("1,1,2\n2,1,2\n0,1,2\n", "not a CSV file with a header line: the first line holds numbers"),
        ("time [s],phi_deg,volt [mA]\n0,1,2\n1,1,3\n", "no column 'pos' .*has: time .s., phi_deg"),
        ("time,pos,volt\n0,1,2\n", "two samples or more"),
        ("time,pos,volt\n0,1,2\n.01,1,2\n.02,1,3\n", "the position never changes"),
    ],
)
def test_bad_tables_are_one_sentence_and_exit_code_two(run_command, tmp_path, content, text):
    path = tmp_path / "bad.csv"
    path.write_text(content)
    check_refusal(run_command, tmp_path / "out", text, str(path), *COLUMNS)


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("a.parquet", b"PAR1 and no more", "damaged or not a .parquet file"),
        ("a.mat", b"MATLAB 5.0 MAT-file" + bytes(105) + b"\x00\x01IM" + bytes(7), "damaged or not a MATLAB file"),
        ("a.mat", b"MATLAB 7.3 MAT-file" + b" " * 105 + b"\x00\x02IM" + bytes(800), "MATLAB 7.3 .*'-v7'"),
        ("a.csv", b"\xff\xfe\x00\x80", "not a CSV file"),
        ("a.xlsx", b"PK", "must be one of .csv, .txt, .mat, .parquet, .mf4"),
        ("axis", b"", "must be one of"),
    ],
)
def test_damaged_and_unknown_files_are_one_sentence(run_command, tmp_path, name, content, text):
    path = tmp_path / name
    path.write_bytes(content)
    check_refusal(run_command, tmp_path / "out", text, str(path), *COLUMNS)


def test_matlab_vectors_of_other_lengths_and_folders_are_refused(run_command, files, tmp_path):
    path, out = tmp_path / "a.mat", tmp_path / "out"
    write_mat(path, {"time": np.arange(3.0), "pos": np.arange(4.0), "volt": np.arange(3.0)})
    check_refusal(run_command, out, r"3 \('time'\), 4 \('pos'\), 3 \('volt'\)", str(path), *COLUMNS)
    write_mat(path, {"time": np.arange(3.0), "pos": np.eye(3), "volt": np.arange(3.0)})
    check_refusal(run_command, out, "no column 'pos' .*the file has: time, volt", str(path), *COLUMNS)
    check_refusal(run_command, out, "is a folder; a file is needed", str(tmp_path))
    check_refusal(run_command, out, "There is no file", str(tmp_path / "none.csv"))
    check_refusal(run_command, out, "is listed twice", files[0], files[0], *COLUMNS)
    check_refusal(run_command, out, "is listed twice", files[0], "--held-out", files[0], *COLUMNS)
    code, _, errors = run_command("fit", files[0], *COLUMNS, "--out", files[0])
    assert code == 2
    assert "is a file; a folder is needed" in errors
