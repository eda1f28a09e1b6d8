"""Friction forces, guards and modes of elements that are written down as numbers, against solutions by hand."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim.scene._event_driven import (
    FrictionElements,
    LawForces,
    Loads,
    PlanarSlip,
    friction_guards,
    mode_numbers,
    next_modes,
    renew_slip,
    solve_friction_forces,
    stick_violation,
)

REST = jnp.asarray(1e-9)
TOLERANCES = jnp.asarray(1e-6), jnp.asarray(1e-8)


def scalars(**numbers: Any) -> FrictionElements:
    """Two elements with a limit of 1 N, 0.5 N in slip, that are coupled."""
    usual: dict[str, Any] = {
        "v": [0.0, 0.0],
        "free_slip_acceleration": [3.0, 1.0],
        "delassus": [[2.0, 1.0], [1.0, 2.0]],
        "minv_jt": [[1.0, 0.0], [0.0, 1.0]],
        "positive_slip": [0.5, 0.5],
        "negative_slip": [-0.5, -0.5],
        "upper": [1.0, 1.0],
        "lower": [1.0, 1.0],
    }
    loads, gears = numbers.pop("loads", None), numbers.pop("gears", None)
    v, free, delassus, minv_jt, *laws = (jnp.asarray(x, float) for x in (usual | numbers).values())
    return FrictionElements(v, free, delassus, minv_jt, LawForces(*laws), loads=loads, gears=gears)


def plane(v: Any, free: Any = (0.0, 0.0, 0.0)) -> FrictionElements:
    """An element in a plane, limit 2 N, and a scalar one, limit 1 N; in rows of the plane scalar forces have no use."""
    limit = jnp.array([2.0, 2.0, 1.0])
    force, onset = jnp.array([0.3, 0.4, 0.0]), jnp.array([1.5, 1.5, 0.0])
    unused = jnp.array([jnp.nan, jnp.nan, 1.0])
    laws, one = LawForces(unused, -unused, limit, limit), jnp.eye(3)
    v, free = jnp.asarray(v, float), jnp.asarray(free, float)
    return FrictionElements(v, free, one, one, laws, PlanarSlip(force, onset), planes=((0, 2),))


def test_stick_takes_the_acceleration_that_slip_leaves() -> None:
    """The first slips with 0.5 N, so the second needs (1 - 0.5)/2 N."""
    forces = solve_friction_forces(scalars(), jnp.array([1.0, 0.0]))
    np.testing.assert_allclose(forces.force, [0.5, 0.25], rtol=1e-14)
    backward = solve_friction_forces(scalars(), jnp.array([-1.0, 0.0]))
    np.testing.assert_allclose(backward.force, [-0.5, 0.75], rtol=1e-14)


@pytest.mark.parametrize(("pulls", "normal"), [(0.0, 10.0), (0.0, -10.0), (-1.0, -10.0)])
def test_a_reaction_as_load_is_solved_with_the_friction_under_it(pulls: float, normal: float) -> None:
    """n = normal - 0.4 f with f = 0.5 |n|, or 0.5 max(n, 0) of a contact."""
    on, coupling, none = jnp.array([[1.0], [0.0]]), jnp.array([[0.4, 0.0]]), jnp.zeros(1)
    loads = Loads(on, jnp.array([normal]), coupling, jnp.array([pulls]), side=none, mass=none, rounding=none)
    forces = solve_friction_forces(scalars(loads=loads), jnp.array([1.0, 0.0]))
    load = normal / 1.2 if normal > 0 else -normal / 0.8 if pulls else 0.0
    np.testing.assert_allclose(forces.force, [0.5 * load, (1.0 - 0.5 * load) / 2.0], rtol=1e-13)
    np.testing.assert_allclose(forces.upper, [load, 1.0], rtol=1e-13)
    np.testing.assert_allclose(forces.margin, 1.0 + 0.2 * min(1.0, pulls), rtol=1e-14)


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize("normal", [10.0, -10.0])
def test_a_gear_has_coefficients_by_the_direction_of_power(normal: float, direction: float) -> None:
    """n = normal - 0.4 f with f = direction (0.3 + c |n|): c is 0.5 where direction n > 0, and 0.2 otherwise."""
    law, other = ([0.5, -0.2, 0.5, 0.2], [0.2, -0.5, 0.2, 0.5])
    first = jnp.array([1.0, 0.0])
    returned = LawForces(*(first * (b - a) for a, b in zip(law, other, strict=True)))
    gears = LawForces(*(first * x for x in (0.3, -0.3, 0.4, 0.4))), returned
    on, coupling, none = jnp.array([[1.0], [0.0]]), jnp.array([[0.4, 0.0]]), jnp.zeros(1)
    loads = Loads(on, jnp.array([normal]), coupling, jnp.array([-1.0]), side=none, mass=none, rounding=none)
    sides = {"positive_slip": 0.5, "negative_slip": -0.2, "upper": 0.5, "lower": 0.2}
    of_rows = {name: [x, np.sign(x)] for name, x in sides.items()}
    forces = solve_friction_forces(scalars(loads=loads, gears=gears, **of_rows), jnp.array([direction, 0.0]))
    c = 0.5 if direction * normal > 0 else 0.2
    n = (normal - 0.12 * direction) / (1.0 + 0.4 * c * direction * np.sign(normal))
    np.testing.assert_allclose(forces.normal, [n], rtol=1e-14)
    np.testing.assert_allclose(forces.force[0], direction * (0.3 + c * abs(n)), rtol=1e-14)
    forwards, backwards = (0.5, 0.2) if normal > 0 else (0.2, 0.5)
    np.testing.assert_allclose(forces.upper, [0.4 + forwards * abs(n), 1.0], rtol=1e-14)
    np.testing.assert_allclose(forces.lower, [0.4 + backwards * abs(n), 1.0], rtol=1e-14)


def test_slip_in_a_plane_has_forces_of_its_own() -> None:
    """At the state the force of the law; at the onset its magnitude in the direction of the reference velocity."""
    mode = jnp.array([0.03, 0.04, 1.0])
    elements = plane([0.1, 0.2, 0.3])
    np.testing.assert_array_equal(solve_friction_forces(elements, mode).force, [0.3, 0.4, 1.0])
    begins = jnp.array([True, True, False])
    np.testing.assert_allclose(solve_friction_forces(elements, mode, begins).force, [0.9, 1.2, 1.0], rtol=1e-14)


def test_guards_fall_through_zero_at_the_limits() -> None:
    rounding = jnp.array([1e-9, 4e-9])
    for load, guard in ((1.0, 0.0), (-1.0, 0.0), (0.5, 0.375), (0.0, 0.5)):
        elements = scalars(free_slip_acceleration=[2.0 * load, load])
        forces = solve_friction_forces(elements, jnp.zeros(2))
        np.testing.assert_allclose(forces.force[0], load, atol=1e-14)
        forces = forces._replace(force=jnp.array([load, 0.0]))  # without rounding
        value, error, event = friction_guards(elements, forces, jnp.zeros(2), REST, rounding, TOLERANCES)
        np.testing.assert_allclose(value[0], guard, atol=1e-14)
        assert 0 < event[0] < 1e-13
        assert value[0] > 0  # not at the limit itself: rounding must not end a stick
        np.testing.assert_allclose(error, 2e-6)
    moving = scalars(v=[0.2, -0.2])
    slip = solve_friction_forces(moving, jnp.ones(2))
    value, error, event = friction_guards(moving, slip, jnp.ones(2), REST, rounding, TOLERANCES)
    np.testing.assert_allclose(value, [0.2, -0.2], atol=1e-8)
    np.testing.assert_allclose(error, [1.1e-8, 1.4e-8], rtol=1e-12)
    np.testing.assert_allclose(event, [0.25e-9, 1e-9], rtol=1e-12)


def test_guards_of_a_plane_ask_for_a_new_reference_velocity() -> None:
    """Slip of 0.05 m/s along the reference velocity of 1 m/s is half of what renews it; another part is far away."""
    mode = jnp.array([0.6, 0.8, 0.0])
    elements = plane([0.03, 0.04, 0.0])
    forces = solve_friction_forces(elements, mode)
    value, _, event = friction_guards(elements, forces, mode, REST, jnp.full(3, 1e-9), TOLERANCES)
    np.testing.assert_array_equal(event[:2], 0.0)
    np.testing.assert_allclose(value[:2], [0.05 - 0.1, 1e4 - 0.05], rtol=1e-12)
    renewed, changes = renew_slip(elements, mode, jnp.array([True, False, False]), REST)
    np.testing.assert_allclose(renewed, [0.03, 0.04, 0.0], rtol=1e-12)
    assert not np.any(changes)
    # The last reference velocity is the least one: from there slip ends.
    least = 1e6 * REST * mode
    renewed, changes = renew_slip(plane([-1e-12, 0.0, 0.0]), least, jnp.array([True, False, False]), REST)
    np.testing.assert_array_equal(changes, [True, True, False])
    np.testing.assert_array_equal(renewed, least)


def test_modes_after_an_instant_at_rest() -> None:
    """Loads of (1.2, 1.6) N hold a plane with a limit of 2 N, (1.5, 2) N do not; a scalar beside it slips at 1.1 N."""
    every = jnp.ones(3, bool)
    for load, slips in ((1.0, False), (1.25, True)):
        elements = plane([0.0, 0.0, 0.0], (1.2 * load, 1.6 * load, 1.1))
        mode = next_modes(elements, jnp.zeros(3), every, ~every, REST)
        least = 1e6 * float(REST)
        np.testing.assert_allclose(mode, [0.6 * least * slips, 0.8 * least * slips, 1.0], rtol=1e-12)
        held = jnp.zeros(3)
        beyond = stick_violation(elements, solve_friction_forces(elements, held), held)
        np.testing.assert_allclose(beyond, [load - 1.0, load - 1.0, 0.1], atol=1e-12)


def test_the_number_of_a_mode_says_whether_a_plane_slips() -> None:
    modes = jnp.array([[0.0, 1e-9, -1.0], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(mode_numbers(modes, (2, 1)), [[1.0, -1.0], [0.0, 1.0]])


@pytest.mark.parametrize("force", [-1e-17, 0.0, 1e-17])
def test_an_element_at_its_limit_slips_towards_that_limit(force):
    """A freewheel at its limit of zero goes forwards, whatever the sign of the rounding in its force."""
    numbers = {
        "v": [0.0], "free_slip_acceleration": [force], "delassus": [[1.0]], "minv_jt": [[1.0]],
        "positive_slip": [0.0], "negative_slip": [-100.0], "upper": [0.0], "lower": [100.0],
    }  # fmt: skip
    freewheel = scalars(**numbers)
    at = jnp.array([True])
    assert next_modes(freewheel, jnp.zeros(1), at, at, REST)[0] == 1.0


def test_stick_without_a_normal_force_leaves_the_forces_of_the_others_exact():
    """The multipliers of elements that are not redundant do not depend on their limits, here one of zero."""
    limits = {"upper": [1.0, 0.0], "lower": [1.0, 0.0]}
    elements = scalars(free_slip_acceleration=[1.0, 2.0], delassus=[[2.0, 1.0], [1.0, 3.0]], **limits)
    np.testing.assert_allclose(solve_friction_forces(elements, jnp.zeros(2)).force, [0.2, 0.6], rtol=1e-10)
