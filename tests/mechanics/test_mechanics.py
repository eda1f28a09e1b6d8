"""Equations of motion from Lagrangians against closed forms."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import AppliedForce, Friction, Scene, Viscous, problems
from jaxmodsim.mechanics import acceleration, energies, motion_equations
from jaxmodsim.scene import State, forward_dynamics, vector_field

SAMPLES = 200

# Both sides are sums of a few terms, each right to some roundings: compare with the largest acceleration around.
ROUNDING = 1e-12


def draw(low: float, high: float, *shape: int, seed: int = 11) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).uniform(low, high, shape))


def assert_equal_motion(scene: Scene, closed: Callable[..., Any], q: Any, qd: Any, t: Any = None) -> None:
    t = jnp.zeros(q.shape[0]) if t is None else t
    ours = jax.jit(jax.vmap(lambda t, q, qd: vector_field(t, State(q, qd, {}), scene).qd))(t, q, qd)
    exact = np.asarray(jax.vmap(closed)(t, q, qd))
    scale = np.abs(exact).max(axis=1, keepdims=True) + np.abs(np.asarray(qd)).max(axis=1, keepdims=True) ** 2
    assert ours.shape == exact.shape
    np.testing.assert_array_less(np.abs(ours - exact), np.broadcast_to(ROUNDING * scale, exact.shape))


@pytest.mark.quick
def test_spherical_pendulum() -> None:
    # Away from the poles, where the mass matrix is singular and its inverse loses digits.
    q = jnp.stack([draw(0.3, np.pi - 0.3, SAMPLES), draw(-4, 4, SAMPLES, seed=12)], axis=1)
    qd = draw(-5, 5, SAMPLES, 2)
    scene = problems.spherical_pendulum.scene(m=0.7, R=1.9, g=9.7)
    assert_equal_motion(scene, lambda _, q, qd: problems.spherical_pendulum.acceleration(q, qd, R=1.9, g=9.7), q, qd)


@pytest.mark.parametrize("k", [None, 0.8])
def test_bead_on_a_spherical_spiral(k: float | None) -> None:
    q, qd = draw(-9, 9, 2, SAMPLES, 1)
    numbers: dict[str, Any] = {"m": 0.7, "R": 1.9, "a": 0.35, "g": 9.7}
    scene = problems.spiral_bead.scene(**numbers, k=k)
    assert_equal_motion(scene, lambda _, q, qd: problems.spiral_bead.acceleration(q, qd, **numbers, k=k or 0.0), q, qd)


def test_reaction_of_the_sphere() -> None:
    """Newton's law in space, m r'' = gravity + reaction, with r'' from the closed-form accelerations."""
    m, R, g = 0.7, 1.9, 9.7
    q, qd = jnp.array([0.8, 0.3]), jnp.array([1.1, -2.0])

    def position(q: Any) -> Any:
        return R * jnp.stack([jnp.sin(q[0]) * jnp.cos(q[1]), jnp.sin(q[0]) * jnp.sin(q[1]), jnp.cos(q[0])])

    qdd = problems.spherical_pendulum.acceleration(q, qd, R=R, g=g)
    velocity = lambda q, qd: jax.jvp(position, (q,), (qd,))[1]  # noqa: E731
    spatial = jax.jvp(velocity, (q, qd), (qd, qdd))[1]
    reaction = m * spatial + jnp.array([0.0, 0.0, m * g])
    radial = problems.spherical_pendulum.reaction(q, qd, m=m, R=R, g=g)
    np.testing.assert_allclose(reaction, radial * position(q) / R, atol=1e-12)


