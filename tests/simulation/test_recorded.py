"""What a run records beside the motion: its first events, and on request all of them and the work."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.problems import belt_oscillator, bouncing_ball
from jaxmodsim.simulation._solve import compiled_runs

T1, TS = 4.0, np.linspace(0.0, 4.0, 9)
BELT = [belt_oscillator.PARAMS["belt"]]  # the mass rides on it


@pytest.fixture(scope="module")
def scene() -> jms.Scene:
    return belt_oscillator.scene()


@pytest.fixture(scope="module")
def run(scene: jms.Scene) -> jms.Trajectory:
    return jms.simulate(scene, [0.0], BELT, T1, ts=TS)


def changes(t1: float) -> np.ndarray:
    """Times at which the belt oscillator slips and sticks, from its closed form."""
    cycle = belt_oscillator.cycle(**belt_oscillator.PARAMS)
    first = float(cycle.begins) / BELT[0]
    slips = first + np.arange(100) * float(cycle.period)
    t = np.sort(np.concatenate([slips, slips + float(cycle.slip)]))
    return t[t < t1]


def test_the_first_events_take_no_other_run(run: jms.Trajectory):
    compiled = compiled_runs()
    found = np.asarray(run.events.t)
    assert compiled_runs() == compiled
    want = changes(T1)
    assert 2 <= want.size <= 16
    np.testing.assert_allclose(found, want, rtol=1e-6)


def test_more_events_take_another_run(scene: jms.Scene):
    run = jms.simulate(scene, [0.0], BELT, 30.0)
    want = changes(30.0)
    assert want.size > 16
    compiled = compiled_runs()
    found = np.asarray(run.events.t)
    assert compiled_runs() == compiled + 1
    np.testing.assert_allclose(found, want, rtol=1e-6)
    recorded = jms.simulate(scene, [0.0], BELT, 30.0, record=("events",), max_events=64)
    np.testing.assert_allclose(recorded.events.t, want, rtol=1e-6)


@pytest.mark.parametrize("record", [("energy",), ("events", "energy")])
def test_recorded_energies_take_no_other_run(scene: jms.Scene, run: jms.Trajectory, record: tuple[str, ...]):
    recorded = jms.simulate(scene, [0.0], BELT, T1, ts=TS, record=record)
    compiled = compiled_runs()
    found = recorded.energy
    assert compiled_runs() == compiled
    np.testing.assert_allclose(found.balance, 0.0, atol=1e-6)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(run.energy), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(recorded.q, run.q, rtol=1e-6)  # to the tolerance: its steps are others


def test_energy_with_impacts_takes_one_other_run():
    ball = bouncing_ball.scene(e=0.5)
    ts = np.array([0.2, 0.6])
    # Falling from 1 m it strikes once before 0.6 s and loses 1 - e^2 of its energy.
    lost = [0.0, 0.75 * 9.81]
    run = jms.simulate(ball, [1.0], [0.0], 0.6, ts=ts)
    compiled = compiled_runs()
    np.testing.assert_allclose(run.energy.dissipated, lost, atol=1e-6)
    assert compiled_runs() == compiled + 1
    recorded = jms.simulate(ball, [1.0], [0.0], 0.6, ts=ts, record=("energy",), max_events=8)
    compiled = compiled_runs()
    np.testing.assert_allclose(recorded.energy.dissipated, lost, atol=1e-6)
    assert compiled_runs() == compiled


def test_recorded_inside_jit_vmap_and_grad():
    def second(belt: jax.Array, **record: Any) -> jax.Array:
        scene = belt_oscillator.scene(belt=belt)
        return jms.simulate(scene, [0.0], belt[None], T1, max_events=16, throw=False, **record).events.t[1]

    def closed(belt: jax.Array) -> jax.Array:
        cycle = belt_oscillator.cycle(**belt_oscillator.PARAMS | {"belt": belt})
        return cycle.begins / belt + cycle.slip

    belts = jnp.array([0.09, 0.1, 0.11])
    both = jax.jit(jax.vmap(jax.value_and_grad(lambda belt: second(belt, record=("events",)))))
    for found, want in zip(both(belts), jax.vmap(jax.value_and_grad(closed))(belts), strict=True):
        np.testing.assert_allclose(found, want, rtol=1e-5)


def test_a_run_that_records_nothing_pays_for_nothing(scene: jms.Scene):
    def end(q0: jax.Array, **record: Any) -> jax.Array:
        return jms.simulate(scene, q0, BELT, T1, throw=False, **record).q

    def shapes(**record: Any) -> str:
        return str(jax.make_jaxpr(lambda q0: end(q0, **record))(jnp.zeros(1)))

    assert "f64[13,1]" not in shapes(max_events=13)
    assert "f64[13,1]" in shapes(max_events=13, record=("events",))


@pytest.mark.parametrize(
    ("record", "words"),
    [(("event",), r"Did you mean 'events'\?"), (("forces",), "events, energy")],
)
def test_records_that_there_are_not(scene: jms.Scene, record: Any, words: str):
    with pytest.raises(ValueError, match=words):
        jms.simulate(scene, [0.0], BELT, T1, record=record)
