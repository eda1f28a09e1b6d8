"""Contacts that open, close and strike: against closed forms, in value, derivative and energy."""
# ruff: noqa: ARG001 (Lagrangians, gaps and forces have all their arguments, used or not)

from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.special import ellipk

import jaxmodsim as jms
from jaxmodsim.problems import bouncing_ball

from ..hard.case import SceneTask
from ..hard.catalogue import hard_cases
from ..problems import vibrating_table

HARD = hard_cases()
TIGHT: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-12}


def _ball_end(start, **more):
    """Saved motion, the end of all bounces, and the run of a ball dropped from `h`."""
    run = jms.simulate(
        bouncing_ball.scene(e=start["e"]),
        jnp.stack([start["h"]]),
        [0.0],
        2.5,
        ts=np.array([0.3, 0.7, 1.1, 1.35, 2.0, 2.5]),
        **TIGHT,
        **more,
    )
    return run, jnp.max(jnp.where(jnp.isfinite(run.events.t), run.events.t, 0.0))


def test_a_ball_bounces_to_rest_on_the_floor():
    start = {"h": 1.0, "e": 0.5}
    run, stop = _ball_end(start)
    height, velocity = bouncing_ball.motion(run.t, **start)
    np.testing.assert_allclose(run.q[:, 0], height, atol=1e-11)
    np.testing.assert_allclose(run.qd[:, 0], velocity, atol=1e-11)
    assert abs(stop - bouncing_ball.rest(**start)) < 1e-10
    assert (run.q[-2:] == 0).all()
    assert (run.qd[-2:] == 0).all()
    np.testing.assert_array_equal(run.mode["floor"], [0, 0, 0, 0, 1, 1])
    np.testing.assert_allclose(run.reactions["floor"].multiplier[:, 0], [0, 0, 0, 0, 9.81, 9.81], rtol=1e-12)
    assert run.mode_changes[0].before == run.mode_changes[0].after == "open"
    assert run.mode_changes[-1].after == "closed"
    # All of the energy is lost in impacts, and no impact gains any.
    np.testing.assert_allclose(run.energy.dissipated[-1], 9.81, rtol=1e-11)
    np.testing.assert_allclose(run.energy.balance, 0.0, atol=1e-11)
    assert (np.diff(run.event_losses) >= -1e-13).all()


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
def test_derivatives_of_the_end_of_all_bounces(derivative):
    start = {"h": 1.0, "e": 0.5}
    ours = jax.jit(derivative(lambda start: _ball_end(start, throw=False)[1]))(start)
    closed = jax.jit(jax.grad(lambda start: bouncing_ball.rest(**start)))(start)
    for name in start:
        np.testing.assert_allclose(ours[name], closed[name], rtol=1e-8)


def test_gradient_through_a_hundred_impacts():
    impacts = 100

    def closed(v, e):
        """Between walls one metre apart: halfway after that many impacts, the time and the place at a fixed time."""
        speeds = v * e ** jnp.arange(impacts + 1)
        t = 0.5 / v + jnp.sum(1.0 / speeds[1:impacts])
        return t, speeds[impacts]

    t1 = float(jax.jit(closed)(1.0, 0.99)[0]) + 0.1

    def end(start):
        walls = jms.end_stops(lambda q: q[0], lower=0.0, upper=1.0, restitution=start["e"])
        scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, constraints=walls)
        run = jms.simulate(scene, [0.5], jnp.stack([start["v"]]), t1, max_events=256, throw=False, **TIGHT)
        return run.q[-1, 0]

    def exact(start):
        t, speed = closed(start["v"], start["e"])
        return speed * (t1 - t)  # the last of an even number of impacts is at the left wall

    start = {"v": 1.0, "e": 0.99}
    (value, ours), (right, theirs) = (jax.jit(jax.value_and_grad(f))(start) for f in (end, exact))
    np.testing.assert_allclose(value, right, rtol=1e-9)
    for name in start:
        np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-8)


