"""Private interfaces of other libraries: each can be missing."""

import importlib.util
import json
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim._core import compat
from jaxmodsim._core.arrays import opaque_one
from jaxmodsim._core.scalarise import columns_of, in_scalars
from jaxmodsim._core.trace_checks import check_indices, traced
from jaxmodsim.export._program import program_of
from jaxmodsim.solvers._error_checks import calls_back, without_error_checks

ROOT = Path(__file__).parents[2]
GROUPS = {"backends", "jaxprs", "kernels", "last_line", "programs", "stored_steps", "trace_state"}


def imported_again() -> ModuleType:
    """The module, with probes of its own."""
    assert compat.__file__
    spec = importlib.util.spec_from_file_location("jaxmodsim._core.compat_again", compat.__file__)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("off", [(), ("kernels",), ("programs", "trace_state"), ("all",)], ids=" ".join)
def test_probes_are_switched_off_by_name(
    off: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("JAXMODSIM_PROBES_OFF", ",".join(off))
    caplog.set_level(logging.WARNING, "jaxmodsim")
    again, missing = imported_again(), GROUPS if off == ("all",) else set(off)
    assert GROUPS - missing == again.AVAILABLE
    assert len(caplog.records) == bool(missing)
    assert [name for name in GROUPS if f"{name} (switched off)" in caplog.text] == [x for x in GROUPS if x in missing]


def test_a_missing_name_turns_off_its_group(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.delenv("JAXMODSIM_PROBES_OFF", raising=False)
    monkeypatch.delattr("equinox.internal.create_vprim")
    monkeypatch.delattr("jax.extend.core.get_opaque_trace_state")
    monkeypatch.setattr("jaxlib.version.__version_info__", (0, 13, 0))
    caplog.set_level(logging.WARNING, "jaxmodsim")
    again = imported_again()
    assert GROUPS - {"kernels", "stored_steps", "trace_state"} == again.AVAILABLE
    assert "equinox.internal has no create_vprim" in caplog.text
    assert again.eqxi is object
    assert again.Primitive is compat.Primitive, "another group has it"
    assert again.get_opaque_trace_state() != again.get_opaque_trace_state()


@pytest.fixture
def none_available() -> Iterator[Callable[[], None]]:
    """A function after whose call no group is available."""
    present = set(compat.AVAILABLE)
    yield compat.AVAILABLE.clear
    compat.AVAILABLE.update(present)


def test_functions_stay_whole(none_available: Callable[[], None]) -> None:
    none_available()

    def rotated(x: Any) -> Any:
        return jnp.stack([jnp.sin(x[0]) * x[1], x[0]])

    x, program = jnp.array([0.3, 2.0]), str(jax.make_jaxpr(rotated)(jnp.ones(2)))
    assert str(jax.make_jaxpr(lambda x: in_scalars(rotated, x, seed=x))(jnp.ones(2))) == program
    assert str(jax.make_jaxpr(lambda x: without_error_checks(rotated, x))(jnp.ones(2))) == program
    columns: Any = columns_of(lambda a, b: [2.0 * a, 3.0 * b - a], opaque_one(x[0]), *x)
    assert [list(map(float, column)) for column in columns] == [[2.0, -1.0], [0.0, 3.0]]
    beyond = lambda q: q[5]  # noqa: E731
    assert traced(beyond, name="the function", q=x) == jax.ShapeDtypeStruct((), x.dtype)
    check_indices(beyond, x, name="the function")
    with pytest.raises(RuntimeError, match=r"to_c reads .*Install jax>="):
        program_of(jax.make_jaxpr(rotated)(x), [])


def test_checks_stay_where_they_cannot_be_left_out(none_available: Callable[[], None]) -> None:
    none_available()
    checked = lambda x: eqx.error_if(x, x < 0.0, "negative")  # noqa: E731
    assert calls_back(jax.make_jaxpr(lambda x: without_error_checks(checked, x))(1.0).jaxpr)


def test_stored_steps_fall_back_on_an_adjoint_of_diffrax(
    none_available: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[dict[str, Any]] = []
    loop = dfx.DirectAdjoint.loop
    monkeypatch.setattr(dfx.DirectAdjoint, "loop", lambda self, **given: used.append(given) or loop(self, **given))

    def end(rate: Any) -> Any:
        term = dfx.ODETerm(lambda t, y, rate: -rate * y)
        solved = dfx.diffeqsolve(term, dfx.Heun(), 0.0, 1.0, 0.1, 1.0, rate, adjoint=jms.StoredSteps(), max_steps=16)
        assert solved.ys is not None
        return solved.ys[0]

    own = [float(mode(end)(2.0)) for mode in (jax.grad, jax.jacfwd)]
    assert not used
    none_available()
    np.testing.assert_allclose([mode(end)(2.0) for mode in (jax.grad, jax.jacfwd)], own, rtol=1e-14)
    assert len(used) == 2


SCRIPT = """
import json
import jax
jax.config.update("jax_enable_x64", True)
import jaxmodsim as jms
from jaxmodsim._core.compat import AVAILABLE
from jaxmodsim.simulation._solve import compiled_runs
from tests.core.test_compat import swung
assert not AVAILABLE
print(json.dumps([float(x) for x in jax.jvp(swung, (1.3,), (1.0,))]))
assert "xla_cpu_small_call" not in jax.jit(swung).lower(1.3).as_text()
assert compiled_runs() == 0
jms.tune_cpu()  # too late, in silence
"""


def swung(m: Any) -> Any:
    """Where a pendulum of mass m is after one second."""
    pendulum = jms.Scene(lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2 + jnp.cos(q[0]), params={"m": m})
    return jms.simulate(pendulum, [1.0], [0.0], 1.0, rtol=1e-9, max_steps=256, throw=False).q[-1, 0]


def test_runs_are_the_same_without_any_group() -> None:
    """In a process of its own, as probes are read at import."""
    environment = os.environ | {"JAXMODSIM_PROBES_OFF": "all", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False, env=environment, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("Private interfaces") == 1
    place, change = jax.jvp(swung, (1.3,), (1.0,))
    np.testing.assert_allclose(json.loads(done.stdout), [place, change], rtol=1e-7)
