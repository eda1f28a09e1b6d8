"""Named mechanisms at random admissible states: what the library says there, and their closed forms."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodsim import Scene, problems
from jaxmodsim.scene import ConstraintReaction, State, forward_dynamics, vector_field

from ..problems import rod_on_rough_floor as rod_problem
from ..problems import rolling_disc as disc_problem

SAMPLES = 50
# Each side is a sum of a few terms, right to some roundings: compare with the largest around.
ROUNDING = 1e-12

PENDULUM = {"m": 0.7, "l": 1.9, "g": 9.7}
SPIRAL = {"m": 0.7, "R": 1.9, "a": 0.35, "g": 9.7}
MU = 0.2
DISC = dict(disc_problem.PARAMS)
ROD = {**rod_problem.PARAMS, "mu": 0.5}
FOUCAULT = {"m": 2.0, "l": 1.3, "g": 9.7, "Omega": 0.4, "latitude": 0.8}
PARTICLE = dict(problems.charged_particle.PARAMS)
CART = {**problems.cart_pole.PARAMS, "force": 1.7}
CRANK = {**problems.slider_crank.PARAMS, "torque": 2.3}


class Case(NamedTuple):
    """A mechanism, admissible states of it, the modes of its friction there, and its accelerations in closed form."""

    scene: Scene
    q: Any
    qd: Any
    closed: Callable[[Any, Any], Any]
    mode: Any = None


class Found(NamedTuple):
    """What the library says at those states."""

    qdd: np.ndarray
    reactions: dict[str, ConstraintReaction]
    uniqueness: Any


def draw(low: float, high: float, *shape: int, seed: int = 5) -> Any:
    return jnp.asarray(np.random.default_rng(seed).uniform(low, high, (SAMPLES, *shape)))


def but(numbers: dict[str, Any], *left_out: str) -> dict[str, Any]:
    return {name: value for name, value in numbers.items() if name not in left_out}


def cart_pole() -> Case:
    closed = lambda q, qd: problems.cart_pole.acceleration(q, qd, **CART)  # noqa: E731
    return Case(problems.cart_pole.scene(**CART), draw(-4, 4, 2), draw(-5, 5, 2, seed=6), closed)


def spiral_bead(**further: float) -> Case:
    numbers = {**SPIRAL, **further}
    q, qd = draw(-9, 9, 1), draw(-9, 9, 1, seed=6)
    closed = lambda q, qd: problems.spiral_bead.acceleration(q, qd, **numbers)  # noqa: E731
    return Case(problems.spiral_bead.scene(**numbers), q, qd, closed, jnp.sign(qd) if "mu" in further else None)


def cartesian_pendulum() -> Case:
    f, w = draw(-4, 4), draw(-5, 5, seed=6)
    q = PENDULUM["l"] * jnp.stack([jnp.sin(f), -jnp.cos(f)], axis=1)
    qd = PENDULUM["l"] * jnp.stack([w * jnp.cos(f), w * jnp.sin(f)], axis=1)
    closed = lambda q, qd: problems.cartesian_pendulum.acceleration(q, qd, **but(PENDULUM, "m"))  # noqa: E731
    return Case(problems.cartesian_pendulum.scene(**PENDULUM), q, qd, closed)


def on_the_sphere(angles: Any) -> Any:
    phi, theta = angles
    return PENDULUM["l"] * jnp.stack([jnp.sin(phi) * jnp.cos(theta), jnp.sin(phi) * jnp.sin(theta), jnp.cos(phi)])


ANGLES, ANGLE_RATES = draw(-4, 4, 2), draw(-5, 5, 2, seed=6)


def cartesian_spherical_pendulum() -> Case:
    q, qd = jax.vmap(lambda a, w: jax.jvp(on_the_sphere, (a,), (w,)))(ANGLES, ANGLE_RATES)
    closed = lambda q, qd: problems.cartesian_pendulum.acceleration(q, qd, **but(PENDULUM, "m"))  # noqa: E731
    return Case(problems.cartesian_pendulum.cartesian_spherical_pendulum(**PENDULUM), q, qd, closed)


# Fast enough for the guide to hold the slider down at times.
CRANK_ANGLE, CRANK_RATE = draw(-4, 4), draw(-30, 30, seed=6)


def slider_crank(mu: float | None = None) -> Case:
    q, qd = jax.vmap(problems.slider_crank.state)(CRANK_ANGLE, CRANK_RATE)
    numbers = CRANK if mu is None else {**CRANK, "mu": mu}

    def closed(q: Any, qd: Any) -> Any:
        return problems.slider_crank.forces(q[0], qd[0], **numbers).qdd

    return Case(problems.slider_crank.scene(**numbers), q, qd, closed, None if mu is None else jnp.sign(qd[:, 2:3]))


def four_bar(crossed: bool = False) -> Case:
    q, qd = jax.vmap(lambda f, w: problems.four_bar.state(f, w, crossed=crossed))(CRANK_ANGLE, CRANK_RATE)
    closed = lambda q, qd: problems.four_bar.acceleration(q[0], qd[0], crossed=crossed)  # noqa: E731
    return Case(problems.four_bar.scene(), q, qd, closed)


def rolling_disc() -> Case:
    q = draw(-4, 4, 5).at[:, 3].set(draw(-1.2, 1.2, seed=7))
    qd = jax.vmap(lambda q, w: disc_problem.velocity(q, w, R=DISC["R"]))(q, draw(-5, 5, 3, seed=6))
    closed = lambda q, qd: disc_problem.acceleration(q, qd, **but(DISC, "m"))  # noqa: E731
    return Case(disc_problem.scene(**DISC), q, qd, closed)


def knife_edge() -> Case:
    q, u = draw(-4, 4, 3), draw(-5, 5, 2, seed=6)
    qd = jnp.stack([u[:, 0] * jnp.cos(q[:, 2]), u[:, 0] * jnp.sin(q[:, 2]), u[:, 1]], axis=1)
    return Case(problems.knife_edge.scene(), q, qd, problems.knife_edge.acceleration)


# Up to here the floor need not pull: (l/2) f'^2 < g.
ROD_ANGLE, ROD_RATE, ROD_SLIP = draw(0.1, 3.0), draw(-2.9, 2.9, seed=6), draw(-5, 5, seed=7)


def rod_on_rough_floor(mu: float = ROD["mu"]) -> Case:
    q, qd = jax.vmap(lambda f, w, v: rod_problem.state(f, w, v, l=ROD["l"]))(ROD_ANGLE, ROD_RATE, ROD_SLIP)
    numbers = {**ROD, "mu": mu}
    closed = lambda q, qd: rod_problem.acceleration(q, qd, **numbers)  # noqa: E731
    modes = jnp.stack([jnp.sign(ROD_SLIP), jnp.ones_like(ROD_SLIP)], axis=1)  # in slip, on the floor
    return Case(rod_problem.scene(**numbers), q, qd, closed, modes)


def foucault_pendulum() -> Case:
    closed = lambda q, qd: problems.foucault_pendulum.acceleration(q, qd, **but(FOUCAULT, "m"))  # noqa: E731
    return Case(problems.foucault_pendulum.scene(**FOUCAULT), draw(-4, 4, 2), draw(-5, 5, 2, seed=6), closed)


def charged_particle() -> Case:
    closed = lambda q, qd: problems.charged_particle.acceleration(q, qd, **PARTICLE)  # noqa: E731
    return Case(problems.charged_particle.scene(**PARTICLE), draw(-4, 4, 3), draw(-5, 5, 3, seed=6), closed)


CASES: dict[str, Callable[[], Case]] = {
    "cart-pole": cart_pole,
    "bead": spiral_bead,
    "bead with drag": lambda: spiral_bead(k=0.8),
    "bead with friction": lambda: spiral_bead(mu=0.3),
    "bead with both": lambda: spiral_bead(k=0.8, mu=0.3),
    "pendulum in a plane": cartesian_pendulum,
    "pendulum in space": cartesian_spherical_pendulum,
    "slider-crank": slider_crank,
    "slider-crank with friction": lambda: slider_crank(MU),
    "four-bar": four_bar,
    "four-bar, crossed": lambda: four_bar(crossed=True),
    "rolling disc": rolling_disc,
    "knife edge": knife_edge,
    "rod on a rough floor": rod_on_rough_floor,
    "rod on a smooth floor": lambda: rod_on_rough_floor(0.0),
    "Foucault's pendulum": foucault_pendulum,
    "charged particle": charged_particle,
}


@cache
def case(name: str) -> Case:
    return CASES[name]()


@jax.jit
def look(scene: Scene, q: Any, qd: Any, mode: Any) -> Any:
    def one(q: Any, qd: Any, mode: Any) -> Any:
        t, y = jnp.zeros(()), State(q, qd, {})
        reactions = forward_dynamics(t, y, scene, mode).reactions if scene.constraints else {}
        return (
            vector_field(t, y, scene, mode).qd,
            reactions,
            forward_dynamics(t, y, scene, mode).uniqueness if scene.checks else None,
        )

    return jax.vmap(one)(q, qd, mode)


@cache
def found(name: str) -> Found:
    one = case(name)
    return Found(*jax.tree.map(np.asarray, look(one.scene, one.q, one.qd, one.mode)))


@cache
def closed(name: str) -> Any:
    """Accelerations in closed form."""
    one = case(name)
    return np.asarray(jax.jit(jax.vmap(one.closed))(one.q, one.qd))


def misfit(ours: Any, exact: Any, least: Any = 0.0) -> float:
    """Largest error, as a part of the largest entry at that state."""
    ours, exact = (np.reshape(x, (SAMPLES, -1)) for x in (ours, exact))
    assert ours.shape == exact.shape
    assert np.all(np.isfinite(ours))
    return float(np.max(np.abs(ours - exact) / np.maximum(np.abs(exact).max(axis=1, keepdims=True), least)))


def assert_equal(ours: Any, exact: Any, tolerance: float = ROUNDING, least: Any = 0.0) -> None:
    assert misfit(ours, exact, least) < tolerance
