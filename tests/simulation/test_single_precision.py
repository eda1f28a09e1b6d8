"""Scenes in float32 run in float32, and say where that is not enough."""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim._core import speed
from jaxmodsim.scene import scene_numbers

from ..problems import linear_stick_slip

F = np.float32
Q0, QD0 = jnp.zeros(1, F), jnp.ones(1, F)


def kinetic(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q
    return 0.5 * p["m"] * qd[0] ** 2


def place(q: Any) -> Any:
    return jnp.stack([q[0], 0.0 * q[0], 0.0 * q[0]])


def rubbed(law: Any) -> jms.Scene:
    return jms.Scene(kinetic, {"m": F(1.0)}, (jms.Friction(law),))


def bound(*constraints: Any) -> jms.Scene:
    return jms.Scene(kinetic, {"m": F(1.0)}, constraints=constraints)


def behind(t: Any, q: Any, p: Any) -> Any:
    del t, p
    return q[0] + 1


# Scenes whose numbers are all float32, with every default that an effect, a law, a constraint or a body has.
SCENES: dict[str, Callable[[], jms.Scene]] = {
    "belt_velocity": lambda: rubbed(jms.Coulomb(F(0.3))),
    "Stribeck Fv": lambda: rubbed(jms.Stribeck(F(1.0), F(1.5), F(0.1))),
    "Curve gain": lambda: rubbed(lambda v: 0.1 * v),
    "MaxwellSlip sigma2": lambda: rubbed(jms.MaxwellSlip(jnp.asarray([1e2], F), jnp.asarray([1.0], F))),
    "ServoGear": lambda: rubbed(jms.ServoGear(F(0.0), F(0.0), F(1.0), F(1.0))),
    "Contact": lambda: bound(jms.Contact(behind)),
    "HuntCrossley": lambda: bound(jms.Contact(behind, restitution=jms.HuntCrossley(F(1e3)))),
    "end_stops": lambda: bound(*jms.end_stops(lambda q: q[0], upper=F(2.0))),
    "VelocityConstraint": lambda: bound(jms.VelocityConstraint(lambda t, q, qd, p: qd[0] - 1)),
    "gravity": lambda: jms.Scene(jms.point_mass(F(1.0), place)),
}


@pytest.mark.parametrize("case", SCENES)
def test_what_was_left_out_does_not_decide(case: str) -> None:
    scene = SCENES[case]()
    assert {x.dtype for x in scene_numbers(scene).values()} == {np.dtype(F)}
    run = jms.simulate(scene, Q0, QD0, 0.1)
    assert {x.dtype for x in (run.t, run.q, run.qd)} == {np.dtype(F)}


def test_a_scene_without_numbers_of_its_own_follows_q0() -> None:
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, effects=(jms.Friction(lambda v: 0.1 * v),))
    for kind in (np.float32, np.float64):
        assert jms.simulate(scene, jnp.zeros(1, kind), jnp.ones(1, kind), 0.1).q.dtype == kind
    assert jms.simulate(scene, [0.0], [1.0], 0.1).q.dtype == np.float64


def test_what_was_given_decides() -> None:
    assert jms.simulate(rubbed(jms.Coulomb(0.3)), Q0, QD0, 0.1).q.dtype == np.float64
    belt = jms.Scene(kinetic, {"m": F(1.0)}, (jms.Friction(jms.Viscous(F(1.0)), belt_velocity=0.0),))
    assert jms.simulate(belt, Q0, QD0, 0.1).q.dtype == np.float64


def pulled(kind: Any, t1: float, rtol: float) -> jms.Trajectory:
    """A box with a stiff LuGre bristle, which a spring pulls."""

    def spring(t: Any, q: Any, qd: Any, p: Any) -> Any:
        return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * (q[0] - p["v"] * t) ** 2

    law = jms.LuGre(*(kind(x) for x in (1e5, 632.0, 0.4, 1.0, 1.5, 0.01)))
    params = {"m": kind(1.0), "k": kind(100.0), "v": kind(0.1)}
    zero = jnp.zeros(1, kind)
    return jms.simulate(jms.Scene(spring, params, (jms.Friction(law),)), zero, zero, t1, rtol=rtol)


def test_rounding_of_a_stiff_bristle_is_remarked_on_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "jaxmodsim")
    speed.warn_about_rounding.cache_clear()
    short, larger, double = pulled(F, 1.0, 1e-6), pulled(F, 10.0, 1e-4), pulled(np.float64, 10.0, 1e-6)
    assert "rounding" not in caplog.text
    run = pulled(F, 10.0, 1e-6)
    assert caplog.text.count("rounding, about 6e-8 sqrt(steps) of the state, exceeds rtol") == 1
    pulled(F, 10.0, 1e-6)
    assert caplog.text.count("exceeds rtol") == 1
    # It says the truth: the error is above rtol, the run with a larger rtol is as good.
    error, at_larger = (abs(float(x.q[-1, 0]) - float(double.q[-1, 0])) for x in (run, larger))
    assert error > 1e-6
    assert at_larger < 3.0 * error
    assert short.q.dtype == np.float32


