"""Compiled runs call nothing in Python, so that JAX keeps them from one process to the next."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim import problems
from jaxmodsim.solvers import without_error_checks
from jaxmodsim.solvers._error_checks import calls_back

TIMES = np.linspace(0.0, 1.0, 5)


def driven_mass() -> jms.Scene:
    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, q
        return 0.5 * p["m"] * qd[0] ** 2

    push = jms.AppliedForce(lambda t, q, qd, p: jnp.reshape(p["u"], (1,)), name="push")
    return jms.Scene(lagrangian, {"m": 1.0, "u": jms.Signal(TIMES, np.sin(TIMES))}, [push])


RUNS: dict[str, tuple[jms.Scene, list[float], dict[str, Any]]] = {
    "plain": (problems.braked_spring.scene(jms.Viscous(0.1)), [0.1], {}),
    "stiff": (problems.ramped_box.scene(problems.ramped_box.lugre()), [0.0], {}),
    "events": (problems.belt_oscillator.scene(), [0.0], {}),
    "constraints": (problems.cartesian_pendulum.scene(m=0.7, l=1.9, g=9.7), [1.9, 0.0], {}),
    "signals": (driven_mass(), [0.0], {}),
    "fixed steps": (problems.braked_spring.scene(jms.Viscous(0.1)), [0.1], {"dt": 0.01}),
    "implicit friction": (
        problems.ramped_box.scene(problems.ramped_box.lugre()),
        [0.0],
        {"dt": 0.01, "solver": jms.ImplicitFriction()},
    ),
}


# Derivatives and batches are made of the traced run, whatever is in it.
TRANSFORMED = [("events", "batch"), ("events", "forward"), ("events", "reverse"), ("stiff", "reverse")]


@pytest.mark.parametrize(("name", "transform"), [*((name, "run") for name in RUNS), *TRANSFORMED])
def test_compiled_runs_call_nothing_in_python(name: str, transform: str) -> None:
    scene, q0, arguments = RUNS[name]
    adjoint = dfx.ForwardMode() if transform == "forward" else None

    def end(q0: Any) -> Any:
        run = jms.simulate(scene, q0, jnp.zeros_like(q0), 1.0, ts=TIMES, adjoint=adjoint, throw=False, **arguments)
        return run.q[-1, 0]

    transformed: dict[str, Any] = {
        "run": end,
        "batch": lambda q0: jax.vmap(end)(jnp.stack([q0, q0])),
        "reverse": jax.grad(end),
        "forward": jax.jacfwd(end),
    }
    assert not calls_back(jax.make_jaxpr(transformed[transform])(jnp.asarray(q0)).jaxpr)


_SCRIPT = """
import collections, json, os, sys
import jax, jax.monitoring
import jax.numpy as jnp

folder = sys.argv[1]
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", folder)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
counts = collections.Counter()
jax.monitoring.register_event_listener(lambda event, **_: counts.update([event.rsplit("/", 1)[-1]]))

import jaxmodsim as jms
from jaxmodsim import problems

scene = problems.belt_oscillator.scene()
run = jms.simulate(scene, [0.0], [0.0], 1.5, ts=jnp.linspace(0.0, 1.5, 4))
end = lambda q0: jms.simulate(scene, q0, [0.0], 1.5).q[-1, 0]
slope = jax.grad(end)(jnp.zeros(1))
kept = sum(name.startswith("jit_solve") and name.endswith("-cache") for name in os.listdir(folder))
found = {name: counts[name] for name in ("cache_hits", "cache_misses")}
print(json.dumps({**found, "kept": kept, "events": int(run.stats["num_events"]), "q": float(run.q[-1, 0]),
                  "slope": float(slope[0])}))
