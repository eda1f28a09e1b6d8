"""Where energy goes: at every state of every named problem, and along runs."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import (
    AppliedForce,
    Coulomb,
    Friction,
    LuGre,
    Scene,
    Viscous,
    cyclic_coordinates,
    energy_audit,
    problems,
    simulate,
)
from jaxmodsim.mechanics import energies, momentum
from jaxmodsim.scene import State, forward_dynamics, vector_field

from ..helpers.mechanisms import CASES, case

LUGRE = {"sigma0": 750.0, "sigma1": 3.0, "sigma2": 0.1, "Fc": 1.5, "Fs": 1.75, "vs": 0.2}


@jax.jit
def unaccounted(scene: Scene, t: Any, y: State, mode: Any) -> tuple[Any, Any]:
    """Rate of kinetic and potential energy less all powers, and the size of what that is a sum of."""

    def one(t: Any, y: State, mode: Any) -> tuple[Any, Any]:
        rate = vector_field(t, y, scene, mode)

        def energy(t: Any, q: Any, qd: Any) -> Any:
            return sum(energies(scene.lagrangian, t, q, qd, scene.params))

        change = jax.jvp(energy, (t, y.q, y.qd), (jnp.ones_like(t), rate.q, rate.qd))[1]
        powers = forward_dynamics(t, y, scene, mode).power.values()
        supplied, absorbed = [x.supplied for x in powers], [x.absorbed for x in powers if x.absorbed is not None]
        size = sum(jnp.abs(each) for each in (*supplied, *absorbed))
        parts = jax.jvp(lambda qd: energies(scene.lagrangian, t, y.q, qd, scene.params), (y.qd,), (rate.qd,))[1]
        return change - sum(supplied) + sum(absorbed), size + jnp.abs(parts[0])

    return jax.vmap(one)(t, y, mode)


def assert_accounted(scene: Scene, q: Any, qd: Any, z: Any, mode: Any, t: float = 0.7) -> None:
    times = jnp.full(q.shape[0], t)
    rest, size = unaccounted(scene, times, State(q, qd, z), mode)
    assert np.all(np.isfinite(rest))
    np.testing.assert_array_less(np.abs(rest), 1e-11 * (1e-3 + np.asarray(size)))


@pytest.mark.parametrize("name", CASES)
def test_power_of_every_named_mechanism(name: str) -> None:
    """The energy changes by what effects bring in and take, at random admissible states, to rounding."""
    one = case(name)
    assert_accounted(one.scene, one.q, one.qd, {}, one.mode, t=0.0)


def random_states(dof: int, count: int = 20) -> tuple[Any, Any]:
    random = np.random.default_rng(3)
    return jnp.asarray(random.uniform(0.3, 2.5, (count, dof))), jnp.asarray(random.uniform(-2.0, 2.0, (count, dof)))


OTHERS: dict[str, tuple[Any, int, Any]] = {
    "spherical pendulum": (problems.spherical_pendulum.scene, 2, None),
    "double pendulum": (problems.n_link_pendulum.double_pendulum, 2, None),
    "three links": (lambda: problems.n_link_pendulum.scene(3, m=jnp.array([1.0, 0.5, 2.0])), 3, None),
    "box": (lambda: problems.ramped_box.scene(problems.ramped_box.coulomb()), 1, [1.0]),
    "box with LuGre": (lambda: problems.ramped_box.scene(LuGre(**LUGRE)), 1, None),
    "braked spring": (problems.braked_spring.scene, 1, [1.0]),
    "belt oscillator": (problems.belt_oscillator.scene, 1, [-1.0]),
    "coupled belts": (problems.coupled_belts.scene, 2, [0.0, 1.0]),
    "stick-slip pendulum": (problems.stick_slip_pendulum.scene, 1, [1.0]),
}


@pytest.mark.parametrize("name", OTHERS)
def test_power_of_the_other_named_problems(name: str) -> None:
    build, dof, modes = OTHERS[name]
    scene = build()
    q, qd = random_states(dof)
    z = {key: jnp.full(q.shape[0], 1e-3) for key in scene.initial_state(q[0])}
    mode = None if modes is None else jnp.broadcast_to(jnp.asarray(modes), (q.shape[0], len(modes)))
    assert_accounted(scene, q, qd, z, mode)


def test_a_wrong_power_has_a_closing_error() -> None:
    """The balance above is no identity: with the force scaled behind its back it is off."""

    class Forgetful(AppliedForce):
        def power(self, t: Any, q: Any, qd: Any, params: Any, action: Any) -> Any:
            power = super().power(t, q, qd, params, action)
            return power._replace(supplied=0.9 * power.supplied)

    scene = Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, effects=(Forgetful(lambda t, q, qd, p: jnp.ones(1)),))
    q, qd = random_states(1)
    with pytest.raises(AssertionError):
        assert_accounted(scene, q, qd, {}, None)


def test_audit_of_a_run_with_events() -> None:
    """Belt oscillator from sticking: what the belt brings in is lost in slip, effect by effect."""
    run = simulate(
        problems.belt_oscillator.scene(), [0.05], [0.1], 2.0, ts=jnp.linspace(0.0, 2.0, 401), rtol=1e-9, atol=1e-12
    )
    audit = energy_audit(run)
    np.testing.assert_allclose(audit.closing_error, 0.0, atol=1e-7)
    np.testing.assert_allclose(audit.closing_error, run.energy.balance, atol=1e-11)
    # All that comes in comes from the belt: force times its velocity, by trapezoids across the jumps of the force.
    work = -np.trapezoid(run.forces["friction"] * problems.belt_oscillator.PARAMS["belt"], run.t)
    np.testing.assert_allclose(audit.work["friction"][-1], work, rtol=5e-3)
    assert float(audit.dissipated["friction"][-1]) > 0.1
    assert np.all(np.diff(audit.dissipated["friction"]) >= -1e-9)
    text = str(audit)
    for line in ("kinetic energy", "work of friction", "dissipated in friction", "lost at events", "closing error"):
        assert line in text


def test_each_effect_has_its_own_account() -> None:
    """Two blocks that are glued together share what brakes one of them; nothing is lost where nothing jumps."""
    glue = Friction(Coulomb(10.0), along=lambda q: q[0] - q[1], name="glue")
    brake = Friction(Viscous(0.3), along=lambda q: q[0])
    scene = Scene(lambda t, q, qd, p: 0.5 * jnp.sum(qd**2), effects=(glue, brake))
    audit = energy_audit(simulate(scene, [0.0, 0.0], [1.0, 1.0], 0.5, ts=jnp.array([0.0, 0.5])))
    assert set(audit.dissipated) == {"glue", "friction"}
    np.testing.assert_allclose(audit.dissipated["friction"][-1], 1.0 - np.exp(-0.3 * 0.5), rtol=1e-5)
    np.testing.assert_allclose(audit.dissipated["glue"], 0.0, atol=1e-12)
    np.testing.assert_allclose(audit.event_losses, 0.0, atol=1e-12)
    np.testing.assert_allclose(audit.closing_error, 0.0, atol=1e-6)


def test_bristles_store_the_energy_that_they_have_not_dissipated() -> None:
    scene = Scene(
        lambda t, q, qd, p: 0.5 * qd[0] ** 2,
        effects=(AppliedForce(lambda t, q, qd, p: jnp.stack([1.0 * t]), name="pull"), Friction(LuGre(**LUGRE))),
    )
    audit = energy_audit(simulate(scene, [0.0], [0.0], 1.0, rtol=1e-9, atol=1e-12))
    z = 1.0 / LUGRE["sigma0"]
    np.testing.assert_allclose(audit.stored["friction"][-1], 0.5 * LUGRE["sigma0"] * z**2, rtol=0.05)
    np.testing.assert_allclose(audit.closing_error, 0.0, atol=1e-7)


def test_cyclic_coordinates() -> None:
    assert cyclic_coordinates(problems.spherical_pendulum.scene(), 2) == (1,)
    assert cyclic_coordinates(problems.cart_pole.scene(), 2) == (0,)
    assert cyclic_coordinates(problems.n_link_pendulum.double_pendulum(), 2) == ()
    assert cyclic_coordinates(Scene(lambda t, q, qd, p: 0.5 * jnp.sum(qd**2)), 3) == (0, 1, 2)
    with pytest.raises(ValueError, match=r"cannot run inside jax\.jit"):
        jax.jit(lambda scene: jnp.asarray(cyclic_coordinates(scene, 2)))(problems.spherical_pendulum.scene())


def test_the_momentum_of_a_cyclic_coordinate_is_constant() -> None:
    scene = problems.spherical_pendulum.scene()
    run = simulate(scene, [2.0, 0.0], [0.3, 1.1], 10.0, ts=jnp.linspace(0.0, 10.0, 11), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(run.momentum[:, 1], np.sin(2.0) ** 2 * 1.1, rtol=1e-9)
    p = momentum(scene.lagrangian, jnp.array(0.0), run.q[3], run.qd[3], scene.params)
    np.testing.assert_allclose(run.momentum[3], p, rtol=1e-13)
