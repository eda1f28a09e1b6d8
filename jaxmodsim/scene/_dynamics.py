"""The equations of motion of a scene, with only the terms it holds, and what a run asks beside them."""

from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple, TypeAlias, TypeVar, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from .._core.cholesky import factor_positive_definite
from .._core.functions import depends_on, real_array
from .._core.index_check import traced
from .._core.safe import safe_norm
from .._core.scalarise import in_scalars
from ..mechanics import (
    LinearizedConstraints,
    MotionEquations,
    energies,
    errors,
    linearize_constraints,
    motion_equations,
    parts,
    project_position,
    project_velocity,
    rates,
)
from ._event_driven import (
    Contact,
    FrictionForces,
    Loads,
    contact,
    contact_guards,
    next_modes,
    solve_friction_forces,
    stick_violation,
    stop_slip,
)
from ._karnopp import karnopp_forces
from ._scene import Scene
from .forces._effect import Action, Power
from .forces._friction import Friction

# Rounding units by which the mobility within constraints may be wrong.
_ROUNDING = 256.0

_Function = TypeVar("_Function", bound=Callable[..., PyTree])

# Modes of the set-valued friction elements; None where the scene has none.
Modes: TypeAlias = Any


class State(NamedTuple):
    """State of a scene: coordinates and velocities, shape `[dof]`, and the effects' own states by name.

    The modes of set-valued friction elements come beside it, an array of -1, 0, +1 in the order of
    `Scene.event_driven`, or None where there are none.
    """

    q: Float[Array, " dof"]
    qd: Float[Array, " dof"]
    z: dict[str, PyTree]


class Dynamics(NamedTuple):
    """What happens at one state.

    - `scene`: with its signals and laws as they are at this state.
    - `equations`: the equations of motion.
    - `actions`: of every effect, by name.
    - `qdd`: accelerations.
    - `contact`, `friction`: the friction elements that depend on accelerations, and their forces, or None.
    - `constraints`, `multipliers`: of all constraints, or None.
    - `validity_margins`: what has to be positive for the equations to hold: of each constraint that can only push its
      multiplier, then the margin of uniqueness of the loads; None where there is nothing of this.
    """

    scene: Scene
    equations: MotionEquations
    actions: dict[str, Action]
    qdd: Float[Array, " dof"]
    contact: Contact | None
    friction: FrictionForces | None
    constraints: LinearizedConstraints | None
    multipliers: Float[Array, " m"] | None
    validity_margins: Float[Array, " checks"] | None


class Mobility(NamedTuple):
    """How the mechanism answers forces: `solve` without its constraints, the methods within them."""

    solve: Callable[[Array], Array]
    constraints: LinearizedConstraints | None

    def accelerate(self, force: Float[Array, " dof"]) -> Float[Array, " dof"]:
        """Accelerations under the generalised force `force`."""
        free = self.solve(force)
        return (
            free
            if self.constraints is None
            else free + self.constraints.apply_force(self.constraints.multipliers(free))
        )

    def respond(self, force: Float[Array, " dof"]) -> Float[Array, " dof"]:
        """Change of the accelerations with the generalised force."""
        free = self.solve(force)
        return (
            free
            if self.constraints is None
            else free + self.constraints.apply_force(self.constraints.multiplier_response(free))
        )

    def least(self, row: Float[Array, " dof"]) -> Float[Array, ""]:
        """Mobility [1/kg] along a direction that rounding can tell from none, where constraints take it away."""
        eps = float(jnp.finfo(row.dtype).eps)
        return _ROUNDING * eps * jnp.sum(row * self.solve(row))


