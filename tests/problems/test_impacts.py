"""Problems with impacts, against their closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms

from . import gripper, newtons_cradle, relief_valve, rocking_block, stacked_blocks, two_balls


def _after_collision(q0, qd0, numbers):
    return jms.simulate(two_balls.scene(**numbers), q0, qd0, 1.0, rtol=1e-10, atol=1e-12, throw=False).q[-1]


_slopes_after_collision = [jax.jit(derivative(_after_collision)) for derivative in (jax.jacrev, jax.jacfwd)]
_slopes_of_motion = jax.jit(jax.jacfwd(lambda q0, qd0, numbers: two_balls.motion(1.0, q0, qd0, **numbers)))


@pytest.mark.parametrize("numbers", [two_balls.PARAMS, two_balls.PARAMS | {"m2": 3.0, "e": 0.6}])
def test_two_balls(numbers):
    given = np.array([0.0, 0.5]), np.array([1.0, -0.2])
    np.testing.assert_allclose(
        _after_collision(*given, numbers), two_balls.motion(1.0, *map(jnp.asarray, given), **numbers), rtol=1e-12
    )
    exact = _slopes_of_motion(*given, numbers)
    if numbers == two_balls.PARAMS:
        np.testing.assert_allclose(exact, [[0.0, 1.0], [1.0, 0.0]], atol=1e-15)
    for slopes in _slopes_after_collision:
        np.testing.assert_allclose(slopes(*given, numbers), exact, atol=1e-12)


def test_newtons_cradle():
    """A quarter of a period after its release the first ball strikes: the balls' velocities there."""
    quarter, start = 0.5 * np.pi * np.sqrt(0.2 / 9.81), -0.02
    speed = -start * np.sqrt(9.81 / 0.2)
    for gap in (0.0, 1e-6):
        run = jms.simulate(
            newtons_cradle.scene(gap=gap), [start, 0.0, 0.0], [0.0] * 3, quarter + 2e-5, rtol=1e-9, atol=1e-14
        )
        exact = newtons_cradle.velocities_after(3, speed, touching=gap == 0)
        np.testing.assert_allclose(run.qd[-1], exact, atol=1e-4)
    np.testing.assert_allclose(newtons_cradle.velocities_after(4, 1.0, touching=True), [-0.5, 0.5, 0.5, 0.5])
    inelastic = newtons_cradle.velocities_after(3, 1.0, touching=False, e=0.5)
    np.testing.assert_allclose(jnp.sum(inelastic), 1.0)
    with pytest.raises(ValueError, match="balls must be 2 to 7, but 8"):
        newtons_cradle.scene(8)


def test_a_block_rocks_as_in_the_formulas_of_housner():
    start, p = 0.02, rocking_block.PARAMS
    quarter = float(rocking_block.quarter_period(start))
    q0, qd0 = rocking_block.state(start)
    # The closed form is that of a slender block, alpha = 0.1.
    ts = jnp.asarray([0.5 * quarter, 0.998 * quarter, 1.002 * quarter, 2.0 * quarter])
    run = jms.simulate(rocking_block.scene(), q0, qd0, 2.0 * quarter, ts=ts, rtol=1e-9, atol=1e-11)
    np.testing.assert_array_equal(run.mode["right"], [1, 1, 0, 0])
    np.testing.assert_array_equal(run.mode["left"], [0, 0, 1, 1])
    # On the one edge or on the other, which does not slip.
    inertia = 4.0 / 3.0 * p["m"] * (p["b"] ** 2 + p["h"] ** 2)
    energy = 0.5 * inertia * run.qd[:, 2] ** 2 + p["m"] * p["g"] * (run.q[:, 1] - p["h"])
    begun = p["m"] * p["g"] * (float(q0[1]) - p["h"])
    kept = begun * rocking_block.speed_ratio() ** 2
    np.testing.assert_allclose(energy, jnp.asarray([begun, begun, kept, kept]), rtol=1e-7)


