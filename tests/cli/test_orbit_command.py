"""`jaxmodsim orbit` and `jaxmodsim branch`: what they print and write, and mistakes in their SPEC."""

import json

import numpy as np
import pandas as pd
import pytest

from jaxmodsim.problems import belt_oscillator

BELT = """
[scene]
problem = "belt_oscillator"
[orbit]
q0 = [0.0]
qd0 = [0.0]
settle = 20.0
"""
BRANCH = """
[branch]
parameter = "friction.belt_velocity"
from = 0.1
to = 0.15
step = 0.5
"""


HOPF = """
[scene]
problem = "belt_oscillator"
c = 2.0
[scene.law]
kind = "Stribeck"
Fc = 5.0
Fs = 8.0
vs = 0.2
[orbit]
q0 = [0.0]
qd0 = [0.0]
rtol = 1e-8
[branch]
parameter = "friction.belt_velocity"
from = 1.0
to = 0.35
start = "Hopf"
max_orbits = 2
"""


@pytest.fixture
def spec(tmp_path):
    def write(text):
        path = tmp_path / "belt.toml"
        path.write_text(text)
        return str(path)

    return write


def test_an_orbit_is_printed_and_written(spec, tmp_path, run_command):
    code, out, _ = run_command("orbit", spec(BELT), "--out", str(tmp_path / "out"))
    assert code == 0
    assert "PeriodicOrbit, autonomous, period 0.978509 s, stable" in out
    numbers = json.loads((tmp_path / "out" / "orbit.json").read_text())
    np.testing.assert_allclose(numbers["period"], belt_oscillator.cycle(**belt_oscillator.PARAMS).period, rtol=1e-8)
    assert numbers["multipliers"] == [[1.0, 0.0], [0.0, 0.0]]
    assert (tmp_path / "out" / "orbit.png").stat().st_size > 1000


def test_a_branch_is_written_and_gone_on_with(spec, tmp_path, run_command):
    arguments = ("branch", spec(BELT + BRANCH), "--out", str(tmp_path / "out"))
    code, out, errors = run_command(*arguments)
    assert code == 0
    assert "end of the span" in out
    assert "orbits" in errors
    table = pd.read_csv(tmp_path / "out" / "branch.csv")
    cycles = [belt_oscillator.cycle(**{**belt_oscillator.PARAMS, "belt": x}) for x in table["friction.belt_velocity"]]
    np.testing.assert_allclose(table["period [s]"], [each.period for each in cycles], rtol=1e-8)
    assert (tmp_path / "out" / "branch.png").stat().st_size > 1000
    assert run_command(*arguments)[1] == out


def test_a_branch_begins_at_a_hopf_point(spec, tmp_path, run_command):
    code, out, _ = run_command("branch", spec(HOPF), "--out", str(tmp_path / "out"))
    assert code == 0
    assert "Hopf  0.36364298" in out
    values = pd.read_csv(tmp_path / "out" / "branch.csv")["friction.belt_velocity"]
    assert values.between(0.36364298, 0.37).all()
    assert (tmp_path / "out" / "branch.png").stat().st_size > 1000
    code, _, errors = run_command("branch", spec(HOPF.replace("0.35", "0.5")), "--out", str(tmp_path / "none"))
    assert code != 0
    assert "no Hopf point" in errors
    code, _, errors = run_command("branch", spec(HOPF.replace("rtol = 1e-8", "settle = 1.0")))
    assert code == 2
    assert 'with start = "Hopf" omit period, frequency and settle' in errors


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (BELT.replace("settle = 20.0", ""), "needs settle"),
        (BELT.replace("settle = 20.0", 'frequency = "omega"'), "frequency must be the name of an entry of params"),
        (BELT.replace("settle = 20.0", 'frequency = "m"\nperiod = 1.0'), "period and frequency exclude each other"),
        (BELT.replace("q0", "q1", 1), "q0 is missing"),
        (BELT + "[branches]\n", "there is no key 'branches'"),
    ],
)
def test_mistakes_are_one_sentence(spec, run_command, text, sentence):
    code, _, errors = run_command("orbit", spec(text))
    assert code == 2
    assert sentence in errors


def test_a_branch_needs_its_table(spec, run_command):
    code, _, errors = run_command("branch", spec(BELT))
    assert code == 2
    assert "[branch] is missing" in errors
