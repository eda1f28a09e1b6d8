"""Named mechanisms: equations of motion, forces of constraint and runs against closed forms and symbolic equations."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from scipy.integrate import solve_ivp
from scipy.special import ellipk
from sympy.physics.mechanics import dynamicsymbols

from jaxmodsim import problems, simulate
from jaxmodsim.mechanics import energies
from jaxmodsim.scene import State, vector_field

from ..helpers.mechanisms import (
    ANGLE_RATES,
    ANGLES,
    CART,
    CASES,
    CRANK,
    CRANK_ANGLE,
    CRANK_RATE,
    DISC,
    FOUCAULT,
    MU,
    PARTICLE,
    PENDULUM,
    ROD,
    ROD_ANGLE,
    ROD_RATE,
    ROD_SLIP,
    SPIRAL,
    assert_equal,
    but,
    case,
    closed,
    found,
    look,
    rod_on_rough_floor,
)
from ..helpers.symbolic import TIME, symbolic_motion
from . import rod_on_rough_floor as rod_problem
from . import rolling_disc as disc_problem


@pytest.mark.parametrize("name", CASES)
def test_accelerations(name: str) -> None:
    # Terms that cancel are at least of the size of gravity and of the squared velocities.
    least = 1.0 + np.max(np.square(case(name).qd), axis=1, keepdims=True)
    assert_equal(found(name).qdd, closed(name), least=least)


# --- Forces of constraint.


def test_tension_of_the_pendulum() -> None:
    """By the angle from straight down, m (l f'^2 + g cos f), towards the pivot."""
    one, rod = case("pendulum in a plane"), found("pendulum in a plane").reactions["rod"]
    m, l, g = PENDULUM.values()
    angle = np.arctan2(one.q[:, 0], -one.q[:, 1])
    rate = (one.q[:, 0] * one.qd[:, 1] - one.q[:, 1] * one.qd[:, 0]) / l**2
    tension = m * (l * rate**2 + g * np.cos(angle))
    assert_equal(-rod.multiplier[:, 0], tension)
    assert_equal(jax.vmap(lambda q, qd: problems.cartesian_pendulum.tension(q, qd, **PENDULUM))(one.q, one.qd), tension)
    assert rod.force is not None
    assert_equal(rod.force[:, [0, 2]], -tension[:, None] * one.q / l)
    assert_equal(rod.generalised, rod.force[:, [0, 2]])


def test_reaction_of_the_sphere() -> None:
    m, l, g = PENDULUM.values()
    rod = found("pendulum in space").reactions["rod"]
    radial = jax.vmap(lambda a, w: problems.spherical_pendulum.reaction(a, w, m=m, R=l, g=g))(ANGLES, ANGLE_RATES)
    assert_equal(rod.multiplier[:, 0], radial)
    newton = m * found("pendulum in space").qdd + np.array([0.0, 0.0, m * g])
    assert_equal(rod.force, newton)


@pytest.mark.parametrize("mu", [None, MU])
def test_joints_of_the_slider_crank(mu: float | None) -> None:
    """Cut free: the forces in the pin and of the guide, and the crank by its equation of motion alone."""
    name = "slider-crank" if mu is None else "slider-crank with friction"
    said, numbers = found(name), {**CRANK, "mu": mu or 0.0}
    free = jax.jit(jax.vmap(lambda f, w: problems.slider_crank.forces(f, w, **numbers)))(CRANK_ANGLE, CRANK_RATE)
    assert_equal(said.reactions["guide"].multiplier[:, 0], free.guide, 1e-11)
    pin = said.reactions["pin"].force
    assert pin is not None
    assert_equal(pin[:, 1, [0, 2]], free.slider_pin)
    np.testing.assert_array_equal(pin[:, 0], -pin[:, 1])
    assert np.any(free.guide > 0)
    assert np.any(free.guide < 0)
    rub = -(mu or 0.0) * np.abs(free.guide) * np.sign(case(name).qd[:, 2])
    alone = jax.jit(jax.vmap(lambda f, w, force: problems.slider_crank.acceleration(f, w, **CRANK, force=force)))
    assert_equal(said.qdd[:, 0], alone(CRANK_ANGLE, CRANK_RATE, rub), least=1.0 + np.square(CRANK_RATE)[:, None])


@pytest.mark.parametrize("name", ["four-bar", "four-bar, crossed"])
def test_joint_of_the_four_bar(name: str) -> None:
    """Moments: of the rocker about the ground, of the coupler about its middle with the force of the crank on it."""
    p, one, said = problems.four_bar.PARAMS, case(name), found(name)
    force, turn = said.reactions["closure"].multiplier, said.qdd
    unit = np.stack([np.cos(one.q), np.sin(one.q)], axis=-1)
    ahead = np.stack([-unit[..., 1], unit[..., 0]], axis=-1)

    def moment(arm: Any, force: Any) -> Any:
        return arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]

    weight = np.array([0.0, -p["g"]])
    rocker = p["c"] * moment(unit[:, 2], force) + 0.5 * p["m3"] * p["c"] * weight[1] * unit[:, 2, 0]
    assert_equal(p["m3"] * p["c"] ** 2 / 3.0 * turn[:, 2], rocker, least=1.0 + np.square(one.qd).max(1, keepdims=True))
    swing = turn[..., None] * ahead - np.square(one.qd)[..., None] * unit
    middle = p["a"] * swing[:, 0] + 0.5 * p["b"] * swing[:, 1]
    crank = p["m2"] * (middle - weight) + force
    coupler = -0.5 * p["b"] * (moment(unit[:, 1], crank) + moment(unit[:, 1], force))
    spin = p["m2"] * p["b"] ** 2 / 12.0 * turn[:, 1]
    assert_equal(spin, coupler, least=1.0 + np.square(one.qd).max(1, keepdims=True))


