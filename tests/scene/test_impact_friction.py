"""Impacts with friction: against closed forms, in velocities and energy."""
# ruff: noqa: ARG001 (Lagrangians, gaps and forces have all their arguments, used or not)

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.scene._impact import _impulses, _Struck

J = 0.4


def _kinetic(t, q, qd, p):
    return 0.5 * (qd[0] ** 2 + qd[1] ** 2 + J * qd[2] ** 2)


def _foot(q):
    return q[0] + q[2]


def _height(t, q, p):
    return q[1]


def _disc(law, friction, **params):
    """A disc of mass and radius one over a floor, without gravity: place, height, angle."""
    return jms.Scene(
        _kinetic,
        params=params,
        effects=(jms.Friction(friction, along=_foot, normal_force="floor"),),
        constraints=(jms.Contact(_height, restitution=law, name="floor"),),
    )


@pytest.mark.parametrize("law", [0.8, jms.Poisson(0.8)])
def test_an_oblique_impact_of_a_disc(law):
    """It slides all through, in either direction, or sticks: the impulse then takes all of the slip."""
    speed = 2.0

    def after(mu, vx, spin):
        scene = _disc(law, jms.Coulomb(mu))
        return jms.simulate(scene, [0.0, 1.0, 0.0], [vx, -speed, spin], 1.0, rtol=1e-10, atol=1e-12)

    for mu, vx, spin in ((0.1, 1.0, 0.3), (0.1, 1.0, -3.0), (1.0, 1.0, 0.3), (0.6, -2.0, 0.5)):
        run = after(mu, vx, spin)
        slip, most = vx + spin, mu * 1.8 * speed
        push = np.clip(slip / (1 + 1 / J), -most, most)
        np.testing.assert_allclose(run.qd[-1], [vx - push, 0.8 * speed, spin - push / J], rtol=1e-11)
        lost = 0.5 * (1 - 0.64) * speed**2 + push * slip - 0.5 * (1 + 1 / J) * push**2
        np.testing.assert_allclose(run.event_losses[-1], lost, rtol=1e-10)
    slope = jax.grad(lambda mu: after(mu, 1.0, 0.3).qd[-1, 2])(0.1)
    np.testing.assert_allclose(slope, -1.8 * speed / J, rtol=1e-9)


@pytest.mark.parametrize("mu", [0.1, 1.0])
def test_an_observer_in_motion_sees_the_same_loss(mu):
    """A disc strikes a floor and a belt, held by a rail; from a frame in motion, in which floor, belt and rail move."""

    def seen(vx, vz):
        """From a frame whose velocity is (-vx, -vz): the rail holds the height less half of the angle."""
        friction = jms.Friction(jms.Coulomb(mu), along=_foot, normal_force="floor", belt_velocity=0.4 + vx)
        scene = jms.Scene(
            _kinetic,
            params={"vz": vz},
            effects=(friction,),
            constraints=(
                jms.Contact(lambda t, q, p: q[1] - p["vz"] * t, restitution=0.8, name="floor"),
                jms.Constraint(lambda t, q, p: q[1] - p["vz"] * t - 0.5 * q[2] - 1.0, name="rail"),
            ),
        )
        return jms.simulate(scene, [0.0, 1.0, 0.0], [1.0 + vx, vz - 2.0, -4.0], 1.0, rtol=1e-10, atol=1e-12)

    still, moving = seen(0.0, 0.0), seen(0.7, -0.3)
    np.testing.assert_allclose(moving.qd[-1] - still.qd[-1], [0.7, -0.3, 0.0], atol=1e-10)
    np.testing.assert_allclose(moving.event_losses, still.event_losses, rtol=1e-10)
    assert abs(still.event_losses[-1]) > 0.1
    work = jms.energy_audit(moving).work
    np.testing.assert_allclose(jms.energy_audit(still).work["floor"], 0.0, atol=1e-10)
    # The floor and the rail move alike, so together they do the work of the impulse that turns the disc up.
    gained = -0.3 * (moving.qd[-1, 1] - (-0.3 - 2.0))
    np.testing.assert_allclose(work["floor"] + work["rail"], gained, rtol=1e-10)
    np.testing.assert_allclose(work["friction"], (0.4 + 0.7) * (moving.qd[-1, 0] - 1.7), rtol=1e-10)
    np.testing.assert_allclose(moving.energy.balance, 0.0, atol=1e-10)


