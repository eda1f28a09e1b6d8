"""Accelerations of a scene, and every force that depends on them."""

from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._core.cholesky import solve_positive_definite
from ..mechanics import LinearizedConstraints, MotionEquations, linearize_constraints, motion_equations, parts
from ._event_driven import Contact, Loads, contact, solve_friction_forces
from ._karnopp import karnopp_forces
from ._scene import Scene
from .forces._effect import Action
from .forces._friction import Friction

# Rounding units by which the mobility within constraints may be wrong.
_ROUNDING = 256.0

# Modes of the set-valued friction elements; None where the scene has none.
Modes: TypeAlias = Any


class State(NamedTuple):
    """State of a scene: coordinates and velocities, shape `[dof]`, and the effects' own states by name.

    The modes of set-valued friction elements come beside it, an array of -1, 0, +1 in the order of
    `Scene.exact`, or None where there are none.
    """

    q: Float[Array, " dof"]
    qd: Float[Array, " dof"]
    z: dict[str, PyTree]


class Dynamics(NamedTuple):
    """What happens at one state.

    - `equations`: the equations of motion.
    - `actions`: of every effect, by name.
    - `qdd`: accelerations.
    - `found`: the friction elements that depend on accelerations, or None.
    - `restraint`, `multipliers`: of all constraints, or None.
    - `margins`: what has to be positive for the equations to hold: of each constraint that can only push its
      multiplier, then the margin of uniqueness of the loads; None where there is nothing of this.
    """

    equations: MotionEquations
    actions: dict[str, Action]
    qdd: Float[Array, " dof"]
    found: Contact | None
    restraint: LinearizedConstraints | None
    multipliers: Float[Array, " m"] | None
    validity_margins: Float[Array, " checks"] | None


class Mobility(NamedTuple):
    """How the mechanism answers forces within its constraints."""

    mass: Float[Array, "dof dof"]
    constraints: LinearizedConstraints | None

    def accelerate(self, force: Float[Array, " dof"]) -> Float[Array, " dof"]:
        """Accelerations under the generalised force `force`."""
        free = solve_positive_definite(self.mass, force)
        return (
            free
            if self.constraints is None
            else free + self.constraints.apply_force(self.constraints.multipliers(free))
        )

    def respond(self, force: Float[Array, " dof"]) -> Float[Array, " dof"]:
        """Change of the accelerations with the generalised force."""
        free = solve_positive_definite(self.mass, force)
        return (
            free
            if self.constraints is None
            else free + self.constraints.apply_force(self.constraints.multiplier_response(free))
        )

    def least(self, row: Float[Array, " dof"]) -> Float[Array, ""]:
        """Mobility [1/kg] along a direction that rounding can tell from none, where constraints take it away."""
        eps = float(jnp.finfo(row.dtype).eps)
        return _ROUNDING * eps * jnp.sum(row * solve_positive_definite(self.mass, row))


