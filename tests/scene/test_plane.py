"""Exact friction in the plane: against closed forms, the scalar law, a second solver, and finite differences."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxmodsim import AppliedForce, Constraint, Coulomb, Friction, Rodas5P, Scene, Stribeck, simulate
from jaxmodsim.problems import turntable_puck
from jaxmodsim.scene import State, forward_dynamics

TIGHT: Any = {"rtol": 1e-10, "atol": 1e-12}
F = 1.5


def free(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A puck under a constant force along x."""
    del t
    return 0.5 * p["m"] * jnp.sum(qd**2) + p["f"] * q[0]


def place(q: Any) -> Any:
    return q


def puck(law: Any = None, **friction: Any) -> Scene:
    law = Coulomb(F, 2.0) if law is None else law
    return Scene(free, params={"m": 2.0, "f": 0.0}, effects=(Friction(law, along=place, **friction),))


PUCK = puck()


def stop(v: Any, f: Any, **more: Any) -> Any:
    """The run of a puck that begins at the velocity `v` under the force `f`, to its stop."""
    return simulate(eqx.tree_at(lambda s: s.params["f"], PUCK, f), jnp.zeros(2), v, 40.0, **TIGHT, **more)


def place_of_stop(v: Any, f: Any) -> Any:
    return stop(v, f, throw=False).q[-1]


# By the velocity and by the force, in both modes.
SLOPES = [jax.jit(derive(place_of_stop, argnums=(0, 1))) for derive in (jax.jacfwd, jax.jacrev)]


def test_a_puck_stops_on_a_line_at_the_place_in_closed_form() -> None:
    """x = v |v| m/(2 F), t = |v| m/F, and their derivatives in both modes."""
    v, zero = np.array([3.0, 4.0]), jnp.array(0.0)
    run = stop(v, zero)
    np.testing.assert_allclose(run.q[-1], v * 5.0 * 2.0 / (2.0 * F), rtol=1e-12)
    np.testing.assert_allclose(run.events.t[0], 5.0 * 2.0 / F, rtol=1e-12)
    assert run.mode["friction"][-1] == 0
    np.testing.assert_array_equal(run.forces["friction"][-1], 0.0)
    exact = (5.0 * np.eye(2) + np.outer(v, v) / 5.0) * 2.0 / (2.0 * F)
    for slopes in SLOPES:
        np.testing.assert_allclose(slopes(v, zero)[0], exact, atol=1e-10)


def turning(f: float, speed: float, angle: float) -> tuple[float, np.ndarray]:
    """Time and place at which slip dies whose direction turns to that of the load.

    With dt = v ds the equations of ln v and of the angle are regular to the end; the time is in closed form, as
    `v (F + f cos(angle))` falls at the constant rate (F^2 - f^2)/m.
    """
    a, b = F / 2.0, f / 2.0

    def rate(_: float, y: np.ndarray) -> list[float]:
        v, c, n = np.exp(y[0]), np.cos(y[1]), np.sin(y[1])
        return [-a + b * c, -b * n, v * v * c, v * v * n]

    end = solve_ivp(
        rate, (0.0, 40.0 / (a - b)), [np.log(speed), angle, 0.0, 0.0], method="DOP853", rtol=1e-13, atol=1e-14
    )
    return speed * (a + b * np.cos(angle)) / (a * a - b * b), end.y[2:, -1]


@pytest.mark.parametrize("f", [0.3, 0.8, 1.4])
def test_slip_that_turns_dies_where_a_regular_form_of_the_equations_says(f: float) -> None:
    """At 0.2, 0.53 and 0.93 of the limit, from 115 degrees of the load; derivatives of the way in closed form."""
    speed, angle = 2.0, 2.0
    v = speed * np.array([np.cos(angle), np.sin(angle)])
    t_exact, q_exact = turning(f, speed, angle)
    run = stop(v, jnp.array(f))
    np.testing.assert_allclose(run.events.t[0], t_exact, rtol=1e-9)
    np.testing.assert_allclose(run.q[-1], q_exact, atol=1e-9)
    assert run.mode["friction"][-1] == 0
    np.testing.assert_allclose(run.forces["friction"][-1], [f, 0.0], atol=1e-12)

    def way(f: Any) -> Any:
        """Along the load; its rate is the velocity, as that of `v (F + f cos(angle))` is a constant."""
        a, b, c = F / 2.0, f / 2.0, jnp.cos(angle)
        return speed**2 * (b * (1.0 + c * c) + 2.0 * a * c) / (4.0 * (a * a - b * b))

    np.testing.assert_allclose(run.q[-1, 0], way(f), atol=1e-9)
    exact = jax.jit(jax.grad(way))(f)
    for slopes in SLOPES:
        np.testing.assert_allclose(slopes(v, jnp.array(f))[1][0], exact, rtol=1e-8)


