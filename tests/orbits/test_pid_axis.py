"""The limit cycle of an axis with stiction under PID control, and the damping at which it vanishes in a fold."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms

LAW = jms.Stribeck(Fc=2.0, Fs=3.0, vs=0.02, Fv=1.0)
NUMBERS = {"m": 1.0, "kp": 100.0, "ki": 200.0, "kd": 19.0}


def lagrangian(_t, _q, qd, p):
    """Position of the axis, and its integral as a coordinate of mass 1."""
    return 0.5 * p["m"] * qd[0] ** 2 + 0.5 * qd[1] ** 2


def pid(_t, q, qd, p):
    """PID force on the axis; a force that keeps the rate of the integral at the position."""
    force = -p["kp"] * q[0] - p["ki"] * q[1] - p["kd"] * qd[0]
    return jnp.stack([force, qd[0] + jnp.sqrt(p["kp"] / p["m"]) * (q[0] - qd[1])])


@pytest.fixture(scope="module")
def branch():
    effects = (jms.AppliedForce(pid), jms.Friction(LAW, along=lambda q: q[0], name="friction"))
    axis = jms.Scene(lagrangian, params=NUMBERS, effects=effects)
    return jms.continue_orbits(
        axis, ([0.06, 0.0], [0.0, 0.06]), "kd", (19.0, 30.0), settle=100.0, step=0.1, max_orbits=100
    )


def run_on(orbit, kd):
    """Amplitude of the axis in the last of 30 periods, begun on a limit cycle with another damping."""
    scene = orbit.run.scene
    scene = jms.Scene(scene.lagrangian, params={**scene.params, "kd": kd}, effects=scene.effects)
    T = float(orbit.period)
    run = jms.simulate(scene, orbit.q, orbit.qd, 30 * T, ts=np.linspace(29 * T, 30 * T, 200), max_events=200)
    return 0.5 * np.ptp(np.asarray(run.q[:, 0]))


def test_the_limit_cycle_vanishes_where_simulations_come_to_rest(branch):
    fold = next(point.value for point in branch.points if point.kind == "fold")
    last = max((each for each in branch.orbits if each.stable), key=lambda each: float(each.period))
    assert run_on(last, 0.999 * fold) > 0.9 * float(last.amplitude[0])
    assert run_on(last, 1.02 * fold) < 0.1 * float(last.amplitude[0])
    assert list(branch.stable) == sorted(branch.stable, reverse=True)


def test_limit_cycle_of_an_axis(branch):
    orbit = branch.orbits[0]
    assert orbit.stable
    # Between two slips the integral turns from one level of stiction to the other, at the rate of the error.
    stick = orbit.stick["friction"] * float(orbit.period) / 2
    assert 0.5 < stick * NUMBERS["ki"] * float(orbit.amplitude[0]) / 5.0 < 1.5