def test_force_on_the_rolling_disc() -> None:
    """It is what accelerates the centre."""
    one, said = case("rolling disc"), found("rolling disc")
    c, s = np.cos(one.q[:, 2]), np.sin(one.q[:, 2])
    exact = closed("rolling disc")
    along = np.stack([c * exact[:, 0] + s * exact[:, 1], c * exact[:, 1] - s * exact[:, 0]], axis=1)
    assert_equal(said.reactions["rolling"].multiplier, DISC["m"] * along)


def test_force_on_the_knife_edge() -> None:
    one = case("knife edge")
    exact = jax.vmap(problems.knife_edge.force)(one.q, one.qd)
    assert_equal(found("knife edge").reactions["edge"].multiplier[:, 0], exact, least=1.0)


@pytest.mark.parametrize("mu", [0.5, 2.0])
def test_rod_on_a_rough_floor(mu: float) -> None:
    """Normal force and margin of uniqueness; the latter falls below zero for mu = 2, and there is no acceleration."""
    one, m = rod_on_rough_floor(mu), ROD["m"]
    qdd, reactions, uniqueness = look(one.scene, one.q, one.qd, one.mode)
    side = jnp.sign(ROD_SLIP)
    compliance = rod_problem.compliance(ROD_ANGLE, side, m=m, mu=mu)
    smooth = rod_problem.compliance(ROD_ANGLE, m=m, mu=0.0)
    np.testing.assert_allclose(smooth, (1 + 3 * np.cos(ROD_ANGLE) ** 2) / m, rtol=1e-14)
    # Friction that lifts the tip never takes the solution away.
    np.testing.assert_allclose(uniqueness, np.minimum(compliance / smooth, 1.0), atol=1e-12)
    normal = jax.vmap(lambda f, w, s: rod_problem.normal_force(f, w, s, **{**ROD, "mu": mu}))(ROD_ANGLE, ROD_RATE, side)
    np.testing.assert_allclose(reactions["floor"].multiplier[:, 0], normal, rtol=1e-11)
    assert bool(jnp.any(compliance < 0)) == (mu > 4 / 3)
    np.testing.assert_array_equal(jnp.isnan(qdd).any(axis=1), compliance < 0)


def test_the_paradox_begins_at_four_thirds() -> None:
    """Where 1 + 3 cos^2 and 3 mu sin cos touch: tan f = 2, at mu = 4/3."""
    f = jnp.linspace(0.01, 1.56, 100_001)
    least = [float(jnp.min(rod_problem.compliance(f, m=1.0, mu=mu))) for mu in (1.333, 4 / 3, 1.334)]
    assert least[0] > 0
    np.testing.assert_allclose(least[1], 0.0, atol=1e-8)
    assert least[2] < 0
    at_two = rod_problem.compliance(jnp.arctan(2.0), m=1.0, mu=4 / 3)
    np.testing.assert_allclose(at_two, 0.0, atol=1e-15)