def ramp(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """Breaks away forwards, stops, and breaks away backwards."""
    del q, qd, p
    return jnp.stack([3.0 * t - t * t, 0.0 * t])


@pytest.mark.parametrize("law", [Coulomb(1.0, 1.4), Stribeck(1.0, 1.4, 0.1, 0.3)])
def test_on_a_line_it_is_the_scalar_law(law: Any) -> None:
    runs = [
        simulate(
            Scene(
                free,
                params={"m": 2.0, "f": 0.0},
                effects=(AppliedForce(ramp), Friction(law, along=along, name="friction")),
            ),
            [0.0, 0.0],
            [0.0, 0.0],
            5.5,
            ts=np.linspace(0.0, 5.5, 12),
            solver=Rodas5P(),
            **TIGHT,
        )
        for along in (lambda q: q[0], place)
    ]
    scalar, plane = runs
    exact = isinstance(law, Coulomb)
    np.testing.assert_allclose(plane.q, scalar.q, rtol=0, atol=1e-13 if exact else 1e-10)
    np.testing.assert_allclose(plane.forces["friction"][:, 0], scalar.forces["friction"], atol=1e-12 if exact else 1e-9)
    np.testing.assert_array_equal(plane.q[:, 1], 0.0)
    np.testing.assert_array_equal(plane.mode["friction"], np.abs(scalar.mode["friction"]))
    np.testing.assert_array_equal(np.unique(scalar.mode["friction"]), [-1, 0, 1])
    if exact:
        signs = [(e.before, e.after) for e in scalar.mode_changes]
        # Where slip turns round at once, it is slip on both sides.
        assert signs == [("stick", "forward"), ("forward", "backward")]
        assert [(e.before, e.after) for e in plane.mode_changes] == [("stick", "slip")]
        np.testing.assert_allclose(plane.mode_changes[0].t, scalar.mode_changes[0].t, rtol=1e-12)


def sprung(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, p
    return 0.5 * jnp.sum(qd**2) - 0.5 * jnp.sum(q**2)


def turning_load(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del q, qd
    return jnp.stack([jnp.sin(0.35 * t), p["across"] * jnp.cos(0.35 * t)])


def test_derivatives_through_break_aways_are_those_of_differences() -> None:
    """Slip that begins follows the load at a rate, friction over speed, that has no bound."""
    effects = (AppliedForce(turning_load), Friction(Coulomb(0.5), along=place))
    scene = Scene(sprung, params={"across": 0.3}, effects=effects)

    def end(q0: Any, across: Any, rtol: float) -> Any:
        here = eqx.tree_at(lambda s: s.params["across"], scene, across)
        return simulate(here, q0, [0.0, 0.0], 20.0, rtol=rtol, atol=1e-2 * rtol, throw=False)

    q0, h = jnp.array([-0.05, 0.02]), 1e-5
    tight = jax.jit(lambda q0, across: end(q0, across, 1e-12))
    slopes = jax.jit(jax.jacfwd(lambda q0, across: end(q0, across, 1e-9).q[-1], argnums=(0, 1)))
    assert tight(q0, 0.3).stats["num_events"] == 5
    by_q0 = [(tight(q0 + h * e, 0.3).q - tight(q0 - h * e, 0.3).q)[-1] / (2 * h) for e in np.eye(2)]
    by_across = (tight(q0, 0.3 + h).q - tight(q0, 0.3 - h).q)[-1] / (2 * h)
    np.testing.assert_allclose(slopes(q0, 0.3)[0], np.stack(by_q0, axis=1), atol=1e-7)
    np.testing.assert_allclose(slopes(q0, 0.3)[1], by_across, atol=1e-7)
    # On a line the motion along it does not depend, to first order, on the place across it.
    on_line = slopes(jnp.array([-0.05, 0.0]), 0.0)[0]
    np.testing.assert_allclose(on_line[[0, 1], [1, 0]], 0.0, atol=1e-10)


def test_forces_turn_with_the_frame() -> None:
    """Stick and slip, at rest and at all speeds, in twenty frames."""
    rng, scene = np.random.default_rng(0), puck(Stribeck(1.0, 2.0, 0.3, 0.4))

    @jax.jit
    def force(q: Any, qd: Any, mode: Any, f: Any) -> Any:
        pushed = Scene(scene.lagrangian, scene.params, (AppliedForce(lambda t, q, qd, p: f), *scene.effects))
        return forward_dynamics(jnp.zeros(()), State(q, qd, {}), pushed, mode).actions["friction"].force

    for _ in range(20):
        angle, v, load = rng.uniform(0, 7), rng.normal(size=2) * 10.0 ** rng.uniform(-9, 2), rng.normal(size=2)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        mode = (v + 0.3 * np.linalg.norm(v) * rng.normal(size=2)) * rng.integers(2)
        plain, turned = (
            np.asarray(force(jnp.zeros(2), *(jnp.asarray(r @ x) for x in (v, mode, load)))) for r in (np.eye(2), turn)
        )
        np.testing.assert_allclose(turned, turn @ plain, atol=1e-12)
        if mode.any() and v @ mode > 0:
            speed = np.linalg.norm(v)
            np.testing.assert_allclose(plain, (1 + np.exp(-((speed / 0.3) ** 2)) + 0.4 * speed) * v / speed, rtol=1e-9)


def after_break_away(mu: float, stiction: float, t1: float) -> np.ndarray:
    """Place on the turntable by scipy, in polar coordinates of the slip, from just behind the break-away on."""
    p, t0, late = turntable_puck.PARAMS, float(turntable_puck.break_away(stiction).t), 1e-5

    def load(t: float, x: float, y: float, u: float, v: float) -> np.ndarray:
        w = p["alpha"] * t
        return np.array([w * w * x + p["alpha"] * y + 2 * w * v, w * w * y - p["alpha"] * x - 2 * w * u])

    first = [load(t, p["r0"], 0.0, 0.0, 0.0) for t in (t0, t0 + late)]
    size, angle = np.linalg.norm(first, axis=1) - mu * p["g"], np.arctan2(first[1][1], first[1][0])
    # The load grows in proportion to the time; where friction does not fall at break-away, slip begins with its square.
    speed = late * 0.5 * (size[0] + size[1])

    def rate(t: float, y: np.ndarray) -> list[float]:
        v, n = np.exp(y[2]), np.array([np.cos(y[3]), np.sin(y[3])])
        a = load(t, y[0], y[1], *(v * n))
        return [*(v * n), (a @ n - mu * p["g"]) / v, (a[1] * n[0] - a[0] * n[1]) / v]

    end = solve_ivp(rate, (t0 + late, t1), [p["r0"], 0.0, np.log(speed), angle], method="Radau", rtol=1e-10, atol=1e-12)
    return end.y[:2, -1]


def test_the_turntable_lets_the_puck_go_at_the_speed_in_closed_form() -> None:
    """With and without stiction; the way from there on by a second solver; derivatives of the time in both modes."""
    mu = turntable_puck.PARAMS["mu"]

    def run(law: Coulomb, **more: Any) -> Any:
        return simulate(turntable_puck.scene(law), [0.5, 0.0], [0.0, 0.0], 4.0, **TIGHT, **more)

    def lets_go(Fs: Any) -> Any:
        return run(Coulomb(mu, Fs), throw=False).events.t[0]

    ahead = jax.jit(lambda Fs: jax.jvp(lets_go, (Fs,), (jnp.ones_like(Fs),))[1])
    slopes = ahead, jax.jit(jax.grad(lets_go))
    for stiction in (1.0, 1.3):
        law = Coulomb(mu, stiction * mu)
        out = run(law)
        force = np.asarray(out.event_forces["friction"][0, 0])
        exact = turntable_puck.break_away(stiction * mu)
        np.testing.assert_allclose(out.events.t[0], exact.t, rtol=1e-12)
        # The load of the turning frame against the radius, which friction holds until then.
        np.testing.assert_allclose(np.arctan2(-force[1], force[0]), exact.direction, rtol=1e-10)
        np.testing.assert_allclose(np.linalg.norm(force), 0.5 * 9.81 * stiction * mu, rtol=1e-10)
        np.testing.assert_allclose(out.q[-1], after_break_away(mu, stiction * mu, 4.0), rtol=1e-7)
        slope = jax.grad(lambda x: turntable_puck.break_away(x).t)(stiction * mu)
        for derivative in slopes:
            np.testing.assert_allclose(derivative(stiction * mu), slope, rtol=1e-8)


def test_the_load_may_be_a_reaction_or_a_number() -> None:
    """A block on a floor that presses harder and harder, in three coordinates and in two."""
    lift = 0.2

    def solid(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del p
        return 0.5 * jnp.sum(qd**2) - (9.81 + lift * t) * q[2]

    def push(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del qd, p
        return jnp.stack([1.0 + 0.0 * t, 0.5 + 0.0 * t, *(0.0 * q[2:])])

    floor = Constraint(lambda t, q, p: q[2], name="floor")
    block = Friction(Coulomb(0.3), along=lambda q: q[:2], normal_force="floor")
    reaction = simulate(
        Scene(solid, effects=(AppliedForce(push), block), constraints=(floor,)),
        [0.0] * 3,
        [1.0, -2.0, 0.0],
        2.0,
        **TIGHT,
    )
    number = Friction(Coulomb(0.3), along=place, normal_force=lambda t, q, qd, p: 9.81 + lift * t)
    plane = simulate(
        Scene(lambda t, q, qd, p: 0.5 * jnp.sum(qd**2), effects=(AppliedForce(push), number)),
        [0.0] * 2,
        [1.0, -2.0],
        2.0,
        **TIGHT,
    )
    np.testing.assert_allclose(reaction.q[-1, :2], plane.q[-1], atol=1e-10)
    np.testing.assert_allclose(reaction.events.t[0], plane.events.t[0], rtol=1e-9)
    np.testing.assert_allclose(reaction.forces["friction"][-1], [1.0, 0.5], atol=1e-10)


def test_on_an_ellipse_friction_is_the_point_of_greatest_dissipation() -> None:
    """In slip against 10 000 points of the ellipse; break-away where the load passes it."""
    ratio, v = 0.5, np.array([0.3, -0.7])
    scene = puck(Coulomb(F), ellipse=ratio)
    state = State(jnp.zeros(2), jnp.asarray(v), {})
    force = np.asarray(jax.jit(forward_dynamics)(jnp.zeros(()), state, scene, jnp.asarray(v)).actions["friction"].force)
    angles = np.linspace(0, 2 * np.pi, 10_001)
    points = F * np.stack([np.cos(angles), ratio * np.sin(angles)])
    np.testing.assert_allclose(force @ v, np.max(v @ points), rtol=1e-6)
    np.testing.assert_allclose((force[0] / F) ** 2 + (force[1] / (ratio * F)) ** 2, 1.0, rtol=1e-12)
    pull = AppliedForce(lambda t, q, qd, p: t * jnp.stack([jnp.cos(0.7), jnp.sin(0.7)]))
    run = simulate(Scene(free, scene.params, (pull, *scene.effects)), [0.0, 0.0], [0.0, 0.0], 1.5, **TIGHT)
    limit = F / np.sqrt(np.cos(0.7) ** 2 + (np.sin(0.7) / ratio) ** 2)
    np.testing.assert_allclose(run.events.t[0], limit, rtol=1e-10)


def test_energy_float32_and_batches() -> None:
    """The energy balance closes over slip and stick; in float32 the stop is right to rounding, in batches too."""
    run = simulate(PUCK, [0.0, 0.0], [3.0, 4.0], 8.0, ts=np.linspace(0.0, 8.0, 9), **TIGHT)
    np.testing.assert_allclose(run.energy.balance, 0.0, atol=1e-9)
    np.testing.assert_allclose(run.energy.dissipated[-1], 25.0, rtol=1e-9)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), PUCK)
    v = np.array([[3.0, 4.0], [-1.0, 0.5], [0.0, 0.0]], np.float32)
    ends = jax.jit(jax.vmap(lambda v: simulate(single, jnp.zeros(2, jnp.float32), v, 8.0).q[-1]))(v)
    assert ends.dtype == jnp.float32
    exact = v * np.linalg.norm(v, axis=1, keepdims=True) * 2.0 / (2.0 * F)
    np.testing.assert_allclose(ends, exact, rtol=2e-5, atol=1e-5)


MASS, HALF, LIMIT = 2.0, 0.5, 1.5


def foot(side: float) -> Any:
    return lambda q: q[:2] + side * HALF * jnp.stack([jnp.cos(q[2]), jnp.sin(q[2])])


def bar_alone(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """Seen from above; the coordinates are its centre and its angle."""
    del t, q, p
    return 0.5 * MASS * jnp.sum(qd[:2] ** 2) + 0.5 * (MASS * HALF**2 / 3.0) * qd[2] ** 2


def on_bar(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A pull along x that grows with time, and a push across the bar at its right end."""
    del qd
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    return jnp.stack([p["pull"] * t, 0.0 * t, 0.0 * t]) + p["push"] * jnp.stack([-s, c, HALF + 0.0 * c])


LEFT, RIGHT = foot(-1.0), foot(1.0)


def bar(left: float, right: float, pull: float, push: float) -> Scene:
    """A bar on rough feet at its ends, with their limits."""
    feet = [
        Friction(Coulomb(x), along=at, name=name) for x, at, name in ((left, LEFT, "left"), (right, RIGHT, "right"))
    ]
    return Scene(bar_alone, params={"pull": pull, "push": push}, effects=(AppliedForce(on_bar), *feet))


def test_feet_of_a_bar_share_a_pull_along_it() -> None:
    """The equations leave the shares open: each foot takes its part in proportion to its limit, and both let go."""
    run = simulate(bar(1.0, 2.0, pull=1.0, push=0.0), [0.0] * 3, [0.0] * 3, 4.0, ts=np.array([1.5, 4.0]), **TIGHT)
    np.testing.assert_allclose(run.forces["left"][0], [0.5, 0.0], atol=1e-9)
    np.testing.assert_allclose(run.forces["right"][0], [1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(run.events.t[:2], 3.0, rtol=1e-6)
    np.testing.assert_allclose(run.q[-1], [1.0 / (6.0 * MASS), 0.0, 0.0], atol=1e-6)


def test_a_bar_pushed_across_at_one_end_pivots_about_the_other() -> None:
    """Constant angular acceleration, until the force that keeps the foot in place reaches its limit."""
    push = LIMIT + 1.0
    angular = (push - LIMIT) * 2 * HALF / (4 / 3 * MASS * HALF**2)
    # Across the bar the foot holds half of what accelerates the bar, along it the centripetal force.
    slips = (LIMIT**2 - 0.25 * (push - LIMIT) ** 2) ** 0.25 / (MASS * HALF) ** 0.5 / angular
    scene = bar(LIMIT, LIMIT, pull=0.0, push=push)
    run = simulate(scene, [0.0] * 3, [0.0] * 3, 1.5 * slips, ts=slips * np.array([0.9, 1.5]), **TIGHT)
    angle = 0.5 * angular * (0.9 * slips) ** 2
    centre = HALF * np.array([np.cos(angle) - 1.0, np.sin(angle)])
    np.testing.assert_allclose(run.q[0], [*centre, angle], rtol=1e-7)
    assert run.mode["left"][0] == 0
    lets_go = next(each for each in run.mode_changes if each.effect == "left" and each.before == "stick")
    np.testing.assert_allclose(lets_go.t, slips, rtol=1e-6)


@pytest.mark.parametrize("load", [1.0, 1.9])
def test_a_plane_beside_a_bearing_that_sticks_breaks_away_across_it(load: float) -> None:
    """The bearing carries the load along it: by 1 s the plane carries its limit across, and y = (t - 1)^3/6."""
    push = AppliedForce(lambda t, q, qd, p: jnp.stack([load + 0.0 * t, t]))
    scene = Scene(lambda t, q, qd, p: 0.5 * jnp.sum(qd**2), effects=(push, *plane_and_bearing(1.0, 2.0)))
    run = simulate(scene, [0.0] * 2, [0.0] * 2, 2.0, **TIGHT)
    np.testing.assert_allclose(run.q[-1], [0.0, 1 / 6], atol=1e-9)
    np.testing.assert_allclose(run.events.t[0], 1.0, rtol=1e-9)


@pytest.mark.parametrize(("pull", "limit"), [(1.7, 1.0), (2.5, 2.0)])
def test_a_plane_and_a_bearing_hold_a_load_that_reverses(pull: float, limit: float) -> None:
    """The load exceeds the limit of the bearing, and never that of both: the mass stays at rest."""
    push = AppliedForce(lambda t, q, qd, p: jnp.stack([pull * jnp.sin(3 * t), 0.6 * jnp.sin(2 * t)]))
    scene = Scene(lambda t, q, qd, p: 0.5 * jnp.sum(qd**2), effects=(push, *plane_and_bearing(1.0, limit)))
    run = simulate(scene, [0.0] * 2, [0.0] * 2, 5.0)
    np.testing.assert_allclose(run.q[-1], 0.0, atol=1e-12)


def plane_and_bearing(of_plane: float, of_bearing: float) -> tuple[Friction, Friction]:
    """Friction in the plane, and a bearing along x."""
    plane = Friction(Coulomb(of_plane), along=lambda q: q, name="plane")
    return plane, Friction(Coulomb(of_bearing), along=lambda q: q[0], name="bearing")