def forward_dynamics(scene: Scene, t: Float[Array, ""], y: State, mode: Modes) -> Dynamics:
    """Solve for the accelerations, and for the forces that depend on them."""
    q, qd = y.q, y.qd
    scene = scene.bind_state(t, q, qd)
    params = scene.params
    equations = motion_equations(scene.lagrangian, t, q, qd, params)
    linearized = (
        linearize_constraints(scene.constraints, t, q, qd, params, equations.mass) if scene.constraints else None
    )
    mobility = Mobility(factor_positive_definite(equations.mass), linearized)
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
    qdd = mobility.solve(rhs)
    multipliers = None
    if linearized is not None:
        multipliers = linearized.multipliers(qdd)
        qdd = qdd + linearized.apply_force(multipliers)
    if not (scene.event_driven or scene.reaction_loaded):
        margins = _margins(scene, t, y, multipliers, None)
        return Dynamics(scene, equations, actions, qdd, None, None, linearized, multipliers, margins)

    units = {name: each.force_per_load(t, q, qd, y.z.get(name), params) for name, each in scene.reaction_loaded.items()}
    pushes = [-each.apply_force(q, units[name][0], params) for name, each in scene.reaction_loaded.items()]

    def loads(rows: Array) -> Loads | None:
        return _loads(scene, mobility, t, y, rows, multipliers)

    floor = mobility.least if linearized is not None else None
    contacts = contact([*scene.event_driven.values()], pushes, mobility.respond, floor, loads, t, q, qd, params, qdd)
    settled = solve_friction_forces(contacts, jnp.zeros(0, q.dtype) if mode is None else mode)
    for i, (name, effect) in enumerate(scene.event_driven.items()):
        actions[name] = Action(effect.apply_force(q, settled.force[i], params), settled.force[i])
    for i, name in enumerate(scene.reaction_loaded, start=len(scene.event_driven)):
        unit, rate = units[name]
        actions[name] = Action(-settled.force[i] * pushes[i - len(scene.event_driven)], settled.force[i] * unit, rate)
    qdd = qdd - jnp.sum(contacts.minv_jt * settled.force[:, None], axis=0)
    if linearized is not None and multipliers is not None:
        taken = sum(actions[name].generalised for name in (*scene.event_driven, *scene.reaction_loaded))
        multipliers = multipliers + linearized.multiplier_response(mobility.solve(jnp.asarray(taken)))
    margins = _margins(scene, t, y, multipliers, settled.margin)
    return Dynamics(scene, equations, actions, qdd, contacts, settled, linearized, multipliers, margins)


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
    yields = [mobility.constraints.multiplier_response(mobility.solve(row)) for row in rows]
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
        of_each = by_constraint(scene, t, y, multipliers)
        margins += [of_each[name][0] for name in pushing]
    if unique is not None and scene.loaded:
        margins.append(unique)
    return jnp.stack(margins) if margins else None


class ConstraintReaction(NamedTuple):
    """What a constraint does; along a run with a leading axis of time.

    - `multiplier`: multipliers, shape `[m]`.
    - `generalised`: generalised force `J^T lambda`, shape `[dof]` [N or N m].
    - `force`: Cartesian force [N] on the constrained point, of the shape of its position; None where the constraint has
      no `at`.
    """

    multiplier: Float[Array, "*time m"]
    generalised: Float[Array, "*time dof"]
    force: Any


def _scalarised(fn: _Function) -> _Function:
    """`fn(t, y, scene, ...)` evaluated in scalars as a whole: laws, loads and solves beside the Lagrangian, too."""

    @wraps(fn)
    def run(t: Array, y: State, scene: Scene, *more: PyTree) -> PyTree:
        return in_scalars(lambda t, y, *more: fn(t, y, scene, *more), t, y, *more, seed=y.q)

    return cast(_Function, run)


@_scalarised
def vector_field(t: Float[Array, ""], y: State, scene: Scene, mode: Modes = None) -> State:
    """Right-hand side of `y' = field(t, y)`; NaN where the equations do not hold, see `scene_validity_margins`."""
    dynamics = forward_dynamics(scene, t, y, mode)
    qdd = dynamics.qdd
    if dynamics.validity_margins is not None:
        qdd = jnp.where(jnp.all(dynamics.validity_margins > 0), qdd, jnp.nan)
    return State(y.qd, qdd, {name: dynamics.actions[name].rate for name in y.z})


def scene_canonical(t: Float[Array, ""], y: State, scene: Scene, mode: Modes = None) -> State:
    """Rates of coordinates and momenta at the state `y`: `p' = dL/dq + Q + J^T lambda`, in the place of qd."""
    dynamics = forward_dynamics(scene, t, y, mode)
    scene = dynamics.scene
    push = jax.grad(scene.lagrangian, argnums=1)(t, y.q, y.qd, scene.params)
    for action in dynamics.actions.values():
        push = push + action.generalised
    if dynamics.constraints is not None and dynamics.multipliers is not None:
        push = push + dynamics.constraints.force(dynamics.multipliers)
    if dynamics.validity_margins is not None:
        push = jnp.where(jnp.all(dynamics.validity_margins > 0), push, jnp.nan)
    return State(y.qd, push, {name: dynamics.actions[name].rate for name in y.z})


@_scalarised
def scene_guards(
    t: Float[Array, ""], y: State, scene: Scene, mode: Modes, rest: Float[Array, ""], tolerances: tuple[Array, Array]
) -> tuple[Float[Array, " guards"], Float[Array, " guards"]]:
    """Guards that are positive while the modes hold, and their tolerances; see `contact_guards`."""
    return contact_guards(*_contact_and_forces(t, y, scene, mode), mode, rest, tolerances)


