"""Several elements in stick and slip at once, and what becomes of scenes that have no consistent mode."""
# ruff: noqa: ARG001 (Lagrangians and forces have their four arguments, used or not)

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import (
    AppliedForce,
    Contact,
    Coulomb,
    Friction,
    LuGre,
    Regularized,
    Scene,
    SimulationError,
    Stribeck,
    simulate,
)
from jaxmodsim.scene._event_driven import FrictionElements, LawForces, next_modes, solve_friction_forces
from jaxmodsim.simulation._solve import compiled_runs

from ..hard.many_events import Contradictory


def masses(t: Any, q: Any, qd: Any, p: Any) -> Any:
    return 0.5 * p["m"] * jnp.sum(qd**2) - 0.5 * p["k"] * jnp.sum(q**2)


def push(t: Any, q: Any, qd: Any, p: Any) -> Any:
    return jnp.zeros_like(q).at[0].set(p["a"] * jnp.sin(p["w"] * t) + p["r"] * t)


def scene(*friction: Friction, **params: float) -> Scene:
    return Scene(
        masses,
        params={"m": 1.0, "k": 0.0, "a": 0.0, "w": 1.0, "r": 0.0, **params},
        effects=(AppliedForce(push, name="push"), *friction),
    )


def random_contact(rng: np.random.Generator, n: int, stiction: bool) -> FrictionElements:
    directions = rng.normal(size=(n, n))
    coupling = directions @ directions.T
    limit = rng.uniform(0.5, 2.0, n)
    level = limit * rng.uniform(0.5, 1.0, n) if stiction else limit
    base = 3.0 * rng.normal(size=n) * np.diag(coupling)
    numbers = (np.zeros(n), base, coupling, directions, level, -level, limit, limit)
    v, free, delassus, minv_jt, *laws = (jnp.asarray(x) for x in numbers)
    return FrictionElements(v, free, delassus, minv_jt, LawForces(*laws))


@jax.jit
def choose(found: FrictionElements) -> Any:
    rest = jnp.zeros_like(found.v)
    return next_modes(found, rest, rest == 0, rest != 0, jnp.zeros(()))


@jax.jit
def forces(found: FrictionElements, modes: Any) -> Any:
    return jax.vmap(lambda mode: solve_friction_forces(found, mode).force)(modes)


def consistent(found: FrictionElements, modes: np.ndarray) -> np.ndarray:
    """Of sets of modes: stick within limits and without acceleration, slip not accelerated against its direction."""
    force = np.asarray(forces(found, modes))
    acceleration = np.asarray(found.free_slip_acceleration) - force @ np.asarray(found.delassus).T
    held = (np.abs(force) <= np.asarray(found.laws.upper) * (1 + 1e-9)) & (np.abs(acceleration) < 1e-7)
    return np.all(np.where(modes == 0, held, modes * acceleration > -1e-9), axis=1)


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("stiction", [False, True])
def test_the_modes_found_satisfy_all_limits(n: int, stiction: bool) -> None:
    """Coupled elements at rest, against all 3^n sets of modes: one that is consistent is found; without stiction
    there is exactly one.
    """
    rng = np.random.default_rng(n)
    every = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=n)))
    kinds = set()
    for _ in range(40):
        found = random_contact(rng, n, stiction)
        mode = np.asarray(choose(found))
        chosen, right = np.all(every == mode, axis=1), consistent(found, every)
        assert np.any(chosen & right)
        kinds.add(tuple(mode))
        if not stiction:
            np.testing.assert_array_equal(right, chosen)
    assert len(kinds) > n


