"""Constraints: multipliers, drift, consistent states, and loads that are reactions."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import (
    AppliedForce,
    Constraint,
    Contact,
    Coulomb,
    DeadZone,
    Friction,
    Gauss,
    Regularized,
    Scene,
    SimulationError,
    VelocityConstraint,
    point_mass,
    project_initial_state,
    simulate,
)
from jaxmodsim._core.cholesky import solve_semidefinite
from jaxmodsim.scene import State, forward_dynamics, vector_field
from jaxmodsim.scene._loads import solve_loads

ZERO = jnp.array(0.0)
# As a whole, not operation by operation.
rate_of, dynamics_of = jax.jit(vector_field), jax.jit(forward_dynamics)
G, LENGTH = 9.81, 2.0


def place(q: Any) -> Any:
    return jnp.stack([q[0], 0.0 * q[0], q[1]])


def circle(t: Any, x: Any, p: Any) -> Any:
    """In a unit that is no length, so that the force must come from the gradient."""
    del t, p
    return jnp.sum(x**2) - LENGTH**2


def free(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, p
    return 0.5 * jnp.sum(qd**2)


BOB = point_mass(1.3, place)
PENDULUM = Scene(BOB, constraints=(Constraint(circle, at=lambda q: q, name="rod"),))


def hanging(angle: float, rate: float) -> tuple[Any, Any]:
    q = LENGTH * jnp.array([np.sin(angle), -np.cos(angle)])
    return q, LENGTH * rate * jnp.array([np.cos(angle), np.sin(angle)])


@pytest.mark.quick
def test_pendulum_in_cartesian_coordinates() -> None:
    q, qd = hanging(0.7, 1.1)
    along, inwards = np.array([np.cos(0.7), np.sin(0.7)]), np.array([-np.sin(0.7), np.cos(0.7)])
    exact = -G * np.sin(0.7) * along + LENGTH * 1.1**2 * inwards
    state = State(q, qd, {})
    np.testing.assert_allclose(rate_of(ZERO, state, PENDULUM).qd, exact, atol=1e-13)
    tension = 1.3 * (LENGTH * 1.1**2 + G * np.cos(0.7))
    reaction = dynamics_of(ZERO, state, PENDULUM).reactions["rod"]
    np.testing.assert_allclose(reaction.force, tension * inwards, rtol=1e-13)
    np.testing.assert_allclose(reaction.generalised, tension * inwards, rtol=1e-13)
    np.testing.assert_allclose(reaction.multiplier, [-tension / (2 * LENGTH)], rtol=1e-13)


@pytest.mark.parametrize("copies", [2, 3])
def test_redundant_constraints_share_and_leave_the_motion_as_it_is(copies: int) -> None:
    q, qd = hanging(0.7, 1.1)
    again = Scene(BOB, constraints=tuple(Constraint(circle, at=lambda q: q) for _ in range(copies)))
    state = State(q, qd, {})
    one = rate_of(ZERO, state, PENDULUM).qd
    np.testing.assert_allclose(rate_of(ZERO, state, again).qd, one, rtol=1e-12)
    parts = [each.force for each in dynamics_of(ZERO, state, again).reactions.values()]
    np.testing.assert_allclose(parts[0], parts[-1], rtol=1e-6)
    np.testing.assert_allclose(sum(parts), dynamics_of(ZERO, state, PENDULUM).reactions["rod"].force, rtol=1e-12)


def test_smallest_solution_of_a_singular_system() -> None:
    """Against the pseudo-inverse: three equations of rank two, two of them alike."""
    rows = np.array([[1.0, 2.0], [1.0, 2.0], [0.5, -1.0]])
    matrix, rhs = jnp.asarray(rows @ rows.T), jnp.asarray(rows @ np.array([0.3, -0.7]))
    ones = jnp.ones(3)
    ours = solve_semidefinite(matrix, rhs, ones, jnp.ones(3, bool))
    np.testing.assert_allclose(matrix @ ours, rhs, atol=1e-13)
    np.testing.assert_allclose(ours, np.linalg.pinv(np.asarray(matrix)) @ np.asarray(rhs), atol=1e-13)
    part = solve_semidefinite(matrix, rhs, ones, jnp.array([True, False, True]))
    np.testing.assert_allclose(part[jnp.array([0, 2])], np.linalg.solve(matrix[::2, ::2], rhs[::2]), rtol=1e-12)
    assert float(part[1]) == 0.0


@pytest.mark.parametrize("n", [2, 3, 4])
def test_solutions_of_least_norm(n: int) -> None:
    """Against the pseudo-inverse: rows of any size and rank, some of them not active, with weights."""
    rng, error = np.random.default_rng(0), 1e-11 if n < 4 else 1e-7
    solve = jax.jit(solve_semidefinite)
    for rank, _ in itertools.product(range(1, n + 1), range(40)):
        rows = rng.normal(size=(n, rank)) * 10 ** rng.uniform(-1, 1, size=(n, 1))
        matrix, weight, active = rows @ rows.T, 10 ** rng.uniform(-0.5, 0.5, n), rng.random(n) < 0.8
        scaled = (matrix * weight[:, None] * weight[None, :])[np.ix_(active, active)]
        values = np.linalg.eigvalsh(scaled)
        if not active.any() or values[values > 1e-12 * values[-1]][0] < 1e-4 * values[-1]:
            continue
        rhs = np.zeros((n, 2))
        rhs[active] = matrix[np.ix_(active, active)] @ rng.normal(size=(active.sum(), 2))
        exact = np.zeros((n, 2))
        inverse = np.linalg.pinv(scaled, rcond=1e-12, hermitian=True)
        exact[active] = weight[active, None] * (inverse @ (weight[active, None] * rhs[active]))
        atol = error * np.abs(exact).max()
        np.testing.assert_allclose(solve(matrix, rhs, weight, active), exact, atol=atol)
        np.testing.assert_allclose(solve(matrix, rhs[:, 0], weight, active), exact[:, 0], atol=atol)


def drift(run: Any) -> float:
    """Largest error of length and of velocity along it."""
    length = jnp.abs(jnp.sum(run.q**2, axis=1) - LENGTH**2)
    return float(jnp.maximum(length, jnp.abs(jnp.sum(run.q * run.qd, axis=1))).max())


def test_drift_with_projection_with_stabilisation_and_without() -> None:
    q, qd = hanging(1.2, 0.0)
    ts = jnp.linspace(0.0, 30.0, 301)
    damped = Scene(BOB, constraints=(Constraint(circle, at=lambda q: q, stabilise=20.0),))
    projected = simulate(PENDULUM, q, qd, 30.0, ts=ts)
    assert drift(projected) < 1e-13
    left, held = (drift(simulate(each, q, qd, 30.0, ts=ts, project=False)) for each in (PENDULUM, damped))
    assert 1e-5 < left < 1e-2
    assert held < 0.01 * left
    # The pendulum in its angle, by the conserved energy at the lowest point: speed^2 = 2 g l (1 - cos(1.2)).
    speed = jnp.sqrt(jnp.sum(projected.qd**2, axis=1))
    height = projected.q[:, 1] + LENGTH * np.cos(1.2)
    np.testing.assert_allclose(0.5 * speed**2 + G * height, 0.0, atol=1e-3)


def test_reactions_along_a_run_and_derivatives_through_it() -> None:
    """The multiplier differentiates like anything else: at the lowest point the tension is m g (3 - 2 cos(start))."""
    q, qd = hanging(1.2, 0.0)

    def tension(gravity: Any) -> Any:
        scene = Scene(point_mass(1.3, place, gravity), constraints=PENDULUM.constraints)
        run = simulate(scene, q, qd, 0.4, rtol=1e-9, atol=1e-11)
        return jnp.sqrt(jnp.sum(run.reactions["rod"].force[-1] ** 2))

    value, slope = jax.jit(jax.value_and_grad(tension))(9.81)
    step = 1e-4
    differences = (tension(9.81 + step) - tension(9.81 - step)) / (2 * step)
    np.testing.assert_allclose(slope, differences, rtol=1e-6)
    run = simulate(PENDULUM, q, qd, 0.4, rtol=1e-9, atol=1e-11)
    cosine = float(-run.q[-1, 1] / LENGTH)
    np.testing.assert_allclose(value, 1.3 * G * (3 * cosine - 2 * np.cos(1.2)), rtol=1e-8)


def test_lanes_of_a_batch_and_single_precision() -> None:
    angles = [0.4, 1.2]
    starts = [hanging(angle, 0.3) for angle in angles]
    q, qd = (jnp.stack(each) for each in zip(*starts, strict=True))
    many = jax.vmap(lambda q, qd: simulate(PENDULUM, q, qd, 1.0).q[-1])(q, qd)
    for i in range(2):
        np.testing.assert_allclose(many[i], simulate(PENDULUM, q[i], qd[i], 1.0).q[-1], rtol=1e-10)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), PENDULUM)
    run = simulate(single, q[0].astype(jnp.float32), qd[0].astype(jnp.float32), 1.0, rtol=1e-5, atol=1e-6)
    assert run.q.dtype == jnp.float32
    np.testing.assert_allclose(run.q[-1], many[0], atol=1e-4)


def test_gauss_keeps_the_energy_of_a_constrained_scene_better_than_its_tolerance() -> None:
    q, qd = hanging(1.2, 0.0)
    run = simulate(PENDULUM, q, qd, 30.0, ts=jnp.linspace(0.0, 30.0, 31), dt=0.05, solver=Gauss(3))
    assert drift(run) < 1e-13
    energy = 0.5 * jnp.sum(run.qd**2, axis=1) + G * run.q[:, 1]
    assert float(jnp.abs(energy - energy[0]).max()) < 1e-6


def moving(t: Any, q: Any, p: Any) -> Any:
    del p
    return q[0] - 0.5 * t**2


def test_a_constraint_that_moves_works() -> None:
    """A mass of 1 kg pushed at 1 m/s^2: the force is 1 N, and the work is the kinetic energy."""
    scene = Scene(free, constraints=(Constraint(moving, name="push"),))
    run = simulate(scene, [0.0], [0.0], 2.0, ts=jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(run.q[:, 0], [0.5, 2.0], atol=1e-12)
    np.testing.assert_allclose(run.reactions["push"].multiplier, 1.0, rtol=1e-12)
    np.testing.assert_allclose(run.energy.work_in, [0.5, 2.0], rtol=1e-6)
    np.testing.assert_allclose(run.energy.balance, 0.0, atol=1e-6)


def blade(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """No sideways motion of a blade at q = (x, y, heading)."""
    del t, p
    return jnp.sin(q[2]) * qd[0] - jnp.cos(q[2]) * qd[1]


def test_a_blade_that_turns_steadily_goes_in_a_circle() -> None:
    """Free of forces it keeps its speed and its turn; the sideways force is m v w."""
    scene = Scene(free, constraints=(VelocityConstraint(blade, name="blade"),))
    run = simulate(scene, [0.0, 0.0, 0.0], [1.5, 0.0, 0.5], 3.0, ts=jnp.array([1.0, 3.0]), rtol=1e-9, atol=1e-11)
    heading = 0.5 * run.t
    radius = 1.5 / 0.5
    np.testing.assert_allclose(run.q[:, 0], radius * jnp.sin(heading), atol=1e-8)
    np.testing.assert_allclose(run.q[:, 1], radius * (1 - jnp.cos(heading)), atol=1e-8)
    np.testing.assert_allclose(jnp.abs(run.reactions["blade"].multiplier), 1.5 * 0.5, rtol=1e-8)
    np.testing.assert_allclose(jax.vmap(lambda q, qd: blade(0.0, q, qd, {}))(run.q, run.qd), 0.0, atol=1e-14)


def test_consistent_states_are_found() -> None:
    q, qd = project_initial_state(PENDULUM, [1.5, -1.0], [1.0, 1.0])
    np.testing.assert_allclose(q, LENGTH * np.array([1.5, -1.0]) / np.hypot(1.5, 1.0), rtol=1e-12)
    np.testing.assert_allclose(q @ qd, 0.0, atol=1e-13)
    np.testing.assert_allclose(qd, np.array([1.0, 1.0]) - q * (q @ np.ones(2)) / LENGTH**2, atol=1e-12)
    held, rate = project_initial_state(PENDULUM, [1.5, -1.0], [1.0, 0.0], hold=[0])
    np.testing.assert_allclose(held, [1.5, -np.sqrt(LENGTH**2 - 1.5**2)], rtol=1e-12)
    np.testing.assert_allclose(rate, [1.0, 1.5 / np.sqrt(LENGTH**2 - 1.5**2)], rtol=1e-12)


def test_inconsistent_states_are_refused() -> None:
    with pytest.raises(SimulationError, match=r"constraints: pass q0, qd0 = jaxmodsim.project_initial_state"):
        simulate(PENDULUM, [1.5, -1.0], [0.0, 0.0], 1.0)
    with pytest.raises(SimulationError, match=r"does not obey the constraints.* velocity residual of 'rod' is"):
        simulate(PENDULUM, [0.0, -2.0], [0.1, 0.1], 1.0)
    with pytest.raises(SimulationError, match=r"No position near .* \(0,\) held: the residual of the last"):
        project_initial_state(PENDULUM, [2.5, -1.0], [0.0, 0.0], hold=[0])
    with pytest.raises(ValueError, match=r"hold must be indices of coordinates, 0 to 1, .*but \[2\]"):
        project_initial_state(PENDULUM, [2.5, -1.0], [0.0, 0.0], hold=[2])


def test_constraints_that_contradict_each_other_end_the_run() -> None:
    """Two rods of which one grows: at t = 0 they agree."""
    grows = Constraint(lambda t, q, p: jnp.sqrt(jnp.sum(q**2)) - 2.0 - 0.1 * t**3)
    scene = Scene(BOB, constraints=(*PENDULUM.constraints, grows))
    q, qd = hanging(0.3, 0.0)
    run = simulate(scene, q, qd, 3.0, ts=jnp.array([0.0, 3.0]), throw=False)
    assert not bool(run.result.ok)
    assert "constraints are not kept" in run.result.message


# --- Loads that are reactions ---------------------------------------------------------------------------------------


def pushed_down(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return jnp.stack([p["side"], -p["down"]])


def heavy(t: Any, q: Any, qd: Any, p: Any) -> Any:
    return 0.5 * 2.0 * jnp.sum(qd**2) + 0.0 * (t + q[0] + p["down"])


def tilted(q: Any, p: Any) -> Any:
    return q[0] + p["tilt"] * q[1]


def height(t: Any, q: Any, p: Any) -> Any:
    del t, p
    return q[1]


def floor_scene(mu: float, tilt: float, pulls: bool = False) -> Scene:
    """A block of 2 kg on a floor, pushed by 3 N along it and 4 N + tilt times friction's own side force.

    The block's height is a coordinate; a lever of slope `tilt` turns sliding into pressing: the direction of friction
    is x + tilt z, so each newton of friction changes the load by tilt.
    """

    return Scene(
        heavy,
        params={"side": 3.0, "down": 4.0, "tilt": tilt},
        effects=(
            AppliedForce(pushed_down),
            Friction(Regularized(Coulomb(mu), 1e-6), along=tilted, normal_force="floor"),
        ),
        constraints=((Constraint if pulls else Contact)(height, name="floor"),),
    )


@pytest.mark.parametrize(("mu", "tilt"), [(0.3, 0.0), (0.3, 0.5), (0.3, -0.5), (0.9, 1.0)])
def test_friction_and_its_load_are_solved_together(mu: float, tilt: float) -> None:
    """Upright: N = down + tilt F with F = mu N, so N = down/(1 - mu tilt)."""
    scene, state, closed = floor_scene(mu, tilt), State(jnp.zeros(2), jnp.array([1.0, 0.0]), {}), jnp.ones(1)
    normal = 4.0 / (1.0 - mu * tilt)
    dynamics = dynamics_of(ZERO, state, scene, closed)
    np.testing.assert_allclose(dynamics.reactions["floor"].multiplier, [normal], rtol=1e-13)
    np.testing.assert_allclose(dynamics.forces["friction"], mu * normal, rtol=1e-13)
    np.testing.assert_allclose(dynamics.rate.qd, [(3.0 - mu * normal) / 2.0, 0.0], atol=1e-13)
    assert dynamics.uniqueness is not None
    np.testing.assert_allclose(dynamics.uniqueness, min(1.0, 1.0 - mu * tilt), rtol=1e-13)


@pytest.mark.parametrize(("pulls", "tilt", "lost"), [(False, 1.2, True), (False, -1.2, False), (True, -1.2, True)])
def test_loss_of_uniqueness_is_named(pulls: bool, tilt: float, lost: bool) -> None:
    """mu tilt = 1.2: friction raises its own load without bound. A guide that also pulls loses it for either sign."""
    scene = floor_scene(1.0, tilt, pulls)
    run = simulate(scene, [0.0, 0.0], [1.0, 0.0], 0.1, throw=False)
    assert bool(run.result.ok) == (not lost)
    if lost:
        assert "lost its unique solution" in run.result.message
        assert "'floor'" in run.result.message


def test_a_contact_that_would_have_to_pull_opens() -> None:
    """Pressed by 1 N - t: the floor lets go at t = 1, and the force lifts the mass."""
    scene = Scene(
        free,
        effects=(AppliedForce(lambda t, q, qd, p: jnp.stack([0.0 * t, t - 1.0])),),
        constraints=(Contact(lambda t, q, p: q[1], name="floor"),),
    )
    run = simulate(scene, [0.0, 0.0], [1.0, 0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 31))
    (opens,) = run.mode_changes
    assert (opens.effect, opens.before, opens.after) == ("floor", "closed", "open")
    np.testing.assert_allclose(opens.t, 1.0, rtol=1e-6)
    np.testing.assert_allclose(run.q[:, 0], run.t, rtol=1e-6)
    np.testing.assert_allclose(run.q[:, 1], jnp.maximum(run.t - 1.0, 0.0) ** 3 / 6.0, atol=1e-6)


def test_a_load_of_a_reaction_sticks_and_slides_exactly() -> None:
    """A block pressed by 4 N and pulled by 0.5 N/s sticks until 0.4 * 4 N, then slides against 0.3 * 4 N."""

    def push(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del q, qd, p
        return jnp.stack([0.5 * t, -4.0 + 0.0 * t])

    scene = Scene(
        free,
        effects=(AppliedForce(push), Friction(Coulomb(0.3, 0.4), along=lambda q: q[0], normal_force="floor")),
        constraints=(Constraint(lambda t, q, p: q[1], name="floor"),),
    )
    run = simulate(scene, [0.0, 0.0], [0.0, 0.0], 5.0, ts=jnp.array([2.0, 5.0]), rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(run.events.t[0], 3.2, rtol=1e-9)
    np.testing.assert_allclose(run.forces["friction"], [1.0, 1.2], rtol=1e-9)
    since = 5.0 - 3.2
    np.testing.assert_allclose(run.qd[1, 0], 0.25 * since**2 + (1.6 - 1.2) * since, rtol=1e-8)


def test_stick_within_a_constraint_takes_few_steps_in_single_precision() -> None:
    """Two shafts with a gear, held against 4 sin(5 t): stick that drifts would be resolved in steps of 1e-5 s."""

    def push(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del q, qd, p
        return jnp.stack([4.0 * jnp.sin(5.0 * t), 0.0 * t])

    def mesh(t: Any, q: Any, p: Any) -> Any:
        del t, p
        return q[1] - q[0] / 1.7

    real = jnp.float32
    friction = Friction(Coulomb(real(10.0)), along=lambda q: q[0])
    scene = Scene(free, effects=(AppliedForce(push), friction), constraints=(Constraint(mesh),))
    run = simulate(scene, jnp.zeros(2, real), jnp.zeros(2, real), real(2.0))
    assert run.q.dtype == real
    assert float(jnp.max(jnp.abs(run.q))) < 1e-9
    assert int(run.stats["num_steps"]) < 150


def test_a_row_that_others_hold_takes_few_steps_in_single_precision() -> None:
    """Its load passes zero at 1 s, from where its slip at the limit is rounding, and has its limit back at once."""

    def push(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del q, qd, p
        return jnp.stack([0.6 * jnp.sin(2.0 * t), 1.0 - t])

    real = jnp.float32
    friction = (
        Friction(Coulomb(real(0.5)), along=lambda q: q[0], normal_force="guide"),
        Friction(Coulomb(real(0.7)), along=lambda q: q[0], name="other"),
    )
    guide = Constraint(lambda t, q, p: q[1], name="guide")
    scene = Scene(free, effects=(AppliedForce(push), *friction), constraints=(guide,))
    run = simulate(scene, jnp.zeros(2, real), jnp.zeros(2, real), real(3.0))
    assert float(jnp.max(jnp.abs(run.q))) < 1e-8
    assert int(run.stats["num_steps"]) < 200


def all_loads(normal: Any, push: Any, pull: Any) -> list[Any]:
    """Every solution of n + G n = normal with columns of `push` for n > 0, and of `pull`, by trying all signs."""
    found = []
    for signs in itertools.product((True, False), repeat=len(normal)):
        n = np.linalg.solve(np.eye(len(normal)) + np.where(signs, push, pull), normal)
        if np.all((n > 0) == np.array(signs)):
            found.append(n)
    return found


@pytest.mark.parametrize("k", [1, 2, 3])
def test_loads_that_depend_on_each_other(k: int) -> None:
    """Against all sign patterns: where the margin is positive there is one solution, and it is found."""
    rng = np.random.default_rng(k)
    solve = jax.jit(solve_loads)
    counts = {True: 0, False: 0}
    for _ in range(200):
        gain, normal = rng.normal(scale=0.6, size=(k, k)), rng.normal(size=k)
        columns = jnp.asarray(gain), jnp.asarray(gain * rng.choice([0.0, -1.0, -0.5], size=k))
        n, pushes, margin = solve(jnp.asarray(normal), *columns, jnp.zeros(k))
        solutions = all_loads(normal, *columns)
        counts[bool(margin > 0)] += 1
        if margin > 0:
            assert len(solutions) == 1
            np.testing.assert_allclose(n, solutions[0], atol=1e-10)
            np.testing.assert_array_equal(pushes, n > 0)
            given = jnp.sign(n) * rng.choice([0.0, 1.0], size=k)
            np.testing.assert_allclose(solve(normal, *columns, given)[0], n, atol=1e-10)
            one = rng.integers(k)  # beyond its zero a load goes on
            beyond, sides, _ = solve(normal, *columns, jnp.zeros(k).at[one].set(-jnp.sign(n[one])))
            assert bool(sides[one]) != bool(pushes[one])
            np.testing.assert_allclose(beyond + np.where(sides, *columns) @ beyond, normal, atol=1e-10)
    assert min(counts.values()) > 10


def test_a_step_ends_where_the_load_of_a_guide_changes_its_sign() -> None:
    """Y'' = A cos(w t) across the guide: v' = -mu A |cos(w t)| along it, and its double integral by pieces."""

    def track(t: Any, q: Any, p: Any) -> Any:
        return q[1] + p["A"] / p["w"] ** 2 * jnp.cos(p["w"] * t)

    def place(x: Any) -> Any:
        guide = Constraint(track, name="guide")
        friction = Friction(Coulomb(x["mu"]), along=lambda q: q[0], normal_force="guide")
        scene = Scene(free, {"A": x["A"], "w": x["w"]}, (friction,), (guide,))
        start = jnp.stack([0.0 * x["A"], -x["A"] / x["w"] ** 2])
        run = simulate(scene, start, [5.0, 0.0], 3.0, throw=False)
        return run.q[-1, 0], run.stats

    def exact(x: Any) -> Any:
        w = x["w"]
        ends = jnp.stack([0.0 * w, *((0.5 + j) * jnp.pi / w for j in range(6)), 3.0 + 0.0 * w])

        def part(s: Any) -> Any:
            return (3.0 - s) * jnp.sin(w * s) / w - jnp.cos(w * s) / w**2

        return 15.0 - x["mu"] * x["A"] * jnp.sum((-1.0) ** jnp.arange(7) * jnp.diff(part(ends)))

    at = {"mu": 0.2, "A": 4.0, "w": 6.0}
    ours, stats = jax.jit(place)(at)
    slopes = jax.jit(jax.grad(lambda x: place(x)[0]))(at)
    assert abs(ours - exact(at)) < 1e-6
    assert int(stats["num_events"]) == 0
    for name, slope in jax.grad(exact)(at).items():
        assert abs(slopes[name] - slope) * at[name] < 1e-6, name