@_scalarised
def scene_switch(
    t: Float[Array, ""], y: State, scene: Scene, mode: Modes, fired: Bool[Array, " guards"]
) -> tuple[State, Float[Array, " n"]]:
    """State and modes after the guards that `fired`."""
    contacts, _ = _contact_and_forces(t, y, scene, mode)
    new = next_modes(contacts, mode, (mode == 0) | fired, fired & (mode == 0))
    return y._replace(qd=stop_slip(contacts, y.qd, new == 0)), new


@_scalarised
def scene_modes(
    t: Float[Array, ""], y: State, scene: Scene, rest: Float[Array, ""]
) -> tuple[State, Float[Array, " n"]]:
    """State and modes to begin with: elements with no more slip velocity than `rest` or rounding stick if they can."""
    none = jnp.zeros(len(scene.event_driven), y.q.dtype)
    dynamics = forward_dynamics(scene, t, y, none)
    scene, (contacts, _) = dynamics.scene, _friction_of(dynamics)
    elements = [*scene.event_driven.values()]
    speed = jnp.stack([jnp.sum(jnp.abs(e.direction(y.q, scene.params) * y.qd)) + jnp.abs(e.belt(t)) for e in elements])
    rounding = 8.0 * float(jnp.finfo(y.q.dtype).eps) * jax.lax.stop_gradient(speed)
    v = contacts.v[: len(elements)]
    still = jnp.abs(v) <= jnp.maximum(rounding, rest)
    mode = next_modes(contacts, jnp.sign(v), still, jnp.zeros_like(still))
    return y._replace(qd=stop_slip(contacts, y.qd, mode == 0)), mode


@_scalarised
def scene_stick_violation(t: Float[Array, ""], y: State, scene: Scene, mode: Modes) -> Float[Array, " n"]:
    """By how much the force of each sticking element exceeds its limit, in limits; 0 in slip."""
    return stick_violation(_contact_and_forces(t, y, scene, mode)[1], mode)


@_scalarised
def scene_stick(t: Float[Array, ""], y: State, scene: Scene, mode: Modes) -> State:
    """State with the slip velocity of sticking elements, which drifts with the error of integration, set to zero."""
    return y._replace(qd=stop_slip(_contact_and_forces(t, y, scene, mode)[0], y.qd, mode == 0))


def scene_drifts(scene: Scene) -> bool:
    """Whether stick drifts with the error of integration: not where it holds one coordinate at a constant speed."""
    return any(each.along is not None or callable(each.belt_velocity) for each in scene.event_driven.values())


