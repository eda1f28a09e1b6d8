"""Over-compensation in the record of a compensated axis, by the level of friction that `FrictionFilter` estimates."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.control import FrictionFilter, compensate_friction
from jaxmodsim.scene import State, replace_elements, scene_step

LEVEL, H = "friction.normal_force", 5e-3
LAW = jms.LuGre(sigma0=1e4, sigma1=100.0, sigma2=1.0, Fc=2.0, Fs=3.0, vs=0.02)


def energy(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q
    return 0.5 * p["m"] * qd[0] ** 2


def motor(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return jnp.reshape(p["u"], (1,))


AXIS = jms.Scene(energy, {"m": 1.0, "u": 0.0}, (jms.AppliedForce(motor), jms.Friction(LAW, normal_force=1.0)))


@jax.jit
def compensated(level: Any) -> tuple[Any, Any, Any]:
    """Record of an axis on a sinusoidal plan: times, measured positions and forces; compensated for a level of 1."""
    t, zero, h = jnp.arange(0.0, 8.0, H), jnp.array(0.0), jnp.array(H)
    actual = replace_elements(AXIS, {LEVEL: level})

    def cycle(carry: Any, t: Any) -> Any:
        y, z = carry
        plan = State(0.1 * jnp.sin(3.0 * t)[None], 0.3 * jnp.cos(3.0 * t)[None], z)
        force, z = compensate_friction(AXIS, zero, h, plan)
        u = -0.9 * jnp.sin(3.0 * t) - 400.0 * (y.q[0] - plan.q[0]) - 40.0 * (y.qd[0] - plan.qd[0]) + force[0]
        after, _ = scene_step(replace_elements(actual, {"u": u}), zero, h, y)
        return (after, z), (y.q, u)

    z = AXIS.initial_state(jnp.zeros(1))
    _, (q, u) = jax.lax.scan(cycle, (State(jnp.zeros(1), jnp.array([0.3]), z), z), t)
    return t, q + 1e-5 * jax.random.normal(jax.random.key(0), q.shape), u


@pytest.fixture(scope="module")
def band() -> Any:
    drift = {"qd[0]": 0.02, "friction.z": 1e-4, LEVEL: 0.02}
    monitor = FrictionFilter(AXIS, 1e-5, drift, numbers=(LEVEL,), rest=5e-3)
    start = monitor.start([0.0], [0.3], {"qd[0]": 0.01, LEVEL: 0.3})
    return jax.jit(lambda t, q, u: monitor.run(t, q, {"u": u}, start).band(LEVEL))


@pytest.mark.parametrize(("level", "over"), [(0.8, True), (1.0, False), (1.2, False)])
def test_the_band_of_the_level_is_below_the_compensated_level_only_with_over_compensation(
    band: Any, level: float, over: bool
) -> None:
    middle, low, high = (float(x[-1]) for x in band(*compensated(jnp.asarray(level))))
    np.testing.assert_allclose(middle, level, atol=0.05)
    assert low < level < high
    assert (high < 1.0) == over
