"""Contacts on which impacts accumulate: against sums of flights, in value and derivative, and what is refused early."""
# ruff: noqa: ARG001 (Lagrangians, gaps and forces have all their arguments, used or not)

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.scene import State, replace_elements
from jaxmodsim.simulation import MAX_STEPS, outcome_messages
from jaxmodsim.simulation._outcome import PENETRATES, describe_failure
from jaxmodsim.simulation._solve import compiled_runs
from tests.helpers.impacts import ball_on_table, mass_in_a_dry_box

from ..problems import vibrating_table

TIGHT: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-12}


def _thrown(t, q, qd, p):
    return 0.5 * jnp.sum(qd**2) - 9.81 * q[1]


def _rough(e, mu=0.3):
    friction = jms.Friction(jms.Coulomb(mu), along=lambda q: q[0], normal_force="floor")
    return jms.Scene(_thrown, effects=(friction,), constraints=(jms.Contact(_over, restitution=e, name="floor"),))


def _over(t, q, p):
    return q[1]


# Amplitude [m], frequency [rad/s], restitution, drop [m].
TABLES = [
    (2e-3, 20.0, 0.3, 0.5), (2e-3, 20.0, 0.5, 0.5), (2e-3, 20.0, 0.7, 0.5), (1e-4, 200.0, 0.6, 0.1),
    (0.05, 5.0, 0.8, 1.0), (1e-6, 50.0, 0.5, 0.01), (0.3, 3.0, 0.2, 2.0), (2e-3, 20.0, 0.02, 0.5),
    (0.0, 20.0, 0.7, 0.5),
]  # fmt: skip


@pytest.mark.parametrize("numbers", [{}, TIGHT], ids=["default", "tight"])
def test_a_ball_settles_on_an_oscillating_table(numbers):
    base = vibrating_table.scene()
    for A, omega, e, h in TABLES:

        def table(t, A=A, omega=omega):
            return A * np.sin(omega * t), A * omega * np.cos(omega * t), -A * omega**2 * np.sin(omega * t)

        ts = np.linspace(0.0, 5.0, 41)
        right = ball_on_table(table, h, e, ts)
        assert len(right.closes) == 1
        scene = replace_elements(base, {"A": A, "omega": omega, "table.restitution": e})
        run = jms.simulate(scene, [h], [0.0], 5.0, ts=ts, max_events=256, **numbers)
        case = f"A {A}, omega {omega}, e {e}"
        np.testing.assert_allclose(run.q[:, 0], right.q, rtol=0, atol=1e-8, err_msg=case)
        np.testing.assert_allclose(run.qd[:, 0], right.qd, rtol=0, atol=1e-6, err_msg=case)
        assert run.mode_changes[-1].after == "closed"
        assert abs(run.mode_changes[-1].t - right.closes[0]) < 1e-6


def test_a_ball_leaves_a_table_that_falls_faster_and_settles_again():
    A, omega, e = 0.02, 25.0, 0.2

    def table(t):
        return A * np.sin(omega * t), A * omega * np.cos(omega * t), -A * omega**2 * np.sin(omega * t)

    ts = np.linspace(0.0, 1.5, 61)
    right = ball_on_table(table, 0.1, e, ts)
    assert len(right.opens) >= 4
    run = jms.simulate(vibrating_table.scene(A=A, omega=omega, e=e), [0.1], [0.0], 1.5, ts=ts, max_events=512, **TIGHT)
    np.testing.assert_allclose(run.q[:, 0], right.q, rtol=0, atol=1e-8)
    np.testing.assert_allclose(run.qd[:, 0], right.qd, rtol=0, atol=1e-6)
    opens = [change.t for change in run.mode_changes if change.before == "closed"]
    np.testing.assert_allclose(opens, right.opens, rtol=0, atol=1e-8)