def test_friction_of_an_impact_may_depend_on_where_it_happens():
    """The coefficient of `scaled_by` is that of the place and the parameters at the instant of the impact."""
    law = jms.scaled_by(jms.Coulomb(0.05), lambda t, q, qd, p: p["wear"] * (1.0 + q[0]))

    def end(wear):
        worn, start = _disc(0.8, law, wear=wear), ([0.0, 1.0, 0.0], [1.0, -2.0, 0.3])
        return jms.simulate(worn, *start, 1.0, rtol=1e-10, atol=1e-12, throw=False).qd[-1]

    push = 0.05 * 1.5 * 1.8 * 2.0  # it strikes at x = 0.5, and slides all through
    value, slope = jax.jit(lambda wear: jax.jvp(end, (wear,), (jnp.ones_like(wear),)))(1.2)
    np.testing.assert_allclose(value, [1.0 - 1.2 * push, 1.6, 0.3 - 1.2 * push / J], rtol=1e-10)
    np.testing.assert_allclose(slope, [-push, 0.0, -push / J], atol=1e-10)


def test_impacts_with_friction_in_batches_and_single_precision():
    """Batches of runs that slide either way or stick, equal to single runs and, in float32, to the closed form."""
    scene, speed = _disc(0.8, jms.Coulomb(0.3)), 2.0
    vx, spin = np.array([1.0, 1.0, -2.0]), np.array([0.3, -3.0, 1.8])

    def after(scene, v):
        return jms.simulate(scene, np.array([0.0, 1.0, 0.0], v.dtype), v, 1.0).qd[-1]

    before = np.stack([vx, np.full(3, -speed), spin], axis=1)
    batch = jax.jit(jax.vmap(lambda v: after(scene, v)))(before)
    np.testing.assert_allclose(batch, [after(scene, v) for v in before], rtol=1e-12)
    push = np.clip((vx + spin) / (1 + 1 / J), -0.3 * 1.8 * speed, 0.3 * 1.8 * speed)
    exact = np.stack([vx - push, np.full(3, 0.8 * speed), spin - push / J], axis=1)
    np.testing.assert_allclose(batch, exact, rtol=1e-9)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), scene)
    short = jax.jit(jax.vmap(lambda v: after(single, v)))(before.astype(jnp.float32))
    assert short.dtype == jnp.float32
    np.testing.assert_allclose(short, exact, rtol=1e-5)


def _on_a_slope(t, q, qd, p):
    return 0.5 * jnp.sum(qd**2) - 9.81 * q[1] - p["along"] * q[0]


def _along(q):
    return q[0]


def _land(speed, along, t1):
    """A block falls on a rough floor from half a metre, at a velocity along it and under a force against that."""
    block = jms.Scene(
        _on_a_slope,
        params={"along": along},
        effects=(jms.Friction(jms.Coulomb(0.3), along=_along, normal_force="floor"),),
        constraints=(jms.Contact(_height, name="floor"),),
    )
    return jms.simulate(block, [0.0, 0.5], [speed, 0.0], t1, ts=np.linspace(0.0, t1, 7), rtol=1e-10, atol=1e-12)