def forward_dynamics(scene: Scene, t: Float[Array, ""], y: State, mode: Modes) -> Dynamics:
    """Solve for the accelerations, and for the forces that depend on them."""
    q, qd = y.q, y.qd
    scene = scene.bind_state(t, q, qd)
    params = scene.params
    equations = motion_equations(scene.lagrangian, t, q, qd, params)
    restraint = (
        linearize_constraints(scene.constraints, t, q, qd, params, equations.mass) if scene.constraints else None
    )
    mobility = Mobility(equations.mass, restraint)
    actions, rhs = {}, equations.load
    holding = {}
    for name, effect in zip(scene.names, scene.effects, strict=True):
        if name in scene.event_driven or name in scene.reaction_loaded:
            continue
        action = effect.act(t, q, qd, y.z.get(name), params)
        actions[name] = action
        rhs = rhs + action.generalised
        if isinstance(effect, Friction) and effect.karnopp:
            holding[name] = effect
    if holding:
        held = karnopp_forces(holding, actions, mobility.accelerate, mobility.respond, rhs, t, q, qd, params)
        for name, action in held.items():
            rhs = rhs + action.generalised - actions[name].generalised
            actions[name] = action
    qdd = solve_positive_definite(equations.mass, rhs)
    multipliers = None
    if restraint is not None:
        multipliers = restraint.multipliers(qdd)
        qdd = qdd + restraint.apply_force(multipliers)
    if not (scene.event_driven or scene.reaction_loaded):
        margins = _margins(scene, t, y, multipliers, None)
        return Dynamics(equations, actions, qdd, None, restraint, multipliers, margins)

    units = {name: each.force_per_load(t, q, qd, y.z.get(name), params) for name, each in scene.reaction_loaded.items()}
    pushes = [-each.apply_force(q, units[name][0], params) for name, each in scene.reaction_loaded.items()]

    def loads(rows: Array) -> Loads | None:
        return _loads(scene, mobility, t, y, rows, multipliers)

    floor = mobility.least if restraint is not None else None
    found = contact([*scene.event_driven.values()], pushes, mobility.respond, floor, loads, t, q, qd, params, qdd)
    settled = solve_friction_forces(found, jnp.zeros(0, q.dtype) if mode is None else mode)
    for i, (name, effect) in enumerate(scene.event_driven.items()):
        actions[name] = Action(effect.apply_force(q, settled.force[i], params), settled.force[i])
    for i, name in enumerate(scene.reaction_loaded, start=len(scene.event_driven)):
        unit, rate = units[name]
        actions[name] = Action(-settled.force[i] * pushes[i - len(scene.event_driven)], settled.force[i] * unit, rate)
    qdd = qdd - jnp.sum(found.minv_jt * settled.force[:, None], axis=0)
    if restraint is not None and multipliers is not None:
        taken = sum(actions[name].generalised for name in (*scene.event_driven, *scene.reaction_loaded))
        multipliers = multipliers + restraint.multiplier_response(
            solve_positive_definite(equations.mass, jnp.asarray(taken))
        )
    margins = _margins(scene, t, y, multipliers, settled.margin)
    return Dynamics(equations, actions, qdd, found, restraint, multipliers, margins)


def _loads(
    scene: Scene, mobility: Mobility, t: Array, y: State, rows: Float[Array, "n dof"], multipliers: Any
) -> Loads | None:
    """Normal forces of the constraints that load friction, and what the elements with `rows` take off them."""
    names = scene.loaded
    if not names:
        return None
    assert mobility.constraints is not None
    loaded = [each.load_constraint for each in (*scene.event_driven.values(), *scene.reaction_loaded.values())]
    where = by_constraint(scene, t, y, jnp.arange(multipliers.shape[0]))
    chosen = dict(zip(scene.constraint_names, scene.constraints, strict=True))
    at = jnp.concatenate([where[name] for name in names])
    size = jnp.stack([chosen[name].per_multiplier(t, y.q, scene.params) for name in names])
    yields = [mobility.constraints.multiplier_response(solve_positive_definite(mobility.mass, row)) for row in rows]
    return Loads(
        jnp.asarray([[float(name == each) for name in names] for each in loaded], y.q.dtype),
        size * multipliers[at],
        size[:, None] * jnp.stack([each[at] for each in yields], axis=1),
        jnp.asarray([0.0 if chosen[name].one_sided else -1.0 for name in names], y.q.dtype),
    )


def by_constraint(scene: Scene, t: Array, y: State, values: Array) -> dict[str, Array]:
    """What there is one of for each equation (multipliers, rows), by the names of the constraints."""
    where = parts(scene.constraints, t, y.q, y.qd, scene.params)
    return {name: values[part] for name, part in zip(scene.constraint_names, where, strict=True)}


def _margins(scene: Scene, t: Array, y: State, multipliers: Any, unique: Array | None) -> Array | None:
    pushing = [name for name, each in zip(scene.constraint_names, scene.constraints, strict=True) if each.one_sided]
    margins = []
    if pushing:
        found = by_constraint(scene, t, y, multipliers)
        margins += [found[name][0] for name in pushing]
    if unique is not None and scene.loaded:
        margins.append(unique)
    return jnp.stack(margins) if margins else None
