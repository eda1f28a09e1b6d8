"""`jaxmodsim export`: the file that it writes, and mistakes in its SPEC."""

import zipfile
from pathlib import Path
from typing import Any

import pytest

from jaxmodsim._core.compat import AVAILABLE

pytestmark = pytest.mark.skipif("jaxprs" not in AVAILABLE, reason="needs the programs that JAX traces")
BELT = """
[scene]
problem = "belt_oscillator"
[export]
q0 = [0.0]
qd0 = [0.1]
inputs = ["friction.belt_velocity"]
platforms = []
t1 = 20.0
"""


def test_it_writes_an_fmu(tmp_path: Path, run_command: Any) -> None:
    (tmp_path / "belt.toml").write_text(BELT)
    code, out, _ = run_command("export", str(tmp_path / "belt.toml"), str(tmp_path / "belt.fmu"))
    assert code == 0
    assert "belt.fmu" in out
    with zipfile.ZipFile(tmp_path / "belt.fmu") as archive:
        text = archive.read("modelDescription.xml").decode()
    assert 'name="friction.belt_velocity"' in text
    assert 'stopTime="20.0"' in text


def test_mistakes_are_one_sentence(tmp_path: Path, run_command: Any) -> None:
    (tmp_path / "belt.toml").write_text(BELT.replace("belt_velocity", "speed"))
    code, _, errors = run_command("export", str(tmp_path / "belt.toml"), str(tmp_path / "belt.fmu"))
    assert code == 2
    assert "no number 'friction.speed'" in errors
    assert not (tmp_path / "belt.fmu").exists()