def test_a_block_lands_with_friction_slides_and_stops():
    mu, g, height, start = 0.3, 9.81, 0.5, 2.0
    run = _land(start, 0.0, 1.5)
    landing = np.sqrt(2 * height / g)
    left = start - mu * g * landing
    lands, stops = run.mode_changes
    np.testing.assert_allclose([lands.t, stops.t], [landing, landing + left / (mu * g)], rtol=1e-10)
    np.testing.assert_allclose(run.q[-1], [start * landing + left**2 / (2 * mu * g), 0.0], rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(run.energy.balance, 0.0, atol=1e-11)


def test_a_block_that_begins_on_the_floor():
    """It strikes the floor at the start, rests, or slides as its load rises from zero: places and all derivatives."""

    def end(force, pull, rise, vz, t1):
        def press(t, q, qd, p):
            return jnp.stack([p["H"], p["P"] - p["r"] * t])

        friction = jms.Friction(jms.Coulomb(0.3, 0.4), along=lambda q: q[0], normal_force="floor")
        scene = jms.Scene(
            lambda t, q, qd, p: 0.5 * (qd[0] ** 2 + qd[1] ** 2),
            params={"H": force, "P": pull, "r": rise},
            effects=(jms.AppliedForce(press), friction),
            constraints=(jms.Contact(_height, name="floor"),),
        )
        run = jms.simulate(scene, [1.0, 0.0], jnp.stack([0.0 * vz, vz]), t1, throw=False)
        return run.q[-1, 0] - 1.0, (run.result.code, run.stats["num_steps"])

    rests = [(3.5, 0.0), (3.5, -1e-6), (3.5, -1.0), (1.0, -1e-9), (1.0, -1e-10)]
    sticks = [(force, -10.0, 0.0, vz, t1) for force, vz in rests for t1 in (1.0, 100.0)]
    slides = [(0.4, 0.0, rise, 0.0, 1.0) for rise in (0.2, 0.7, 1.3)]
    value_and_slopes = jax.jit(jax.vmap(jax.value_and_grad(end, (0, 1, 2), has_aux=True)))
    (x, (codes, steps)), slopes = value_and_slopes(*map(jnp.array, zip(*sticks, *slides, strict=True)))
    np.testing.assert_array_equal(codes, 0)
    # Rounding at rest is no error: such gradients took thousands of steps.
    assert np.max(steps) < 100
    n = len(sticks)
    np.testing.assert_allclose(x[:n], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.stack(slopes)[:, :n], 0.0, atol=1e-9)
    # x = H t^2/2 - mu r t^3/6, and mu P t^2/2 more where P lifts.
    np.testing.assert_allclose(x[n:], [0.2 - 0.05 * each[2] for each in slides], rtol=1e-9)
    np.testing.assert_allclose(np.stack(slopes)[:, n:].T, [[0.5, 0.15, -0.05]] * 3, rtol=1e-9)


def test_a_slow_block_stops_where_it_lands():
    run = _land(0.5, 0.5, 1.0)
    assert {change.after for change in run.mode_changes} == {"stick", "closed"}
    landing = np.sqrt(1 / 9.81)
    np.testing.assert_allclose(run.q[-1, 0], 0.5 * landing - 0.25 * landing**2, rtol=1e-9)


def _double_pendulum(law):
    """Two thin rods, whose tip strikes a rough floor."""

    def lagrangian(t, q, qd, p):
        del t, p
        kinetic = 4 / 3 * qd[0] ** 2 + 1 / 3 * qd[1] ** 2 + jnp.cos(q[1] - q[0]) * qd[0] * qd[1]
        return 0.5 * kinetic + 9.81 * (1.5 * jnp.cos(q[0]) + 0.5 * jnp.cos(q[1]))

    def tip(q):
        return jnp.sin(q[0]) + jnp.sin(q[1])

    floor = np.cos(np.pi / 9) + np.cos(np.pi / 6)
    gap = lambda t, q, p: floor - jnp.cos(q[0]) - jnp.cos(q[1])  # noqa: E731
    return jms.Scene(
        lagrangian,
        effects=(jms.Friction(jms.Coulomb(0.5), along=tip, normal_force="floor"),),
        constraints=(jms.Contact(gap, restitution=law, name="floor"),),
    )


@pytest.mark.parametrize(("law", "gains"), [(0.5, True), (jms.Poisson(0.5), False)])
def test_where_newtons_law_gains_energy_poissons_does_not(law, gains):
    """The double pendulum of Kane and Levinson, Dynamics: Theory and Applications, 1985."""
    run = jms.simulate(_double_pendulum(law), [np.pi / 9, np.pi / 6], [-0.1, -0.2], 1e-3)
    assert run.mode_changes[0].effect == "floor"
    assert (run.event_losses[-1] < 0) == gains


def _random_impacts(count, n, m, dof):
    rng = np.random.default_rng(n + m)
    rows = rng.normal(size=(count, n + m, dof))
    v = np.einsum("bij,bj->bi", rows, rng.normal(size=(count, dof)))
    v[:, :n] = -np.abs(v[:, :n])
    return np.einsum("bij,bkj->bik", rows, rows), v, rng.uniform(0, 1, (count, m)), rng.uniform(0, 1, (count, n))


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 2)])
def test_impacts_obey_their_laws_and_poissons_gains_no_energy(n, m):
    """Random mechanisms, struck at all contacts at once, each with its own coefficients."""

    def poisson(matrix, v, mu, e):
        struck = _Struck(matrix, jnp.ones(n, bool), jnp.eye(m, n), mu, mu)
        squeeze = _impulses(struck, v, jnp.zeros(n))
        halfway = v + matrix @ squeeze
        return squeeze, halfway, _impulses(struck, halfway, e * squeeze[:n])

    matrix, v, mu, e = _random_impacts(200, n, m, 6)
    squeeze, halfway, expand = jax.jit(jax.vmap(poisson))(matrix, v, mu, e)
    after = halfway + np.einsum("bij,bj->bi", matrix, expand)
    for end, p, least in ((halfway, squeeze, 0.0), (after, expand, e * squeeze[:, :n])):
        normal, friction = p[:, :n] - least, p[:, n:]
        assert (normal > -1e-10).all()
        assert (end[:, :n] > -1e-10).all()
        np.testing.assert_allclose(normal * end[:, :n], 0.0, atol=1e-9)
        assert (np.abs(friction) <= mu * p[:, :m] + 1e-10).all()
        # Where it slips, friction is at its limit, against the slip.
        slides = np.abs(end[:, n:]) > 1e-9
        np.testing.assert_allclose((friction + np.sign(end[:, n:]) * mu * p[:, :m])[slides], 0.0, atol=1e-9)
    gain = 0.5 * np.sum((squeeze + expand) * (v + after), axis=1)
    assert (gain < 1e-12).all()