def test_a_ball_bounces_once_a_period_of_a_vibrating_table():
    p = vibrating_table.PARAMS
    phase, period = float(vibrating_table.bounce_phase()), 2 * np.pi / p["omega"]
    t0 = phase / p["omega"]
    run = jms.simulate(
        vibrating_table.scene(),
        [p["A"] * np.sin(phase)],
        [0.5 * p["g"] * period],
        t0 + 5.5 * period,
        t0=t0,
        rtol=1e-11,
        atol=1e-14,
    )
    times = np.array([change.t for change in run.mode_changes])
    np.testing.assert_allclose(p["omega"] * times, phase + 2 * np.pi * np.arange(1, 6), atol=1e-10 * 2 * np.pi)


def test_a_contact_opens_where_its_reaction_falls_to_zero():
    A, omega = 0.05, 20.0
    scene = vibrating_table.scene(A=A, omega=omega, e=0.0)
    run = jms.simulate(scene, [0.0], [A * omega], 0.3, **TIGHT)
    opens, closes = run.mode_changes
    assert (opens.before, opens.after, closes.after) == ("closed", "open", "closed")
    np.testing.assert_allclose(opens.t, np.arcsin(9.81 / (A * omega**2)) / omega, rtol=1e-9)
    # In between it is a throw, and lands on the table without a bounce.
    speed = A * omega * np.cos(omega * opens.t)
    fall = closes.t - opens.t
    height = A * np.sin(omega * opens.t) + speed * fall - 0.5 * 9.81 * fall**2
    np.testing.assert_allclose(height, A * np.sin(omega * closes.t), atol=1e-10)
    np.testing.assert_allclose(run.q[-1, 0], A * np.sin(omega * 0.3), rtol=1e-14)


def test_a_stop_holds_a_mass_with_friction():
    """A driven mass on a spring stays at either stop until the drive has fallen by friction; both hold it."""
    m, k, F, omega, Fc, gap = 1.064, 30.12, 4.141, 3.43, 1.154, 0.1099
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * m * qd[0] ** 2 - 0.5 * k * q[0] ** 2,
        effects=(
            jms.AppliedForce(lambda t, q, qd, p: jnp.stack([F * jnp.sin(omega * t)])),
            jms.Friction(jms.Coulomb(Fc), name="rail"),
        ),
        constraints=jms.end_stops(lambda q: q[0], lower=-gap, upper=gap, restitution=0.0),
    )
    run = jms.simulate(scene, [0.0], [0.0], 8.0, **TIGHT)
    leaves = [change.t for change in run.mode_changes if change.effect == "rail" and change.before == "stick"]
    # It leaves the upper stop where F sin(omega t) = k gap - Fc, and the lower one half a period later.
    first = (np.pi - np.arcsin((k * gap - Fc) / F)) / omega
    half = np.pi / omega
    np.testing.assert_allclose(leaves[1:], first + half * np.arange(len(leaves) - 1), rtol=1e-9)
    assert len(leaves) == 1 + int((8.0 - first) / half) + 1


def test_openings_of_a_contact_in_single_precision():
    """A ball on a shaken table, for 64 frequencies, leaves it once a period where its reaction falls to zero."""
    A, t1 = 0.01, 1.0

    def openings(omega):
        scene = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), vibrating_table.scene(A=A, omega=omega, e=0.0))
        start = jnp.zeros(1, jnp.float32), jnp.stack([A * omega])
        run = jms.simulate(scene, *start, t1, rtol=1e-5, record=("events",), max_events=64, throw=False)
        return run.result.ok, jnp.where(run.events.after == 0, run.events.t, jnp.inf)

    omega = np.linspace(34.0, 50.0, 64)
    ok, found = jax.jit(lambda x: jax.lax.map(openings, x))(jnp.asarray(omega, jnp.float32))
    assert ok.all()
    for each, t in zip(omega, np.sort(found, axis=1), strict=True):
        exact = (np.arcsin(9.81 / (A * each**2)) + 2 * np.pi * np.arange(64)) / each
        np.testing.assert_allclose(t[np.isfinite(t)], exact[exact < t1], atol=2e-5)