def test_each_parameter_of_the_bead_is_stored_once() -> None:
    """So the derivative of its acceleration by a parameter of the scene is that of the closed form."""
    q, qd, mode = jnp.array([1.3]), jnp.array([-2.1]), jnp.array([-1.0])
    numbers = {**SPIRAL, "k": 0.8}
    scene = problems.spiral_bead.scene(**numbers, mu=0.3)
    assert set(scene.params) == set(numbers)

    def ours(params: Any, mu: Any) -> Any:
        # The scene is built from its numbers anew, by its own leaves.
        changed = problems.spiral_bead.scene(**params, mu=mu)
        assert jax.tree.structure(changed) == jax.tree.structure(scene)
        return vector_field(jnp.array(0.0), State(q, qd, {}), changed, mode).qd[0]

    def exact(params: Any, mu: Any) -> Any:
        return problems.spiral_bead.acceleration(q, qd, **params, mu=mu)[0]

    values = jax.tree.map(jnp.asarray, numbers)
    by_ours, by_exact = (jax.jit(jax.grad(fn, argnums=(0, 1)))(values, jnp.array(0.3)) for fn in (ours, exact))
    for a, b in zip(jax.tree.leaves(by_ours), jax.tree.leaves(by_exact), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)
        assert b != 0
    normal = problems.spiral_bead.normal_force(q, qd, **SPIRAL)
    bead: Any = scene.lagrangian
    np.testing.assert_allclose(bead.normal_force(jnp.array(0.0), q, qd, scene.params), normal, rtol=1e-13)


# --- Symbolic equations.


def values(names: str, numbers: dict[str, Any]) -> tuple[Any, dict[Any, float]]:
    symbols = sympy.symbols(names)
    return symbols, {symbol: float(numbers[str(symbol)]) for symbol in symbols}


def body(m: Any, inertia: Any, x: Any, z: Any, angle: Any, g: Any) -> Any:
    """Lagrangian of a body in a vertical plane."""
    return (m * (x.diff(TIME) ** 2 + z.diff(TIME) ** 2) + inertia * sympy.diff(angle, TIME) ** 2) / 2 - m * g * z


def bar(m: Any, l: Any, x: Any, z: Any, angle: Any, g: Any) -> Any:
    """Lagrangian of a uniform bar that begins at (x, z), and its end."""
    c, s = sympy.cos(angle), sympy.sin(angle)
    return body(m, m * l**2 / 12, x + l * c / 2, z + l * s / 2, angle, g), x + l * c, z + l * s


def symbolic_cart_pole() -> Any:
    (M, m, l, g, force), numbers = values("M m l g force", CART)
    x, f = dynamicsymbols("x f")
    pole = body(m, m * l**2 / 12, x + l * sympy.sin(f) / 2, l * sympy.cos(f) / 2, f, g)
    return symbolic_motion(pole + M * x.diff() ** 2 / 2, [x, f], numbers, forces=[force, 0])


def symbolic_bead() -> Any:
    (m, R, a, g), numbers = values("m R a g", SPIRAL)
    theta = dynamicsymbols("theta")
    phi = sympy.pi / 2 - sympy.atan(a * theta)
    place = [R * sympy.sin(phi) * sympy.cos(theta), R * sympy.sin(phi) * sympy.sin(theta), R * sympy.cos(phi)]
    energy = m * sum(x.diff(TIME) ** 2 for x in place) / 2 - m * g * place[2]
    return symbolic_motion(energy, [theta], numbers)


def symbolic_pendulum(names: str) -> Any:
    (m, l, g), numbers = values("m l g", PENDULUM)
    q = list(dynamicsymbols(names))
    energy = m * sum(x.diff() ** 2 for x in q) / 2 - m * g * q[-1]
    return symbolic_motion(energy, q, numbers, holonomic=[sympy.sqrt(sum(x**2 for x in q)) - l])


