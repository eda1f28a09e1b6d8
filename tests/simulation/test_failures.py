"""Runs that end early: a code inside compiled code, a sentence outside, and what was computed is kept."""

import subprocess
import sys
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim import problems
from jaxmodsim.scene import replace_elements

from ..helpers.differences import central_difference

BOX = problems.ramped_box.scene(problems.ramped_box.lugre())
TS = jnp.linspace(0.0, 10.0, 11)


def run_box(scene: jms.Scene = BOX, **arguments: Any) -> jms.Trajectory:
    return jms.simulate(scene, [0.0], [0.0], 10.0, ts=TS, **arguments)


def test_step_limit() -> None:
    with pytest.raises(jms.SimulationError, match=r"step limit was reached before t1: pass a larger max_steps.*t = \d"):
        run_box(max_steps=30)
    run, whole = run_box(max_steps=30, throw=False), run_box()
    assert not run.result.ok
    assert "step limit" in str(run.result)
    assert int(run.stats["num_steps"]) == 30
    # What was reached is that of the whole run, and what was not says so.
    reached = np.isfinite(np.asarray(run.t))
    assert 0 < reached.sum() < TS.shape[0]
    assert (np.diff(reached.astype(int)) <= 0).all()
    np.testing.assert_allclose(run.q[reached], whole.q[reached], rtol=1e-10)
    assert np.isinf(np.asarray(run.q)[~reached]).all()


def test_parameter_out_of_range_is_found_where_it_was_not_built() -> None:
    """`tree_at` and traced code go around the constructor's check; the run does not."""
    bad = eqx.tree_at(lambda s: s.effects[1].law.Fc, BOX, jnp.array(-1.0))
    sentence = r"LuGre: Fc must be finite and > 0 \[N\], but -1.0 was given. \(at scene.effects\[1\].law\)"
    with pytest.raises(jms.SimulationError, match=sentence):
        run_box(bad)
    run = run_box(bad, throw=False)
    assert "Fc must be" in str(run.result)
    np.testing.assert_array_equal(run.t, [0.0, *[np.inf] * 10])
    np.testing.assert_array_equal(run.q[0], [0.0])


def test_parameter_out_of_range_inside_jit() -> None:
    def distance(Fc: Any) -> Any:
        scene = problems.ramped_box.scene(problems.ramped_box.lugre(Fc=Fc))
        return jms.simulate(scene, [0.0], [0.0], 10.0).q[-1, 0]

    compiled = eqx.filter_jit(distance)
    assert float(compiled(jnp.array(1.5))) > 40
    with pytest.raises(eqx.EquinoxRuntimeError, match=r"LuGre: Fs must be finite and >= Fc \[N\]"):
        compiled(jnp.array(1.8))


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd, lambda f: jax.vmap(jax.grad(f))])
def test_a_derivative_alone_raises_the_error_of_its_run(derivative: Any) -> None:
    """The program of a derivative that needs no value of the run has the check, too."""

    def end(Fs: Any) -> Any:
        scene = problems.ramped_box.scene(problems.ramped_box.lugre(Fs=Fs))
        return jms.simulate(scene, [0.0], [0.0], 10.0, max_steps=30).q[-1, 0]

    compiled = eqx.filter_jit(derivative(end))
    with pytest.raises(eqx.EquinoxRuntimeError, match="step limit was reached"):
        compiled(jnp.array(1.75) if derivative in (jax.grad, jax.jacfwd) else jnp.array([1.75, 1.8]))