def test_a_backlash_opens_for_good_in_single_precision():
    """Where its reaction falls to zero beside friction, for 32 forces; a closed one never pulls."""

    def masses(t, q, qd, p):
        return 0.25 * qd[0] ** 2 + 0.5 * qd[1] ** 2 - 10.0 * q[1] ** 2

    def ends(F):
        drive = jms.AppliedForce(lambda t, q, qd, p: jnp.stack([p["F"] * jnp.cos(p["omega"] * t), 0.0 * t]))
        rail = jms.Friction(jms.Coulomb(0.5), along=lambda q: q[1], name="rail")
        play = jms.backlash(lambda q: q[0] - q[1], 0.05, restitution=0.0)
        scene = jms.Scene(masses, {"F": F, "omega": 3.0}, (drive, rail), constraints=play)
        scene = jax.tree.map(lambda x: jnp.asarray(x, F.dtype), scene)
        zero, ts = jnp.zeros(2, F.dtype), jnp.linspace(0.0, 3.0, 61, dtype=F.dtype)
        run = jms.simulate(scene, zero, zero, 3.0, ts=ts, rtol=1e-5 if F.dtype == jnp.float32 else 1e-10, throw=False)
        return run.result.ok, run.q[-1], jnp.stack([run.reactions[name].multiplier for name in scene.contacts])

    forces = np.linspace(3.99, 4.01, 32)
    (ok, q, push), (_, exact, _) = (
        jax.jit(lambda x: jax.lax.map(ends, x))(jnp.asarray(forces, kind)) for kind in (jnp.float32, jnp.float64)
    )
    assert ok.all()
    assert push.min() > -1e-3
    np.testing.assert_allclose(q, exact, atol=2e-5)


def test_a_block_leaves_what_it_has_struck_at_once():
    """A braked block strikes a free one without restitution: it goes on slower, and the contact opens at the impact."""

    def blocks(t, q, qd, p):
        return 0.5 * p["m"] * qd[0] ** 2 + 0.5 * qd[1] ** 2

    brake = jms.AppliedForce(lambda t, q, qd, p: jnp.stack([-p["F"], 0.0 * t]))
    gap = jms.Contact(lambda t, q, p: q[1] - q[0], restitution=0.0)

    def run(x):
        scene = jms.Scene(blocks, {"F": x[2], "m": x[3]}, (brake,), constraints=(gap,))
        end = jms.simulate(scene, jnp.stack([-x[0], 0.0 * x[0]]), jnp.stack([x[1], 0.0 * x[0]]), 1.0, **TIGHT)
        return jnp.concatenate([end.q[-1], end.qd[-1]])

    def exact(x):
        distance, speed, force, m = x
        a = force / m
        t = (speed - jnp.sqrt(speed**2 - 2 * a * distance)) / a
        after, left = m * (speed - a * t) / (m + 1.0), 1.0 - t
        return jnp.stack([(after - 0.5 * a * left) * left, after * left, after - a * left, after])

    x = jnp.array([0.3, 2.0, 1.5, 1.25])
    np.testing.assert_allclose(run(x), exact(x), atol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(run))(x), jax.jacfwd(exact)(x), atol=1e-9)


