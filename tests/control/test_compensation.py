"""Friction compensation in the loop, and the passivity of the observer."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.control import check_observer, compensate_friction
from jaxmodsim.scene import State, compensating_force, replace_elements, scene_step

# A geared shoulder: friction falls from 2.8 N m by about 7 N m s/rad, as published for such a joint.
LAW = jms.LuGre(sigma0=2000.0, sigma1=60.0, sigma2=0.5, Fc=0.7, Fs=2.8, vs=0.2)
INERTIA, KP, KD, KI, H = 0.4, 300.0, 15.0, 200.0, 1e-3


def energy(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t
    return 0.5 * p["J"] * qd[0] ** 2 + p["mgl"] * jnp.cos(q[0])


def motor(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return jnp.reshape(p["u"], (1,))


JOINT = jms.Scene(energy, {"J": INERTIA, "mgl": 9.0, "u": 0.0}, (jms.AppliedForce(motor), jms.Friction(LAW)))


@jax.jit
def tracked(plan: Any, speed: Any, gain: Any, share: Any, observes: Any) -> Any:
    """Angles under a PID controller with gravity compensation, and the force of the compensation."""

    def cycle(carry: Any, each: Any) -> Any:
        y, z, integral = carry
        angle, velocity = each
        error = y.q - angle
        planned = State(jnp.where(observes, y.q, angle[None]), jnp.where(observes, y.qd, velocity[None]), z)
        zero = jnp.zeros(())
        force, z = compensate_friction(
            JOINT, zero, zero + H, planned, error=error, gain=jnp.where(observes, gain, 0.0), share=share
        )
        integral = integral + H * error[0]
        u = 9.0 * jnp.sin(y.q[0]) - KP * error[0] - KD * (y.qd[0] - velocity) - KI * integral + force[0]
        y, _ = scene_step(replace_elements(JOINT, {"u": u}), zero, zero + H, y)
        return (y, z, integral), (y.q[0], y.qd[0], force[0])

    z = JOINT.initial_state(jnp.zeros(1))
    start = State(plan[:1], jnp.zeros(1), z)
    return jax.lax.scan(cycle, (start, z, jnp.zeros(())), (plan, speed))[1]


def slow_move() -> tuple[Any, Any]:
    t = jnp.arange(0.0, 6.0, H)
    return 0.5 + 0.02 * t, jnp.full_like(t, 0.02)


def worst(found: Any, plan: Any) -> float:
    return float(np.abs(found[0] - plan)[2000:].max())


def test_compensation_removes_most_of_the_error_of_a_slow_move():
    plan, speed = slow_move()
    without = worst(tracked(plan, speed, 0.0, 0.0, False), plan)
    feedforward = worst(tracked(plan, speed, 0.0, 1.0, False), plan)
    observer = worst(tracked(plan, speed, 20.0, 1.0, True), plan)
    assert feedforward < without / 3
    assert observer < without / 3
    assert without > 1e-4


def test_the_force_never_exceeds_break_away():
    """The observer ramps up in stick against an error that stays, and stops at the limit of the bristle."""
    y, h = State(jnp.zeros(1), jnp.zeros(1), JOINT.initial_state(jnp.zeros(1))), jnp.array(H)
    forces = []
    for _ in range(200):
        force, z = compensate_friction(JOINT, jnp.zeros(()), h, y, error=jnp.array([-0.01]), gain=5.0)
        y = y._replace(z=z)
        forces.append(float(force[0]))
    ramp = float(LAW.sigma0) * 5.0 * 0.01 * H
    np.testing.assert_allclose(np.diff(forces)[:20], ramp, rtol=1e-9)
    np.testing.assert_allclose(forces[-1], float(LAW.Fs), rtol=1e-12)


def test_over_compensation_is_named():
    assert "Over-compensation" in check_observer(LAW, INERTIA, KP, KD, KI, level=1.2).condition
    assert check_observer(LAW, INERTIA, KP, KD, KI).ok
    assert not check_observer(LAW, INERTIA, KP, KD, KI, level=1.2).ok


def test_passivity_is_that_of_the_frequency_response():
    """Sign of Re G(jw) over frequency, and stable poles, for random gains on either side of the conditions."""
    rng, w = np.random.default_rng(0), np.geomspace(1e-4, 1e6, 4000)
    seen = set()
    for _ in range(200):
        m, kp, kd, ki = np.exp(rng.normal(size=4) * 1.5 + np.log([0.4, 300.0, 12.0, 2000.0]))
        s = 1j * w
        response = (60.0 * s + 2000.0) * s / (m * s**3 + kd * s**2 + kp * s + ki)
        stable = (np.roots([m, kd, kp, ki]).real < 0).all()
        expected = bool(stable and (response.real > 0).all())
        assert check_observer(LAW, m, kp, kd, ki).ok == expected
        seen.add(expected)
    assert seen == {True, False}


@pytest.mark.parametrize("gains", [(0.4, 2.0, 25.0, 4000.0), (0.4, 0.0, 50.0, 0.0)], ids=["integral", "no stiffness"])
def test_no_margin_is_left_where_damping_cannot_help(gains):
    m, kp, _, ki = gains
    assert not any(check_observer(LAW, m, kp, kd, ki).ok for kd in np.geomspace(1e-3, 1e9, 25))
    assert check_observer(LAW, *gains).margin == -np.inf


def test_the_feedforward_is_that_in_c():
    y = State(jnp.array([0.1]), jnp.array([0.03]), {"friction": jnp.array(1e-4)})
    ours = compensate_friction(JOINT, jnp.zeros(()), jnp.array(H), y)
    for a, b in zip(
        jax.tree.leaves(ours),
        jax.tree.leaves(compensating_force(JOINT, jnp.zeros(()), jnp.array(H), y)),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


def test_an_observer_needs_lugre():
    scene = jms.Scene(energy, {"J": 1.0, "mgl": 1.0}, (jms.Friction(jms.Dahl(1e3, 1.0)),))
    y = State(jnp.zeros(1), jnp.zeros(1), scene.initial_state(jnp.zeros(1)))
    with pytest.raises(ValueError, match="needs LuGre"):
        compensate_friction(scene, jnp.zeros(()), jnp.array(H), y, error=jnp.zeros(1))
