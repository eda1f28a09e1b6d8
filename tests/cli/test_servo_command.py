"""`jaxmodsim fit --axis servo` and `jaxmodsim predict`, on records of a servo simulated by SciPy."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ..helpers.servo import TRUE, clock, commands, simulate_servo


def frame(kind: str, kp: float) -> pd.DataFrame:
    t = clock(1.5, np.random.default_rng(0))
    goal, on = commands(t, kind)
    volts = np.full_like(t, 7.3)
    q = simulate_servo(t, goal, volts, on, kp, TRUE, 0.0)
    duty = np.clip(kp * (goal - q) * 4096 / (2 * np.pi) / 256 / 885, -1, 1) * on
    return pd.DataFrame({"t": t, "q_goal": goal, "q": q, "pwm": 885 * duty, "volts": volts, "torque_enable": on})


@pytest.fixture(scope="module")
def folder(tmp_path_factory, run_command) -> Path:
    """Four records and a fit."""
    folder = tmp_path_factory.mktemp("servo")
    for kind, kp in (("sine", 100), ("sine", 400), ("lift", 100), ("lift", 400)):
        frame(kind, kp).to_csv(folder / f"kp{kp}_{kind}.csv", index=False)
    run(run_command, "fit", *records(folder), "--axis", "servo", "--laws", "M3,MQ", "--out", str(folder / "fit"))
    return folder


def records(folder: Path) -> list[str]:
    return [str(path) for path in sorted(folder.glob("kp*.csv"))]


def run(run_command, *arguments: str) -> str:
    code, output, errors = run_command(*arguments)
    assert code == 0, errors
    return output


def test_laws_are_ranked_by_records_left_out(folder) -> None:
    report = json.loads((folder / "fit" / "fit.json").read_text())
    assert report["model"] == "MQ"  # the law of the records
    assert [row["law"] for row in report["ranking"]] == ["MQ", "M3"]
    groups = {"trajectory sine", "trajectory lift", "gain 100", "gain 400"}
    assert set(report["servo"]["left_out"]) == groups
    assert sum(report["servo"]["evaluations"].values()) <= 1000
    assert (folder / "fit" / "kp100_sine.png").exists()


def test_new_gain_and_command_are_predicted_without_the_angle(folder, run_command) -> None:
    new = frame("chirp", 150)
    new.drop(columns=["q", "pwm"]).to_csv(folder / "new.csv", index=False)
    out = folder / "predicted"
    run(
        run_command,
        "predict",
        str(folder / "fit" / "fit.json"),
        str(folder / "new.csv"),
        "--gain",
        "150",
        "--out",
        str(out),
    )
    table, summary = pd.read_csv(out / "new.csv"), json.loads((out / "new.json").read_text())
    assert list(table.columns) == ["t", "q", "lower", "upper"]
    np.testing.assert_allclose(table["t"], new["t"])
    assert np.mean(np.abs(table["q"] - new["q"])) < 0.02
    assert np.mean((table["lower"] <= new["q"]) & (new["q"] <= table["upper"])) > 0.8
    assert summary["gain"] == 150.0
    assert "mean_absolute_error" not in summary


def test_angle_gain_and_start_come_from_columns_or_options(folder, run_command) -> None:
    new = frame("chirp", 150).assign(kp=150.0)
    new.to_csv(folder / "both.csv", index=False)
    fit, out = str(folder / "fit" / "fit.json"), folder / "both"
    run(run_command, "predict", fit, str(folder / "both.csv"), "--out", str(out))
    summary = json.loads((out / "both.json").read_text())
    assert summary["mean_absolute_error"] < 0.02
    run(run_command, "predict", fit, str(folder / "both.csv"), "--q0", "0.05", "--out", str(out))
    assert pd.read_csv(out / "both.csv")["q"].to_numpy()[0] == pytest.approx(0.05)


def test_first_angle_alone_is_the_start(folder, run_command) -> None:
    new = frame("chirp", 150).assign(kp=150.0)
    new.loc[1:, "q"] = np.nan
    new.loc[0, "q"] = 0.03
    new.to_csv(folder / "started.csv", index=False)
    fit, out = str(folder / "fit" / "fit.json"), folder / "started"
    run(run_command, "predict", fit, str(folder / "started.csv"), "--out", str(out))
    assert pd.read_csv(out / "started.csv")["q"].to_numpy()[0] == pytest.approx(0.03)
    assert "mean_absolute_error" not in json.loads((out / "started.json").read_text())


def test_fit_from_the_measured_duty_predicts_from_it(folder, run_command) -> None:
    out = folder / "duty"
    run(run_command, "fit", *records(folder)[:3], "--axis", "servo", "--laws", "MQ", "--duty", "pwm", "--out", str(out))
    fitted = json.loads((out / "fit.json").read_text())["servo"]
    assert max(fitted["fitted"].values()) < 0.02
    code, _, errors = run_command("predict", str(out / "fit.json"), records(folder)[0], "--out", str(out))
    assert code == 2
    assert "add --duty COLUMN" in errors


def test_wrong_options_and_files_are_named(folder, run_command) -> None:
    fit = str(folder / "fit" / "fit.json")
    frame("sine", 100).to_csv(folder / "nameless.csv", index=False)
    cases = {
        "gain of the position loop is unknown": ["predict", fit, str(folder / "nameless.csv")],
        "--gain must be a number > 0 or a column": ["predict", fit, str(folder / "nameless.csv"), "--gain", "fast"],
        "no column 'supply'": ["predict", fit, str(folder / "nameless.csv"), "--supply", "supply", "--gain", "9"],
        "is no JSON file": ["predict", str(folder / "nameless.csv"), str(folder / "nameless.csv"), "--gain", "9"],
        "--pendulum needs MASS,LENGTH": ["fit", *records(folder), "--axis", "servo", "--pendulum", "1"],
        "there is no servo law 'lugre'; the servo laws are: M1": [
            "fit",
            *records(folder),
            "--axis",
            "servo",
            "--laws",
            "lugre",
        ],
        "there is no parameter 'kv'": ["fit", *records(folder), "--axis", "servo", "--prior", "kv=1:2"],
        "--prior needs NAME=MEAN:DEVIATION": ["fit", *records(folder), "--axis", "servo", "--prior", "kt=1"],
        "there is no servo law 'coulomb'; the servo laws are: M1, M2, M3, M4, M5, M6, MQ": [
            *("fit", *records(folder), "--axis", "servo", "--laws", "coulomb"),
        ],
        "--units does not belong to --axis servo": ["fit", *records(folder), "--axis", "servo", "--units", "time=ms"],
        "--free does not belong to --axis servo": ["fit", *records(folder), "--axis", "servo", "--free", "m"],
        "--next does not belong to --axis servo": ["fit", *records(folder), "--axis", "servo", "--next", "next.csv"],
        "--gain does not belong to --axis driven": ["fit", *records(folder), "--gain", "100"],
        "--axis must be driven or servo": ["fit", *records(folder), "--axis", "arm"],
    }
    for message, arguments in cases.items():
        code, _, errors = run_command(*arguments)
        assert code == 2, arguments
        assert message in errors