def moving_pivot(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """Pendulum of length l whose pivot moves sideways as A sin(w t): L depends on t in the kinetic energy."""
    pivot = p["A"] * p["w"] * jnp.cos(p["w"] * t)
    x, z = pivot + p["l"] * jnp.cos(q[0]) * qd[0], p["l"] * jnp.sin(q[0]) * qd[0]
    return 0.5 * p["m"] * (x**2 + z**2) + p["m"] * p["g"] * p["l"] * jnp.cos(q[0])


PIVOT = {"m": 0.8, "l": 1.3, "A": 0.4, "w": 2.7, "g": 9.81}


def test_pendulum_with_a_moving_pivot() -> None:
    q, qd = draw(-4, 4, 2, SAMPLES, 1)
    t = draw(0, 5, SAMPLES)

    def closed(t: Any, q: Any, qd: Any) -> Any:
        del qd
        pivot = -PIVOT["A"] * PIVOT["w"] ** 2 * jnp.sin(PIVOT["w"] * t)
        return -(PIVOT["g"] * jnp.sin(q) + pivot * jnp.cos(q)) / PIVOT["l"]

    assert_equal_motion(Scene(moving_pivot, params=PIVOT), closed, q, qd, t)


def test_mass_that_varies_with_time() -> None:
    """L = m(t) qd^2/2 gives qdd = -m'/m qd."""
    scene = Scene(lambda t, q, qd, p: 0.5 * p["m"] * jnp.exp(p["c"] * t) * qd[0] ** 2 + 0 * q[0], {"m": 2.0, "c": 0.3})
    q, qd = draw(-4, 4, 2, SAMPLES, 1)
    assert_equal_motion(scene, lambda t, q, qd: -0.3 * qd + 0 * t * q, q, qd, draw(0, 5, SAMPLES))


def rotating(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """Free particle in a frame that turns at w: Coriolis and centrifugal terms from gyroscopic ones in L."""
    del t
    return 0.5 * p["m"] * ((qd[0] - p["w"] * q[1]) ** 2 + (qd[1] + p["w"] * q[0]) ** 2)


def test_particle_in_a_rotating_frame() -> None:
    q, qd = draw(-4, 4, 2, SAMPLES, 2)
    scene = Scene(rotating, params={"m": 0.4, "w": 1.7})

    def closed(t: Any, q: Any, qd: Any) -> Any:
        del t
        return 1.7**2 * q + 2 * 1.7 * jnp.stack([qd[1], -qd[0]])

    assert_equal_motion(scene, closed, q, qd)


def test_mass_matrix_and_force_enter_as_they_should() -> None:
    """Two masses coupled by inertia, L = qd.M.qd/2, and a force: qdd = M^-1 F."""
    mass = jnp.array([[2.0, 0.5], [0.5, 1.0]])
    free = lambda t, q, qd, p: 0.5 * jnp.sum(qd * (p @ qd))  # noqa: E731
    zero = jnp.zeros(2)
    equations = motion_equations(free, jnp.array(0.0), zero, zero, mass)
    np.testing.assert_allclose(equations.mass, mass, rtol=1e-15)
    np.testing.assert_array_equal(equations.load, zero)
    push = jnp.array([1.0, -3.0])
    ours = acceleration(free, jnp.array(0.0), zero, zero, mass, push)
    np.testing.assert_allclose(ours, np.linalg.solve(mass, push), rtol=1e-14)


def test_energies_of_a_pendulum() -> None:
    q, qd, p = jnp.array([0.8, 0.3]), jnp.array([1.1, -2.0]), {"m": 0.7, "R": 1.9, "g": 9.7}
    scene = problems.spherical_pendulum.scene(**p)
    kinetic, potential = energies(scene.lagrangian, jnp.array(0.0), q, qd, scene.params)
    square = 1.1**2 + (np.sin(0.8) * 2.0) ** 2
    np.testing.assert_allclose(kinetic, 0.5 * 0.7 * 1.9**2 * square, rtol=1e-14)
    np.testing.assert_allclose(potential, 0.7 * 9.7 * 1.9 * np.cos(0.8), rtol=1e-13)


def test_energies_in_a_rotating_frame() -> None:
    """T is quadratic in the relative velocity; V holds the centrifugal potential."""
    q, qd = jnp.array([0.8, 0.3]), jnp.array([1.1, -2.0])
    kinetic, potential = energies(rotating, jnp.array(0.0), q, qd, {"m": 0.4, "w": 1.7})
    np.testing.assert_allclose(kinetic, 0.5 * 0.4 * (1.1**2 + 2.0**2), rtol=1e-14)
    np.testing.assert_allclose(potential, -0.5 * 0.4 * 1.7**2 * (0.8**2 + 0.3**2), rtol=1e-13)


def test_force_at_a_point_is_mapped_by_the_transposed_jacobian() -> None:
    def at(q: Any) -> Any:
        return jnp.stack([jnp.sin(q[0]) * q[1], jnp.cos(q[0] * q[1]), q[0] ** 2 - q[1]])

    def fn(t: Any, q: Any, qd: Any, p: Any) -> Any:
        return p["F"] * (1.0 + t) + jnp.stack([q[0], qd[1], q[1] * qd[0]])

    params = {"F": jnp.array([0.3, -1.2, 2.0])}
    t, q, qd = jnp.array(0.4), jnp.array([0.7, -0.6]), jnp.array([1.1, 0.2])
    effect = AppliedForce(fn, at=at)
    action = effect.act(t, q, qd, None, params)
    np.testing.assert_allclose(action.force, fn(t, q, qd, params))
    np.testing.assert_allclose(action.generalised, jax.jacobian(at)(q).T @ fn(t, q, qd, params), rtol=1e-14)
    # And its power is that of the force along the velocity of the point.
    power = effect.power(t, q, qd, params, action)
    np.testing.assert_allclose(power.supplied, fn(t, q, qd, params) @ (jax.jacobian(at)(q) @ qd), rtol=1e-14)


def test_friction_along_a_displacement() -> None:
    """Slip is the rate of `along` less the belt's; the force acts down its gradient; the load multiplies it."""

    def along(q: Any) -> Any:
        return jnp.sin(q[0]) + q[0] * q[1]

    scene = Scene(
        lambda t, q, qd, p: 0.5 * p["m"] * jnp.sum(qd**2) + 0 * t * q[0],
        params={"m": 2.0},
        effects=(
            Friction(
                Viscous(0.3),
                along=along,
                belt_velocity=lambda t: 0.1 * t,
                normal_force=lambda t, q, qd, p: p["m"] * 9.81 + qd[0] * q[1] + t,
            ),
        ),
    )
    t, q, qd = jnp.array(0.4), jnp.array([0.7, -0.6]), jnp.array([1.1, 0.2])
    gradient = np.array([np.cos(0.7) - 0.6, 0.7])
    force = (2.0 * 9.81 - 0.66 + 0.4) * 0.3 * (gradient @ np.array([1.1, 0.2]) - 0.04)
    np.testing.assert_allclose(forward_dynamics(t, State(q, qd, {}), scene).forces["friction"], force, rtol=1e-14)
    np.testing.assert_allclose(vector_field(t, State(q, qd, {}), scene).qd, -force * gradient / 2.0, rtol=1e-14)


@pytest.mark.parametrize(("load", "expected"), [(-3.0, 0.0), (0.0, 0.0), (2.0, 2.0 * 0.3 * 0.5)])
def test_lift_off_gives_no_friction(load: float, expected: float) -> None:
    effect = Friction(Viscous(0.3), normal_force=lambda *state: load)
    action = effect.act(jnp.array(0.0), jnp.array([0.0]), jnp.array([0.5]), None, {})
    np.testing.assert_allclose(action.force, expected)


def test_braked_spring_closed_form() -> None:
    """Piecewise solution: its pieces join, it obeys m x'' = -k x - Fc sign(x'), and it rests where it says."""
    numbers = dict(problems.braked_spring.PARAMS)
    rest = problems.braked_spring.rest(**numbers)
    assert rest.half_cycles == 12
    np.testing.assert_allclose(rest.t, problems.braked_spring.STOP, rtol=1e-14)
    half = float(rest.t) / 12
    x, v = problems.braked_spring.motion(jnp.asarray(half * np.arange(1, 14)) - 1e-9, **numbers)
    after, _ = problems.braked_spring.motion(jnp.asarray(half * np.arange(1, 14)) + 1e-9, **numbers)
    # Speeds within 1e-9 s of a turning point are below 1e-9 times the acceleration.
    np.testing.assert_allclose(x, after, atol=1e-15)
    np.testing.assert_allclose(v, 0.0, atol=3e-9)
    np.testing.assert_allclose(x[-1], rest.x)
    assert abs(float(rest.x)) <= numbers["Fs"] / numbers["k"]

    def speed(t: Any) -> Any:
        return problems.braked_spring.motion(t, **numbers)[1]

    t = jnp.asarray(half * (np.arange(12) + 0.37))
    x, v = problems.braked_spring.motion(t, **numbers)
    pull = -numbers["k"] * x - numbers["Fc"] * jnp.sign(v)
    np.testing.assert_allclose(numbers["m"] * jax.vmap(jax.grad(speed))(t), pull, atol=1e-12)
    rate = jax.vmap(jax.grad(lambda t: problems.braked_spring.motion(t, **numbers)[0]))(t)
    np.testing.assert_allclose(rate, v, atol=1e-12)


def test_derivatives_of_the_resting_place() -> None:
    def place(x0: Any, Fc: Any) -> Any:
        return problems.braked_spring.rest(**{**problems.braked_spring.PARAMS, "x0": x0, "Fc": Fc}).x

    by_x0, by_fc = jax.grad(place, argnums=(0, 1))(jnp.array(1.0), jnp.array(0.11))
    np.testing.assert_allclose(by_x0, 1.0)
    np.testing.assert_allclose(by_fc, -2 * 12 / 2.7, rtol=1e-14)