def test_several_contacts_at_one_instant():
    """A rigid bar falls flat on two supports."""
    bar = HARD["bar_on_two_supports"].task
    assert isinstance(bar, SceneTask)
    run = jms.simulate(bar.scene, [0.1, 0.0], [0.0, 0.0], 2.0, ts=np.array([0.2, 2.0]), **TIGHT)
    height, velocity = bouncing_ball.motion(run.t, h=0.1, e=0.5)
    np.testing.assert_allclose(run.q[:, 0], height, atol=1e-11)
    np.testing.assert_allclose(run.qd[:, 0], velocity, atol=1e-11)
    np.testing.assert_allclose(run.q[:, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose([each.multiplier[-1, 0] for each in run.reactions.values()], 9.81 / 2, rtol=1e-9)


def test_backlash_between_a_motor_and_its_load():
    """The motor runs through the play and strikes: momentum and Newton's law, then both accelerate together."""
    play, torque = 0.2, 0.5
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * (1.0 * qd[0] ** 2 + 3.0 * qd[1] ** 2),
        params={"play": play},
        effects=(jms.AppliedForce(lambda t, q, qd, p: jnp.stack([torque + 0.0 * t, 0.0 * t])),),
        constraints=jms.backlash(lambda q: q[0] - q[1], lambda p: p["play"], name="teeth"),
    )

    def end(play):
        wide = jms.scene.replace_numbers(scene, {"play": play})
        return jms.simulate(wide, [0.0, 0.0], [0.0, 0.0], 2.0, throw=False, **TIGHT).q[-1, 1]

    run = jms.simulate(scene, [0.0, 0.0], [0.0, 0.0], 2.0, ts=[1.0, 2.0], **TIGHT)
    strikes, left = np.sqrt(play / torque), 2.0 - np.sqrt(play / torque)
    (change,) = run.mode_changes
    assert (change.effect, change.after) == ("teeth_upper", "closed")
    np.testing.assert_allclose(change.t, strikes, rtol=1e-10)
    np.testing.assert_allclose(run.q[-1, 1], torque / 4 * (strikes * left + 0.5 * left**2), rtol=1e-10)
    np.testing.assert_allclose(run.q[-1, 0] - run.q[-1, 1], play / 2, rtol=1e-12)
    np.testing.assert_allclose(run.reactions["teeth_upper"].multiplier[:, 0], 0.75 * torque, rtol=1e-10)
    # The place is torque/4 (2 - play/(2 torque)).
    np.testing.assert_allclose(jax.jit(jax.grad(end))(jnp.asarray(play)), -1 / 8, rtol=1e-8)


def test_an_impact_within_a_constraint():
    """A pendulum in Cartesian coordinates strikes a wall at its lowest point: the rod holds, the speed is e times."""
    e, g, start = 0.5, 9.81, 0.6
    scene = jms.Scene(
        jms.point_mass(1.0, lambda q: jnp.stack([q[0], 0.0 * q[0], q[1]])),
        constraints=(
            jms.Contact(lambda t, q, p: q[0], restitution=e, name="wall"),
            jms.Constraint(lambda t, q, p: jnp.sqrt(jnp.sum(q**2)) - 1.0, name="rod"),
        ),
    )
    run = jms.simulate(scene, [np.sin(start), -np.cos(start)], [0.0, 0.0], 0.75, ts=np.linspace(0.0, 0.75, 16), **TIGHT)
    (strike,) = run.mode_changes
    # A quarter of the period, an elliptic integral.
    np.testing.assert_allclose(strike.t, ellipk(np.sin(start / 2) ** 2) / np.sqrt(g), rtol=1e-9)
    t, q, qd = map(np.asarray, (run.t, run.q, run.qd))
    np.testing.assert_allclose(np.sum(q**2, axis=1), 1.0, atol=1e-12)
    after = t > strike.t
    energy = 0.5 * np.sum(qd**2, axis=1) + g * (1 + q[:, 1])
    full = g * (1 - np.cos(start))
    np.testing.assert_allclose(energy, np.where(after, e**2 * full, full), rtol=1e-8)
    np.testing.assert_allclose(run.event_losses, np.where(after, (1 - e**2) * full, 0.0), atol=1e-8)


def test_poissons_law():
    """A ball strikes one that lies on a floor: the floor gives its impulse back, which Newton's law cannot say."""
    m1, m2, v = 2.0, 3.0, 1.5
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * m1 * qd[0] ** 2 + 0.5 * m2 * qd[1] ** 2,
        constraints=(
            jms.Contact(lambda t, q, p: q[0], restitution=jms.Poisson(1.0), name="floor"),
            jms.Contact(lambda t, q, p: q[1] - q[0], restitution=jms.Poisson(0.0), name="balls"),
        ),
    )
    run = jms.simulate(scene, [0.0, 1.0], [0.0, -v], 1.0, ts=np.array([0.5, 1.0]), **TIGHT)
    np.testing.assert_allclose(run.qd[-1], m2 * v / (m1 + m2), rtol=1e-12)
    np.testing.assert_array_equal(run.mode["floor"], [1, 0])
    np.testing.assert_array_equal(run.mode["balls"], [0, 1])
    # Alone, a contact does as by Newton's law.
    ball = bouncing_ball.scene(e=0.5)
    ball = jms.Scene(
        ball.lagrangian, ball.params, constraints=(jms.Contact(lambda t, q, p: q[0], restitution=jms.Poisson(0.5)),)
    )
    run = jms.simulate(ball, [1.0], [0.0], 2.5, ts=np.array([1.1, 2.5]), **TIGHT)
    np.testing.assert_allclose(run.q[:, 0], bouncing_ball.motion(run.t, h=1.0, e=0.5)[0], atol=1e-11)