def test_two_elements_on_one_coordinate_share_in_proportion_to_their_limits() -> None:
    """Limits 1 N and 3 N under a ramp of 1 N/s: both let go at 4 s, and slide against 1 N + 2 N from there on."""
    both = scene(Friction(Coulomb(1.0)), Friction(Coulomb(2.0, 3.0)), r=1.0)
    run = simulate(both, [0.0], [0.0], 6.0, ts=np.array([2.0, 3.9, 6.0]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(run.events.t[:2], 4.0, rtol=1e-7)
    np.testing.assert_array_equal(run.events.effect, [1, 2])
    np.testing.assert_allclose(run.forces["friction"][:2], [0.5, 0.975], rtol=1e-7)
    np.testing.assert_allclose(run.forces["friction_2"][:2], [1.5, 2.925], rtol=1e-7)
    np.testing.assert_allclose(run.qd[:, 0], [0.0, 0.0, (36 - 16) / 2 - 3 * 2], atol=1e-6)


def test_redundant_elements_in_series_give_no_nan() -> None:
    """Two masses, each on the ground, and an element between them: three constraints for two velocities."""
    three = scene(
        Friction(Coulomb(1.0), along=lambda q: q[0]),
        Friction(Coulomb(1.0), along=lambda q: q[1]),
        Friction(Coulomb(0.5), along=lambda q: q[0] - q[1]),
        r=1.0,
    )
    run = simulate(three, [0.0, 0.0], [0.0, 0.0], 4.0, ts=np.array([1.0, 1.45, 2.0, 4.0]), rtol=1e-9, atol=1e-12)
    # The first mass moves at 1.5 N = 1 N to the ground + 0.5 N through the second, which never moves.
    np.testing.assert_allclose(run.events.t[1], 1.5, rtol=1e-7)
    speed = [0.0, 0.0, 0.5 * 0.5**2, 0.5 * 2.5**2]
    np.testing.assert_allclose(run.qd, np.stack([speed, np.zeros(4)], axis=1), atol=1e-7)
    total = run.forces["friction"] + run.forces["friction_3"]
    np.testing.assert_allclose(total[:2], [1.0, 1.45], rtol=1e-7)


def test_a_moving_base_is_followed_to_rounding_while_its_acceleration_can_be() -> None:
    """A box on a surface that swings with sin(3 t): friction m 3 cos(3 t) <= 3 N carries it, 2.9 N does not."""
    ts = np.linspace(0.0, 10.0, 41)
    swing = lambda t: jnp.sin(3.0 * t)  # noqa: E731
    carried = simulate(scene(Friction(Coulomb(2.0, 3.0), belt_velocity=swing)), [0.0], [0.0], 10.0, ts=ts)
    assert carried.stats["num_events"] == 0
    np.testing.assert_allclose(carried.qd[:, 0], np.sin(3.0 * ts), atol=1e-14)
    np.testing.assert_allclose(carried.forces["friction"], -3.0 * np.cos(3.0 * ts), atol=1e-12)
    slips = simulate(scene(Friction(Coulomb(2.0, 2.9), belt_velocity=swing)), [0.0], [0.0], 10.0, ts=ts)
    assert slips.stats["num_events"] > 5
    # At the very start the base runs away from the box, which has no slip velocity yet.
    velocity, mode, force = map(np.asarray, (slips.qd[:, 0], slips.mode["friction"], slips.forces["friction"]))
    v, mode, force = (velocity - np.sin(3.0 * ts))[1:], mode[1:], force[1:]
    np.testing.assert_array_equal(np.sign(np.where(np.abs(v) < 1e-12, 0.0, v)), mode)
    np.testing.assert_allclose(np.where(mode == 0, 0.0, force - 2.0 * mode), 0.0, atol=1e-12)
    np.testing.assert_allclose(slips.energy.balance, 0.0, atol=1e-5)


def test_a_load_that_swings_within_the_limit_is_not_stepped_over() -> None:
    """In stick nothing moves and the solver sees no error: only the guards keep the steps short."""
    under = scene(Friction(Coulomb(1.0, 1.1)), a=1.05, w=20.0)
    run = simulate(under, [0.0], [0.0], 30.0)
    assert run.stats["num_events"] == 0
    assert run.stats["num_steps"] > 200
    over = scene(Friction(Coulomb(1.0, 1.1)), a=1.15, w=20.0)
    first = simulate(over, [0.0], [0.0], 1.0).events.t[0]
    np.testing.assert_allclose(first, np.arcsin(1.1 / 1.15) / 20.0, rtol=1e-9)


def pulses(t: Any, q: Any, qd: Any, p: Any) -> Any:
    return jnp.reshape(p["a"] * jnp.exp(200.0 * (jnp.cos(2.0 * jnp.pi * t) - 1.0)), (1,))


def test_short_pulses_are_named_where_they_are_stepped_over_and_found_with_dtmax() -> None:
    """Once a second a pulse of 6 N and a twentieth of a second on a box that 3 N hold."""
    friction = Friction(Coulomb(2.0, 3.0))
    box = Scene(masses, params={"m": 1.0, "k": 0.0, "a": 6.0}, effects=(AppliedForce(pulses), friction))
    ts = np.linspace(0.5, 10.5, 201)
    missed = simulate(box, [0.0], [0.0], 10.5, t0=0.5, ts=ts, dtmax=10.0, throw=False)
    assert "stepped over" in missed.result.message
    found = simulate(box, [0.0], [0.0], 10.5, t0=0.5, ts=ts, dtmax=0.03)
    assert found.stats["num_events"] == 20
    fine = simulate(box, [0.0], [0.0], 10.5, t0=0.5, ts=ts, dt=0.002)
    np.testing.assert_allclose(found.q, fine.q, atol=1e-6)


def test_an_entry_above_the_limit_slips_at_once_and_in_the_direction_of_the_load() -> None:
    start, run = (simulate(scene(Friction(Coulomb(1.0, 1.5)), k=1.0), [5.0], [0.0], t1) for t1 in (0.0, 1.0))
    np.testing.assert_array_equal([start.mode["friction"][0], run.mode["friction"][0]], [-1.0, -1.0])
    assert run.stats["num_events"] == 0
    np.testing.assert_allclose(run.q[-1], 1.0 + 4.0 * np.cos(1.0), rtol=1e-6)


def test_an_entry_at_zero_velocity_below_the_limit_sticks() -> None:
    run = simulate(scene(Friction(Coulomb(1.0)), k=1.0), [0.9], [0.0], 5.0)
    np.testing.assert_array_equal(run.q, [[0.9]])
    np.testing.assert_array_equal(run.modes, [[0.0]])
    np.testing.assert_allclose(run.forces["friction"], [-0.9])


def test_a_force_that_equals_the_limit_does_not_flicker() -> None:
    for level in (1.0, 1.0 / 3.0, 0.1):
        run = simulate(scene(Friction(Coulomb(level)), k=1.0), [-level], [0.0], 3.0)
        assert run.stats["num_events"] == 0
        np.testing.assert_array_equal(run.qd, [[0.0]])


def test_exact_and_bristle_laws_in_one_scene() -> None:
    """Two masses: one held by Coulomb friction, one by a bristle; without coupling each moves as if alone."""
    bristle = LuGre(sigma0=750.0, sigma1=10.0, sigma2=0.1, Fc=1.5, Fs=1.75, vs=0.2)
    both = scene(
        Friction(Stribeck(1.0, 1.5, 0.1), along=lambda q: q[0]), Friction(bristle, along=lambda q: q[1]), k=4.0, r=0.5
    )
    alone = scene(Friction(Stribeck(1.0, 1.5, 0.1)), k=4.0, r=0.5)
    run = simulate(both, [0.0, 0.4], [0.0, 0.0], 4.0, rtol=1e-9, atol=1e-12)
    single = simulate(alone, [0.0], [0.0], 4.0, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(run.q[0, 0], single.q[0, 0], atol=1e-8)
    other = simulate(
        Scene(masses, params={"m": 1.0, "k": 4.0}, effects=(Friction(bristle),)),
        [0.4],
        [0.0],
        4.0,
        rtol=1e-9,
        atol=1e-12,
    )
    np.testing.assert_allclose(run.q[0, 1], other.q[0, 0], atol=1e-8)


def test_chatter_is_named_or_held() -> None:
    law = scene(Friction(Contradictory(), name="pad"), r=1.0)
    with pytest.raises(SimulationError, match=r"mode changes of 'pad' accumulate: chatter.*stopped at t = 1"):
        simulate(law, [0.0], [0.0], 1.8, ts=np.array([0.5, 1.5]))
    beside = Scene(law.lagrangian, law.params, law.effects, (Contact(lambda t, q, p: q[0] + 9.0),))
    with pytest.raises(SimulationError, match=r"mode changes of 'pad' accumulate: chatter.*stopped at t = 1"):
        simulate(beside, [0.0], [0.0], 1.8)
    early = simulate(law, [0.0], [0.0], 1.8, ts=np.array([0.5, 1.5]), throw=False)
    assert not early.result.ok
    # The step before ends on the event to 1e-5 of its length.
    np.testing.assert_allclose(early.t_end, 1.0, atol=1e-5)
    np.testing.assert_allclose(early.forces["pad"][0], 0.5)
    held = simulate(law, [0.0], [0.0], 1.8, stick_on_chatter=True)
    # To the absolute tolerance of the run.
    np.testing.assert_allclose(held.q, 0.0, atol=1e-9)
    np.testing.assert_array_equal(held.modes, [[0.0]])
    # In a batch the others go on.
    ramp = lambda r: simulate(scene(Friction(Contradictory()), r=r), [0.0], [0.0], 1.8, throw=False)  # noqa: E731
    batch = jax.vmap(ramp)(jnp.array([0.1, 1.0, 0.2]))
    np.testing.assert_array_equal(batch.result.ok, [True, False, True])
    np.testing.assert_allclose(batch.t_end, [1.8, 1.0, 1.8], atol=1e-5)


def test_the_limit_of_mode_changes_is_named() -> None:
    shaken = scene(Friction(Coulomb(1.0)), a=2.0, w=10.0)
    with pytest.raises(SimulationError, match=r"limit of mode changes was reached.*larger max_events"):
        simulate(shaken, [0.0], [0.0], 10.0, max_events=5)
    run = simulate(shaken, [0.0], [0.0], 10.0, max_events=5, throw=False)
    assert np.sum(np.isfinite(run.events.t)) == 5
    assert run.events.t[4] < run.t_end + 1e-6
    # Whatever times are saved, events are those, and nothing is compiled for them.
    other = simulate(shaken, [0.0], [0.0], 10.0, ts=np.array([1.0, 2.0]), max_events=5, throw=False)
    compiled = compiled_runs()
    np.testing.assert_array_equal(other.events.t, run.events.t)
    assert compiled_runs() == compiled


def test_smooth_and_bristle_laws_converge_to_the_exact_run() -> None:
    """Where a mass on a spring comes to rest: the distance falls with the width, and with one over the stiffness."""

    def spring(law: Any) -> Any:
        box = Scene(masses, params={"m": 1.0, "k": 100.0}, effects=(Friction(law),))
        return simulate(box, [0.1], [0.0], 2.0, rtol=1e-9, atol=1e-12)

    exact = spring(Coulomb(1.5))
    assert exact.mode["friction"][-1] == 0
    smooth = jax.jit(jax.vmap(lambda width: spring(Regularized(Coulomb(1.5), width)).q[-1, 0]))
    widths = jnp.array([1e-4, 1e-5, 1e-6])
    distance = np.abs(np.asarray(smooth(widths)) - float(exact.q[-1, 0]))
    np.testing.assert_allclose(np.diff(np.log10(distance)), -1.0, atol=0.05)

    def bristle(sigma0: Any) -> Any:
        return spring(LuGre(sigma0=sigma0, sigma1=2 * jnp.sqrt(sigma0), sigma2=0.0, Fc=1.5, Fs=1.5, vs=0.1)).q[-1, 0]

    stiffness = jnp.array([1e4, 1e5, 1e6])
    distance = np.abs(np.asarray(jax.jit(jax.vmap(bristle))(stiffness)) - float(exact.q[-1, 0]))
    np.testing.assert_allclose(np.diff(np.log10(distance)), -1.0, atol=0.05)