def _accelerated(t, q, p):
    return q[0] - 0.5 * p["a"] * t**2


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_a_table_that_accelerates_is_a_floor_in_another_gravity(derivative):
    """The end of all bounces, and its derivatives by restitution and acceleration."""
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * qd[0] ** 2 - 9.81 * q[0],
        params={"a": 1.0},
        constraints=(jms.Contact(_accelerated, restitution=0.5, name="table"),),
    )

    def closes(x):
        there = replace_elements(scene, {"a": x[1], "table.restitution": x[0]})
        run = jms.simulate(there, [1.0], [0.0], 6.0, throw=False, max_events=256, **TIGHT)
        return jnp.max(jnp.where(jnp.isfinite(run.events.t), run.events.t, 0.0)), (run.result.code, run.q[-1, 0])

    def exact(x):
        return jnp.sqrt(2.0 / (9.81 + x[1])) * (1.0 + x[0]) / (1.0 - x[0])

    ours, theirs = jax.jit(lambda x: (closes(x), derivative(closes, has_aux=True)(x)[0])), jax.grad(exact)
    for e, a in ((0.5, 1.0), (0.7, -3.0), (0.3, 20.0), (0.6, 0.0)):
        x = jnp.array([e, a])
        (end, (code, q)), slope = ours(x)
        assert code == 0
        np.testing.assert_allclose(q, 18.0 * a, rtol=1e-14)
        # Rebounds end where they rise to the rounding of the place of the table.
        np.testing.assert_allclose(end, exact(x), rtol=2e-6)
        np.testing.assert_allclose(slope, theirs(x), rtol=1e-4)


def _in_a_box(t, q, qd, p):
    return 0.5 * p["M"] * qd[0] ** 2 + 0.5 * p["m"] * (qd[0] + qd[1]) ** 2


def _pushed(t, q, qd, p):
    return jnp.stack([0.0 * t, p["F"]])


@pytest.mark.parametrize("numbers", [{}, TIGHT], ids=["default", "tight"])
def test_impacts_that_break_a_box_loose_from_dry_friction(numbers):
    """Down to speeds of 1e-8 m/s, at which rounding of the place is all that is left of a flight."""
    base = jms.Scene(
        _in_a_box,
        params={"M": 5.0, "m": 1.0, "F": 5.0},
        effects=(
            jms.AppliedForce(_pushed, name="push"),
            jms.Friction(jms.Coulomb(15.85), along=lambda q: q[0], name="dry"),
        ),
        constraints=jms.end_stops(lambda q: q[1], upper=0.5, restitution=0.8, name="stop"),
    )
    cases = np.array(
        [
            (e, m, F, v)
            for e in (0.3, 0.8, 0.9)
            for m in (0.2, 1.0, 2.0, 5.0)
            for F in (0.5, 5.0, 15.0)
            for v in (0.0, 3.0)
        ]
    )

    @jax.jit
    @jax.vmap
    def end(x):
        scene = replace_elements(base, {"stop_upper.restitution": x[0], "m": x[1], "F": x[2]})
        v = jnp.stack([0.0 * x[3], x[3]])
        run = jms.simulate(scene, [0.0, 0.0], v, 10.0, throw=False, max_events=1000, max_steps=4096, **numbers)
        return run.q[-1], run.result.code, run.stats["num_rejected_steps"]

    q, code, rejected = end(jnp.asarray(cases))
    assert not np.any(code), cases[np.flatnonzero(code)]
    assert np.max(rejected) < 1000
    right = [mass_in_a_dry_box(5.0, m, 15.85, F, e, 0.5, v, 10.0)[0] for e, m, F, v in cases]
    np.testing.assert_allclose(q, np.array([0.0, 0.5]) + np.array(right) * [1.0, -1.0], rtol=0, atol=1e-8)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_restitution_under_friction_does_not_move_the_resting_place(derivative):
    """A block thrown onto a rough floor: what bounces take from its impulse and give to its time is the same."""
    base, h, start = _rough(0.5), 0.5, 4.0

    def place(x):
        scene = replace_elements(base, {"floor.restitution": x[0], "friction.Fc": x[1]})
        run = jms.simulate(scene, [0.0, h], [start, 0.0], 5.0, throw=False, max_events=256)
        return run.q[-1, 0], run.result.code

    def exact(mu):
        fall = jnp.sqrt(2.0 * h / 9.81)
        return start * fall + (start - mu * 9.81 * fall) ** 2 / (2.0 * mu * 9.81)

    ours = jax.jit(jax.vmap(lambda x: (place(x), derivative(place, has_aux=True)(x)[0])))
    restitutions = (0.0, 1e-12, 1e-6, 1e-4, 1e-3, 0.01, 0.02, 0.03, 0.05, 0.1, 0.3, 0.5)
    cases = jnp.array([(e, mu) for mu in (0.1, 0.3, 0.4) for e in restitutions])
    (places, codes), slopes = ours(cases)
    assert not np.any(codes)
    by_mu = jax.vmap(jax.value_and_grad(exact))(cases[:, 1])
    np.testing.assert_allclose(places, by_mu[0], rtol=1e-9)
    np.testing.assert_allclose(slopes[:, 0], 0.0, atol=1e-8)
    np.testing.assert_allclose(slopes[:, 1], by_mu[1], rtol=1e-8)