def symbolic_slider_crank() -> Any:
    (m1, m2, m3, r, l, g, torque), numbers = values("m1 m2 m3 r l g torque", CRANK)
    f, b, x, y = dynamicsymbols("f b x y")
    crank, x1, z1 = bar(m1, r, sympy.Integer(0), sympy.Integer(0), f, g)
    rod, x2, z2 = bar(m2, l, x1, z1, b, g)
    energy = crank + rod + m3 * (x.diff() ** 2 + y.diff() ** 2) / 2 - m3 * g * y
    return symbolic_motion(energy, [f, b, x, y], numbers, forces=[torque, 0, 0, 0], holonomic=[x - x2, y - z2, y])


def symbolic_four_bar() -> Any:
    (a, b, c, d, m1, m2, m3, g), numbers = values("a b c d m1 m2 m3 g", problems.four_bar.PARAMS)
    q = list(dynamicsymbols("q1 q2 q3"))
    crank, x1, z1 = bar(m1, a, sympy.Integer(0), sympy.Integer(0), q[0], g)
    coupler, x2, z2 = bar(m2, b, x1, z1, q[1], g)
    rocker, x3, z3 = bar(m3, c, d, sympy.Integer(0), q[2], g)
    holonomic = [x3 - x2, z3 - z2]
    return symbolic_motion(crank + coupler + rocker, q, numbers, holonomic=holonomic)


def symbolic_disc() -> Any:
    (m, R, k, g), numbers = values("m R k g", DISC)
    x, y, h, f, s = dynamicsymbols("x y h f s")
    z = R * sympy.cos(f)
    about_axle = s.diff() + h.diff() * sympy.sin(f)
    spin = k * about_axle**2 + k * (f.diff() ** 2 + (h.diff() * sympy.cos(f)) ** 2) / 2
    energy = m * (x.diff() ** 2 + y.diff() ** 2 + z.diff(TIME) ** 2 + R**2 * spin) / 2 - m * g * z
    along = sympy.cos(h) * x.diff() + sympy.sin(h) * y.diff() - R * about_axle
    across = sympy.cos(h) * y.diff() - sympy.sin(h) * x.diff() + R * sympy.cos(f) * f.diff()
    return symbolic_motion(energy, [x, y, h, f, s], numbers, nonholonomic=[along, across])


def symbolic_knife_edge() -> Any:
    (m, inertia, slope, g), numbers = values("m I slope g", problems.knife_edge.PARAMS)
    x, y, h = dynamicsymbols("x y h")
    energy = m * (x.diff() ** 2 + y.diff() ** 2) / 2 + inertia * h.diff() ** 2 / 2 + m * g * x * sympy.sin(slope)
    sideways = sympy.cos(h) * y.diff() - sympy.sin(h) * x.diff()
    return symbolic_motion(energy, [x, y, h], numbers, nonholonomic=[sideways])


def symbolic_rod() -> Any:
    (m, l, g), numbers = values("m l g", ROD)
    x, y, f = dynamicsymbols("x y f")
    return symbolic_motion(body(m, m * l**2 / 12, x, y, f, g), [x, y, f], numbers, holonomic=[y - l * sympy.sin(f) / 2])


def symbolic_foucault() -> Any:
    """From the velocity in a frame that does not turn, less what is quadratic in Omega."""
    (m, l, g, Omega, latitude), numbers = values("m l g Omega latitude", FOUCAULT)
    x, y = dynamicsymbols("x y")
    spin = Omega * sympy.sin(latitude)
    square = (x.diff() - spin * y) ** 2 + (y.diff() + spin * x) ** 2 - spin**2 * (x**2 + y**2)
    return symbolic_motion(m * (square - g / l * (x**2 + y**2)) / 2, [x, y], numbers)


def symbolic_particle() -> Any:
    """In another gauge: A = (0, B x, 0)."""
    (m, charge, B), numbers = values("m charge B", PARTICLE)
    q = list(dynamicsymbols("x y z"))
    push = sum(e * x for e, x in zip(PARTICLE["E"], q, strict=True))
    energy = m * sum(x.diff() ** 2 for x in q) / 2 + charge * (B * q[0] * q[1].diff() + push)
    return symbolic_motion(energy, q, numbers)


SYMBOLIC: dict[str, Callable[[], Any]] = {
    "cart-pole": symbolic_cart_pole,
    "bead": symbolic_bead,
    "pendulum in a plane": lambda: symbolic_pendulum("x z"),
    "pendulum in space": lambda: symbolic_pendulum("x y z"),
    "slider-crank": symbolic_slider_crank,
    "four-bar": symbolic_four_bar,
    "rolling disc": symbolic_disc,
    "knife edge": symbolic_knife_edge,
    "rod on a smooth floor": symbolic_rod,
    "Foucault's pendulum": symbolic_foucault,
    "charged particle": symbolic_particle,
}