def scene_energies(t: Float[Array, ""], y: State, scene: Scene) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Kinetic and potential energy [J] of the Lagrangian; the scene is that of time `t`."""
    return energies(scene.lagrangian, t, y.q, y.qd, scene.params)


def scene_mass(t: Float[Array, ""], y: State, scene: Scene) -> Float[Array, "dof dof"]:
    """Mass matrix [kg for lengths, kg m^2 for angles]; the scene is that of time `t`."""
    return motion_equations(scene.lagrangian, t, y.q, y.qd, scene.params).mass


def scene_project(t: Float[Array, ""], y: State, scene: Scene) -> State:
    """State moved onto the constraints: the coordinates, then the velocities there; the scene is that of time `t`."""
    mass = motion_equations(scene.lagrangian, t, y.q, y.qd, scene.params).mass
    q = project_position(scene.constraints, t, y.q, scene.params, mass)
    return y._replace(q=q, qd=project_velocity(scene.constraints, t, q, y.qd, scene.params, mass))


def scene_constraint_residual(t: Float[Array, ""], y: State, scene: Scene) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """How far coordinates and velocities are from the constraints, relative to their own size or to one.

    Each error is divided by the length of its gradient, which makes it a distance from its own surface: constraints
    that contradict each other show, too. The scene is that of time `t`.
    """
    y = jax.lax.stop_gradient(y)

    def far(fn: Callable[[Array], Array], x: Array) -> Array:
        error, rows = fn(x), jax.jacrev(fn)(x)
        slope = safe_norm(rows, axis=1)
        distance = jnp.abs(error) / jnp.where(slope > 0, slope, 1.0)
        return jnp.max(distance, initial=0.0) / jnp.maximum(1.0, jnp.max(jnp.abs(x)))

    position, velocity = errors(scene.constraints, t, scene.params), rates(scene.constraints, t, y.q, scene.params)
    return far(position, y.q), far(velocity, y.qd)


def scene_validity_margins(
    t: Float[Array, ""], y: State, scene: Scene, mode: Modes = None
) -> Float[Array, " checks"] | None:
    """What has to be positive for the equations to hold, in the order of `Scene.checks`; None for nothing."""
    return forward_dynamics(scene, t, y, mode).validity_margins


def scene_reactions(t: Float[Array, ""], y: State, scene: Scene, mode: Modes = None) -> dict[str, ConstraintReaction]:
    """What each constraint does, by name."""
    return _reactions(t, y, forward_dynamics(scene, t, y, mode))


def _reactions(t: Float[Array, ""], y: State, dynamics: Dynamics) -> dict[str, ConstraintReaction]:
    scene = dynamics.scene
    if dynamics.constraints is None or dynamics.multipliers is None:
        return {}
    multipliers = by_constraint(scene, t, y, dynamics.multipliers)
    rows = by_constraint(scene, t, y, dynamics.constraints.rows)
    return {
        name: ConstraintReaction(
            multipliers[name],
            jnp.sum(rows[name] * multipliers[name][:, None], axis=0),
            each.force(t, y.q, scene.params, multipliers[name]),
        )
        for name, each in zip(scene.constraint_names, scene.constraints, strict=True)
    }


def _contact_and_forces(t: Float[Array, ""], y: State, scene: Scene, mode: Modes) -> tuple[Contact, FrictionForces]:
    return _friction_of(forward_dynamics(scene, t, y, mode))


def _friction_of(dynamics: Dynamics) -> tuple[Contact, FrictionForces]:
    assert dynamics.contact is not None
    assert dynamics.friction is not None
    return dynamics.contact, dynamics.friction


def scene_forces(t: Float[Array, ""], y: State, scene: Scene, mode: Modes = None) -> dict[str, Array]:
    """Force of each effect in its own terms, by name."""
    actions = forward_dynamics(scene, t, y, mode).actions
    return {name: actions[name].force for name in scene.names}


def scene_power(t: Float[Array, ""], y: State, scene: Scene, mode: Modes = None) -> dict[str, Power]:
    """Power [W] from outside into the mechanism and its effects, and absorbed by friction: of each effect by its name.

    Besides, under the name of a constraint what its motion in time supplies, and under `lagrangian` what a Lagrangian
    does that depends on time by itself, `-dL/dt`; not there where it does not.
    """
    dynamics = forward_dynamics(scene, t, y, mode)
    scene = dynamics.scene
    powers = {
        name: effect.power(t, y.q, y.qd, scene.params, dynamics.actions[name])
        for name, effect in zip(scene.names, scene.effects, strict=True)
    }
    for name, reaction in _reactions(t, y, dynamics).items():
        powers[name] = Power(jnp.sum(reaction.generalised * y.qd))

    def lagrangian(t: Array) -> Array:
        return scene.lagrangian(t, y.q, y.qd, scene.params)

    if depends_on(lagrangian, t):
        powers["lagrangian"] = Power(-jax.grad(lagrangian)(t))
    return powers


def check_scene(scene: Scene, y: State) -> None:
    """Check shapes of everything the scene's functions return, and the indices that they use.

    **Raises:**

    - `ValueError` naming the function, the shape it returned and the shape that is needed, or the index that is out of
      range; see `traced` for those that are seen.
    """
    t = y.q[0]
    scene = scene.bind_time(t)

    def energy(*state: Any) -> Array:
        return real_array(scene.lagrangian(*state), name="the Lagrangian")

    given = traced(energy, t=t, q=y.q, qd=y.qd, params=scene.params, name="the Lagrangian")
    if given.shape != () or not jnp.issubdtype(given.dtype, jnp.floating):
        raise ValueError(
            f"The Lagrangian must return one number [J], shape (), that depends on the state, but it returned {given}."
            f" With q and qd of shape {y.q.shape}, index the coordinates (qd[0]) or sum over them."
        )
    for name, effect in zip(scene.names, scene.effects, strict=True):
        effect.check(y.q, y.qd, scene.params, name)
    for name, constraint in zip(scene.constraint_names, scene.constraints, strict=True):
        constraint.check(y.q, y.qd, scene.params, name)
        size = jax.eval_shape(constraint.rate, t, y.q, y.qd, scene.params).shape[0]
        if name in scene.loaded and size != 1:
            raise ValueError(
                f"Constraint {name!r} loads friction (normal_force={name!r}), so it must be one equation, but it has"
                f" {size}. Give each direction a Constraint of its own."
            )