def test_a_violated_start_is_refused_before_the_run_is_compiled():
    before = compiled_runs()
    floor = jms.Scene(_thrown, constraints=(jms.Contact(_over, name="floor"),))
    with pytest.raises(jms.SimulationError, match=r"contact 'floor': its gap is negative, -2e-06\. (?!.*dtmax)"):
        jms.simulate(floor, [0.0, -2e-6], [0.0, 0.0], 1.0)
    with pytest.raises(jms.SimulationError, match="gap is negative"):
        jms.simulate(_rough(0.5), jnp.array([0.0, -2e-6]), jnp.zeros(2), 1.0)
    rod = jms.Scene(_thrown, constraints=(jms.Constraint(lambda t, q, p: jnp.sum(q**2) - 1.0),))
    for q, qd in (([0.0, -1.001], [0.0, 0.0]), ([0.0, -1.0], [0.0, 0.1])):
        with pytest.raises(jms.SimulationError, match=r"does not obey the constraints.* residual of 'constraint' is"):
            jms.simulate(rod, q, qd, 1.0)
    for q, qd, error in (
        ([0.0], [0.0, 0.0], "must both have the shape"),
        ([0.0, np.nan], [0.0, 0.0], "must be finite"),
    ):
        with pytest.raises(ValueError, match=error):
            jms.simulate(floor, q, qd, 1.0)
    assert compiled_runs() == before


def test_a_missed_impact_names_its_contact():
    floor = jms.Scene(_thrown, constraints=(jms.Contact(_over, name="floor"),))
    text = describe_failure(floor, 0.5, State(jnp.array([0.0, -0.02]), jnp.zeros(2), {}), PENETRATES)
    assert text.startswith("The run missed an impact at contact 'floor': its gap is negative, -0.02. Pass smaller")


def test_a_gap_that_a_linear_signal_moves_is_refused():
    """Contacts and constraints would not see its velocity."""
    u = jms.Signal([0.0, 1.0], [0.0, 0.5], linear=True)
    for constraint in (
        jms.Contact(lambda t, q, p: q[1] - p["u"], name="table"),
        jms.Constraint(lambda t, q, p: q[1] - p["u"], name="table"),
        jms.VelocityConstraint(lambda t, q, qd, p: qd[1] - p["u"], name="table"),
    ):
        scene = jms.Scene(_thrown, params={"u": u}, constraints=(constraint,))
        with pytest.raises(ValueError, match=r"'table'.*linear Signal"):
            jms.simulate(scene, [0.0, 0.0], [0.0, 0.5], 1.0)


def test_early_ends_at_a_contact_name_it_and_no_law_that_is_not_there():
    messages = outcome_messages(_rough(0.5), 2)
    assert not any("DeadZone" in text for text in messages)
    (named,) = [text for text in messages if "at contact 'floor'" in text]
    assert "HuntCrossley" in named
    assert "'floor'" in messages[MAX_STEPS]
    chatters = jms.Scene(_thrown, effects=(jms.Friction(jms.Sign(jms.Coulomb(1.0)), along=lambda q: q[0]),))
    assert any("Run DeadZone and Sign with a fixed step" in text for text in outcome_messages(chatters, 2))
