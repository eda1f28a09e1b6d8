import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxmodsim as jms
from jaxmodsim.mechanics import Contact
from jaxmodsim.orbits import OrbitError, continue_bifurcation

from ..problems import vibrating_table


def spring(_t, q, qd, p):
    return 0.5 * qd[0] ** 2 - 0.5 * q[0] ** 2 - 0.25 * p["a"] * q[0] ** 4


def swing(t, _q, _qd, p):
    return jnp.array([jnp.cos(p["W"] * t)])


def of_frequency(p):
    return 2.0 * jnp.pi / p["W"]


def duffing(W):
    effects = (jms.AppliedForce(swing), jms.Friction(jms.Viscous(0.1)))
    return jms.Scene(spring, params={"a": 0.05, "W": W}, effects=effects)


def table_period(p):
    return 2.0 * jnp.pi / p["omega"]


BALL = {**vibrating_table.PARAMS, "A": 0.9e-3}


@pytest.fixture(scope="module")
def ball():
    """One bounce a period, in closed form but for the last digits."""
    T = 2 * np.pi / BALL["omega"]
    phase = float(vibrating_table.bounce_phase(**{k: BALL[k] for k in ("g", "A", "omega", "e")}))
    since = T - phase / BALL["omega"]
    q0, qd0 = BALL["A"] * np.sin(phase) + BALL["g"] * since * (T - since) / 2, BALL["g"] * (T / 2 - since)
    return jms.periodic_orbit(vibrating_table.scene(**BALL), ([q0], [qd0]), period=table_period, settle=0.0)


def ball_branch(ball, guess, to, **options):
    return jms.continue_orbits(
        vibrating_table.scene(**BALL), guess or ball, "A", (BALL["A"], to), period=table_period, **options
    )


def test_period_doubling_of_the_ball_is_that_of_its_closed_form(ball):
    branch = ball_branch(ball, None, 0.95e-3, step=0.1)
    (point,) = branch.points
    g, omega, e = BALL["g"], BALL["omega"], BALL["e"]
    table = np.pi * g * (1 - e) / ((1 + e) * omega)
    exact = np.hypot(2 * (1 + e**2) * g / (1 + e) ** 2 / omega**2, table / omega)
    assert point.kind == "period doubling"
    np.testing.assert_allclose(point.value, exact, rtol=1e-8)
    assert list(branch.stable) == [x < exact for x in branch.values]
    # Over the restitution it is followed as exactly.
    scene, span = vibrating_table.scene(**BALL), (BALL["e"], 0.7)
    curve = continue_bifurcation(scene, point, ("A", "table.restitution"), span, period=table_period, step=0.3)
    A, e = curve.values.T
    table = np.pi * g * (1 - e) / ((1 + e) * omega)
    np.testing.assert_allclose(A, np.hypot(2 * (1 + e**2) * g / (1 + e) ** 2 / omega, table) / omega, rtol=1e-8)
    assert e[-1] > 0.7
    assert "period doubling" in str(curve)
    # Two bounces in two periods branch off there, and are stable.
    doubled = ball_branch(ball, point, 0.95e-3, step=0.1)
    orbit = doubled.orbits[-1]
    np.testing.assert_allclose(orbit.period, 2 * ball.period)
    assert orbit.sequence == (("table", "open", "open"),) * 2
    assert orbit.stable
    with pytest.raises(ValueError, match="starts at a period doubling"):
        ball_branch(ball, ball_branch(ball, None, 0.5e-3, step=0.1).points[0], 1e-3)


def test_fold_of_the_ball_is_that_of_its_closed_form(ball):
    # Where the table moves just fast enough: the bounce passes through the start of the period there.
    branch = ball_branch(ball, None, 0.5e-3, step=0.1)
    (point,) = branch.points
    g, omega, e = BALL["g"], BALL["omega"], BALL["e"]
    assert point.kind == "fold"
    np.testing.assert_allclose(point.value, np.pi * g * (1 - e) / ((1 + e) * omega**2), rtol=1e-8)
    assert "end of the span" in branch.ending
    assert not branch.stable[-1]
    scene, span = vibrating_table.scene(**BALL), (omega, 1.1 * omega)
    curve = continue_bifurcation(scene, point, ("A", "omega"), span, period=table_period, step=0.3)
    A, omega = curve.values.T
    np.testing.assert_allclose(A, np.pi * g * (1 - e) / ((1 + e) * omega**2), rtol=1e-8)
    with pytest.raises(ValueError, match="parameters must be the names of two"):
        continue_bifurcation(scene, point, ("A", "A"), span, period=table_period)
    with pytest.raises(ValueError, match="point must be a bifurcation of a branch: fold,"):
        continue_bifurcation(
            scene, dataclasses.replace(point, kind="grazing"), ("A", "omega"), span, period=table_period
        )


