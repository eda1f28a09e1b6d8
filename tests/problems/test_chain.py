"""Chains of links: automatic differentiation, closed forms and symbolic equations agree."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from sympy.physics.mechanics import dynamicsymbols

from jaxmodsim import problems, simulate
from jaxmodsim.mechanics import energies
from jaxmodsim.scene import State, vector_field

from ..helpers.symbolic import TIME, symbolic_motion

SAMPLES = 200
G = 9.7


def numbers(n: int) -> dict[str, Any]:
    rng = np.random.default_rng(n)
    return {"m": rng.uniform(0.5, 2.0, n), "l": rng.uniform(0.5, 2.0, n), "g": G}


def states(n: int, samples: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(17)
    return rng.uniform(-4.0, 4.0, (samples, n)), rng.uniform(-5.0, 5.0, (samples, n))


def ours(n: int, q: Any, qd: Any) -> np.ndarray:
    scene, zero = problems.n_link_pendulum.scene(n, **numbers(n)), jnp.array(0.0)
    return np.asarray(jax.jit(jax.vmap(lambda q, qd: vector_field(zero, State(q, qd, {}), scene).qd))(q, qd))


def closed(n: int, q: Any, qd: Any) -> np.ndarray:
    values = numbers(n)
    return np.asarray(jax.vmap(lambda q, qd: problems.n_link_pendulum.acceleration(q, qd, **values))(q, qd))


def assert_close(a: np.ndarray, b: np.ndarray, tolerance: float) -> None:
    """To a part of the largest acceleration, as each is a sum of terms of that size."""
    assert a.shape == b.shape
    scale = np.abs(b).max(axis=1, keepdims=True) + 1.0
    np.testing.assert_array_less(np.abs(a - b), np.broadcast_to(tolerance * scale, b.shape))


@pytest.mark.quick
@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_accelerations_by_differentiation_and_in_closed_form(n: int) -> None:
    q, qd = states(n)
    assert_close(ours(n, q, qd), closed(n, q, qd), 1e-12)


def test_accelerations_of_a_long_chain() -> None:
    """Beyond the size up to which everything is written out; the mass matrix is worse conditioned there."""
    q, qd = states(14, 20)
    assert_close(ours(14, q, qd), closed(14, q, qd), 1e-11)


def test_one_link_is_the_simple_pendulum() -> None:
    q, qd = states(1)
    assert_close(closed(1, q, qd), -G / numbers(1)["l"] * np.sin(q), 1e-14)


def test_two_links_are_the_double_pendulum_of_the_textbooks() -> None:
    """Solved for the accelerations, as in every collection of chaotic systems."""
    q, qd = states(2)
    (m1, m2), (l1, l2) = numbers(2)["m"], numbers(2)["l"]
    q1, q2, w1, w2 = q[:, 0], q[:, 1], qd[:, 0], qd[:, 1]
    sine, cosine = np.sin(q1 - q2), np.cos(q1 - q2)
    denominator = 2 * m1 + m2 - m2 * np.cos(2 * q1 - 2 * q2)
    first = -G * (2 * m1 + m2) * np.sin(q1) - m2 * G * np.sin(q1 - 2 * q2)
    first -= 2 * sine * m2 * (w2**2 * l2 + w1**2 * l1 * cosine)
    second = 2 * sine * (w1**2 * l1 * (m1 + m2) + G * (m1 + m2) * np.cos(q1) + w2**2 * l2 * m2 * cosine)
    exact = np.stack([first / (l1 * denominator), second / (l2 * denominator)], axis=1)
    assert_close(closed(2, q, qd), exact, 1e-12)
    assert_close(ours(2, q, qd), exact, 1e-12)


def symbolic_chain(n: int) -> tuple[Any, list[Any], dict[Any, float]]:
    """Lagrangian, coordinates and parameters of the chain, by the positions of its masses."""
    q = list(dynamicsymbols(f"q:{n}"))
    m, l, g = sympy.symbols(f"m:{n}"), sympy.symbols(f"l:{n}"), sympy.Symbol("g")
    x = z = energy = sympy.Integer(0)
    for i in range(n):
        x, z = x + l[i] * sympy.sin(q[i]), z - l[i] * sympy.cos(q[i])
        energy += m[i] * (x.diff(TIME) ** 2 + z.diff(TIME) ** 2) / 2 - m[i] * g * z
    values = numbers(n)
    return energy, q, dict(zip([*m, *l, g], [*values["m"], *values["l"], values["g"]], strict=True))


@pytest.mark.parametrize("n", [2, 3])
def test_symbolic_equations(n: int) -> None:
    q, qd = states(n, 50)
    solve = symbolic_motion(*symbolic_chain(n))
    assert_close(ours(n, q, qd), np.stack([solve(*state).qdd for state in zip(q, qd, strict=True)]), 1e-10)


def test_symbolic_multipliers() -> None:
    """A pendulum in Cartesian coordinates: the rod's tension; with a push along x; and a skate that cannot slide."""
    x, z = dynamicsymbols("x z")
    m, g, push = sympy.symbols("m g push")
    energy = m * (x.diff() ** 2 + z.diff() ** 2) / 2 - m * g * z
    values = {m: 0.7, g: G, push: 1.3}
    at, velocity = np.array([0.6, -0.8]), 1.9 * np.array([0.8, 0.6])
    found = symbolic_motion(energy, [x, z], values, forces=[push, 0], holonomic=[(x**2 + z**2 - 1) / 2])(at, velocity)
    force = np.array([1.3, -0.7 * G])
    np.testing.assert_allclose(found.multipliers, [-(0.7 * 1.9**2 + force @ at)], rtol=1e-12)
    np.testing.assert_allclose(0.7 * found.qdd, force + found.multipliers * at, rtol=1e-12)
    # Along the plane z = x in the velocities alone.
    skate = symbolic_motion(energy, [x, z], values, nonholonomic=[x.diff() - z.diff()])(at, [1.0, 1.0])
    np.testing.assert_allclose(skate.qdd, [-G / 2, -G / 2], rtol=1e-12)
    np.testing.assert_allclose(skate.multipliers, [-0.7 * G / 2], rtol=1e-12)


def test_energy_of_a_double_pendulum_is_constant() -> None:
    """Two links through a quarter turn, against the energy it started from."""
    scene = problems.n_link_pendulum.double_pendulum(m=np.array([1.0, 0.7]), l=np.array([0.8, 1.1]))
    run = simulate(scene, [1.5, -0.4], [0.0, 0.0], 2.0, rtol=1e-10, atol=1e-12)
    zero = jnp.array(0.0)
    before = sum(energies(scene.lagrangian, zero, jnp.array([1.5, -0.4]), jnp.zeros(2), scene.params))
    after = sum(energies(scene.lagrangian, zero, run.q[-1], run.qd[-1], scene.params))
    np.testing.assert_allclose(after, before, atol=1e-8)


@pytest.mark.parametrize("n", [0, -1, True, 2.0])
def test_number_of_links_is_checked(n: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)  # as users have it
    with pytest.raises(ValueError, match=f"n must be a positive integer, but {n} was given"):
        problems.n_link_pendulum.scene(n)


def test_number_of_masses_is_checked() -> None:
    with pytest.raises(
        ValueError, match=r"m must be one number or have the shape \(2,\) for 2 links, but it has \(3,\)"
    ):
        problems.n_link_pendulum.double_pendulum(m=np.ones(3))