def test_nothing_is_said_where_numbers_are_traced(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "jaxmodsim")
    speed.warn_about_rounding.cache_clear()
    jax.jit(lambda t1: pulled(F, t1, 1e-6).q)(10.0)
    assert "rounding" not in caplog.text


def test_a_bristle_that_overflows_in_a_long_step_is_integrated_by_shorter_ones() -> None:
    """Where the box comes to rest, a step of the length before it takes the bristle beyond the largest number."""
    case = jms.problems.named_problems()["pulled_box"]()
    scale, (q0, qd0) = np.linspace(1.0, 1.004, 16), (np.asarray(x, F) for x in (case.q0, case.qd0))

    def end(scale: Any) -> tuple[Any, Any]:
        scene = jax.tree.map(lambda x: jnp.asarray(x, scale.dtype) * scale, case.scene)
        kind = scale.dtype
        run = jms.simulate(scene, q0.astype(kind), qd0.astype(kind), case.t1, rtol=1e-5, throw=False)
        return run.q[-1], run.code

    ends = {kind: jax.jit(lambda x: jax.lax.map(end, x))(jnp.asarray(scale, kind)) for kind in (F, np.float64)}
    assert not np.any(ends[F][1])
    np.testing.assert_allclose(ends[F][0], ends[np.float64][0], rtol=3e-4)


def test_velocities_pass_zero_at_the_default_tolerance() -> None:
    """A box on a spring that sticks to a belt whose velocity swings through zero, for 64 limits."""
    system = linear_stick_slip.system([[]], [(1.5, 1.5)], [1.7], mass=1.0, stiffness=4.0, belt=[0.2, 0.0, 0.0, 0.3])
    scene = jax.tree.map(lambda x: jnp.asarray(x, F), linear_stick_slip.scene(system))

    def run(Fc: Any) -> Any:
        changed = eqx.tree_at(lambda scene: scene.effects[1].law.Fc, scene, Fc)
        done = jms.simulate(changed, jnp.zeros(1, F), jnp.full(1, 0.2, F), 12.0, max_steps=4096, throw=False)
        return done.result.ok, done.q[-1, 0]

    limits = np.linspace(0.97, 1.03, 64)
    start = np.zeros(1), np.array([0.2])
    ends = [linear_stick_slip.motion(replace(system, Fc=np.array([Fc])), *start, 12.0).q[0] for Fc in limits]
    ok, q = jax.jit(lambda x: jax.lax.map(run, x))(jnp.asarray(limits, F))
    assert ok.all()
    assert q.dtype == F
    np.testing.assert_allclose(q, ends, atol=1e-4)


def test_derivatives_pass_the_kink_of_a_bristle() -> None:
    """Its rate has |v|: over a reversal the error of a tangent falls with the step, to the resolution of time."""

    def spring(t: Any, q: Any, qd: Any, p: Any) -> Any:
        return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2 + p["F"] * jnp.sin(3.0 * t) * q[0]

    def end(x: Any, rtol: float) -> tuple[Any, Any]:
        m, k, force, Fc, sigma0 = x
        law = jax.tree.map(lambda y: jnp.asarray(y, x.dtype), jms.LuGre(sigma0, 20.0, 0.1, Fc, 1.3, 0.05))
        scene = jms.Scene(spring, {"m": m, "k": k, "F": force}, (jms.Friction(law),))
        run = jms.simulate(scene, 0.0 * x[:1], 0.0 * x[:1], 5.0, rtol=rtol, throw=False)
        return jnp.stack([run.q[-1, 0], run.qd[-1, 0]]), run.code

    x, part = np.array([1.0, 10.0, 2.0, 1.0, 1e3]), np.array([0.5, -0.3, 0.8, 1.0, 1.2])
    slope = jax.jit(lambda x, d: jax.jvp(lambda x: end(x, 1e-6), (x,), (d,), has_aux=True)[1:])
    single, code = slope(x.astype(F), (x * part).astype(F))
    moved = jnp.stack([x * (1.0 + change * part) for change in (-1e-5, 1e-5)])
    before, after = jax.jit(lambda x: jax.lax.map(lambda x: end(x, 1e-11)[0], x))(moved)
    assert code == 0
    np.testing.assert_allclose(single, (after - before) / 2e-5, rtol=1e-4)