def test_branch_of_a_forced_oscillator_with_dry_friction_and_its_loss_of_stick():
    effects = (jms.AppliedForce(swing), jms.Friction(jms.Coulomb(0.5)), jms.Friction(jms.Viscous(0.1)))
    scene = jms.Scene(spring, params={"a": 0.0, "W": 0.55}, effects=effects)
    branch = jms.continue_orbits(scene, ([0.0], [0.0]), "W", (0.55, 0.7), period=of_frequency, step=0.25)
    (point,) = branch.points
    assert point.kind == "loss of stick"
    assert point.orbit.stick["friction"] < 1e-4
    for value, orbit in zip(branch.values, branch.orbits, strict=True):
        assert (orbit.stick["friction"] > 0) == (value < point.value)
        np.testing.assert_allclose(orbit.period, 2 * np.pi / value)
        assert orbit.residual < 1e-9
    assert branch.stable.all()
    assert "loss of stick" in str(branch)


def test_onset_of_stick_is_where_the_closed_form_without_stick_fails():
    W = 0.7
    friction = jms.Friction(jms.Coulomb(0.7))
    scene = jms.Scene(spring, params={"a": 0.0, "W": W}, effects=(jms.AppliedForce(swing), friction))
    branch = jms.continue_orbits(
        scene, ([0.0], [0.0]), "friction.Fc", (0.7, 0.74), period=of_frequency, settle=900.0, step=0.2
    )
    (point,) = branch.points
    # Behind a turning point the acceleration is W^2 amplitude - Fc, with Den Hartog's amplitude; stick where it ends.
    V, U = 1 / (1 - W**2), np.sin(np.pi / W) / (W * (1 + np.cos(np.pi / W)))
    assert point.kind == "onset of stick"
    np.testing.assert_allclose(point.value, V * W**2 / np.sqrt(1 + W**4 * U**2), rtol=1e-6)


def van_der_pol_force(t, q, qd, p):
    return jnp.array([(1.0 - q[0] ** 2) * qd[0] + p["F"] * jnp.cos(p["W"] * t)])


def test_neimark_sacker_point_of_a_forced_van_der_pol_oscillator():
    effects = (jms.AppliedForce(van_der_pol_force),)
    scene = jms.Scene(spring, params={"a": 0.0, "F": 5.0, "W": 1.7}, effects=effects)
    branch = jms.continue_orbits(scene, ([0.0], [0.0]), "F", (5.0, 2.0), period=of_frequency, step=0.1)
    (point,) = branch.points
    assert point.kind == "Neimark-Sacker"
    assert list(branch.stable) == [x > point.value for x in branch.values]
    np.testing.assert_allclose(np.abs(point.orbit.multipliers), 1.0, atol=1e-8)
    assert np.min(np.abs(np.imag(point.orbit.multipliers))) > 0.1
    # By Liouville's formula their product is 1 where the mean of q^2 is, in a second solver too.
    orbit, T = point.orbit, 2 * np.pi / 1.7
    t = np.linspace(0.0, T, 400, endpoint=False)
    second = solve_ivp(
        lambda t, y: [y[1], (1 - y[0] ** 2) * y[1] - y[0] + point.value * np.cos(1.7 * t)],
        *((0.0, T), [orbit.q[0], orbit.qd[0]], "DOP853", [*t, T]), rtol=1e-12, atol=1e-13,
    )  # fmt: skip
    np.testing.assert_allclose(np.mean(second.y[0, :-1] ** 2), 1.0, rtol=1e-7)
    np.testing.assert_allclose(second.y[:, -1], second.y[:, 0], atol=1e-8)


def soft(_t, q, qd, p):
    spring = 0.5 * q[0] ** 2 - q[0] ** 3 / 3
    return 0.5 * qd[0] ** 2 - spring + 0.5 * qd[1] ** 2 - 0.5 * p["W"] ** 2 * q[1] ** 2


