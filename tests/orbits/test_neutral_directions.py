"""Orbits in places that nothing determines: machines that advance, and coordinates that stick throughout."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

import jaxmodsim as jms
from jaxmodsim.mechanics import Contact
from jaxmodsim.orbits import OrbitError
from jaxmodsim.scene import scene_numbers


def of_frequency(p):
    return 2.0 * jnp.pi / p["W"]


def free(_t, _q, qd, p):
    return 0.5 * p["m"] * jnp.sum(qd**2)


def pull(t, _q, qd, p):
    return (p["F0"] + p["F1"] * jnp.cos(p["W"] * t)) * jnp.eye(len(qd))[0]


BOX = {"m": 1.3, "F0": 1.0, "F1": 2.5, "W": 2.0}


def box(*more, friction=None, constraints=(), **numbers):
    friction = jms.Friction(jms.Coulomb(2.0)) if friction is None else friction
    effects = (jms.AppliedForce(pull), friction, *more)
    return jms.Scene(free, BOX | numbers, effects, constraints=constraints, coordinates=("x [m]",))


def advance_of_a_box(m=1.3, F0=1.0, F1=2.5, W=2.0, Fc=2.0):
    """Of the closed form: slip from where the force exceeds friction to where the velocity is zero again."""
    begin = -np.arccos((Fc - F0) / F1) / W

    def velocity(t):
        return ((F0 - Fc) * (t - begin) + F1 / W * (np.sin(W * t) - np.sin(W * begin))) / m

    end: float = brentq(velocity, 0.0, begin + 2 * np.pi / W, xtol=1e-14)  # pyright: ignore[reportAssignmentType]
    s = end - begin
    return (0.5 * (F0 - Fc) * s**2 - F1 / W * np.sin(W * begin) * s - F1 / W**2 * np.cos(W * end)) / m + (
        F1 / W**2 * np.cos(W * begin) / m
    )


@pytest.fixture(scope="module")
def advancing():
    return jms.periodic_orbit(box(), ([0.5], [0.0]), period=of_frequency)


def test_a_box_that_is_pulled_over_a_floor_advances_as_its_closed_form(advancing):
    np.testing.assert_allclose(advancing.advance, advance_of_a_box(), rtol=1e-9)
    np.testing.assert_allclose(advancing.q, 0.5)  # where the guess is
    np.testing.assert_allclose(advancing.highest - advancing.lowest, advancing.advance, rtol=1e-9)
    assert list(advancing.multipliers) == [1.0, 0.0]
    assert advancing.neutral == 1
    assert advancing.stability == "stable"
    assert "advance" in str(advancing)
    segments = jms.periodic_orbit(box(), advancing, period=of_frequency, segments=3)
    np.testing.assert_allclose(segments.advance, advancing.advance, rtol=1e-9)
    assert list(segments.multipliers) == [1.0, 0.0]


def test_the_advance_has_the_derivatives_of_its_closed_form(advancing):
    def advance(scene):
        return jms.periodic_orbit(scene, advancing, period=of_frequency, rtol=1e-12, atol=1e-14).advance[0]

    reverse, ones = scene_numbers(jax.grad(advance)(box())), jax.tree.map(jnp.ones_like, box())
    numbers = BOX | {"Fc": 2.0}
    for name, x in numbers.items():
        # The error of the step falls with its square, to 1e-10; that of the root rises with its inverse.
        h = 1e-5 * x
        difference = (advance_of_a_box(**{name: x + h}) - advance_of_a_box(**{name: x - h})) / (2 * h)
        np.testing.assert_allclose(reverse["friction.Fc" if name == "Fc" else name], difference, rtol=1e-7)
    np.testing.assert_allclose(jax.jvp(advance, (box(),), (ones,))[1], sum(reverse.values()), rtol=1e-9)


def test_a_branch_of_advancing_orbits_ends_where_the_box_does_not_move(advancing, tmp_path):
    def follow(**options):
        return jms.continue_orbits(
            box(), advancing, "friction.Fc", (2.0, 3.2), period=of_frequency, step=0.2, out=tmp_path / "box", **options
        )

    follow(max_orbits=4)
    branch = follow()
    exact = [advance_of_a_box(Fc=x) for x in branch.values]
    np.testing.assert_allclose([x.advance[0] for x in branch.orbits], exact, rtol=1e-8)
    assert branch.stable.all()
    assert "end of the span" in branch.ending


def joined(_t, q, qd, p):
    """Two bodies on a spring, geared one to `n`."""
    return 0.5 * qd[0] ** 2 + 0.7 * qd[1] ** 2 - 0.5 * p["k"] * (q[1] - p["n"] * q[0]) ** 2


def drag(_t, _q, qd, _p):
    return -0.4 * qd


@pytest.mark.parametrize("n", [1.0, -2.5])
def test_bodies_that_are_joined_advance_together(n):
    p = {"k": 3.0, "n": n, "F0": 1.0, "F1": 2.5, "W": 2.0}
    scene = jms.Scene(joined, p, (jms.AppliedForce(pull), jms.AppliedForce(drag)))
    orbit = jms.periodic_orbit(scene, ([0.0, 0.3], [0.0, 0.0]), period=of_frequency)
    # Mean velocities v and n v, at which the mean force does the work that the drag takes.
    mean = p["F0"] / (0.4 * (1.0 + n**2))
    np.testing.assert_allclose(orbit.advance, 2 * np.pi / p["W"] * mean * np.array([1.0, n]), rtol=1e-9)
    stiffness = -p["k"] * np.array([[n**2, -n], [-n / 1.4, 1 / 1.4]])
    system = np.block([[np.zeros((2, 2)), np.eye(2)], [stiffness, -0.4 * np.diag([1.0, 1 / 1.4])]])
    exact = np.linalg.eigvals(expm(system * 2 * np.pi / p["W"]))
    np.testing.assert_allclose(np.sort(np.abs(orbit.multipliers)), np.sort(np.abs(exact)), rtol=1e-6)
    assert orbit.multipliers[0] == 1.0


def oscillator_and_box(_t, q, qd, _p):
    return 0.5 * jnp.sum(qd**2) - 0.5 * q[0] ** 2


def push(_t, q, qd, p):
    return jnp.stack([p["mu"] * (1.0 - q[0] ** 2) * qd[0], p["F0"] + q[0]])


def the_box(q):
    return q[1]


def test_an_orbit_of_unknown_period_advances():
    # Van der Pol's oscillator, which is not disturbed, pulls a box with the force F0 + q0.
    friction = jms.Friction(jms.Coulomb(1.5), along=the_box)
    scene = jms.Scene(oscillator_and_box, {"mu": 1.0, "F0": 0.5}, (jms.AppliedForce(push), friction))
    orbit = jms.periodic_orbit(scene, ([0.0, 0.0], [0.5, 0.0]), settle=60.0)
    np.testing.assert_allclose(orbit.period, 6.6632868593231, rtol=1e-8)
    assert list(orbit.multipliers[:2]) == [1.0, 1.0]
    assert orbit.multipliers[3] == 0.0
    assert orbit.stability == "stable"
    # A plain run, which has settled.
    ts = 90.0 + orbit.period * np.arange(3)
    run = jms.simulate(scene, [0.0, 0.0], [0.5, 0.0], ts[-1], ts=ts, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(orbit.advance[1], np.diff(run.q[:, 1]), rtol=1e-7)
    assert orbit.advance[0] == 0.0


def washboard(_t, q, _qd, _p):
    return 0.05 * jnp.sin(q)


def wall(_t, q, _p):
    return 200.0 - q[0]


@pytest.mark.parametrize(
    "scene",
    [
        box(jms.AppliedForce(washboard)),
        box(friction=jms.AppliedForce(drag), constraints=(Contact(wall, restitution=0.5, name="wall"),)),
    ],
)
def test_a_machine_that_advances_over_a_ground_that_changes_is_refused(scene):
    with pytest.raises(OrbitError, match=r"the machine advances, x by .* such a shift changes its motion"):
        jms.periodic_orbit(scene, ([0.5], [0.0]), period=of_frequency, settle=2 * np.pi)


def coupled(_t, q, qd, p):
    return 0.5 * jnp.sum(qd**2) - 0.5 * q[0] ** 2 - 0.5 * p["k"] * (q[1] - q[0]) ** 2


def swing(t, _q, qd, p):
    return jnp.stack([jnp.cos(p["W"] * t) - 0.2 * qd[0], jnp.zeros_like(t)])


def beside_a_held_mass(Fc=2.0):
    effects = (jms.AppliedForce(swing), jms.Friction(jms.Coulomb(Fc), along=the_box, name="floor"))
    return jms.Scene(coupled, {"k": 0.5, "W": 0.7}, effects)


def extent_beside_a_held_mass(k=0.5, W=0.7, place=0.3):
    """Least and greatest position of the mass that moves."""
    size = 1.0 / abs(1.0 + k - W**2 + 0.2j * W)
    return k * place / (1.0 + k) + size * np.array([-1.0, 1.0])


@pytest.mark.parametrize("place", [0.0, 0.3])
def test_a_mass_that_sticks_throughout_keeps_its_position(place):
    scene, guess = beside_a_held_mass(), ([0.0, place], [0.0, 0.0])
    orbit = jms.periodic_orbit(scene, guess, period=of_frequency)
    extent = extent_beside_a_held_mass(place=place)
    np.testing.assert_allclose([orbit.lowest[0], orbit.highest[0]], extent, rtol=1e-9)
    np.testing.assert_allclose([orbit.lowest[1], orbit.highest[1]], place, atol=1e-12)
    exact = np.exp(2 * np.pi / 0.7 * np.roots([1.0, 0.2, 1.5]))
    np.testing.assert_allclose(np.sort_complex(orbit.multipliers[1:3]), np.sort_complex(exact), rtol=1e-8)
    assert orbit.multipliers[0] == 1.0
    assert orbit.multipliers[3] == 0.0
    assert orbit.stick == {"floor": 1.0}
    assert orbit.stability == "stable"
    assert "floor sticks throughout, at or near the guess" in str(orbit)

    def highest(scene):
        return jms.periodic_orbit(scene, guess, period=of_frequency, rtol=1e-12, atol=1e-14).highest[0]

    reverse, h = jax.grad(highest)(scene).params, 1e-5
    for name, x in (("k", 0.5), ("W", 0.7)):
        above, below = (extent_beside_a_held_mass(**{name: x + d}, place=place)[1] for d in (h, -h))
        np.testing.assert_allclose(reverse[name], (above - below) / (2 * h), rtol=1e-7)


def test_a_branch_with_a_held_mass_ends_at_its_break_away():
    scene, guess = beside_a_held_mass(0.6), ([0.0, 0.1], [0.0, 0.0])
    branch = jms.continue_orbits(scene, guess, "k", (0.5, 1.2), period=of_frequency, step=0.2)
    (place,) = {round(float(x.q[1]), 12) for x in branch.orbits}
    extent = np.array([extent_beside_a_held_mass(k, place=place) for k in branch.values])
    np.testing.assert_allclose([x.highest[0] for x in branch.orbits], extent[:, 1], rtol=1e-8)
    # The spring pulls with no more than friction holds.
    pulls = branch.values[:, None] * (extent - place)
    assert np.max(np.abs(pulls)) <= 0.6
    np.testing.assert_allclose(np.max(np.abs(pulls[-1])), 0.6, rtol=1e-4)
    assert "floor" in branch.ending
    assert "slips" in branch.ending


def test_a_coordinate_at_rest_has_no_extent_of_its_own():
    # Its velocity is an error of the run, which is no scale for residuals.
    scene = jms.Scene(hanging, {"k": 1e4, "m": 1.0, "W": 1.0}, (jms.AppliedForce(swing_above),))
    guess = ([0.1, -9.81e-4], [0.0, 0.0])
    orbit = jms.periodic_orbit(scene, guess, period=of_frequency, settle=0.0)
    np.testing.assert_allclose(orbit.amplitude[0], 5.0, rtol=1e-9)
    # Of fast disturbances, which leave no trace in the state of the orbit.
    decay = np.exp(2 * np.pi * np.roots([1.0, 0.2, 1.0]))
    fast = np.exp(2 * np.pi * np.roots([1.0, 40.0, 1e4]))
    np.testing.assert_allclose(np.sort_complex(orbit.multipliers[:2]), np.sort_complex(decay), rtol=1e-8)
    np.testing.assert_allclose(orbit.multipliers[2:], fast, atol=1e-9)
    place = jax.grad(lambda s: jms.periodic_orbit(s, orbit, period=of_frequency).q[1])(scene).params
    np.testing.assert_allclose([place["m"], place["k"]], [-9.81e-4, 9.81e-8], rtol=1e-8)


def hanging(_t, q, qd, p):
    masses = 0.5 * qd[0] ** 2 + 0.5 * p["m"] * qd[1] ** 2
    return masses - 0.5 * q[0] ** 2 - 0.5 * p["k"] * q[1] ** 2 - 9.81 * p["m"] * q[1]


def swing_above(t, _q, qd, p):
    return jnp.stack([jnp.cos(p["W"] * t) - 0.2 * qd[0], -40.0 * qd[1]])
