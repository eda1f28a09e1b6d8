"""Scenes: names, leaves, refusals, and that the traced field holds only what the scene does."""

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import (
    AppliedForce,
    Contact,
    Coulomb,
    DeadZone,
    Friction,
    LuGre,
    Regularized,
    Scene,
    Sign,
    SimulationError,
    Stribeck,
    Viscous,
    problems,
    simulate,
)
from jaxmodsim._core.compat import ClosedJaxpr
from jaxmodsim._core.scalarise import in_scalars
from jaxmodsim.scene import AbstractEffect, State, quantity_of, scene_ranges, vector_field
from jaxmodsim.simulation import named_series


def free(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, p
    return 0.5 * jnp.sum(qd**2)


def push(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del qd, p
    return jnp.sin(t) * q


def pull(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del q, p
    return jnp.ones(3) * t * qd[0]


LUGRE = {"sigma0": 750.0, "sigma1": 1.0, "sigma2": 0.1, "Fc": 1.5, "Fs": 1.75, "vs": 0.2}


@pytest.mark.quick
def test_names_are_given_or_counted() -> None:
    scene = Scene(
        free,
        effects=(
            AppliedForce(push),
            Friction(Viscous(1.0)),
            AppliedForce(push, name="applied_2"),
            Friction(Viscous(1.0), name="guide"),
            AppliedForce(push),
            Friction(LuGre(**LUGRE)),
        ),
    )
    assert scene.names == ("applied", "friction", "applied_2", "guide", "applied_3", "friction_2")
    assert set(scene.initial_state(jnp.zeros(1))) == {"friction_2"}


def test_a_default_name_gives_way_to_a_given_one() -> None:
    scene = Scene(free, effects=(Friction(Viscous(1.0)), Friction(Viscous(1.0), name="friction")))
    assert scene.names == ("friction_2", "friction")


def test_every_number_is_a_leaf() -> None:
    """And nothing else is: two scenes that differ in numbers alone have one structure, hence one compilation."""

    def scene(x: float) -> Scene:
        return Scene(
            free,
            params={"m": x, "table": np.arange(3.0) + x, "count": 3},
            effects=(
                AppliedForce(problems.spiral_bead.SphericalSpiral(R=1.0 + x, a=0.2)),
                Friction(regularized(x), belt_velocity=0.1 * x, normal_force=3 + x),
                Friction(LuGre(**LUGRE)),
                Friction(DeadZone(Coulomb(1.5), width=x), belt_velocity=jnp.sin),
            ),
        )

    leaves, structure = jax.tree.flatten(scene(1.0))
    assert all(isinstance(leaf, jax.Array) and leaf.dtype == jnp.float64 for leaf in leaves)
    # params 3, spiral 2, regularized Stribeck 5 with belt and load 7, LuGre 6 with belt 7, dead zone 2.
    assert len(leaves) == 3 + 2 + 7 + 7 + 2
    other, same = jax.tree.flatten(scene(2.0))
    assert structure == same
    assert hash(structure) == hash(same)
    assert sum(bool((a != b).any()) for a, b in zip(leaves, other, strict=True)) == 7


def regularized(x: float) -> Regularized:
    return Regularized(Stribeck(Fc=1.0, Fs=1.0 + x, vs=0.1), width=1e-3)


def test_coordinates_have_names_and_units() -> None:
    """From them follow those of velocities and forces; and of the numbers of friction about an axis."""
    cart = problems.cart_pole.scene(Viscous(1.0))
    assert [quantity_of(cart, x).label for x in ("q[0]", "qd[1]")] == ["x [m]", "angle_dot [rad/s]"]
    assert quantity_of(cart, "nothing[2]") == ("nothing[2]", "")
    law = Friction(Viscous(1.0))
    axis = Scene(free, effects=(AppliedForce(push), law), coordinates=("phi[rad]",))
    assert axis.coordinates == ("phi [rad]",)
    assert [quantity_of(axis, x).unit for x in ("applied[0]", "friction")] == ["N m", "N m"]
    assert scene_ranges(axis)["friction.Fv"].unit == "N m s/rad"
    assert scene_ranges(Scene(free, effects=(law,), coordinates=("x [m]",)))["friction.Fv"].unit == "N s/m"
    assert quantity_of(Scene(free, effects=(law,)), "friction") == ("friction", "N or N m")
    assert quantity_of(Scene(free, coordinates=("s [mm]", "z")), "q[1]").label == "z"
    # Of a run that fails, the state has their names, too.
    with pytest.raises(SimulationError, match=r"(?s)coordinate q\[1\] \(b\):.*with a = 0 m, b = 0 m, a_dot = 0 m/s"):
        run(Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, coordinates=("a [m]", "b [m]")), 2)
    with pytest.raises(ValueError, match=r"there are: q\[0\] \(phi\), qd\[0\] \(phi_dot\), applied\[0\], friction;"):
        named_series(run(axis), "phi")


@pytest.mark.parametrize("name", sorted(problems.named_problems()))
def test_named_problems_name_their_coordinates(name: str) -> None:
    case = problems.named_problems()[name]()
    assert len(case.scene.coordinates) == len(case.q0)
    assert all(x.endswith(("[m]", "[rad]")) for x in case.scene.coordinates)


def test_numbers_can_be_replaced() -> None:
    scene = problems.ramped_box.scene(problems.ramped_box.lugre())
    changed = eqx.tree_at(lambda s: s.effects[1].law.sigma0, scene, jnp.array(10.0))
    assert {10.0} == {float(x) for x in jax.tree.leaves(changed)} - {float(x) for x in jax.tree.leaves(scene)}
    assert 750.0 not in jax.tree.leaves(changed)


def run(scene: Any, dof: int = 1) -> Any:
    return simulate(scene, [0.0] * dof, [0.0] * dof, 1.0)


one_friction: Callable[..., Any] = lambda **k: Scene(free, effects=(Friction(Viscous(1.0), **k),))  # noqa: E731

REFUSALS: dict[str, tuple[Callable[[], Any], str]] = {
    "string in params": (lambda: Scene(free, params={"m": "2"}), r"params\['m'\] must be a real number.*'2' was given"),
    "flag in params": (lambda: Scene(free, params={"a": {"on": True}}), r"params\['a'\]\['on'\] must be a real number"),
    "complex in params": (lambda: Scene(free, params=[1.0, 2j]), r"params\[1\] must be a real number"),
    "no Lagrangian": (lambda: Scene(cast_any(3.0)), r"lagrangian must be a function, but 3.0 was given"),
    "effect not in a tuple": (
        lambda: Scene(free, effects=cast_any(Friction(Viscous(1.0)))),
        r"effects must be a tuple of effects, as in effects=\(effect,\)",
    ),
    "law without Friction": (
        lambda: Scene(free, effects=cast_any((Viscous(1.0),))),
        r"effects must hold AppliedForce, Friction or Switch objects.*goes into Friction\(law\)",
    ),
    "contact among effects": (
        lambda: Scene(free, effects=cast_any((Contact(lambda t, q, p: q[0]),))),
        r"(?s)effects must hold AppliedForce, Friction or Switch objects.*It goes into constraints=\(\.\.\.\)\.",
    ),
    "same name": (
        lambda: Scene(free, effects=(AppliedForce(push, name="x"), Friction(Viscous(1.0), name="x"))),
        "Two effects have the name 'x'",
    ),
    "exact beside dead zone": (
        lambda: Scene(free, effects=(Friction(Coulomb(1.0)), Friction(DeadZone(Coulomb(1.0), 0.1)))),
        r"friction: set-valued laws of one scene run either all by events or all by DeadZone",
    ),
    "unknown law": (
        lambda: Friction(cast_any("lugre")),
        r"needs a law or a function of slip velocity, but 'lugre' was given. Known laws:.*LuGre",
    ),
    "class as law": (lambda: Friction(cast_any(LuGre)), "but the class LuGre was given"),
    "belt of text": (lambda: Friction(Viscous(1.0), belt_velocity=cast_any("fast")), "belt_velocity must be a real"),
    "belt of two": (lambda: Friction(Viscous(1.0), belt_velocity=jnp.ones(2)), r"belt_velocity has shape \(2,\)"),
    "load of nothing": (
        lambda: one_friction(normal_force="floor"),
        "normal_force='floor' names no constraint of the scene; there are: none",
    ),
    "along is no function": (lambda: Friction(Viscous(1.0), along=cast_any(0)), "along must be a function, but 0"),
    "coordinates in one text": (lambda: Scene(free, coordinates=cast_any("x [m]")), "must hold a name for each coord"),
    "coordinate without a name": (
        lambda: Scene(free, coordinates=("[m]",)),
        r"coordinates must hold a name for each.*'\[m\]'",
    ),
    "coordinates of one name": (
        lambda: Scene(free, coordinates=("x [m]", "x [rad]")),
        "Two coordinates have the name 'x'; names of coordinates must differ",
    ),
    "coordinate of an effect's name": (
        lambda: Scene(free, effects=(Friction(Viscous(1.0)),), coordinates=("friction [m]",)),
        "A coordinate needs a name of its own: 'friction' is also that of an effect",
    ),
    "coordinates of the names of an effect and of the time": (
        lambda: Scene(free, effects=(Friction(Viscous(1.0)),), coordinates=("friction [m]", "t [m]")),
        "'friction' is also that of an effect, 't' is also that of the time",
    ),
    "force is no function": (lambda: AppliedForce(cast_any(2.0)), r"AppliedForce fn must be a function, but 2.0"),
    "at is no function": (lambda: AppliedForce(push, at=cast_any(1)), r"AppliedForce at must be a function, but 1"),
    # The following are found when the run is traced.
    "vector Lagrangian": (
        lambda: run(Scene(lambda t, q, qd, p: 0.5 * qd**2)),
        r"Lagrangian must return one number.*returned.*index the coordinates",
    ),
    "force of a wrong shape": (
        lambda: run(Scene(free, effects=(AppliedForce(lambda t, q, qd, p: t, name="pull"),))),
        r"AppliedForce 'pull': fn returned the shape \(\), but \(1,\) is needed.*the coordinates",
    ),
    "Cartesian force of a wrong shape": (
        lambda: run(Scene(free, effects=(AppliedForce(push, at=lambda q: jnp.ones(3) * q[0]),))),
        r"fn returned the shape \(1,\), but \(3,\) is needed.*what `at` returns",
    ),
    "friction on two coordinates": (lambda: run(one_friction(), 2), "2 coordinates: say along which displacement"),
    "names of two coordinates for one": (
        lambda: run(Scene(free, coordinates=("x [m]", "y [m]"))),
        r"The scene has 2 names of coordinates \(x \[m\], y \[m\]\), but q has the length 1: pass a q0 of 2 numbers",
    ),
    "vector displacement": (lambda: run(one_friction(along=lambda q: q)), r"along\(q\) returned the shape \(1,\)"),
    "vector belt": (
        lambda: run(one_friction(belt_velocity=lambda t: jnp.ones(3) * t)),
        r"belt_velocity\(t\) returned the shape \(3,\)",
    ),
    "vector load": (
        lambda: run(one_friction(normal_force=lambda t, q, qd, p: q)),
        r"normal_force\(t, q, qd, params\) returned the shape \(1,\)",
    ),
}


def cast_any(x: Any) -> Any:
    return x


@pytest.mark.quick
@pytest.mark.parametrize("name", REFUSALS)
def test_wrong_structure_is_refused(name: str) -> None:
    build, text = REFUSALS[name]
    with pytest.raises(ValueError, match=text):
        build()


# Primitives in a traced function, with those inside of called functions and without the calls themselves.


def primitives(fn: Callable[..., Any], *args: Any) -> Counter[str]:
    return _count(jax.make_jaxpr(fn)(*args).jaxpr)


def _count(jaxpr: Any) -> Counter[str]:
    total: Counter[str] = Counter()
    for equation in jaxpr.eqns:
        inner = [x.jaxpr for x in equation.params.values() if isinstance(x, ClosedJaxpr)]
        if inner:
            total += sum((_count(x) for x in inner), Counter())
        else:
            total[equation.primitive.name] += 1
    return total


def state(scene: Scene, dof: int) -> State:
    return State(jnp.linspace(0.5, 0.9, dof), jnp.linspace(1.0, -1.0, dof), scene.initial_state(jnp.zeros(dof)))


def euler_lagrange(lagrangian: Any, t: Any, q: Any, qd: Any, p: Any) -> Any:
    """The equations as one writes them by hand: d/dt dL/dqd = dL/dq, for one and for two coordinates."""

    def equations(t: Any, q: Any, qd: Any, p: Any) -> Any:
        def momentum(t: Any, q: Any, qd: Any) -> Any:
            by_q, by_qd = jax.grad(lagrangian, argnums=(1, 2))(t, q, qd, p)
            return by_qd, by_q

        _, push, by_q = jax.linearize(momentum, t, q, qd, has_aux=True)
        still, rest = jnp.zeros_like(t), jnp.zeros_like(q)
        if q.shape == (1,):
            m = push(still, rest, jnp.ones_like(qd))[None]
        else:
            m = jax.vmap(lambda e: push(still, rest, e), out_axes=1)(jnp.eye(2))
        return m, by_q - push(jnp.ones_like(t), qd, rest)

    m, load = equations(t, q, qd, p)
    if q.shape == (1,):
        return qd, load / m[0]
    m00, m10, m11, r0, r1 = m[0, 0], m[1, 0], m[1, 1], load[0], load[1]
    m00 = jnp.where(m00 > 0, m00, jnp.nan)
    ratio = m10 / m00
    pivot = m11 - ratio * m10
    x1 = (r1 - ratio * r0) / jnp.where(pivot > 0, pivot, jnp.nan)
    return qd, jnp.stack([(r0 - m10 * x1) / m00, x1])


MECHANISMS = {
    "box": (problems.ramped_box.scene(), 1),
    "spring": (problems.braked_spring.scene(), 1),
    "bead": (problems.spiral_bead.scene(), 1),
    "pendulum": (problems.spherical_pendulum.scene(), 2),
}


@pytest.mark.parametrize("name", MECHANISMS)
def test_a_scene_without_effects_traces_to_the_equations_by_hand(name: str) -> None:
    scene, dof = MECHANISMS[name]
    scene = eqx.tree_at(lambda s: s.effects, scene, ())
    t, y = jnp.array(0.3), state(scene, dof)
    ours = primitives(lambda t, y, s: vector_field(t, y, s), t, y, scene)
    by_hand = primitives(
        lambda t, q, qd, p, fn: in_scalars(partial(euler_lagrange, fn), t, q, qd, p, seed=q),
        t,
        y.q,
        y.qd,
        scene.params,
        scene.lagrangian,
    )
    assert ours == by_hand


# What differentiating and stacking bring along; none of them computes anything the equations do not hold.
BOOKKEEPING = {
    *("broadcast_in_dim", "convert_element_type", "squeeze", "slice", "dynamic_slice", "pad", "concatenate"),
    "unstack",
    *("reshape", "transpose", "select_n", "lt", "ge", "iota", "eq", "add_any", "copy", "full", "mul", "neg", "sub"),
    *("reduce_sum", "sign", "square", "integer_pow", "gt", "stop_gradient"),
}


def test_frictionless_pendulum_has_only_the_functions_of_its_closed_form() -> None:
    """Sines and cosines of the Lagrangian, the quotients of the elimination; no factorisation, no loop."""
    scene = problems.spherical_pendulum.scene()
    y = state(scene, 2)
    ours = primitives(lambda t, y, s: vector_field(t, y, s), jnp.array(0.3), y, scene)
    closed = primitives(lambda q, qd: problems.spherical_pendulum.acceleration(q, qd), y.q, y.qd)
    assert {"sin", "cos"} <= set(closed)
    assert set(ours) - set(closed) <= BOOKKEEPING
    # The Lagrangian's sine and cosine, which are their own slopes and curvatures: each is formed once.
    assert ours["sin"] + ours["cos"] <= 2


EFFECTS = {
    "force": AppliedForce(push),
    "force at a point": AppliedForce(pull, at=problems.spiral_bead.SphericalSpiral(1.0, 0.2)),
    "viscous": Friction(Viscous(0.3)),
    "viscous under load": Friction(Viscous(0.3), normal_force=2.0, belt_velocity=jnp.sin),
    "regularized": Friction(Regularized(Coulomb(1.0), 1e-3)),
    "sign": Friction(Sign(Coulomb(1.0))),
    "lugre": Friction(LuGre(**LUGRE)),
}


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_adds_only_its_own_terms(name: str) -> None:
    """Its own action and one addition to the right-hand side; and a state only if the law has one."""
    effect = EFFECTS[name]
    bare, scene = (
        problems.braked_spring.scene(),
        eqx.tree_at(lambda s: s.effects, problems.braked_spring.scene(), (effect,)),
    )
    t = jnp.array(0.3)
    without = primitives(lambda t, y, s: vector_field(t, y, s), t, state(bare, 1), bare)
    with_it = primitives(lambda t, y, s: vector_field(t, y, s), t, state(scene, 1), scene)
    q, qd = state(scene, 1)[:2]
    z = scene.initial_state(q).get(scene.names[0])
    own = primitives(lambda *x: in_scalars(effect_action, *x, seed=q), effect, t, q, qd, z, scene.params)
    most = without + own + Counter({"add": 1})
    if name == "force at a point":
        # Not the sum of its parts: the vectors of this force have the whole field taken apart into scalars, which forms
        # equal terms of force and motion once and drops zeros. Only the way into vectors may come on top.
        assert set(with_it - most) <= {"reshape", "unstack"}
    else:
        assert with_it == most
    assert len(jax.tree.leaves(scene.initial_state(q))) == (1 if name == "lugre" else 0)
    if name == "viscous":
        # Its own terms are the velocity, a product, a sign and the shape; nothing from other laws.
        assert {n for n in own if n not in BOOKKEEPING} == set()
        assert own["mul"] == 1


def effect_action(effect: Any, *args: Any) -> Any:
    action = effect.act(*args)
    return action.generalised, action.rate


def test_only_a_dead_zone_brings_the_holding_force() -> None:
    """The mass matrix is factored once; what a direction to be held needs is solved for only where something holds."""

    def pivots_and_quotients(law: Any) -> tuple[int, int]:
        scene = Scene(
            problems.spherical_pendulum.scene().lagrangian,
            params={"m": 1.0, "R": 1.0, "g": 9.81},
            effects=(Friction(law, along=lambda q: q[1]),),
        )
        counts = primitives(lambda t, y, s: vector_field(t, y, s), jnp.array(0.3), state(scene, 2), scene)
        return counts["gt"], counts["div"]

    # Each pivot is compared with zero. Quotients of sine and cosine (by an opaque one) and of the two accelerations;
    # then of the free acceleration along the one coordinate held, of its response to a force, and of the holding force.
    assert pivots_and_quotients(Sign(Coulomb(1.0))) == (2, 4)
    assert pivots_and_quotients(DeadZone(Coulomb(1.0), 1e-3)) == (2, 7)


@pytest.mark.parametrize("name", ["inital_state", "Power", "store_energy"])
def test_a_misspelled_method_of_an_effect_is_refused(name: str) -> None:
    meant = {"inital_state": "initial_state", "Power": "power", "store_energy": "stored_energy"}[name]
    with pytest.raises(TypeError, match=rf"Own\.{name} is no method of AbstractEffect\. Did you mean '{meant}'\?"):
        type("Own", (AbstractEffect,), {name: lambda self: None})


def test_other_methods_of_an_effect_are_its_own() -> None:
    type("Own", (AbstractEffect,), {"pressure": lambda self: None, "act_on": lambda self: None})