@pytest.mark.parametrize("name", SYMBOLIC)
def test_symbolic_equations(name: str) -> None:
    one, said, solve = case(name), found(name), SYMBOLIC[name]()
    exact = [solve(*state) for state in zip(one.q, one.qd, strict=True)]
    least = 1.0 + np.max(np.square(one.qd), axis=1, keepdims=True)
    assert_equal(said.qdd, np.stack([each.qdd for each in exact]), 1e-10, least=least)
    if one.scene.constraints:
        multipliers = np.concatenate([said.reactions[each].multiplier for each in one.scene.constraint_names], axis=1)
        assert_equal(multipliers, np.stack([each.multipliers for each in exact]), 1e-10)


# --- Motions in closed form obey the equations of motion.


def assert_motion(motion: Callable[[Any], Any], acceleration: Callable[[Any, Any], Any]) -> None:
    """`motion(t)` gives coordinates; they, their derivatives by t and these' derivatives fit together."""

    def rate(t: Any) -> Any:
        return jax.jvp(motion, (t,), (jnp.ones_like(t),))

    t = jnp.linspace(0.0, 7.0, 29)
    (q, qd), (_, qdd) = jax.jit(jax.vmap(lambda t: jax.jvp(rate, (t,), (jnp.ones_like(t),))))(t)
    np.testing.assert_allclose(qdd, jax.vmap(acceleration)(q, qd), atol=1e-11)


def test_cycloid_of_the_knife_edge() -> None:
    numbers = {"turn": 1.7, "speed": 0.9}
    assert_motion(lambda t: problems.knife_edge.motion(t, **numbers)[0], problems.knife_edge.acceleration)
    q, qd = problems.knife_edge.motion(jnp.array([0.0, 2.0 * np.pi / 1.7]), turn=1.7)
    np.testing.assert_allclose(q[0], 0.0, atol=1e-15)
    np.testing.assert_allclose(qd[:, :2], 0.0, atol=1e-14)
    # In a full turn it has moved across, but not down, by b/(2 w) times the time.
    drift = 9.81 * np.sin(0.4) / (2 * 1.7) * 2 * np.pi / 1.7
    np.testing.assert_allclose(q[1], [0.0, drift, 2 * np.pi], atol=1e-14)


def test_motion_of_the_charged_particle() -> None:
    q0, qd0 = jnp.array([0.3, -0.8, 0.5]), jnp.array([1.2, 0.4, -0.7])
    assert_motion(
        lambda t: problems.charged_particle.motion(t, q0, qd0, **PARTICLE)[0],
        lambda q, qd: problems.charged_particle.acceleration(q, qd, **PARTICLE),
    )
    # Without the electric field a circle at the cyclotron frequency.
    numbers = but(PARTICLE, "E")
    period = 2 * np.pi * 0.7 / (1.1 * 2.3)
    q, qd = problems.charged_particle.motion(jnp.array([0.0, period]), q0, qd0, **numbers)
    np.testing.assert_allclose(q, [q0, q0 + jnp.array([0.0, 0.0, -0.7 * period])], atol=1e-14)
    np.testing.assert_allclose(qd, [qd0, qd0], atol=1e-14)


def test_motion_of_foucaults_pendulum() -> None:
    q0, qd0 = jnp.array([0.3, -0.8]), jnp.array([1.2, 0.4])
    numbers = but(FOUCAULT, "m")
    assert_motion(
        lambda t: problems.foucault_pendulum.motion(t, q0, qd0, **numbers),
        lambda q, qd: problems.foucault_pendulum.acceleration(q, qd, **numbers),
    )
    start = jax.jvp(lambda t: problems.foucault_pendulum.motion(t, q0, qd0, **numbers), (0.0,), (1.0,))
    np.testing.assert_allclose(start, [q0, qd0], atol=1e-14)
    day = 2 * np.pi / 7.2921159e-5
    # Paris: a full turn takes a sidereal day over sin(latitude), to the west of north.
    np.testing.assert_allclose(problems.foucault_pendulum.precession(), -2 * np.pi / (day / np.sin(0.8527)), rtol=1e-14)