def excited(_t, q, qd, p):
    swing = qd[1] / p["W"]
    return jnp.stack([p["F"] * q[1] - 0.1 * qd[0], p["W"] * (1 - q[1] ** 2 - swing**2) * qd[1]])


def test_period_doubling_of_an_orbit_of_unknown_period():
    # A soft spring (Thompson's escape equation) under a self-excited oscillator, whose limit cycle is sin(W t).
    W, span = 0.85, (0.095, 0.102)
    scene = jms.Scene(soft, params={"F": 0.095, "W": W}, effects=(jms.AppliedForce(excited),))
    branch = jms.continue_orbits(scene, ([-0.074, 0.0], [-0.552, W]), "F", span, settle=300.0, step=0.3)
    (point,) = branch.points
    assert point.kind == "period doubling"
    assert list(branch.stable) == [point.value > F for F in branch.values]
    doubled = jms.continue_orbits(scene, point, "F", span, step=0.2, max_orbits=3)
    orbit, F, T = doubled.orbits[-1], doubled.values[-1], 2 * np.pi / W
    assert point.value < F
    assert orbit.stable
    np.testing.assert_allclose(orbit.period, 2 * T, rtol=1e-9)

    def second(F, start, time):
        """Under a force that is given, by another solver."""
        q, at = start.q, np.arctan2(start.q[1] * W, start.qd[1])
        return solve_ivp(
            lambda t, y: [y[1], -y[0] + y[0] ** 2 - 0.1 * y[1] + F * np.sin(W * t + at)],
            *((0.0, time), [q[0], start.qd[0]], "DOP853"), rtol=1e-12, atol=1e-13,
        ).y[:, -1]  # fmt: skip

    start = np.array([orbit.q[0], orbit.qd[0]])
    np.testing.assert_allclose(second(F, orbit, 2 * T), start, atol=1e-8)
    assert np.max(np.abs(second(F, orbit, T) - start)) > 1e-3
    np.testing.assert_allclose(second(point.value, point.orbit, T), [point.orbit.q[0], point.orbit.qd[0]], atol=1e-8)
    np.testing.assert_allclose(np.min(np.real(point.orbit.multipliers)), -1.0, atol=1e-8)


def buckling(_t, q, qd, p):
    return 0.5 * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2 - 0.25 * q[0] ** 4


def pulsing_damper(t, _q, qd, _p):
    return -(1.0 + 0.5 * jnp.cos(t)) * qd


def test_branch_point_where_a_spring_buckles():
    scene = jms.Scene(buckling, params={"k": 0.2}, effects=(jms.AppliedForce(pulsing_damper),))
    branch = jms.continue_orbits(scene, ([0.0], [0.0]), "k", (0.2, -0.2), period=2 * np.pi, settle=0.0, step=0.3)
    (point,) = branch.points
    assert point.kind == "branch point"
    np.testing.assert_allclose(point.value, 0.0, atol=1e-8)
    # Without a spring velocities decay by the mean of the damping, and positions stay.
    np.testing.assert_allclose(np.sort(np.real(point.orbit.multipliers)), [np.exp(-2 * np.pi), 1.0], rtol=1e-7)
    assert list(branch.stable) == [k > 0 for k in branch.values]


def gap_to_the_stop(_t, q, p):
    return p["stop"] - q[0]


def test_grazing_is_where_the_amplitude_without_impacts_reaches_the_stop():
    W, c = 0.8, 0.3
    amplitude = 1 / np.hypot(1 - W**2, c * W)
    effects = (jms.AppliedForce(swing), jms.Friction(jms.Viscous(c)))
    stop = Contact(gap_to_the_stop, restitution=0.5, name="stop")
    scene = jms.Scene(spring, params={"a": 0.0, "W": W, "stop": 3.0}, effects=effects, constraints=(stop,))
    span = (amplitude + 0.01, amplitude - 0.01)
    branch = jms.continue_orbits(scene, ([0.0], [0.0]), "stop", span, period=of_frequency, settle=200.0, step=0.3)
    (point,) = branch.points
    assert point.kind == "grazing"
    np.testing.assert_allclose(point.value, amplitude, rtol=1e-7)
    assert list(branch.stable) == [x > amplitude for x in branch.values]