def _ball(t, q, qd, p):
    return 0.5 * p["m"] * qd[0] ** 2 - p["m"] * p["g"] * q[0]


def _over_a_rising_floor(t, q, p):
    return q[0] - p["rise"] * t


def _compliant_ball(law, m=1.0, g=9.81, rise=0.0):
    floor = jms.Contact(_over_a_rising_floor, restitution=law, name="floor")
    return jms.Scene(_ball, params={"m": m, "g": g, "rise": rise}, constraints=(floor,))


@pytest.mark.parametrize("law", [jms.HuntCrossley(1e3, 1.0, 0.2), jms.HuntCrossley(1e5, 1.5, 0.4)])
def test_a_compliant_contact_gives_back_what_its_closed_form_says(law):
    """In free flight against a floor that moves; energy is stored, lost and supplied, and all of it accounted for."""
    scene, e = _compliant_ball(law, m=2.0, g=0.0, rise=0.5), float(law.restitution(2.0))
    run = jms.simulate(scene, [0.1], [-1.5], 1.0, ts=np.linspace(0.0, 1.0, 41), **TIGHT)
    np.testing.assert_allclose(run.qd[-1, 0], 0.5 + 2.0 * e, rtol=1e-8)
    assert not run.mode
    np.testing.assert_allclose(run.energy.balance, 0.0, atol=1e-8)
    assert (np.diff(run.energy.dissipated) >= -1e-9).all()
    np.testing.assert_allclose(run.energy.dissipated[-1], 4.0 * (1.0 - e**2), rtol=1e-7)
    assert np.min(run.reactions["floor"].multiplier) >= 0.0


def test_the_coefficient_of_restitution_of_a_compliant_contact():
    """And its derivatives of first and second order: w = e y satisfies -w - log(1 - w) = y - log(1 + y)."""

    def coefficient(y):
        return jms.HuntCrossley(1.0, damping=y / 1.5).restitution(1.0)

    def exact(y):
        y = mpmath.mpf(y)
        c = y - mpmath.log1p(y)
        w = 1 - mpmath.exp(-1 - c) if y > 0.5 else y - 2 * y**2 / 3
        for _ in range(20):
            w += (w + mpmath.log1p(-w) + c) * (1 - w) / w
        slope = y * (1 - w) / ((1 + y) * w)
        bend = (1 - w) / ((1 + y) ** 2 * w) - y * slope / ((1 + y) * w**2)
        return w / y, slope / y - w / y**2, bend / y - 2 * slope / y**2 + 2 * w / y**3

    ours = jax.jit(lambda y: (coefficient(y), jax.grad(coefficient)(y), jax.grad(jax.grad(coefficient))(y)))
    with mpmath.workdps(100):
        for y in (1e-9, 1e-6, 2e-6, 1e-3, 0.1, 0.299, 0.301, 0.6, 3.0, 20.0, 100.0):
            np.testing.assert_allclose(ours(y), [float(x) for x in exact(y)], rtol=1e-11, err_msg=f"y = {y}")
    np.testing.assert_allclose(ours(0.0), [1.0, -2 / 3, 8 / 9], rtol=1e-14)
    np.testing.assert_allclose(ours(1e4), [1e-4, -1e-8, 2e-12], rtol=1e-14)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize(("rtol", "error"), [(1e-6, 1e-4), (1e-10, 1e-8)])