def root(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A force that stops being real once q has passed one."""
    del t
    return 0.5 * p["m"] * qd[0] ** 2 + p["c"] * jnp.sqrt(1.0 - q[0]) ** 3


EARLY = jnp.array([0.2, 0.4, 2.9])
ROOT = jms.Scene(root, params={"m": 1.0, "c": -0.1})


@pytest.mark.parametrize("dt", [None, 0.01])
def test_field_that_stops_being_finite(dt: float | None) -> None:
    """At the last state before; with adaptive steps the run halves its way up to the edge."""
    run = jms.simulate(ROOT, [0.0], [1.0], 3.0, ts=EARLY, dt=dt, throw=False)
    assert np.isfinite(np.asarray(run.q)[:2]).all()
    assert np.isinf(np.asarray(run.t)[2])
    wanted = "not finite" if dt else "step size fell below|not finite"
    with pytest.raises(jms.SimulationError, match=wanted) as info:
        jms.simulate(ROOT, [0.0], [1.0], 3.0, ts=EARLY, dt=dt)
    assert "throw=False returns what was computed" in str(info.value)


def test_field_that_is_not_finite_from_the_start() -> None:
    with pytest.raises(jms.SimulationError, match=r"not finite.*stopped at t = 0 with q = \[2.\]"):
        jms.simulate(ROOT, [2.0], [1.0], 3.0, ts=EARLY)


def test_pendulum_at_the_pole_names_its_coordinate() -> None:
    with pytest.raises(jms.SimulationError, match=r"singular or indefinite at coordinate q\[1\]") as info:
        jms.simulate(problems.spherical_pendulum.scene(), [0.0, 0.0], [0.1, 0.0], 1.0)
    assert "coordinates involved: q[1]" in str(info.value)


def quadratic(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q
    return 0.5 * jnp.sum(qd * (p @ qd))


@pytest.mark.parametrize(
    ("mass", "coordinate", "involved"),
    [
        ([[0.0, 0.0], [0.0, 1.0]], 0, "q[0]"),
        ([[1.0, 0.0], [0.0, -2.0]], 1, "q[1]"),
        ([[1.0, 1.0], [1.0, 1.0]], 1, "q[0], q[1]"),
        ([[1.0, 2.0], [2.0, 1.0]], 1, "q[0], q[1]"),
    ],
)
def test_mass_matrix_without_inverse_names_its_coordinates(mass: Any, coordinate: int, involved: str) -> None:
    scene = jms.Scene(quadratic, params=jnp.array(mass))
    with pytest.raises(jms.SimulationError) as info:
        jms.simulate(scene, [0.0, 0.0], [1.0, 1.0], 1.0)
    assert f"singular or indefinite at coordinate q[{coordinate}]" in str(info.value)
    assert f"coordinates involved: {involved}." in str(info.value)


def test_outcomes_can_be_read_under_jit() -> None:
    codes = jax.jit(lambda s: run_box(s, throw=False).code)(BOX)
    assert int(codes) == 0


def test_a_tolerance_above_the_width_of_a_smoothed_law_is_refused() -> None:
    """At ten widths the velocity after break-away came 1.5 % low, and nothing was said."""
    box = problems.ramped_box.scene(jms.Regularized(jms.Coulomb(1.5), width=1e-7))

    def run(width: Any, **arguments: Any) -> jms.Trajectory:
        scene = replace_elements(box, {"friction.width": width})
        return jms.simulate(scene, [0.0], [0.0], 10.0, throw=False, **arguments)

    assert "Pass atol no larger than the width" in str(run(1e-7, atol=1e-6).result)
    runs = jax.vmap(lambda width: run(width, atol=1e-6))(jnp.array([1e-7, 1e-6, jnp.nan]))
    assert [bool(ok) for ok in runs.result.ok] == [False, True, False]
    assert "atol is above the width" in str(runs.result)
    assert bool(run(1e-7, dt=1e-2).result.ok)


@pytest.mark.parametrize("effects", [(), (jms.Friction(jms.Coulomb(0.5), along=lambda q: q[1]),)])
def test_a_step_that_overflows_is_repeated_with_a_shorter_one(effects: Any) -> None:
    """A step of a falling body ends deep in a wall of `exp(-k q)`, where its force and its error are infinite."""

    def lagrangian(_t: Any, q: Any, qd: Any, p: Any) -> Any:
        return 0.5 * jnp.sum(qd**2) - 9.81 * q[0] - jnp.exp(-p["k"] * q[0])

    def end(k: Any, rtol: float = 1e-9) -> tuple[Any, jms.Trajectory]:
        scene = jms.Scene(lagrangian, {"k": k}, effects)
        run = jms.simulate(scene, [1.0, 0.0], [0.0, 0.4], 1.0, rtol=rtol, max_steps=1000)
        return run.q[-1, 0], run

    (height, run), slope = jax.value_and_grad(end, has_aux=True)(1e4)
    assert float(0.5 * run.qd[-1, 0] ** 2 + 9.81 * height) == pytest.approx(9.81, rel=1e-7)
    assert float(slope) == pytest.approx(central_difference(lambda k: end(k, 1e-11)[0], 1e4, 100.0), rel=1e-3)


def test_energies_of_a_run_that_cannot_be_repeated_with_the_work_beside_it() -> None:
    """The push does nothing to so heavy a mass, but its work swings, and needs more steps than the motion."""
    push = jms.AppliedForce(lambda t, q, qd, p: jnp.sin(50.0 * t)[None], name="push")
    heavy = jms.Scene(lambda t, q, qd, p: 0.5e6 * qd[0] ** 2, effects=(push,))
    steps = int(jms.simulate(heavy, [0.0], [1.0], 1.0).stats["num_steps"])
    run = jms.simulate(heavy, [0.0], [1.0], 1.0, max_steps=steps + 1)
    with pytest.raises(jms.SimulationError, match=r"work integrals beside it, it does not.*step limit"):
        _ = run.energy


ENDS_EARLY = """
import jax, jaxmodsim as jms
jax.config.update("jax_enable_x64", True)
def swing(k):
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * (qd[0] ** 2 - p["k"] * q[0] ** 2), {"k": k})
    return jms.simulate(scene, [1.0], [0.0], 100.0, max_steps=20).q[-1, 0]
"""
IN_A_CELL = """
from IPython.core.interactiveshell import InteractiveShell
InteractiveShell.instance().run_cell({code!r})
"""


@pytest.mark.parametrize("where", ["script", "cell"])
@pytest.mark.parametrize("call", ["jax.jit(swing)(2.0)", "eqx.filter_jit(swing)(2.0)"])
def test_the_last_line_of_an_early_end_inside_jit_names_the_cause(where: str, call: str) -> None:
    code = f"{ENDS_EARLY}\nimport equinox as eqx\n{call}\n"
    code = code if where == "script" else IN_A_CELL.format(code=code)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.rstrip().splitlines()[-1].startswith("The step limit was reached before t1: pass a larger")


def test_an_early_end_inside_jit_that_is_caught_is_not_said_again() -> None:
    code = f"{ENDS_EARLY}\ntry:\n    jax.jit(swing)(2.0)\nexcept Exception:\n    raise ValueError('mine') from None\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.rstrip().splitlines()[-1] == "ValueError: mine"
