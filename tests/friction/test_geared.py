"""Friction that grows with a transmitted torque: efficiencies, self-locking, and its execution by a bristle."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim import Bristle, Coulomb, Dahl, Geared, Stribeck, asymmetric, scaled_by
from jaxmodsim.scene import State, vector_field

DRIVE, BACK, SPEED, LOAD = 0.25, 0.4, 3.0, 0.7


def spring(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """Torque of the elastic joint between motor and load [N m]."""
    del t, qd
    return p["k"] * (q[0] - q[1])


def energy(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """Motor and load with an elastic joint."""
    del t
    return 0.5 * (p["J1"] * qd[0] ** 2 + p["J2"] * qd[1] ** 2 - p["k"] * (q[0] - q[1]) ** 2)


def torques(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """Of the motor, and of the load against it."""
    del q
    return jnp.stack([p["u"] * jnp.cos(p["w"] * t), -p["M"] - p["c"] * qd[1]])


def motor_angle(q: Any) -> Any:
    return q[0]


def joint(law: Any, u: Any = 0.0, *, w: float = 0.0, c: float = 0.0, load: Any = LOAD) -> jms.Scene:
    return jms.Scene(
        energy,
        params={"J1": 0.01, "J2": 0.05, "k": 20.0, "u": u, "w": w, "c": c, "M": load},
        effects=(jms.AppliedForce(torques), jms.Friction(law, along=motor_angle, name="gear")),
    )


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize("load", [LOAD, -LOAD])
def test_efficiency_in_steady_motion(direction: float, load: float) -> None:
    drives = direction * load > 0
    # Output over input power: the load over the motor where that drives, the motor over the load otherwise.
    u = load * (1.0 + DRIVE) if drives else load * (1.0 - BACK)
    speed = direction * SPEED
    scene = joint(Geared(Coulomb(0.0), DRIVE, spring, BACK), u, load=load)
    state = State(jnp.array([load / 20.0, 0.0]), jnp.array([speed, speed]), {})
    rate = vector_field(jnp.array(0.0), state, scene, jnp.array([direction]))
    np.testing.assert_allclose(rate.qd, 0.0, atol=1e-12)
    motor, other = u * speed, load * speed
    efficiency = other / motor if drives else motor / other
    assert efficiency == pytest.approx(1.0 / (1.0 + DRIVE) if drives else 1.0 - BACK, abs=1e-12)
    # With a bristle in place of events, where it has come to its limit.
    bent = joint(Bristle(Geared(Coulomb(0.0), DRIVE, spring, BACK), 1e-3), u, load=load)
    rate = vector_field(jnp.array(0.0), state._replace(z={"gear": jnp.array(direction)}), bent)
    np.testing.assert_allclose(rate.qd, 0.0, atol=1e-12)
    assert rate.z["gear"] == 0.0


@pytest.mark.parametrize("over", [1e-12, -1e-12])
def test_the_gear_locks_itself_from_a_coefficient_of_one_on(over: float) -> None:
    scene = joint(Geared(Coulomb(0.0), DRIVE, spring, 1.0 + over))
    run = jms.simulate(scene, [0.0, -LOAD / 20.0], [0.0, 0.0], 0.1)
    assert bool(run.mode["gear"][-1] == 0) == (over > 0)
    if over > 0:
        np.testing.assert_array_equal(run.q[-1], [0.0, -LOAD / 20.0])


def test_the_gear_drives_locks_and_is_driven_back() -> None:
    law = Geared(Stribeck(Fc=0.05, Fs=0.08, vs=0.1, Fv=0.01), Stribeck(0.2, 0.25, 0.1), spring, 0.3)
    scene = joint(law, 2.0, w=2.0, c=0.05)
    options: dict[str, Any] = {"t1": 3.0, "rtol": 1e-9, "atol": 1e-11}
    run = jms.simulate(scene, [0.0, 0.0], [0.0, 0.0], ts=jnp.linspace(0.0, 3.0, 301), **options)
    mode, power = np.asarray(run.mode["gear"]), np.asarray(20.0 * (run.q[:, 0] - run.q[:, 1]) * run.qd[:, 0])
    assert {*np.unique(mode)} == {-1.0, 0.0, 1.0}
    assert np.any(power[mode != 0] > 0.1)
    assert np.any(power[mode != 0] < -0.1)
    assert float(jnp.max(jnp.abs(run.energy.balance))) < 1e-6
    assert float(jnp.min(jnp.diff(run.energy.dissipated))) > -1e-9

    def end(scene: jms.Scene, simulate: Any = jms.simulate) -> Any:
        return simulate(scene, [0.0, 0.0], [0.0, 0.0], **options).q[-1, 1]

    names = ("friction.Fc", "friction.drive.Fs", "friction.back.Fc", "k", "u")
    check = jms.check_gradients(end, scene, names=[name.replace("friction", "gear") for name in names])
    assert check.ok, str(check)
