import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.orbits import OrbitError
from jaxmodsim.scene import scene_numbers


def hill(_t, q, qd, p):
    return 0.5 * qd[0] ** 2 + 0.5 * p["a"] ** 2 * q[0] ** 2


def swing(t, _q, _qd, p):
    return jnp.array([jnp.cos(p["W"] * t)])


def of_frequency(p):
    return 2.0 * jnp.pi / p["W"]


def on_a_hill(a, segments):
    """The orbit -cos(t)/(1 + a^2), with the multipliers exp(+-2 pi a)."""
    scene = jms.Scene(hill, params={"a": a, "W": 1.0}, effects=(jms.AppliedForce(swing),))
    rest = [[0.0]] * segments
    return scene, jms.periodic_orbit(scene, (rest, rest), period=of_frequency, segments=segments)


# Multipliers of 1e6 and 4e13.
@pytest.mark.parametrize("a", [2.2, 5.0])
def test_an_orbit_too_unstable_for_a_run_over_the_period(a):
    scene, orbit = on_a_hill(a, 8)
    np.testing.assert_allclose(orbit.q, [-1 / (1 + a**2)], rtol=1e-10)
    np.testing.assert_allclose(orbit.amplitude, [1 / (1 + a**2)], rtol=1e-8)
    np.testing.assert_allclose(orbit.multipliers, np.exp([2 * np.pi * a, -2 * np.pi * a]), rtol=2e-8)
    assert orbit.residual < 1e-10

    def amplitude(scene):
        return jms.periodic_orbit(scene, orbit, period=of_frequency, segments=8).amplitude[0]

    slopes = scene_numbers(jax.grad(amplitude)(scene))
    # Of 1/(W^2 + a^2).
    np.testing.assert_allclose(slopes["a"], -2 * a / (1 + a**2) ** 2, rtol=1e-8)
    np.testing.assert_allclose(slopes["W"], -2 / (1 + a**2) ** 2, rtol=1e-8)


def test_single_shooting_fails():
    with pytest.raises(OrbitError, match="pass more `segments`"):
        on_a_hill(5.0, 1)


def test_invalid_arguments_are_refused():
    scene, orbit = on_a_hill(2.2, 4)
    with pytest.raises(ValueError, match="in 4 segments: it has one run each"):
        _ = orbit.run
    with pytest.raises(ValueError, match=r"guess has 3 states, .* but segments is 2, and a period was given"):
        jms.periodic_orbit(scene, ([[0.0]] * 3, [[0.0]] * 3), period=of_frequency, segments=2)
    with pytest.raises(ValueError, match="segments must be"):
        jms.periodic_orbit(scene, orbit, period=of_frequency, segments=0)