def test_a_body_without_slip_moves_freely_in_flight():
    """Friction under an open contact has no load, so derivatives in flight are those of free motion, from rest too."""
    drop, m, g = 0.2, 2.0, 9.81

    def block(t, q, qd, p):
        return 0.5 * m * jnp.sum(qd**2) - m * g * q[1]

    def pull(t, q, qd, p):
        return jnp.stack([p["F"], 0.0 * t])

    ground = jms.Contact(_height, restitution=0.5, name="ground")
    slide = jms.Friction(jms.Coulomb(0.3), along=lambda q: q[0], normal_force="ground")

    @jax.jit
    @jax.jacfwd
    def slopes(x, end):
        scene = jms.Scene(block, {"F": x[0]}, (jms.AppliedForce(pull), slide), constraints=(ground,))
        run = jms.simulate(scene, [0.0, drop], jnp.stack([x[1], 0.0]), end, rtol=1e-9, atol=1e-12, throw=False)
        return jnp.stack([run.q[-1, 0], run.qd[-1, 0]])

    lands = (2.0 * drop / g) ** 0.5
    np.testing.assert_allclose(slopes(jnp.zeros(2), 0.15), [[0.15**2 / (2 * m), 0.15], [0.15 / m, 1.0]], rtol=1e-9)
    # The impact stops it; then it flies again. The second start slips until then.
    end, flight = 0.3, 0.3 - lands
    expected = [[(lands**2 + flight**2) / (2 * m), lands], [flight / m, 0.0]]
    for speed in (0.0, 0.5):
        np.testing.assert_allclose(slopes(jnp.array([0.0, speed]), end), expected, rtol=1e-7, atol=1e-12)


def test_the_derivative_by_a_load_of_zero_is_that_of_a_load_above_it():
    slide = jms.Friction(jms.Coulomb(0.3), normal_force=lambda t, q, qd, p: p["N"])

    def end(load):
        scene = jms.Scene(lambda t, q, qd, p: qd[0] ** 2, {"N": load}, (slide,))
        return jms.simulate(scene, [0.0], [1.0], 2.0, rtol=1e-9, atol=1e-12).q[-1, 0]

    np.testing.assert_allclose(jax.grad(end)(0.0), -0.3 * 2.0**2 / (2 * 2.0), rtol=1e-9)
