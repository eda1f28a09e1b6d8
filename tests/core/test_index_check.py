"""Indices out of range, which JAX moves into the range in silence: refused by name wherever a user gives a function."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import (
    AppliedForce,
    Chart,
    Constraint,
    Friction,
    Record,
    Scene,
    VelocityConstraint,
    Viscous,
    fit,
    point_mass,
    rigid_body,
    scaled_by,
    simulate,
    simulate_to_accuracy,
    sweep,
)
from jaxmodsim._core.compat import AVAILABLE
from jaxmodsim._core.trace_checks import traced
from jaxmodsim.problems import named_problems
from jaxmodsim.scene import State, check_scene

pytestmark = pytest.mark.skipif("jaxprs" not in AVAILABLE, reason="needs the programs that JAX traces")


def free(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, p
    return 0.5 * jnp.sum(qd**2)


Q = jnp.arange(2.0)
FOUR = jnp.arange(4.0)
KNOWN = jnp.array([0, 1, 5])


@jax.custom_vjp
def third(q: Any) -> Any:
    return q[2]


third.defvjp(lambda q: (q[2], None), lambda _, c: (c * jnp.ones(2),))

# What a function does to q of two entries, and the index that is out of range.
BEYOND: dict[str, tuple[Callable[[Any], Any], str]] = {
    "number": (lambda q: q[2], r"q\[2\]"),
    "negative": (lambda q: q[-3], r"q\[-3\]"),
    "number of NumPy": (lambda q: q[np.int64(7)], r"q\[7\]"),
    "array": (lambda q: q[jnp.array([0, 2])], r"q\[2\]"),
    "array of NumPy": (lambda q: q[np.array([0, -3])], r"q\[-3\]"),
    "array from outside": (lambda q: q[KNOWN], r"q\[5\]"),
    "computed": (lambda q: q[jnp.arange(2) + 1], r"q\[2\]"),
    "stacked": (lambda q: q[jnp.stack([0, 3])], r"q\[3\]"),
    "chosen": (lambda q: q[jnp.where(jnp.array([True, False]), 1, 9)], r"q\[9\]"),
    "at get": (lambda q: q.at[3].get(), r"q\[3\]"),
    "take": (lambda q: jnp.take(q, 3), r"q\[3\]"),
    "dynamic slice": (lambda q: jax.lax.dynamic_slice(q, (1,), (2,)), r"q\[2\]"),
    "written": (lambda q: q.at[2].set(1.0), r"q\[2\]"),
    "added to": (
        lambda q: jnp.zeros_like(q).at[-3].add(q[0]),
        r"the index -3 is out of range along axis 0 of an array",
    ),
    "matrix": (lambda q: jnp.outer(q, q)[:, 2], r"index 2 is out of range along axis 1 of an array of shape \(2, 2\)"),
    "row": (lambda q: jnp.outer(q, q)[jnp.array([0, 1]), 2], r"index 2 .* axis 1"),
    "vmap over indices": (lambda q: jax.vmap(lambda i: q[i])(jnp.arange(3)), r"q\[2\]"),
    "vmap over rows": (lambda q: jax.vmap(lambda r: r[2])(jnp.outer(q, q)), "index 2 .* axis 1"),
    "vmap of writing": (lambda q: jax.vmap(lambda r: r.at[2].set(0.0))(jnp.outer(q, q)), "index 2 .* axis 1"),
    "loop": (lambda q: jax.lax.fori_loop(0, 3, lambda i, a: a + i * q[4], 0.0), r"q\[4\]"),
    "condition": (lambda q: jax.lax.cond(q[0] > 0, lambda q: q[0], lambda q: q[2], q), r"q\[2\]"),
    "jit": (lambda q: jax.jit(lambda x: x[4])(q), r"q\[4\]"),
    "checkpoint": (lambda q: jax.checkpoint(lambda x: x[4])(q), r"q\[4\]"),
    "own derivative": (third, r"q\[2\]"),
    "derivative": (jax.grad(lambda q: q[2] ** 2), r"q\[2\]"),
}

WITHIN: dict[str, Callable[[Any], Any]] = {
    "number": lambda q: q[1],
    "negative": lambda q: q[-2],
    "slice": lambda q: q[1:5],
    "slice in front": lambda q: q[-9:1],
    "array": lambda q: q[jnp.array([0, -2])],
    "mask": lambda q: q[np.array([True, False])],
    "around": lambda q: q[(jnp.arange(4) + 1) % 2],
    "limited": lambda q: q[jnp.clip(jnp.array([5]), 0, 1)],
    "clip": lambda q: q.at[jnp.array([3])].get(mode="clip") + jnp.take(q, 3, mode="clip"),
    "fill": lambda q: q.at[3].get(mode="fill", fill_value=0.0),
    "padding of a sum": lambda q: q.at[jnp.array([0, 2, 2])].add(1.0, mode="drop"),
    "loop": lambda q: jax.lax.fori_loop(0, 2, lambda i, a: a + q[i], 0.0),
    "known condition": lambda q: jax.lax.cond(False, lambda q: q[5], lambda q: q[0], q),
    "vmap": lambda q: jax.vmap(lambda r: r[1])(jnp.outer(q, q)),
    "library": lambda q: (
        jnp.interp(q[0], jnp.arange(3.0), jnp.ones(3)) + jnp.linalg.det(jnp.outer(q, q)) + jnp.roll(q, 1)
    ),
    "keys": lambda q: q + jax.random.normal(jax.random.key(0), (2,)),
}


@pytest.mark.quick
@pytest.mark.parametrize("name", BEYOND)
def test_an_index_out_of_range_is_seen(name: str) -> None:
    fn, text = BEYOND[name]
    with pytest.raises(ValueError, match=rf"In the function, .*{text}"):
        traced(fn, name="the function", q=Q)


@pytest.mark.quick
@pytest.mark.parametrize("name", WITHIN)
def test_what_is_legal_is_left_alone(name: str) -> None:
    shape = jax.eval_shape(WITHIN[name], Q)
    assert traced(WITHIN[name], name="the function", q=Q) == shape


def test_what_is_not_seen_is_what_the_documentation_says() -> None:
    """Indices that are computed from the arguments, and those that count a loop."""
    for fn in (
        lambda q: q[q[0].astype(int) + 5],
        lambda q: jax.lax.fori_loop(0, 3, lambda i, a: a + q[i], 0.0),
    ):
        assert traced(fn, name="the function", q=Q).shape == ()


def scene_of(**friction: Any) -> Scene:
    return Scene(free, effects=(Friction(**({"law": Viscous(1.0), "along": lambda q: q[0]} | friction), name="brake"),))


def force(**k: Any) -> Scene:
    return Scene(free, effects=(AppliedForce(**({"fn": lambda t, q, qd, p: 0.0 * q} | k), name="pull"),))


def held(constraint: Any) -> Scene:
    return Scene(free, constraints=(constraint,))


# Scenes of two coordinates.
FUNCTIONS: dict[str, tuple[Callable[[], Scene], str]] = {
    "Lagrangian": (lambda: Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2 + qd[2] ** 2), r"the Lagrangian, qd\[2\]"),
    "sum of bodies": (
        lambda: Scene(point_mass(1.0, lambda q: jnp.stack([q[0], q[1], q[2]])) + free),
        r"the Lagrangian, qd?\[2\] is out of range: there are 2 coordinates, so the last is qd?\[1\]",
    ),
    "params": (
        lambda: Scene(lambda t, q, qd, p: p["m"][2] * free(t, q, qd, p), params={"m": jnp.ones(2)}),
        r"the Lagrangian, the index 2 is out of range along axis 0 of params\['m'\] of shape \(2,\)",
    ),
    "along": (lambda: scene_of(along=lambda q: q[2]), r"along of Friction 'brake', q\[2\]"),
    "along with params": (lambda: scene_of(along=lambda q, p: q[-3]), r"along of Friction 'brake', q\[-3\]"),
    "normal force": (
        lambda: scene_of(normal_force=lambda t, q, qd, p: qd[3] ** 2),
        r"normal_force\(t, q, qd, params\) of Friction 'brake', qd\[3\]",
    ),
    "scaled by": (
        lambda: scene_of(law=scaled_by(Viscous(1.0), lambda t, q, qd, p: q[2])),
        r"scaled_by's fn\(t, q, qd, params\) of Friction 'brake', q\[2\]",
    ),
    "belt": (
        lambda: scene_of(belt_velocity=lambda t: jnp.ones(2)[2] * t),
        r"belt_velocity\(t\) of Friction 'brake', the index 2",
    ),
    "force": (lambda: force(fn=lambda t, q, qd, p: q[jnp.array([1, 2])]), r"fn of AppliedForce 'pull', q\[2\]"),
    "force written": (
        lambda: force(fn=lambda t, q, qd, p: jnp.zeros(2).at[2].set(t)),
        r"fn of AppliedForce 'pull', the index 2 is out of range along axis 0 of an array of shape \(2,\)",
    ),
    "at": (
        lambda: force(fn=lambda t, q, qd, p: jnp.ones(2), at=lambda q: jnp.stack([q[0], q[2]])),
        r"at of AppliedForce 'pull', q\[2\]",
    ),
    "constraint": (
        lambda: held(Constraint(lambda t, q, p: q[0] - q[2], name="rod")),
        r"phi of Constraint 'rod', q\[2\]",
    ),
    "at of a constraint": (
        lambda: held(Constraint(lambda t, x, p: x[0], at=lambda q: q[1:2] + q[2], name="rod")),
        r"at of Constraint 'rod', q\[2\]",
    ),
    "point of a constraint": (
        lambda: held(Constraint(lambda t, x, p: x[2], at=lambda q: q, name="rod")),
        r"phi of Constraint 'rod', the index 2 is out of range along axis 0 of x of shape \(2,\)",
    ),
    "velocity constraint": (
        lambda: held(VelocityConstraint(lambda t, q, qd, p: qd[2], name="blade")),
        r"psi of VelocityConstraint 'blade', qd\[2\]",
    ),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_each_function_of_a_scene_is_named(name: str) -> None:
    build, text = FUNCTIONS[name]
    with pytest.raises(ValueError, match=f"In {text}"):
        simulate(build(), [0.0, 0.1], [0.0, 0.0], 1.0)


@pytest.mark.parametrize("way", [jax.jit, jax.vmap, jax.grad])
def test_seen_inside_transformations(way: Any) -> None:
    """One coordinate, where a second one would be the first again."""
    scene = Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2 - qd[1] * q[0])

    def end(v: Any) -> Any:
        return simulate(scene, [0.0], jnp.reshape(v, (1,)), 1.0).q[0, 0]

    with pytest.raises(ValueError, match=r"In the Lagrangian, qd\[1\] is out of range: there is 1 coordinate, so"):
        way(end)(jnp.ones(3) if way is jax.vmap else 1.0)


@pytest.mark.parametrize("name", sorted(named_problems()))
def test_no_named_problem_is_refused(name: str) -> None:
    case = named_problems()[name]()
    q, qd = jnp.asarray(case.q0), jnp.asarray(case.qd0)
    check_scene(case.scene, State(q, qd, case.scene.initial_state(q)))


def test_positions_that_are_called_by_hand() -> None:
    bead = point_mass(1.0, lambda q: jnp.stack([q[0], q[1], 0.0 * q[0]]))
    one = jnp.ones(1)
    for call in (bead, bead.reaction, bead.normal_force):
        with pytest.raises(ValueError, match="In point_mass position, the index 1 is out of range"):
            call(jnp.zeros(()), one, one, None)
    body = rigid_body(1.0, 1.0, lambda q: jnp.ones(3) * q[0], lambda q: q[1])
    with pytest.raises(ValueError, match="In rigid_body orientation, the index 1 is out of range"):
        body(jnp.zeros(()), one, one, None)
    with pytest.raises(ValueError, match="In Chart position, the index 3 is out of range"):
        Chart(lambda q: jnp.stack([q[0], q[1], q[3]]))


SPRING = Scene(lambda t, q, qd, p: 0.5 * jnp.sum(qd**2) - 0.5 * p["k"] * jnp.sum(q**2), params={"k": 4.0})


def test_observables() -> None:
    start: Any = ([1.0, 0.0], [0.0, 0.0], 1.0)
    text = r"the index 5 is out of range along axis 1 of an array of shape \(\d+, 2\)"
    with pytest.raises(ValueError, match=f"In observable, {text}"):
        simulate_to_accuracy(SPRING, *start, accuracy=1e-3, observable=lambda run: run.q[:, 5])
    with pytest.raises(ValueError, match=rf"In observe\['x'\], {text}"):
        sweep(SPRING, {"k": [1.0, 2.0]}, {"x": lambda run: run.q[-1, 5]}, q0=start[0], qd0=start[1], t1=1.0)
    t = np.linspace(0.0, 1.0, 11)
    record = Record(t, np.cos(2.0 * t))
    with pytest.raises(ValueError, match=r"In observe\(q, qd\), q\[2\] is out of range"):
        fit(SPRING, record, ["k"], observe=lambda q, qd: q[2], q0=[1.0, 0.0], qd0=[0.0, 0.0])


def test_an_observable_may_compute_with_numpy() -> None:
    """What cannot be traced is not looked at."""
    run = simulate_to_accuracy(SPRING, [1.0], [0.0], 1.0, accuracy=1e-3, observable=lambda run: np.asarray(run.q)[:, 0])
    assert run.accuracy is not None
    run = simulate_to_accuracy(
        SPRING, [1.0], [0.0], 1.0, accuracy=1e-3, observable=lambda run: jnp.asarray(float(run.q[-1, 0]))
    )
    assert run.accuracy is not None


def test_a_run_is_as_it_was() -> None:
    """The look at the functions leaves no trace in the run, with derivatives by `diffrax.ForwardMode`, too."""
    slope = jax.jacfwd(lambda k: simulate(
        Scene(SPRING.lagrangian, params={"k": k}), [1.0], [0.0], 1.0, rtol=1e-9, atol=1e-11, adjoint=dfx.ForwardMode()
    ).q[-1, 0])(4.0)  # fmt: skip
    np.testing.assert_allclose(slope, -0.5 * np.sin(2.0) / 2.0, rtol=1e-6)
