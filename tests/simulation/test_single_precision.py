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


def test_derivatives_of_a_clutch_whose_slip_is_rounding() -> None:
    """Behind a break-away the slip is a difference of velocities that are 1e7 times as large; for five clutches."""

    def clutch(x: Any) -> jms.Scene:
        law, p = jms.Stribeck(Fc=x[4], Fs=1.3 * x[4], vs=0.3), {"J": x[:2], "T": x[2], "d": x[3], "N": x[5], "w": x[6]}
        torque = jms.AppliedForce(lambda t, q, qd, p: jnp.stack([p["T"] - 0.1 * qd[0], -p["d"] * qd[1]]))
        plates = jms.Friction(
            law,
            along=lambda q: q[0] - q[1],
            normal_force=lambda t, q, qd, p: p["N"] * jnp.clip(t - 0.5, 0, 1) * (1 - 0.8 * jnp.sin(p["w"] * t) ** 2),
        )
        scene = jms.Scene(lambda t, q, qd, p: 0.5 * jnp.sum(p["J"] * qd**2), p, (torque, plates))
        return jax.tree.map(lambda n: jnp.asarray(n, x.dtype), scene)

    def events(x: Any) -> tuple[Any, Any]:
        """Whether the run ends well; times of events, and their derivatives along the numbers of the clutch."""

        def times(x: Any) -> tuple[Any, Any]:
            q0, qd0 = jnp.zeros(2, x.dtype), jnp.asarray([10.0, 0.0], x.dtype)
            rtol = 1e-5 if x.dtype == F else 1e-11
            run = jms.simulate(clutch(x), q0, qd0, 6.0, rtol=rtol, record=("events",), throw=False)
            return jnp.where(jnp.isfinite(run.events.t), run.events.t, 0.0), run.result.ok

        return jax.jvp(times, (x,), (x,), has_aux=True)

    numbers = np.array(
        [
            [0.54113954, 1.1240969, 3.992858, 0.1956649, 0.25359812, 36.218075, 1.720873],
            [0.6595295, 0.66881, 3.470771, 0.2587157, 0.1480656, 45.59356, 1.780515],
            [0.3290633, 0.6143131, 3.191928, 0.2258665, 0.2760853, 27.43927, 1.923342],
            [0.5116981, 1.019342, 2.996398, 0.2951827, 0.2036226, 41.01647, 1.971936],
            [0.6249341, 1.134312, 4.100193, 0.4021715, 0.2397198, 51.54245, 1.595435],
        ]
    )
    found, exact = (jax.jit(lambda x: jax.lax.map(events, x))(jnp.asarray(numbers, kind)) for kind in (F, np.float64))
    assert found[2].all()
    np.testing.assert_allclose(found[0], exact[0], atol=2e-3)
    np.testing.assert_allclose(found[1], exact[1], rtol=0.05, atol=0.01)


def test_a_slip_that_nearly_stays_ends_at_its_root() -> None:
    """Two bodies near the speed V, with the slip `(t - 1)^2 - depth`: it ends at `1 - sqrt(depth)`."""

    def kinetic(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, q, p
        return 0.5 * jnp.sum(qd**2)

    def drive(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del q, qd
        return jnp.stack([2.0 * (t - 1.0) + p["F"], -p["F"]])

    def slip(q: Any) -> Any:
        return q[0] - q[1]

    def first(case: Any) -> Any:
        V, depth = case
        rubs = jms.Friction(jms.Coulomb(F(0.05)), along=slip)
        scene = jms.Scene(kinetic, {"F": F(0.05)}, (jms.AppliedForce(drive), rubs))
        start = jnp.stack([V + 1.0 - depth, V])
        fine: dict[str, Any] = {"rtol": 8e-6, "atol": 1e-9, "record": ("events",), "max_events": 8}
        run = jms.simulate(scene, np.zeros(2, F), start, F(1.5), throw=False, **fine)
        return run.events.t[0], run.result.code

    # Depths above the rounding of the slip, 1e-6 V.
    cases = np.array([(V, d) for V in (0.0, 7.0, 100.0) for d in (1e-2, 1e-3, 3e-5) if d > 3e-7 * V], F)
    t, code = jax.jit(lambda cases: jax.lax.map(first, cases))(cases)
    assert not np.any(code)
    np.testing.assert_allclose(t, 1.0 - np.sqrt(cases[:, 1]), atol=1e-3)


def test_friction_under_two_waves_ends_at_t1() -> None:
    """The cubic of a step that is too long has roots that are none: by those, some of these runs ended as chatter."""
    rng = np.random.default_rng(3)
    numbers = rng.uniform((0.5, 0.0, 0.5, 1.0, -2.0, 0.3, -1.0), (3.0, 100.0, 4.0, 8.0, 2.0, 2.0, 1.0), (120, 7))

    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t
        return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2

    def drive(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del q, qd
        return (p["a"] * jnp.sin(p["w"] * t) + p["b"] * jnp.sin(2.3 * p["w"] * t))[None]

    def code(x: Any) -> Any:
        m, k, a, w, b, Fc, v = x
        params = {"m": m, "k": k, "a": a, "w": w, "b": b}
        scene = jms.Scene(lagrangian, params, (jms.AppliedForce(drive), jms.Friction(jms.Coulomb(Fc))))
        return jms.simulate(scene, 0.0 * v[None], v[None], F(5.0), throw=False).code

    codes = jax.jit(lambda x: jax.lax.map(code, x))(jnp.asarray(numbers, F))
    np.testing.assert_array_equal(codes, 0)