# --- Runs.


def total(scene: Any, run: Any) -> np.ndarray:
    """Kinetic and potential energy along a run."""
    parts = jax.jit(jax.vmap(lambda q, qd: energies(scene.lagrangian, jnp.zeros(()), q, qd, scene.params)))
    return np.asarray(sum(parts(run.q, run.qd)))


def test_the_swings_of_foucaults_pendulum_turn() -> None:
    scene, p = problems.foucault_pendulum.scene(**FOUCAULT), -0.4 * np.sin(0.8)
    ts = np.linspace(0.0, 10.0, 21)
    run = simulate(scene, [0.5, 0.0], [0.0, 0.5 * p], 10.0, ts=ts, rtol=1e-10, atol=1e-12)
    across = run.q[:, 1] * np.cos(p * ts) - run.q[:, 0] * np.sin(p * ts)
    np.testing.assert_allclose(across, 0.0, atol=1e-9)
    assert np.abs(np.sin(p * ts)).max() > 0.99
    numbers = but(FOUCAULT, "m")
    exact = problems.foucault_pendulum.motion(jnp.asarray(ts), jnp.array([0.5, 0.0]), run.qd[0], **numbers)
    np.testing.assert_allclose(run.q, exact, atol=1e-9)


def test_over_both_poles() -> None:
    """From the bottom over the top and back, in the time of the elliptic integral; the angles fail at either pole."""
    m, l, g = PENDULUM.values()
    speed = 2.2 * np.sqrt(g * l)
    half = 2.0 * l / speed * ellipk(4.0 * g * l / speed**2)
    run = simulate(
        problems.cartesian_pendulum.cartesian_spherical_pendulum(**PENDULUM),
        [0.0, 0.0, -l],
        [0.6 * speed, 0.8 * speed, 0.0],
        2.0 * half,
        ts=[half, 1.3 * half, 2.0 * half],
        rtol=1e-10,
        atol=1e-12,
    )
    top = np.sqrt(speed**2 - 4 * g * l)
    np.testing.assert_allclose(run.q[0], [0.0, 0.0, l], atol=1e-8)
    np.testing.assert_allclose(run.qd[0], [-0.6 * top, -0.8 * top, 0.0], atol=1e-7)
    np.testing.assert_allclose(run.q[2], [0.0, 0.0, -l], atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(run.q, axis=1), l, rtol=1e-14)
    radial = problems.spherical_pendulum.reaction(jnp.zeros(2), jnp.array([top / l, 0.0]), m=m, R=l, g=g)
    np.testing.assert_allclose(run.reactions["rod"].multiplier[0], [radial], rtol=1e-6)


def test_four_bar_stays_closed() -> None:
    q0, qd0 = problems.four_bar.state(0.3, 9.0)
    scene = problems.four_bar.scene()
    ts = jnp.linspace(0.0, 2.0, 41)
    run = simulate(scene, q0, qd0, 2.0, ts=ts, rtol=1e-9, atol=1e-11)
    assert run.q[-1, 0] > 2 * np.pi
    closure: Any = scene.constraints[0]
    drift = jax.vmap(lambda q: closure.error(jnp.zeros(()), q, scene.params))(run.q)
    assert jnp.abs(drift).max() < 1e-12
    q, qd = jax.vmap(problems.four_bar.state)(run.q[:, 0], run.qd[:, 0])
    turned = (np.asarray(run.q - q) + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turned, 0.0, atol=1e-12)
    np.testing.assert_allclose(run.qd, qd, atol=1e-10)
    energy = total(scene, run)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-7)


