"""The ramped box under each law and way to run it, against its closed forms and published numbers."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim import problems

STEP = 0.01
TS = np.linspace(0.0, 10.0, 1001)


def run(law: Any, ramp: float = 1.0, v0: float = 0.0, t1: float = 10.0, **arguments: Any) -> jms.Trajectory:
    times = jnp.asarray(TS[: round(t1 / STEP) + 1])
    return jms.simulate(problems.ramped_box.scene(law, ramp=ramp), [0.0], [v0], t1, ts=times, **arguments)


def fixed(law: Any, **arguments: Any) -> jms.Trajectory:
    """With the exercise's own fixed step and the simplest method, so that each step is a sample."""
    return run(law, dt=STEP, solver=dfx.Euler(), **arguments)


def crossings(v: Any) -> np.ndarray:
    """Indices of samples before which the velocity changed its sign."""
    sign = np.sign(np.asarray(v))
    return 1 + np.flatnonzero(sign[1:] * sign[:-1] < 0)


# (e) LuGre


@pytest.mark.quick
def test_lugre_ends_where_four_solvers_agree() -> None:
    end = run(problems.ramped_box.lugre(), rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(end.qd[-1, 0], problems.ramped_box.LUGRE_V10, rtol=1e-6)
    np.testing.assert_allclose(end.z["friction"][-1], problems.ramped_box.LUGRE_Z10, rtol=1e-6)


def stick_oscillation(**changes: float) -> tuple[float, float, int, float]:
    """Mean square [N^2] of friction about the applied force from 0.2 to 0.6 s and from 0.6 to 1 s; how often the box
    overtakes the bristle's creep until 1 s; and how far the bristle has given way by then [m].

    Quasi-static creep is 1/(sigma0 (1 - t/Fs)), as the bristle yields the more the further it is loaded. A swing
    begins with the force amplitude sqrt(m/sigma0), 0.052 N on the box.
    """
    motion = run(problems.ramped_box.lugre(**changes), rtol=1e-8, atol=1e-12)
    error = (np.asarray(motion.forces["friction"]) - TS) ** 2
    creep = 1.0 / (changes.get("sigma0", 750.0) * (1.0 - TS[:101] / 1.75))
    overtakes = len(crossings(np.asarray(motion.qd[:101, 0]) - creep))
    return float(error[20:60].mean()), float(error[60:100].mean()), overtakes, float(motion.q[100, 0])


def test_stick_oscillations_of_lugre_are_damped_by_sigma1() -> None:
    """Bristle damping adds a decay of energy by exp(-sigma1 t/m), and is critical at 2 sqrt(m sigma0) = 77.5."""
    plain, weak, critical = (stick_oscillation(sigma1=s) for s in (0.0, 10.0, 77.5))
    assert plain[0] > 0.5 * 0.052**2 / 2  # hardly damped by the law itself
    assert plain[2] >= 5
    # exp(-5 t) over the first window is 0.15 on average; the drift of the creep is in it as well.
    assert weak[0] < 0.25 * plain[0]
    assert critical[0] < 0.02 * plain[0]
    assert critical[2] == 0


def test_stick_oscillations_of_lugre_are_damped_by_a_smaller_sigma0() -> None:
    """Slower swings, which die out within fewer; the price is a bristle that gives way ten times further."""
    stiff, soft = stick_oscillation(), stick_oscillation(sigma0=75.0)
    assert soft[1] / soft[0] < 0.25 * stiff[1] / stiff[0]
    assert soft[2] < stiff[2]
    np.testing.assert_allclose(soft[3] / stiff[3], 10.0, rtol=0.1)


# (a) Coulomb by sign(v)

COULOMB = problems.ramped_box.coulomb()


def test_sign_stops_an_adaptive_run() -> None:
    with pytest.raises(jms.SimulationError, match=r"step limit|step size fell below"):
        run(jms.Sign(COULOMB), v0=-1.0, max_steps=2000)


def test_sign_chatters_at_a_fixed_step_until_the_force_exceeds_friction() -> None:
    slow, fast = fixed(jms.Sign(COULOMB), ramp=1.0), fixed(jms.Sign(COULOMB), ramp=3.0)
    until = []
    for motion, ramp in ((slow, 1.0), (fast, 3.0)):
        v = np.asarray(motion.qd[:, 0])
        changes = crossings(v)
        until.append(TS[changes[-1]])
        # Each step changes v by up to (Fa + Fc)/m times the step, and that is how far it strays from zero.
        stray = 2 * 1.5 / 2.0 * STEP
        assert np.abs(v[: changes[-1]]).max() <= stray
        # A stray is won back at (Fc - Fa)/m, which near Fa = Fc takes until Fa = Fc itself: not before ...
        won_back = np.sqrt(2 * stray * 2.0 / ramp)
        assert 1.5 / ramp - won_back - 2 * STEP < until[-1] < 1.5 / ramp + STEP
        # ... but up to Fc/4 one step of 5/8 Fc/m and at most 5/3 steps of 3/8 Fc/m make a cycle: chatter, not stick.
        early = round(0.25 * 1.5 / ramp / STEP)
        assert np.count_nonzero(changes <= early) > 0.7 * early
    assert until[0] > 2.5 * until[1]


# (c) Karnopp with a dead zone


def released(t: Any, v0: float = 0.0) -> np.ndarray:
    """Velocity of a box that is held at v0 until the force t exceeds 1.5 N, and slips from there on."""
    t = np.asarray(t)
    return v0 + np.where(t > 1.5, (t - 1.5) ** 2 / 4.0, 0.0)


def test_dead_zone_holds_until_the_force_exceeds_friction() -> None:
    motion = fixed(jms.DeadZone(COULOMB, width=1.0))
    held = TS <= 1.5
    np.testing.assert_array_equal(motion.qd[held], 0.0)
    np.testing.assert_allclose(motion.forces["friction"][held], TS[held], rtol=1e-12)  # equal to the applied force
    np.testing.assert_allclose(motion.forces["friction"][~held], 1.5, rtol=1e-12)
    # Euler's error of an accelerated motion: the step times half of the final acceleration.
    np.testing.assert_allclose(motion.qd[:, 0], released(TS), atol=0.5 * STEP * 4.25 * 1.01)


def test_dead_zone_entered_from_below_keeps_the_velocity_of_its_edge() -> None:
    motion = fixed(jms.DeadZone(COULOMB, width=1.0), v0=-2.0)
    v = np.asarray(motion.qd[:, 0])
    # Slip to -1: -2 + (1.5 t + t^2/2)/2 = -1 at t = sqrt(6.25) - 1.5 = 1; until 1.5 s it is held there.
    inside = (TS > 1.0 + 2 * STEP) & (TS < 1.5)
    assert np.ptp(v[inside]) == 0.0
    assert -1.0 <= v[inside][0] <= -1.0 + (1.5 + 1.0) / 2.0 * STEP  # the step that crossed the edge overshoots it
    assert v[TS <= 1.0 - 2 * STEP].max() < -1.0
    np.testing.assert_allclose(v[TS > 1.5], released(TS[TS > 1.5], v[inside][0]), atol=0.5 * STEP * 4.25 * 1.01)


def test_small_dead_zone_brings_the_chatter_back() -> None:
    """A band narrower than a step's change of velocity, here (1.5 N + Fa)/m times the step, is stepped over."""
    wide, narrow = (fixed(jms.DeadZone(COULOMB, width=w), v0=-0.5) for w in (0.02, 1e-4))
    assert len(crossings(wide.qd[:, 0])) <= 1
    assert len(crossings(narrow.qd[:, 0])) > 10
    # The box comes to a stop at 0.56 s: -0.5 + (1.5 t + t^2/2)/2 = 0. The chatter is far larger than the band.
    first = crossings(narrow.qd[:, 0])[0]
    np.testing.assert_allclose(TS[first], 0.5616, atol=2 * STEP)
    assert np.abs(narrow.qd[first : first + 10, 0]).max() > 10 * 1e-4


# (d) Stiction, Stribeck and viscous friction

STRIBECK = problems.ramped_box.stribeck()


@pytest.mark.parametrize("law", [jms.DeadZone(STRIBECK, 1e-2), jms.Regularized(STRIBECK, 1e-5)], ids=["held", "smooth"])
def test_stiction_holds_then_drops_then_rises(law: Any) -> None:
    held_by_dead_zone = isinstance(law, jms.DeadZone)
    motion = fixed(law) if held_by_dead_zone else run(law)
    v, force = np.asarray(motion.qd[:, 0]), np.asarray(motion.forces["friction"])
    stick = TS < 1.745
    if held_by_dead_zone:
        np.testing.assert_array_equal(v[stick], 0.0)
        np.testing.assert_allclose(force[stick], TS[stick], rtol=1e-12)
    else:
        # Creep by width atanh(Fa/Fs), which is where the smooth law carries the load; nearer to Fs inertia lags.
        early = TS < 1.5
        np.testing.assert_allclose(v[early], 1e-5 * np.arctanh(TS[early] / 1.75), atol=1e-8)
        np.testing.assert_allclose(force[early], TS[early], atol=1e-8 * 1.75 / 1e-5)
        assert v[stick].max() < 1e-4
        assert v[round(1.80 / STEP)] > 1e-4
    # Breaks away at 1.75 s; a fixed step needs a few more to leave the band of 1e-2 m/s.
    slip = TS > 2.6
    lowest = np.argmin(np.where(TS > 1.75, force, np.inf))
    assert 1.75 < TS[lowest] < 3.2
    assert force[lowest] < 1.57  # below 1.5 + Stribeck's rest + viscous part of a few 0.1 m/s, from 1.75
    assert (np.diff(force[lowest:]) > 0).all()
    np.testing.assert_allclose(force[slip], 1.5 + 0.25 * np.exp(-((v[slip] / 0.2) ** 2)) + 0.1 * v[slip], rtol=1e-9)


def test_bristle_under_constant_slip_follows_its_closed_form() -> None:
    ts = jnp.linspace(0.0, 1.0, 11)
    law = problems.ramped_box.lugre()
    for v, z0 in ((0.01, 0.0), (-0.03, 1e-3)):
        motion = jms.simulate(
            problems.bristles.slipping_bristle(law, v),
            [0.0],
            [0.0],
            1.0,
            ts=ts,
            z0={"friction": z0},
            rtol=1e-10,
            atol=1e-14,
        )
        exact = problems.bristles.deflection(ts, law, v, z0=z0)
        np.testing.assert_allclose(motion.z["friction"], exact, rtol=1e-8)
        stepped = jax.vmap(lambda t, v=v, z0=z0: law.step_exact(jnp.asarray(v), jnp.asarray(z0), t))(ts)
        np.testing.assert_allclose(stepped, exact, rtol=1e-13)


def test_braked_spring_comes_to_rest_as_coulomb_says() -> None:
    """A smooth law of width w slips at up to w where the exact one rests, and errs by the like on the way."""
    width = 1e-4
    law = jms.Regularized(jms.Coulomb(problems.braked_spring.PARAMS["Fc"]), width)
    ts = jnp.linspace(0.0, 26.0, 53)
    motion = jms.simulate(problems.braked_spring.scene(law), [1.0], [0.0], 26.0, ts=ts, rtol=1e-8, atol=1e-10)
    x, v = problems.braked_spring.motion(
        ts, **{**problems.braked_spring.PARAMS, "Fs": problems.braked_spring.PARAMS["Fc"]}
    )
    np.testing.assert_allclose(motion.q[:, 0], x, atol=2 * width)
    np.testing.assert_allclose(motion.qd[:, 0], v, atol=2 * width)


# Two elements that hold


def pull_second(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return jnp.stack([0.0 * p["F"], p["F"]])


def stacked(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A box on a box on the ground: the upper one rubs on the lower, the lower on the ground."""
    del t, q
    return 0.5 * (p["m1"] * qd[0] ** 2 + p["m2"] * qd[1] ** 2)


def stacked_scene(pull: float, upper: float = 1.0, lower: float = 3.0) -> jms.Scene:
    """`pull` acts on the upper box (q[1]); friction couples both through the mass matrix."""
    return jms.Scene(
        stacked,
        params={"m1": 2.0, "m2": 0.5, "F": pull},
        effects=(
            jms.AppliedForce(pull_second),
            jms.Friction(jms.DeadZone(jms.Coulomb(lower), 1e-3), along=lambda q: q[0], name="ground"),
            jms.Friction(jms.DeadZone(jms.Coulomb(upper), 1e-3), along=lambda q: q[1] - q[0], name="between"),
        ),
    )


STACK = stacked_scene(0.0)


@pytest.mark.parametrize(
    ("pull", "ground", "between", "rates"),
    [
        # Everything rests, and each surface passes the pull on.
        (0.7, 0.7, 0.7, (0.0, 0.0)),
        (-0.7, -0.7, -0.7, (0.0, 0.0)),
        # The upper box slips: the lower one carries only what friction gives.
        (1.6, 1.0, 1.0, (0.0, 0.6 / 0.5)),
        (-1.6, -1.0, -1.0, (0.0, -0.6 / 0.5)),
    ],
)
def test_two_coupled_elements_hold_consistently(pull: float, ground: float, between: float, rates: Any) -> None:
    scene = jax.tree.unflatten(jax.tree.structure(STACK), jax.tree.leaves(stacked_scene(pull)))
    motion = jms.simulate(scene, [0.0, 0.0], [0.0, 0.0], 0.5, ts=jnp.array([0.0, 0.5]), dt=0.01, solver=dfx.Euler())
    # The sweeps over the two elements converge by a factor of m2/(m1 + m2) = 0.2 or better each.
    np.testing.assert_allclose(motion.forces["ground"], ground, atol=1e-12)
    np.testing.assert_allclose(motion.forces["between"], between, atol=1e-12)
    np.testing.assert_allclose(motion.qd[-1], 0.5 * np.array(rates), atol=1e-12)


def test_upper_box_carries_the_lower_one_along() -> None:
    """Weak ground: both move as one with (F - lower)/(m1 + m2), and the force between is what the lower one needs."""
    scene = jax.tree.unflatten(jax.tree.structure(STACK), jax.tree.leaves(stacked_scene(0.7, lower=0.2)))
    motion = jms.simulate(scene, [0.0, 0.0], [0.0, 0.0], 0.5, ts=jnp.array([0.0, 0.5]), dt=0.01, solver=dfx.Euler())
    np.testing.assert_allclose(motion.forces["ground"], 0.2, rtol=1e-12)
    np.testing.assert_allclose(motion.forces["between"], 0.2 + 2.0 * 0.5 / 2.5, rtol=1e-12)
    np.testing.assert_allclose(motion.qd[-1], 0.5 * 0.5 / 2.5, rtol=1e-12)