def test_derivatives_through_a_compliant_contact(derivative, rtol, error):
    """Of the velocity after a rebound: that of its closed form by speed and damping, and none by mass and stiffness."""

    def after(x):
        law = jms.HuntCrossley(x["stiffness"], 1.5, x["damping"])
        scene = _compliant_ball(law, m=x["m"], g=0.0)
        return jms.simulate(scene, [0.1], jnp.stack([-x["speed"]]), 1.0, throw=False, rtol=rtol, atol=1e-12).qd[-1, 0]

    def closed(x):
        return x["speed"] * jms.HuntCrossley(1.0, damping=x["damping"]).restitution(x["speed"])

    ours, exact = jax.jit(derivative(after)), jax.jit(jax.grad(closed))
    for stiffness in (1e4, 1e8, 1e12):
        at = {"stiffness": stiffness, "damping": 0.3, "m": 2.0, "speed": 1.5}
        found, right = ours(at), exact(at)
        for name, x in at.items():
            assert abs(found[name] - right[name]) * x < error, (stiffness, name)


def test_derivatives_of_random_rebounds():
    """By mass, stiffness, damping and speed, from 1e4 to 1e12 N/m^1.5, in free flight, against the closed form."""
    rng = np.random.default_rng(2)
    numbers = np.stack([rng.uniform(0.2, 3.0, 32), 10.0 ** rng.uniform(4, 12, 32), rng.uniform(0.0, 0.5, 32)], 1)
    numbers = np.concatenate([numbers, rng.uniform(0.5, 5.0, (32, 1))], axis=1)

    def after(x):
        scene = _compliant_ball(jms.HuntCrossley(x[1], damping=x[2]), m=x[0], g=0.0)
        return jms.simulate(scene, [0.1], -x[3:], 1.0, throw=False).qd[-1, 0]

    slopes = jax.jit(jax.vmap(jax.jacfwd(after)))(numbers)
    exact = jax.vmap(jax.jacfwd(lambda x: jms.HuntCrossley(x[1], damping=x[2]).restitution(x[3]) * x[3]))(numbers)
    size = np.max(np.abs(exact * numbers), axis=1)
    errors = np.max(np.abs(slopes - exact) * numbers, axis=1) / size
    assert np.median(errors) < 1e-5
    assert np.max(errors) < 5e-3


def test_a_compliant_contact_becomes_rigid_as_its_stiffness_grows():
    """It lasts as long as depth over speed, and the depth is `(m v^2/k)^(1/(n + 1))`: order 2/5 for n = 3/2."""
    law = jms.HuntCrossley(1.0, damping=0.2)
    e = float(law.restitution(np.sqrt(2 * 9.81)))
    exact = float(bouncing_ball.motion(jnp.asarray(0.8), h=1.0, e=e)[0])

    def error(k):
        scene = _compliant_ball(jms.HuntCrossley(k, damping=0.2))
        return abs(float(jms.simulate(scene, [1.0], [0.0], 0.8, rtol=1e-9, atol=1e-12).q[-1, 0]) - exact)

    errors = np.array([error(k) for k in (1e9, 1e11, 1e13)])
    np.testing.assert_allclose(np.log10(errors[:-1] / errors[1:]) / 2, 0.4, atol=0.01)


def test_friction_under_a_compliant_contact():
    """A block settled in a soft floor slides under its weight's friction, and stops."""
    law = jms.HuntCrossley(1e4, 1.0, 1.0)
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * jnp.sum(qd**2) - 9.81 * q[1],
        effects=(jms.Friction(jms.Coulomb(0.3), along=lambda q: q[0], normal_force="floor"),),
        constraints=(jms.Contact(lambda t, q, p: q[1], restitution=law, name="floor"),),
    )
    run = jms.simulate(scene, [0.0, -9.81e-4], [1.0, 0.0], 1.0, **TIGHT)
    np.testing.assert_allclose(run.q[-1], [1.0 / (2 * 0.3 * 9.81), -9.81e-4], rtol=1e-9)
    assert abs(run.qd[-1, 0]) < 1e-15