def test_a_gripper_catches_a_falling_object():
    d, v0 = gripper.PARAMS["d"], gripper.PARAMS["v0"]

    def end(mu, **more):
        return jms.simulate(gripper.scene(mu=mu), [d, 0.0], [0.0, v0], 0.5, rtol=1e-10, atol=1e-12, **more)

    run, caught = end(0.2), gripper.catch(mu=0.2)
    assert caught.speed > 0.1  # the impact alone does not stop it
    changes = [(each.effect, each.after) for each in run.mode_changes]
    assert changes[-1] == ("friction", "stick")
    np.testing.assert_allclose(run.mode_changes[0].t, caught.strikes, rtol=1e-10)
    np.testing.assert_allclose(run.mode_changes[-1].t, caught.stops, rtol=1e-10)
    np.testing.assert_allclose(run.q[-1], jnp.stack([0.0 * caught.depth, caught.depth]), rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(run.reactions["fingers"].multiplier[-1], 2.0 * gripper.PARAMS["grip"], rtol=1e-10)
    exact = jax.jit(jax.grad(lambda mu: gripper.catch(mu=mu).depth))(0.2)
    slope = jax.jit(jax.grad(lambda mu: end(mu, throw=False).q[-1, 1]))(0.2)
    np.testing.assert_allclose(slope, exact, rtol=1e-8)
    # Too weak a grip: it slides on.
    assert np.isinf(gripper.catch(mu=0.1).stops)
    np.testing.assert_array_equal(end(0.1).mode["friction"], 1)


def test_the_upper_one_of_stacked_blocks_lags_behind():
    slips = stacked_blocks.slips()
    ts = jnp.asarray([0.9 * slips.floor, 0.5 * (slips.floor + slips.between), 1.5 * slips.between])
    run = jms.simulate(stacked_blocks.scene(), [0.0, 0.0], [0.0, 0.0], ts[-1], ts=ts, rtol=1e-10, atol=1e-12)
    changes = {each.effect: each.t for each in run.mode_changes}
    np.testing.assert_allclose([changes["floor"], changes["between"]], slips, rtol=1e-11)
    np.testing.assert_allclose(run.q, jnp.stack([stacked_blocks.motion(t) for t in ts]), rtol=1e-9, atol=1e-13)
    np.testing.assert_array_equal(run.mode["between"], [0, 0, -1])


def test_a_relief_valve_swings_below_the_flow_of_its_closed_form_and_strikes_its_seat():
    at = jax.tree.map(float, relief_valve.onset())
    period, pressure = 2.0 * np.pi / at.frequency, at.lift + relief_valve.PARAMS["delta"]
    ts, sizes = 40.0 + np.linspace(0.0, 20.0 * period, 2001), {}
    for part in (0.98, 1.0, 1.02):
        scene = relief_valve.scene(flow=part * at.flow)
        start = [at.lift + 1e-4], [0.0], ts[-1]
        run = jms.simulate(scene, *start, ts=ts, z0={"pressure": pressure}, rtol=1e-9, atol=1e-12)
        q = np.asarray(run.q[:, 0])
        sizes[part] = [np.max(np.abs(q - np.mean(q))[part]) for part in (slice(200), slice(-200, None))]
    assert sizes[0.98][1] > 1.5 * sizes[0.98][0]
    np.testing.assert_allclose(sizes[1.0][1], sizes[1.0][0], rtol=1e-3)
    assert sizes[1.02][1] < 0.7 * sizes[1.02][0]
    # Far below it strikes its seat, again and again.
    run = jms.simulate(relief_valve.scene(), [0.1], [0.0], ts[-1], ts=ts, rtol=1e-9, atol=1e-12)
    assert np.min(run.q) >= 0.0
    assert np.sum(np.isfinite(run.events.t)) > 10
    assert (np.diff(run.event_losses) >= -1e-12).all()