"""


def test_the_next_process_compiles_nothing(tmp_path: Path) -> None:
    """Of a run with events and its gradient, the second process takes every program from the first."""
    environment = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}

    def process() -> dict[str, Any]:
        command = [sys.executable, "-c", _SCRIPT, str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
        return json.loads(done.stdout.splitlines()[-1])

    assert not [*tmp_path.iterdir()], "the first process finds nothing"
    first, second = process(), process()
    assert first["events"] > 0
    assert first["kept"] >= 2, "the run, and its gradient"
    assert second["cache_misses"] == 0
    # Small programs of one process may be equal: the first one hits what it has just written.
    assert second["cache_hits"] == first["cache_misses"] + first["cache_hits"]
    assert {name: second[name] for name in ("q", "slope", "kept")} == {
        name: first[name] for name in ("q", "slope", "kept")
    }


SPRING = problems.braked_spring.scene(jms.Viscous(0.1))

# What makes a run, and what is not known before the run and makes none.
POSED: dict[str, Any] = {"t1": 1.0, "ts": [0.1, 0.5, 0.9], "dtmax": 1.0, "rtol": 1e-6, "atol": 1e-9}
STEPS: dict[str, Any] = {"t1": 1.0, "dt": 0.25}
ILL_POSED: dict[str, dict[str, Any]] = {
    "backward": POSED | {"t1": -1.0},
    "endless": POSED | {"t1": np.inf},
    "not a time": POSED | {"t1": np.nan},
    "unsorted": POSED | {"ts": [0.0, 0.7, 0.3]},
    "before": POSED | {"ts": [-0.1, 0.5, 0.9]},
    "behind": POSED | {"ts": [0.1, 0.5, 1.1]},
    "missing": POSED | {"ts": [0.1, np.nan, 0.5]},
    "step backward": STEPS | {"dt": -0.01},
    "no step": STEPS | {"dt": 0.0},
    "no longest step": POSED | {"dtmax": 0.0},
    "no tolerance": POSED | {"rtol": 0.0, "atol": 0.0},
    "negative tolerance": POSED | {"atol": -1e-9},
}


@eqx.filter_jit
def run_spring(given: dict[str, Any], throw: bool) -> Any:
    run = jms.simulate(SPRING, [0.1], [0.0], **given, throw=throw)
    return run.result, run.t_end


@pytest.mark.parametrize("given", ILL_POSED.values(), ids=ILL_POSED)
def test_traced_times_and_tolerances_that_make_no_run(given: dict[str, Any]) -> None:
    """diffrax's checks of them are not in the compiled run: it ends by a code of its own, at t0."""
    result, t_end = run_spring({name: jnp.asarray(x, float) for name, x in given.items()}, False)
    assert "The times or tolerances do not make a run" in str(result)
    assert float(t_end) == 0.0
    with pytest.raises(eqx.EquinoxRuntimeError, match="t1 must not be before t0, ts must increase"):
        run_spring({name: jnp.asarray(x, float) for name, x in given.items()}, True)


@pytest.mark.parametrize("given", [POSED, STEPS], ids=["tolerances", "steps"])
def test_traced_times_and_tolerances_that_make_a_run(given: dict[str, Any]) -> None:
    result, t_end = run_spring({name: jnp.asarray(x, float) for name, x in given.items()}, False)
    assert result.ok
    assert float(t_end) == 1.0


def test_one_run_of_a_batch_that_is_none_leaves_the_others() -> None:
    def end(t1: Any) -> Any:
        run = jms.simulate(SPRING, [0.1], [0.0], t1, throw=False)
        return run.q[-1, 0], run.result.ok

    positions, ok = jax.vmap(end)(jnp.asarray([0.5, -0.5, 1.0]))
    np.testing.assert_array_equal(ok, [True, False, True])
    np.testing.assert_allclose(positions[2], end(1.0)[0], rtol=1e-12)


def test_checks_of_a_scenes_own_functions_stay() -> None:
    def force(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, qd, p
        return eqx.error_if(-q, q < 0.05, "the rope is slack")

    scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, {}, [jms.AppliedForce(force)])

    def end(q0: Any) -> Any:
        return jms.simulate(scene, q0, jnp.zeros(1), 1.0, ts=TIMES, throw=False).q[-1, 0]

    assert calls_back(jax.make_jaxpr(end)(jnp.ones(1)).jaxpr)
    assert np.isfinite(eqx.filter_jit(end)(jnp.ones(1)))
    with pytest.raises(Exception, match="the rope is slack"):
        eqx.filter_jit(end)(jnp.full(1, 0.01))


def test_checks_of_arguments_alone_are_left_out() -> None:
    def checked(x: Any, y: Any) -> Any:
        x = eqx.error_if(2.0 * jnp.array(x), x < 0, "x is negative")
        return jnp.sum(x**2) * eqx.error_if(y + 1.0, y < 0, "y is negative")

    call = eqx.filter_jit(lambda x, y: without_error_checks(lambda x: checked(x, y), x))
    x, y = jnp.asarray([-1.0, 2.0]), jnp.asarray(0.5)
    np.testing.assert_allclose(call(x, y), 30.0)
    np.testing.assert_allclose(jax.jit(jax.grad(call))(x, y), [-12.0, 24.0])
    np.testing.assert_allclose(jax.jit(jax.hessian(call))(x, y), 12.0 * np.eye(2))
    np.testing.assert_allclose(jax.vmap(call, in_axes=(0, None))(jnp.stack([x, x]), y), [30.0, 30.0])
    with pytest.raises(eqx.EquinoxRuntimeError, match="y is negative"):
        call(x, -y)
    assert without_error_checks(lambda x, y: (x, y), jnp.ones(1), None)[1] is None