@pytest.mark.parametrize("e", [0.0, 1e-12, 0.5])
def test_restitution_down_to_none(e):
    run = jms.simulate(bouncing_ball.scene(e=e), [1.0], [0.0], 2.0)
    assert run.q[-1, 0] == run.qd[-1, 0] == 0
    assert run.mode["floor"][-1] == 1


def test_a_ball_comes_to_rest_in_single_precision():
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), bouncing_ball.scene(e=0.5))
    run = jms.simulate(scene, jnp.ones(1, jnp.float32), jnp.zeros(1, jnp.float32), 2.0)
    assert run.q.dtype == jnp.float32
    assert run.q[-1, 0] == run.qd[-1, 0] == 0


def test_an_impact_at_either_end_of_a_run():
    fall = float(np.sqrt(2 / 9.81))
    run = jms.simulate(bouncing_ball.scene(e=0.5), [1.0], [0.0], fall, **TIGHT)
    np.testing.assert_allclose(run.qd[-1, 0], 0.5 * 9.81 * fall, rtol=1e-12)
    run = jms.simulate(bouncing_ball.scene(e=0.5), [0.0], [-1.0], 0.05, **TIGHT)
    np.testing.assert_allclose(run.q[-1, 0], 0.5 * 0.05 - 0.5 * 9.81 * 0.05**2, rtol=1e-10)


def test_the_loss_of_an_impact_is_in_the_balance_at_a_saved_time_within_rounding_of_it():
    wall = jms.Contact(lambda t, q, p: q[0], restitution=0.5)
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, {}, constraints=(wall,))
    run = jms.simulate(scene, [0.2], [-1.0], 1.0, ts=0.2 * np.array([0.5, 1.0 - 4e-13, 1.0, 5.0]), **TIGHT)
    np.testing.assert_allclose(run.qd[:, 0], [-1.0, 0.5, 0.5, 0.5], atol=1e-12)
    np.testing.assert_allclose(run.event_losses, [0.0, 0.375, 0.375, 0.375], atol=1e-12)
    np.testing.assert_allclose(run.energy.balance, 0.0, atol=1e-12)
    # Early in a run the resolution of time is that of its end.
    early = jms.simulate(scene, [0.01], [-1.0], 1.0, ts=0.01 * np.array([0.5, 1.0 - 1e-11, 1.0, 5.0]), **TIGHT)
    np.testing.assert_allclose(early.qd[:, 0], [-1.0, 0.5, 0.5, 0.5], atol=1e-12)
    np.testing.assert_allclose(early.event_losses, [0.0, 0.375, 0.375, 0.375], atol=1e-12)