def test_runs_of_the_rolling_disc() -> None:
    """A steady circle closes; any other motion rolls on and keeps its energy."""
    scene, turn, lean = disc_problem.scene(**DISC), -1.3, 0.4
    spin = float(disc_problem.steady_spin(lean, turn, **but(DISC, "m")))
    q0 = jnp.array([0.0, 0.0, 0.0, lean, 0.0])
    qd0 = disc_problem.velocity(q0, jnp.array([turn, 0.0, spin]), R=DISC["R"])
    period = 2 * np.pi / abs(turn)
    how: dict[str, Any] = {"ts": np.linspace(0.0, period, 17), "rtol": 1e-10, "atol": 1e-12}
    run = simulate(scene, q0, qd0, period, **how)
    # On a circle about (0, radius), radius = R w/h'.
    radius = DISC["R"] * (spin + turn * np.sin(lean)) / turn
    np.testing.assert_allclose(run.q[:, 3], lean, atol=1e-8)
    np.testing.assert_allclose(np.hypot(run.q[:, 0], run.q[:, 1] - radius), abs(radius), rtol=1e-8)
    np.testing.assert_allclose(run.q[-1], [0.0, 0.0, turn * period, lean, spin * period], atol=1e-7)

    qd0 = disc_problem.velocity(q0, jnp.array([0.5, -1.0, 6.0]), R=DISC["R"])
    run = simulate(scene, q0, qd0, period, **how)
    assert np.ptp(run.q[:, 3]) > 0.3
    energy = total(scene, run)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-8)
    rolls = jax.vmap(lambda q, w: disc_problem.velocity(q, w, R=DISC["R"]))(run.q, run.qd[:, 2:])
    np.testing.assert_allclose(run.qd, rolls, atol=1e-13)


def slipping_rod(mu: float, angle: float, rate: float, end: Callable[..., float]) -> tuple[float, float]:
    """Time and angle at which `end(angle, rate)` falls through zero; in slip the angle moves by itself."""
    q, qd = rod_problem.state(angle, rate, 1e6, l=ROD["l"])
    turn = jax.jit(lambda f, w: rod_problem.acceleration(q.at[2].set(f), qd.at[2].set(w), **{**ROD, "mu": mu})[2])

    def stop(t: float, y: Any) -> float:
        del t
        return end(*y)

    setattr(stop, "terminal", True)  # noqa: B010 (an attribute of a function)
    solved: Any = solve_ivp(
        lambda _, y: [y[1], float(turn(*y))], (0.0, 0.5), [angle, rate], events=stop, rtol=1e-10, atol=1e-12
    )
    assert len(solved.t_events[0]) == 1
    return solved.t[-1], solved.y[0, -1]


def weight_left(angle: float, rate: float) -> float:
    """What gravity leaves to press the tip down."""
    return ROD["g"] - 0.5 * ROD["l"] * np.sin(angle) * rate**2


def compliance_left(angle: float, rate: float) -> float:
    del rate
    return float(rod_problem.compliance(jnp.asarray(angle), m=ROD["m"], mu=2.0)) - 1e-6


def test_the_rod_lifts_off_and_its_run_ends_where_the_paradox_begins() -> None:
    ts = jnp.linspace(0.0, 0.5, 101)

    def run(mu: float, state: tuple[float, float, float]) -> Any:
        scene = rod_problem.scene(**{**ROD, "mu": mu})
        q0, qd0 = rod_problem.state(*state, l=ROD["l"])
        return simulate(scene, q0, qd0, 0.5, ts=ts, rtol=1e-9, atol=1e-11, throw=False)

    # Lift-off.
    state = (1.0, 3.3, 5.0)
    exact = slipping_rod(0.5, *state[:2], weight_left)
    lifted = run(0.5, state)
    opens = lifted.mode_changes[0]
    assert (opens.effect, opens.after) == ("floor", "open")
    np.testing.assert_allclose(opens.t, exact[0], atol=1e-6)
    np.testing.assert_array_equal(lifted.reactions["floor"].multiplier[:, 0] > 0, ts < exact[0])
    # Then it turns at a constant rate.
    np.testing.assert_allclose(lifted.qd[ts > exact[0], 2], lifted.qd[-1, 2], rtol=1e-9)
    # Into the paradox.
    state = (0.5, 2.0, 20.0)
    exact = slipping_rod(2.0, *state[:2], compliance_left)
    jammed = run(2.0, state)
    assert "Friction under the reaction of 'floor' has lost its unique solution" in jammed.result.message
    np.testing.assert_allclose(jammed.t_end, exact[0], atol=1e-4)
    kept = np.isfinite(jammed.t)
    assert 0 < kept.sum() < len(ts)
    assert np.all(jammed.q[kept, 2] < exact[1])
    # And at once, where it starts there.
    begun = run(2.0, (1.0, 0.0, 5.0))
    assert "lost its unique solution" in begun.result.message
    assert begun.t_end == 0
