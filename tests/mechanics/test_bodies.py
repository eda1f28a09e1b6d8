"""Bodies whose place is a function of the coordinates, and friction along their true path."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import (
    Coulomb,
    DeadZone,
    ElastoPlastic,
    Friction,
    Regularized,
    Scene,
    Viscous,
    asymmetric,
    point_mass,
    rigid_body,
    simulate,
)
from jaxmodsim.mechanics import acceleration
from jaxmodsim.scene import State, forward_dynamics, scene_numbers, vector_field

ZERO = jnp.array(0.0)


def helix(q: Any, p: Any) -> Any:
    return jnp.stack([p["R"] * jnp.cos(q[0]), p["R"] * jnp.sin(q[0]), p["h"] * q[0]])


def bowl(q: Any) -> Any:
    """A surface of two coordinates, skew and curved."""
    x, y = q[0] + 0.3 * q[1], q[1]
    return jnp.stack([x, y, 0.5 * x**2 + 0.2 * x * y + 0.3 * y**3])


HELIX = {"R": 0.7, "h": 0.2, "m": 1.3, "mu": 0.3}
BEAD = point_mass(lambda p: p["m"], helix, gravity=9.7)


@pytest.mark.quick
def test_a_number_in_params_serves_every_function() -> None:
    """Bead on a helix: theta'' = -g h/(R^2 + h^2), whose derivatives by R and h come from one leaf each."""
    scene = Scene(BEAD, params=HELIX)

    def turn(scene: Scene) -> Any:
        return vector_field(ZERO, State(jnp.array([0.4]), jnp.array([1.7]), {}), scene).qd[0]

    R, h, g = HELIX["R"], HELIX["h"], 9.7
    np.testing.assert_allclose(turn(scene), -g * h / (R**2 + h**2), rtol=1e-14)
    by = jax.jit(jax.grad(turn))(scene)
    np.testing.assert_allclose(by.params["R"], 2 * g * h * R / (R**2 + h**2) ** 2, rtol=1e-13)
    np.testing.assert_allclose(by.params["h"], -g / (R**2 + h**2) + 2 * g * h**2 / (R**2 + h**2) ** 2, rtol=1e-13)
    np.testing.assert_allclose(by.params["m"], 0.0, atol=1e-13)
    assert set(scene_numbers(scene)) == {*HELIX, "lagrangian.gravity"}


def test_reaction_of_a_wire_is_newtons_law() -> None:
    """The reaction is what m r'' leaves once gravity is taken off, and normal to the wire."""
    q, qd, p = jnp.array([0.4]), jnp.array([1.7]), HELIX
    qdd = acceleration(BEAD, ZERO, q, qd, p)
    velocity = lambda q, qd: jax.jvp(lambda q: helix(q, p), (q,), (qd,))[1]  # noqa: E731
    newton = p["m"] * (jax.jvp(velocity, (q, qd), (qd, qdd))[1] + jnp.array([0.0, 0.0, 9.7]))
    np.testing.assert_allclose(BEAD.reaction(ZERO, q, qd, p), newton, atol=1e-13)
    # On a helix: m R theta'^2 inwards, and gravity less its part along the wire.
    gravity = p["m"] * 9.7 * p["R"] / np.hypot(p["R"], p["h"])
    np.testing.assert_allclose(
        BEAD.normal_force(ZERO, q, qd, p), np.hypot(p["m"] * p["R"] * 1.7**2, gravity), rtol=1e-13
    )


def test_reaction_of_a_surface_is_newtons_law() -> None:
    mass = point_mass(0.8, bowl)
    q, qd = jnp.array([0.4, -0.3]), jnp.array([1.7, 0.6])
    qdd = acceleration(mass, ZERO, q, qd, {})
    velocity = lambda q, qd: jax.jvp(bowl, (q,), (qd,))[1]  # noqa: E731
    newton = 0.8 * (jax.jvp(velocity, (q, qd), (qd, qdd))[1] + jnp.array([0.0, 0.0, 9.81]))
    np.testing.assert_allclose(mass.reaction(ZERO, q, qd, {}), newton, atol=1e-13)
    np.testing.assert_allclose(jax.jacobian(bowl)(q).T @ newton, 0.0, atol=1e-13)


def test_friction_of_a_bead_acts_along_the_wire_with_the_true_normal_force() -> None:
    """theta'' = (-m g h - mu N s)/(m s^2) with ds/dtheta = s."""
    effect = Friction(Regularized(Coulomb(0.3), 1e-9), along=helix, normal_force=BEAD.normal_force)
    scene = Scene(BEAD, params=HELIX, effects=(effect,))
    q, qd = jnp.array([0.4]), jnp.array([1.7])
    s = np.hypot(HELIX["R"], HELIX["h"])
    normal = float(BEAD.normal_force(ZERO, q, qd, HELIX))
    np.testing.assert_allclose(effect.slip(ZERO, q, qd, scene.params), 1.7 * s, rtol=1e-14)
    np.testing.assert_allclose(
        forward_dynamics(ZERO, State(q, qd, {}), scene).forces["friction"], 0.3 * normal, rtol=1e-13
    )
    exact = -9.7 * HELIX["h"] / s**2 - 0.3 * normal / (HELIX["m"] * s)
    np.testing.assert_allclose(vector_field(ZERO, State(q, qd, {}), scene).qd, [exact], rtol=1e-13)


def test_a_bead_sticks_on_a_wire_that_is_not_too_steep() -> None:
    """On a straight wire of slope tan(a) the limit is mu = tan(a); below, the bead accelerates at g (sin - mu cos)."""
    slope = 0.5

    def wire(q: Any) -> Any:
        return jnp.stack([q[0], 0.0 * q[0], slope * q[0]])

    bead = point_mass(2.0, wire)

    def run(mu: float) -> Any:
        friction = Friction(Coulomb(mu), along=wire, normal_force=bead.normal_force)
        return simulate(Scene(bead, effects=(friction,)), [0.0], [0.0], 1.0, rtol=1e-9, atol=1e-12)

    assert abs(float(run(0.51).qd[-1, 0])) < 1e-15
    length = np.sqrt(1 + slope**2)
    fall = 9.81 * (slope - 0.4) / length / length  # along the wire, then as x''
    np.testing.assert_allclose(run(0.4).q[-1, 0], -0.5 * fall, rtol=1e-8)


@pytest.mark.parametrize("law", [Viscous(0.4), Regularized(Coulomb(0.3), 1e-2)])
def test_friction_on_a_surface_opposes_the_slip_vector(law: Any) -> None:
    """Generalised force J^T F with F = -law(|v|) v/|v|, and the power it takes is law(|v|) |v|."""
    effect = Friction(law, along=bowl, normal_force=2.0)
    q, qd = jnp.array([0.4, -0.3]), jnp.array([1.7, 0.6])
    v = np.asarray(jax.jvp(bowl, (q,), (qd,))[1])
    force = 2.0 * float(law.force(jnp.asarray(np.linalg.norm(v)))) * v / np.linalg.norm(v)
    action = effect.act(ZERO, q, qd, None, {})
    np.testing.assert_allclose(action.force, force, rtol=1e-13)
    np.testing.assert_allclose(action.generalised, -jax.jacobian(bowl)(q).T @ force, rtol=1e-13)
    power = effect.power(ZERO, q, qd, {}, action)
    assert power.absorbed is not None
    np.testing.assert_allclose(power.absorbed, np.linalg.norm(force) * np.linalg.norm(v), rtol=1e-13)


def test_planar_friction_is_smooth_through_rest() -> None:
    """At rest the force is its slope times slip; values and derivatives there are finite and those of the limit."""
    effect = Friction(Regularized(Coulomb(0.3), 1e-2), along=lambda q: q)
    at = lambda qd: effect.act(ZERO, jnp.zeros(2), qd, None, {}).force  # noqa: E731
    np.testing.assert_array_equal(at(jnp.zeros(2)), 0.0)
    np.testing.assert_allclose(jax.jacobian(at)(jnp.zeros(2)), 30.0 * np.eye(2), rtol=1e-12)
    np.testing.assert_allclose(jax.jacobian(at)(jnp.array([1e-9, 0.0])), 30.0 * np.eye(2), rtol=1e-6, atol=1e-9)


def test_a_puck_slides_straight_and_slows_at_mu_g() -> None:
    """On a table in x and y: |v| falls by mu g t, the direction stays."""
    table = lambda q: jnp.stack([q[0], q[1], 0.0 * q[0]])  # noqa: E731
    puck = point_mass(0.5, table)
    friction = Friction(Regularized(Coulomb(0.2), 1e-4), along=table, normal_force=puck.normal_force)
    run = simulate(Scene(puck, effects=(friction,)), [0.0, 0.0], [0.3, 0.4], 0.2, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(run.qd[-1], (0.5 - 0.2 * 9.81 * 0.2) * np.array([0.6, 0.8]), rtol=1e-7)


@pytest.mark.parametrize(
    ("effect", "text"),
    [
        (Friction(asymmetric(Coulomb(1.0), Fc=2.0), along=bowl), "cannot act.*the same in all directions"),
        (Friction(ElastoPlastic(1e3, 1.0, 0.1, 0.5, 1.0, 1.5, 0.1), along=bowl), "ElastoPlastic cannot act"),
        (Friction(DeadZone(Coulomb(1.0), 0.1), along=bowl), "DeadZone cannot act"),
        (Friction(Viscous(1.0), along=bowl, belt_velocity=0.1), "must be a function of t that returns one"),
        (Friction(Viscous(1.0), along=lambda q: jnp.ones(4)), r"returned the shape \(4,\).*\(2,\) or \(3,\)"),
    ],
)
def test_what_cannot_slide_in_the_plane_is_refused(effect: Friction, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        simulate(Scene(point_mass(1.0, bowl), effects=(effect,)), [0.0, 0.0], [0.0, 0.0], 1.0)


def turned(q: Any) -> Any:
    """Rotation by the angles of a heavy top: precession, nutation, spin."""
    c, s = jnp.cos(q), jnp.sin(q)
    one, zero = jnp.ones_like(q[0]), jnp.zeros_like(q[0])
    about_z = lambda i: jnp.stack([c[i], -s[i], zero, s[i], c[i], zero, zero, zero, one]).reshape(3, 3)  # noqa: E731
    about_x = jnp.stack([one, zero, zero, zero, c[1], -s[1], zero, s[1], c[1]]).reshape(3, 3)
    return about_z(0) @ about_x @ about_z(2)


def test_heavy_symmetric_top() -> None:
    """The Lagrangian of the top in its angles: A/2 (sin^2(b) a'^2 + b'^2) + C/2 (c' + cos(b) a')^2 - m g l cos(b)."""
    m, length, A, C = 0.6, 0.3, 0.08, 0.01
    about_tip = rigid_body(
        m, jnp.array([A - m * length**2, A - m * length**2, C]), lambda q: length * turned(q)[:, 2], turned
    )

    def closed(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, p
        spin = qd[2] + jnp.cos(q[1]) * qd[0]
        kinetic = 0.5 * A * ((jnp.sin(q[1]) * qd[0]) ** 2 + qd[1] ** 2) + 0.5 * C * spin**2
        return kinetic - m * 9.81 * length * jnp.cos(q[1])

    q, qd = jnp.array([0.3, 0.8, -1.1]), jnp.array([1.2, -0.7, 9.0])
    np.testing.assert_allclose(about_tip(ZERO, q, qd, {}), closed(ZERO, q, qd, {}), rtol=1e-13)
    ours, exact = (acceleration(each, ZERO, q, qd, {}) for each in (about_tip, closed))
    np.testing.assert_allclose(ours, exact, rtol=1e-11)


def test_an_inertia_tensor_and_an_angle() -> None:
    """A tensor is its principal form turned; plane motion takes one moment of inertia and an angle."""
    principal = jnp.array([0.1, 0.2, 0.25])
    axes = turned(jnp.array([0.4, 0.9, 0.2]))
    q, qd = jnp.array([0.3, 0.8, -1.1]), jnp.array([1.2, -0.7, 2.0])
    centre = lambda q: 0.0 * q  # noqa: E731
    one = rigid_body(1.0, axes @ jnp.diag(principal) @ axes.T, centre, turned)
    other = rigid_body(1.0, principal, centre, lambda q: turned(q) @ axes)
    np.testing.assert_allclose(one(ZERO, q, qd, {}), other(ZERO, q, qd, {}), rtol=1e-13)
    rod = rigid_body(2.0, 0.3, lambda q: jnp.stack([jnp.sin(q[0]), 0 * q[0], -jnp.cos(q[0])]), lambda q: q[0])
    np.testing.assert_allclose(
        acceleration(rod, ZERO, q[:1], qd[:1], {}), [-2.0 * 9.81 * np.sin(0.3) / (2.0 + 0.3)], rtol=1e-13
    )


def test_numbers_of_a_sum_have_the_names_of_their_bodies() -> None:
    many: Any = sum  # type checkers know of sums of numbers
    line = lambda q: jnp.stack([q[0], 0.0 * q[0], 0.0 * q[0]])  # noqa: E731
    body, bob = point_mass(1.0, line), point_mass(2.0, line, name="bob")
    rod = rigid_body(3.0, 0.1, line, lambda q: q[0])
    for total in (body + bob + rod + body, body + (bob + rod) + body, many([body, bob, rod, body])):
        numbers = scene_numbers(Scene(total))
        masses = {"bob": 2.0, "point_mass": 1.0, "point_mass_2": 1.0, "rigid_body": 3.0}
        assert {k: float(x) for k, x in numbers.items() if k.endswith("m")} == {
            f"lagrangian.parts.{name}.m": m for name, m in masses.items()
        }
        # Each body has the gravity of the sum.
        gravity = {k: float(x) for k, x in numbers.items() if k.endswith("gravity")}
        assert gravity == {"lagrangian.gravity": 9.81}
        here = jnp.array([0.4, 0.1]), jnp.array([1.0, 2.0])
        np.testing.assert_allclose(
            (total + bob)(ZERO, *here, {}),
            sum(each(ZERO, *here, {}) for each in (body, bob, rod, body, bob)),
            rtol=1e-14,
        )
    # Bodies with several gravities, or one that is a function of `params`, keep them.
    for other in (1.62, lambda p: p["g"]):
        numbers = scene_numbers(Scene(body + bob + point_mass(1.0, line, gravity=other, name="moon"), {"g": 9.81}))
        assert {"lagrangian.parts.bob.gravity", "lagrangian.parts.point_mass.gravity"} <= {*numbers}
    # Terms without a name that can be written are terms.
    assert list((bob + (lambda t, q, qd, p: 0.0 * q[0]) + bob).parts) == ["bob", "term", "bob_2"]


def test_bodies_and_springs_add_up() -> None:
    def spring(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, qd, p
        return -0.5 * 3.0 * q[0] ** 2

    line = lambda q: jnp.stack([q[0], 0 * q[0], 0 * q[0]])  # noqa: E731
    mass = point_mass(2.0, line)
    many: Any = sum  # type checkers know of sums of numbers
    for together in (mass + mass + spring, many([mass, mass, spring]), spring + (mass + mass)):
        qdd = acceleration(together, ZERO, jnp.array([0.5]), jnp.array([0.1]), {})
        np.testing.assert_allclose(qdd, [-3.0 * 0.5 / 4.0], rtol=1e-14)


@pytest.mark.parametrize(
    ("build", "text"),
    [
        (lambda: point_mass("1", bowl), "point_mass m must be a real number.*'1' was given"),
        (lambda: point_mass(1.0, 3.0), "position must be a function, but 3.0"),
        (lambda: point_mass(1.0, lambda t, q, p: q), "takes 3 arguments"),
        (lambda: Scene(point_mass(1.0, lambda q: q)), r"position returned the shape \(2,\), but \(3,\)"),
        (
            lambda: Scene(rigid_body(1.0, jnp.ones(2), lambda q: jnp.zeros(3), lambda q: jnp.eye(3))),
            r"orientation returned the shape \(3, 3\) with an inertia of shape \(2,\)",
        ),
        (lambda: point_mass(1.0, bowl, name=""), "point_mass name must be a text that is not empty, or None, but ''"),
        (lambda: point_mass(1.0, bowl) + 3.0, "added to a body must be a function"),
    ],
)
def test_wrong_bodies_are_refused(build: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        simulate(build(), [0.0, 0.0], [0.0, 0.0], 1.0)