@pytest.mark.parametrize("law", [lambda e: e, jms.Poisson])
@pytest.mark.parametrize("e", [0.0, 0.6, 1.0])
def test_the_loss_of_an_impact_on_a_wall_that_moves_is_that_of_the_relative_motion(e, law):
    """The wall does the work that its impulse does at its velocity; a perfectly elastic blow loses nothing."""
    m, v, wall = 2.0, -1.5, 0.5
    scene = jms.Scene(
        _ball,
        params={"m": m, "g": 0.0, "rise": wall},
        constraints=(jms.Contact(_over_a_rising_floor, restitution=law(e), name="wall"),),
    )
    run = jms.simulate(scene, [0.1], [v], 1.0, ts=np.array([0.01, 1.0]), **TIGHT)
    after = wall + e * (wall - v)
    np.testing.assert_allclose(run.qd[-1, 0], after, rtol=1e-12)
    lost, work = 0.5 * m * (1 - e**2) * (wall - v) ** 2, m * (after - v) * wall
    np.testing.assert_allclose(run.event_losses, [0.0, lost], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(run.energy.dissipated, [0.0, lost], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(run.energy.work_in, [0.0, work], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(run.energy.balance, 0.0, atol=1e-12)
    audit = jms.energy_audit(run)
    np.testing.assert_allclose([audit.work["wall"][-1], audit.event_losses[-1]], [work, lost], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(jms.metrics.dissipated()(run), lost, rtol=1e-12, atol=1e-12)


def test_a_saved_time_and_an_end_at_an_impact_hold_the_state_after_it():
    """At the default tolerances, at impacts of the closed form and at those that a run has noted."""
    for h, e in ((1.0, 0.5), (0.37, 0.8), (20.0, 0.3)):
        fall = np.sqrt(2 * h / 9.81)
        strikes = fall * np.cumsum([1.0, *(2 * e ** np.arange(1, 6))])
        after = 9.81 * fall * e ** np.arange(1, 7)
        scene = bouncing_ball.scene(e=e)
        saved = jms.simulate(scene, [h], [0.0], strikes[-1], ts=strikes, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(saved.qd[:, 0], after, rtol=1e-8)
        np.testing.assert_allclose(saved.q[:, 0], 0.0, atol=1e-11)
        np.testing.assert_allclose(saved.mode_changes[-1].t, strikes[-1], rtol=1e-11)
        for t, v in zip(strikes, after, strict=True):
            np.testing.assert_allclose(jms.simulate(scene, [h], [0.0], t).qd[-1, 0], v, rtol=1e-8)
    table = vibrating_table.scene(e=0.8)
    times = [change.t for change in jms.simulate(table, [0.02], [0.0], 0.5).mode_changes]
    assert len(times) > 5
    saved = jms.simulate(table, [0.02], [0.0], 0.5, ts=np.repeat(times, 2) - np.tile([1e-10, 0.0], len(times)))
    p = vibrating_table.PARAMS
    before, after = (saved.qd[:, 0] - p["A"] * p["omega"] * jnp.cos(p["omega"] * saved.t)).reshape(-1, 2).T
    np.testing.assert_allclose(after, -0.8 * before, rtol=1e-6)


@pytest.mark.quick
def test_wrong_contacts_are_refused():
    with pytest.raises(ValueError, match="restitution must be"):
        jms.Contact(lambda t, q, p: q[0], restitution=1.5)
    with pytest.raises(ValueError, match="Contact gap must be a function"):
        jms.Contact(1.0)
    with pytest.raises(ValueError, match="HuntCrossley: stiffness must be finite and > 0"):
        jms.HuntCrossley(0.0)
    with pytest.raises(ValueError, match="Poisson: e must be finite and >= 0 and <= 1"):
        jms.Poisson(1.5)
    with pytest.raises(ValueError, match="end_stops needs lower, upper or both"):
        jms.end_stops(lambda q: q[0])
    with pytest.raises(ValueError, match="backlash along must be a function"):
        jms.backlash(0.1, 0.2)
    mixed = jms.Contact(lambda t, q, p: q[0]), jms.Contact(lambda t, q, p: q[0], restitution=jms.Poisson(0.5))
    with pytest.raises(ValueError, match="one law of impact"):
        jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, constraints=mixed)
    with pytest.raises(ValueError, match="7 contacts, but impacts of no more than 6"):
        jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, constraints=7 * (jms.Contact(lambda t, q, p: q[0]),))
    pair = jms.Contact(lambda t, q, p: jnp.stack([q[0], q[0]]), name="floor")
    lagrangian = bouncing_ball.scene(e=0.5).lagrangian
    with pytest.raises(ValueError, match=r"'floor'.*one number"):
        jms.simulate(jms.Scene(lagrangian, params={"m": 1.0, "g": 9.81}, constraints=(pair,)), [1.0], [0.0], 1.0)
    with pytest.raises(ValueError, match=r"takes no events, by which .* changes: use another solver"):
        jms.simulate(bouncing_ball.scene(e=0.5), [1.0], [0.0], 1.0, dt=1e-3, solver=jms.ImplicitFriction())
    with pytest.raises(jms.SimulationError, match="gap is negative"):
        jms.simulate(bouncing_ball.scene(e=0.5), [-0.1], [0.0], 1.0)
