import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.orbits import OrbitError

LAW = jms.Stribeck(Fc=2.0, Fs=3.0, vs=0.02, Fv=1.0)
AXIS = {"m": 1.0, "kp": 100.0, "ki": 200.0}


@pytest.fixture(scope="module")
def found():
    return jms.hunting(LAW, "kd", 30.0, kd=19.0, **AXIS)


def run_on(orbit, kd):
    """Amplitude of the axis in the last of 30 periods, begun on a limit cycle with another damping."""
    scene = orbit.run.scene
    scene = jms.Scene(scene.lagrangian, params={**scene.params, "kd": kd}, effects=scene.effects)
    T = float(orbit.period)
    run = jms.simulate(scene, orbit.q, orbit.qd, 30 * T, ts=np.linspace(29 * T, 30 * T, 200), max_events=200)
    return 0.5 * np.ptp(np.asarray(run.q[:, 0]))


@pytest.mark.deep
def test_hunting_vanishes_where_simulations_cease_to_hunt(found):
    last = max((each for each in found.branch.orbits if each.stable), key=lambda each: float(each.period))
    assert run_on(last, 0.999 * found.vanishes) > 0.9 * float(last.amplitude[0])
    assert run_on(last, 1.02 * found.vanishes) < 0.1 * float(last.amplitude[0])
    assert list(found.branch.stable) == sorted(found.branch.stable, reverse=True)
    assert f"vanishes at kd = {found.vanishes:.8g}" in str(found)


@pytest.mark.deep
def test_limit_cycle_of_an_axis(found):
    assert found.orbit.stable
    # Between two slips the integral turns from one level of stiction to the other, at the rate of the error.
    stick = found.orbit.stick["friction"] * float(found.period) / 2
    assert 0.5 < stick * AXIS["ki"] * float(found.amplitude) / 5.0 < 1.5


def test_an_axis_that_settles_and_garbage_are_refused():
    with pytest.raises(OrbitError, match="the axis settles"):
        jms.hunting(LAW, "kd", 30.0, kd=22.5, **AXIS)
    with pytest.raises(ValueError, match="Fs > Fc, but Coulomb"):
        jms.hunting(jms.Coulomb(2.0), "kd", 30.0, kd=2.0, **AXIS)
    with pytest.raises(ValueError, match="kd than that of the axis, but both are 2"):
        jms.hunting(LAW, "kd", 2.0, kd=2.0, **AXIS)
    with pytest.raises(OrbitError, match="unstable without stiction"):
        jms.hunting(LAW, "kd", 30.0, kd=2.0, **{**AXIS, "ki": 1000.0})
    with pytest.raises(ValueError, match="there are: kd, ki, kp, m"):
        jms.hunting(LAW, "kx", 30.0, kd=2.0, **AXIS)
    with pytest.raises(ValueError, match="kd must be >= 0"):
        jms.hunting(LAW, "kd", 30.0, kd=-1.0, **AXIS)
    with pytest.raises(ValueError, match="ki must be one finite number > 0"):
        jms.hunting(LAW, "kd", 30.0, kd=2.0, **{**AXIS, "ki": 0.0})