# --- What is refused ------------------------------------------------------------------------------------------------

ON = Constraint(lambda t, q, p: q[1], name="floor")
TWO = Constraint(lambda t, q, p: q, name="floor")


@pytest.mark.parametrize(
    ("build", "text"),
    [
        (lambda: Scene(free, constraints=ON), r"constraints must be a tuple, as in constraints=\(constraint,\)"),
        (
            lambda: Scene(free, constraints=(Coulomb(1.0),)),
            "VelocityConstraint or Contact objects",
        ),
        (lambda: Scene(free, constraints=(ON, ON)), "Two constraints have the name 'floor'"),
        (
            lambda: Scene(free, effects=(Friction(Coulomb(1.0), name="floor"),), constraints=(ON,)),
            "An effect and a constraint both have the name 'floor'",
        ),
        (
            lambda: Scene(free, effects=(Friction(Coulomb(1.0), normal_force="wall"),), constraints=(ON,)),
            "normal_force='wall' names no constraint of the scene; there are: 'floor'",
        ),
        (
            lambda: Scene(
                free, effects=(Friction(DeadZone(Coulomb(1.0), 0.1), normal_force="floor"),), constraints=(ON,)
            ),
            "under the load of a constraint DeadZone cannot run",
        ),
        (
            lambda: Scene(
                free,
                effects=(Friction(Coulomb(1.0), along=lambda q: q[0], normal_force="floor"),),
                constraints=(TWO,),
            ),
            "loads friction .* so it must be one equation, but it has 2",
        ),
        (lambda: Constraint(3.0), "phi must be a function, but 3.0"),
        (lambda: Constraint(circle, stabilise=-1.0), "stabilise must be finite and >= 0"),
        (lambda: Scene(free, constraints=(Constraint(lambda t, q, p: jnp.eye(2)),)), r"it returned shape \(2, 2\)"),
    ],
)
def test_wrong_constraints_are_refused(build: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        simulate(build(), [0.0, 0.0], [0.0, 0.0], 1.0)


def test_entries_by_lists_of_indices_have_derivatives_without_a_scatter() -> None:
    """No kernel holds a scatter: runs with such constraints were several times slower."""
    some, q = np.array([0, 2]), jnp.array([0.3, 0.5, 0.2])
    position = Constraint(lambda t, q, p: q[some] ** 2 * q[1])
    velocity = VelocityConstraint(lambda t, q, qd, p: q[some] * qd[some])
    found = [
        jax.make_jaxpr(jax.jacrev(lambda q: position.error(ZERO, q, None)))(q),
        jax.make_jaxpr(jax.jacrev(lambda qd: velocity.rate(ZERO, q, qd, None)))(2.0 * q),
    ]
    assert not any(name in str(jaxpr) for jaxpr in found for name in ("scatter", "gather"))
    rows = jax.jit(jax.jacrev(lambda q: position.error(ZERO, q, None)))(q)
    np.testing.assert_allclose(rows, [[0.3, 0.09, 0.0], [0.0, 0.04, 0.2]], rtol=1e-14)