def test_mode_changes_that_swap_their_order_are_no_grazing():
    """Two oscillators of one damping pass zero at once where their stiffnesses are equal."""

    def two(_t, q, qd, p):
        return 0.5 * jnp.sum(qd**2) - 0.5 * (3.0 * q[0] ** 2 + p["k"] * q[1] ** 2)

    def force(t, _q, qd, p):
        return jnp.cos(p["W"] * t) - 0.4 * qd

    gates = [jms.Switch(lambda _t, q, _qd, _p, i=i: q[i], name=f"gate_{i}") for i in range(2)]
    scene = jms.Scene(two, params={"k": 3.2, "W": 1.0}, effects=(jms.AppliedForce(force), *gates))
    branch = jms.continue_orbits(
        scene, ([0.5, 0.5], [0.0, 0.0]), "k", (3.2, 2.8), period=of_frequency, settle=60.0, step=0.3
    )
    assert {point.kind for point in branch.points} == {"order of modes"}
    np.testing.assert_allclose([point.value for point in branch.points], 3.0, rtol=1e-6)


def test_folds_of_duffing_and_a_branch_that_resumes_from_its_store(tmp_path):
    def follow(**options):
        return jms.continue_orbits(
            duffing(0.8), ([0.0], [0.0]), "W", (0.8, 2.2), period=of_frequency, step=0.1, **options
        )

    whole = follow()
    assert [each.kind for each in whole.points] == ["fold", "fold"]
    between = slice(whole.points[0].index + 1, whole.points[1].index + 1)
    assert not whole.stable[between].any()
    assert whole.stable[: between.start].all()
    for point in whole.points:
        np.testing.assert_allclose(np.min(np.abs(point.orbit.multipliers - 1.0)), 0.0, atol=1e-5)
    # One of them over the hardening of the spring, against branches at other values of it.
    fold = whole.points[0]
    curve = continue_bifurcation(duffing(0.8), fold, ("W", "a"), (0.05, 0.07), period=of_frequency, step=0.5)
    i = len(curve.orbits) // 2
    (W, a), nearby = curve.values[i], (curve.orbits[i].q, curve.orbits[i].qd)
    scene = jms.Scene(spring, params={"a": a, "W": W}, effects=duffing(W).effects)
    span = (W - 0.05, W + 0.05)
    branch = jms.continue_orbits(scene, nearby, "W", span, period=of_frequency, step=0.5)
    at = [x.value for x in branch.points if x.kind == "fold"]
    np.testing.assert_allclose(at, [W], rtol=1e-8)
    assert 0.05 < a < 0.07
    seen = []
    follow(out=tmp_path / "duffing", max_orbits=len(whole.values) // 2, progress=lambda count, _: seen.append(count))
    # As a process leaves it that is killed while it writes.
    (tmp_path / "duffing").rename(tmp_path / ".duffing.before")
    rest = []
    again = follow(out=tmp_path / "duffing", progress=lambda count, _: rest.append(count))
    assert rest[0] == seen[-1] + 1
    np.testing.assert_allclose([x.value for x in again.points], [x.value for x in whole.points], rtol=1e-7)
    with pytest.raises(ValueError, match="holds another branch, which differs in: span"):
        jms.continue_orbits(
            duffing(0.8), ([0.0], [0.0]), "W", (0.8, 2.0), period=of_frequency, out=tmp_path / "duffing"
        )
    (tmp_path / "other").mkdir()
    with pytest.raises(ValueError, match="is no store of a branch"):
        follow(out=tmp_path / "other")


def test_garbage_is_refused():
    scene = duffing(0.8)
    start = ([0.0], [0.0])
    with pytest.raises(ValueError, match="Did you mean 'friction"):
        jms.continue_orbits(scene, start, "friction.Fc", (0.1, 0.2), period=of_frequency)
    with pytest.raises(ValueError, match=r"span must be \(first, last\)"):
        jms.continue_orbits(scene, start, "W", (0.1, 0.2, 0.3), period=of_frequency)
    with pytest.raises(ValueError, match="two different values"):
        jms.continue_orbits(scene, start, "W", (0.1, 0.1), period=of_frequency)
    with pytest.raises(ValueError, match="step must be one finite number > 0"):
        jms.continue_orbits(scene, start, "W", (0.1, 0.2), period=of_frequency, step=0.0)


def test_a_guess_below_the_table_is_refused(ball):
    with pytest.raises(OrbitError):
        ball_branch(ball, ([-1.0], [0.0]), 1e-3)
