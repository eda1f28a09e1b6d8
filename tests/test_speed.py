"""The one switch for speed."""

import logging
import subprocess
import sys

import jax.numpy as jnp
import pytest

from jaxmodsim import tune_cpu
from jaxmodsim._core.speed import recommend_tuning, warn_about_compilation


def test_too_late(monkeypatch: pytest.MonkeyPatch) -> None:
    jnp.zeros(1).block_until_ready()
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    with pytest.raises(RuntimeError, match="has no effect, because JAX has already started its backend"):
        tune_cpu()


@pytest.mark.parametrize("threshold", [0, -5, True, 1e5])
def test_wrong_thresholds_are_refused(threshold: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)  # as users have it
    with pytest.raises(ValueError, match=f"must be a positive integer, but {threshold!r} was given"):
        tune_cpu(threshold)  # pyright: ignore[reportArgumentType]


SCRIPT = """
import os
os.environ["XLA_FLAGS"] = "--xla_cpu_enable_fast_math=false"
import jaxmodsim
jaxmodsim.tune_cpu(50_000)
first = os.environ["XLA_FLAGS"]
jaxmodsim.tune_cpu()
assert os.environ["XLA_FLAGS"] == first, "set twice"
assert first.startswith("--xla_cpu_enable_fast_math=false ")
assert first.endswith("xla_cpu_small_while_loop_byte_threshold=50000")
import jax.numpy as jnp
assert float(jnp.ones(3).sum()) == 3.0, "XLA does not take the flag"
jaxmodsim.tune_cpu()
assert os.environ["XLA_FLAGS"] == first
"""


def test_in_time() -> None:
    """In a process of its own, as the option holds for the whole process; importing the package computes nothing."""
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("flags", "said"), [("", True), ("--xla_cpu_small_while_loop_byte_threshold=50000", False)])
def test_runs_without_it_say_so_once(
    flags: str, said: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("XLA_FLAGS", flags)
    monkeypatch.setattr("jax.default_backend", lambda: "cpu")
    caplog.set_level(logging.WARNING, "jaxmodsim")
    recommend_tuning.cache_clear()
    recommend_tuning()
    recommend_tuning()
    assert [record.name for record in caplog.records] == ["jaxmodsim"] * said
    assert not said or "jaxmodsim.tune_cpu()" in caplog.text


def test_what_a_loop_makes_is_told_from_what_shares_a_line(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "jaxmodsim")
    warn_about_compilation(0.0, (lambda: 1, lambda: 2, lambda: 3, lambda: 4))
    assert not caplog.records
    made = [lambda: 1 for _ in range(4)]
    for each in made:
        warn_about_compilation(0.0, (each,))
    assert len(caplog.records) == 1
    assert "test_speed.py:" in caplog.text
    assert "compiled for the third time" in caplog.text
