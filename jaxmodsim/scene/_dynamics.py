"""The equations of motion of a scene, with only the terms that it has, and the further functions of a run."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._core.arrays import PerDof, Scalar, apply_matrix
from .._core.cholesky import factor_positive_definite
from .._core.functions import depends_on
from .._core.readable import short
from .._core.scalarise import in_scalars
from ..mechanics import (
    AbstractEquations,
    Contact,
    LinearizedConstraints,
    linearize_constraints,
    motion_equations,
    parts,
)
from ._event_driven import (
    FrictionElements,
    FrictionForces,
    Loads,
    assemble_friction,
    friction_guards,
    next_modes,
    renew_slip,
    solve_friction_forces,
    speed_of_rest,
    stick_violation,
    stop_slip,
)
from ._karnopp import karnopp_forces
from ._scene import Scene
from .forces._effect import Action, Power

# Error of the mobility within constraints, in rounding units.
_ROUNDING = 256.0

_Value = TypeVar("_Value")

# Modes of a scene, an array; None without modes.
Modes: TypeAlias = Any


class State(NamedTuple):
    """State of a scene: coordinates and velocities, shape `[dof]`, and the effects' own states by name.

    Modes are a separate array, in the order of `Scene.mode_names`, or None without modes.
    """

    q: PerDof
    qd: PerDof
    z: dict[str, PyTree]


def state_names(y: State) -> list[str]:
    """Names of the entries of a state: q[0], qd[0], and friction.z for the state of a law.

    **Returns:**

    One name for each number, in the order of the leaves.
    """
    names = []
    for path, leaf in jtu.tree_leaves_with_path(y):
        words = [str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))) for key in path]
        word = ".".join([*words[1:], "z"] if words[0] == "z" else words)
        names += [word + (f"[{','.join(map(str, i))}]" if i else "") for i in np.ndindex(np.shape(leaf))]
    return names


class ConstraintReaction(NamedTuple):
    """Forces of a constraint; along a run with a leading axis of time.

    - `multiplier`: multipliers, shape `[m]`.
    - `generalised`: generalised force `J^T lambda`, shape `[dof]` [N or N m].
    - `force`: Cartesian force [N] on the constrained point, of the shape of its position; None if the constraint has no
      `at`.
    """

    multiplier: Float[Array, "*time m"]
    generalised: Float[Array, "*time dof"]
    force: Any

    def __repr__(self) -> str:
        given = (f"{name}: {short(x)}" for name, x in zip(self._fields, self, strict=True) if x is not None)
        return f"{type(self).__name__}({'; '.join(given)})"


class Dynamics(NamedTuple):
    """Accelerations and forces at one state, see `forward_dynamics`.

    - `t`, `y`, `mode`: time, state and modes.
    - `scene`: the scene with its signals and laws at this state; `unbound`: with those of all states.
    - `actions`: actions of all effects, by name.
    - `qdd`: accelerations.
    - `elements`, `friction`: the friction elements that depend on accelerations, and their forces, or None.
    - `constraints`, `multipliers`: rows and multipliers of all constraints, or None.
    - `uniqueness`: margin of uniqueness of loads that are reactions, see `FrictionForces.margin`; the equations hold if
      it is positive. None without such loads.
    """

    t: Scalar
    y: State
    mode: Modes
    scene: Scene
    unbound: Scene
    actions: dict[str, Action]
    qdd: PerDof
    elements: FrictionElements | None
    friction: FrictionForces | None
    constraints: LinearizedConstraints | None
    multipliers: Float[Array, " m"] | None
    uniqueness: Scalar | None

    @property
    def rate(self) -> State:
        """Rate of the state; NaN if the equations do not hold."""
        return self._valid_rate(self.qdd)

    @property
    def canonical_rate(self) -> State:
        """Rates of coordinates, and of momenta, `p' = dL/dq + Q + J^T lambda`, in the place of qd."""
        push = jax.grad(self.scene.lagrangian, argnums=1)(self.t, self.y.q, self.y.qd, self.scene.params)
        for action in self.actions.values():
            push = push + action.generalised
        if self.constraints is not None and self.multipliers is not None:
            push = push + self.constraints.force(self.multipliers)
        return self._valid_rate(push)

    def _valid_rate(self, rate: PerDof) -> State:
        if self.uniqueness is not None:
            rate = jnp.where(self.uniqueness > 0, rate, jnp.nan)
        return State(self.y.qd, rate, {name: self.actions[name].rate for name in self.y.z})

    @property
    def forces(self) -> dict[str, Array]:
        """Force of each effect in its own terms, by name."""
        return {name: self.actions[name].force for name in self.scene.names}

    @property
    def reactions(self) -> dict[str, ConstraintReaction]:
        """Forces of each constraint, by name."""
        if self.constraints is None or self.multipliers is None:
            return {}
        scene, t, y = self.scene, self.t, self.y
        multipliers = by_constraint(scene, t, y, self.multipliers)
        rows = by_constraint(scene, t, y, self.constraints.rows)
        return {
            name: ConstraintReaction(
                multipliers[name],
                jnp.sum(rows[name] * multipliers[name][:, None], axis=0),
                each.force(t, y.q, scene.params, multipliers[name]),
            )
            for name, each in zip(scene.constraint_names, scene.constraints, strict=True)
        }

    @property
    def power(self) -> dict[str, Power]:
        """Power [W] from outside into the mechanism and its effects, and power absorbed by friction, by effect name.

        Further entries are the power that the prescribed motion of a constraint supplies, by its name, and `-dL/dt`
        under `lagrangian`, if the Lagrangian depends on time.
        """
        scene, y = self.scene, self.y
        powers = {
            name: effect.power(self.t, y.q, y.qd, scene.params, self.actions[name])
            for name, effect in zip(scene.names, scene.effects, strict=True)
        }
        for name, reaction in self.reactions.items():
            done = jnp.sum(reaction.generalised * y.qd)
            powers[name] = Power(done)
            if name in scene.compliant:
                taken = -reaction.multiplier[0] * scene.compliant[name].rate(self.t, y.q, y.qd, scene.params)[0]
                powers[name] = Power(done + taken, taken)

        def lagrangian(t: Array) -> Array:
            return scene.lagrangian(t, y.q, y.qd, scene.params)

        if depends_on(lagrangian, self.t):
            powers["lagrangian"] = Power(-jax.grad(lagrangian)(self.t))
        return powers

    def guards(self, rest: Scalar, tolerances: tuple[Array, Array]) -> tuple[Float[Array, " guards"], ...]:
        """Guards that are positive while the modes hold, and their tolerances; see `friction_guards`.

        The guard of an open contact is its gap, that of a closed one its multiplier. A gap closes only below zero by
        more than its rounding, because it starts from zero after an impact and when a contact opens. The guard of a
        switch is multiplied by its mode, as is a kink. The values of the guards at their events come third: rounding,
        or zero.
        """
        friction, gaps, sides = self._modes
        state = self.t, self.y.q, self.y.qd
        guards, atol, roots = [], [], []
        if friction.size:
            assert self.friction is not None
            speeds = self._speed_of_rest(rest), self._rounding_of_slip
            found = friction_guards(self.friction_elements, self.friction, friction, *speeds, tolerances)
            guards, atol, roots = ([each] for each in found)
        if gaps.size:
            contacts, at = self.scene.contacts.values(), (self.t, self.y.q, self.scene.params)
            wide = jnp.concatenate([each.error(*at) for each in contacts])
            rounding = jnp.stack([each.rounding(*at) for each in contacts])
            guards.append(jnp.where(gaps > 0, self.contact_forces, wide + rounding))
            atol.append(jnp.where(gaps > 0, 0.0, tolerances[1] + rounding))
            roots.append(jnp.where(gaps > 0, 0.0, rounding))
        if sides.size:
            loads, of_loads = self.guide_loads(rest)
            values = jnp.concatenate([self.scene.side_values(*state), loads])
            # Kinks have the rounding of their numbers as a hysteresis, as they may stay near zero.
            none = jnp.zeros(len(self.scene.switches), sides.dtype)
            rounding = jnp.concatenate([none, self.unbound.kink_rounding(*state, rest), of_loads])
            guards.append(sides * values + rounding)
            atol.append(rounding)
            roots.append(rounding)
        return tuple(jnp.concatenate(each) for each in (guards, atol, roots))

    def start_friction(self, rest: Scalar) -> tuple[State, Float[Array, " n"]]:
        """Initial state, and modes of the friction elements, which do not depend on those in `mode`."""
        elements, rounding = self.friction_elements, self._rounding_of_slip
        v = elements.v[: rounding.size]
        still = elements.magnitude(v) <= jnp.maximum(rounding, rest)
        rest = self._speed_of_rest(rest)
        mode = next_modes(
            elements, elements.slip_mode(jax.lax.stop_gradient(v), rest), still, jnp.zeros_like(still), rest
        )
        mode = self._release(mode)
        return self._stick(mode), mode

    def switch_struck(
        self,
        fired: Bool[Array, " n"],
        stopped: Bool[Array, " elements"],
        struck: Bool[Array, ""],
        rest: Scalar,
        held: Bool[Array, " n"] | None,
    ) -> tuple[State, Float[Array, " n"]]:
        """State and modes of the friction elements after an impact, which may reverse a slip, and end a stick.

        `stopped`: the elements that the impact has stopped. `struck`: whether it has changed a velocity.
        """
        elements, mode = self.friction_elements, self._elements
        v = jax.lax.stop_gradient(elements.v[: mode.size])
        turned = struck & (elements.magnitude(v) > rest)
        fired = (fired & ~turned) | (elements.in_rows(stopped) & ~elements.sticks(mode))
        mode = jnp.where(turned, elements.slip_mode(v, self._speed_of_rest(rest)), mode)
        return self.switch_friction(fired, mode, rest, held)

    def switch_friction(
        self,
        fired: Bool[Array, " n"],
        mode: Float[Array, " n"],
        rest: Scalar,
        held: Bool[Array, " n"] | None,
    ) -> tuple[State, Float[Array, " n"]]:
        """State and modes of the friction elements after the guards that `fired`.

        The elements that are `held` stick regardless of their limits.
        """
        elements, rest = self.friction_elements, self._speed_of_rest(rest)
        mode, fired = renew_slip(elements, mode, fired, rest) if elements.planes else (mode, fired)
        sticks = elements.sticks(mode)
        new = next_modes(elements, mode, sticks | fired, fired & sticks, rest)
        if held is not None:
            new = jnp.where(elements.in_planes(held, lambda part: jnp.any(held[part])), 0.0, new)
        # The remaining slip of a plane that stops is removed in any case: it does not determine the next direction.
        stops = elements.in_planes(elements.sticks(new), lambda part: fired[part] | elements.sticks(new)[part])
        free = self._release(new)
        if held is not None:
            free = jnp.where(held, new, free)
        return self.y._replace(qd=stop_slip(elements, self.y.qd, stops)), free

    def _release(self, mode: Float[Array, " n"]) -> Float[Array, " n"]:
        """Modes in which no element sticks under an open contact: stick would hold it in derivatives."""
        loads = [each.load_constraint for each in self.scene.event_driven.values()]
        if not any(load in self.scene.contacts for load in loads):
            return mode
        contacts = dict(zip(self.scene.contacts, jnp.where(self.pulls, 0.0, self._modes[1]), strict=True))
        elements, closed = self.friction_elements, jnp.ones_like(self.t)
        free = jnp.stack([contacts.get(load or "", closed) == 0 for load in loads])
        v = jax.lax.stop_gradient(elements.v[: mode.size])
        return jnp.where(elements.in_rows(free) & (mode == 0), jnp.where(v < 0, -1.0, jnp.ones_like(v)), mode)

    def stick(self, mode: Modes) -> State:
        """State without the slip velocity of elements that stick in `mode`, which drifts from zero."""
        return self._stick(mode[: self._elements.size])

    def _stick(self, mode: Float[Array, " n"]) -> State:
        elements = self.friction_elements
        return self.y._replace(qd=stop_slip(elements, self.y.qd, elements.sticks(mode)))

    @property
    def _rounding_of_slip(self) -> Float[Array, " n"]:
        """Rounding error [m/s] of the slip of each element, in each of its rows; constant."""
        speed = []
        for each in self.scene.event_driven.values():
            row = each.direction(self.y.q, self.scene.params)
            size = jnp.sum(jnp.abs(row * jnp.broadcast_to(self.y.qd, row.shape))) + jnp.sum(jnp.abs(each.belt(self.t)))
            speed += [size] if row.ndim == 1 else [size] * row.shape[0]
        return 8.0 * float(jnp.finfo(self.y.q.dtype).eps) * jax.lax.stop_gradient(jnp.stack(speed))

    def _speed_of_rest(self, rest: Scalar) -> Scalar:
        assert self.friction is not None
        return speed_of_rest(self.friction_elements, self.friction, rest, self.t)

    @property
    def _elements(self) -> Float[Array, " n"]:
        """Modes of the friction elements."""
        return self._modes[0]

    @property
    def _modes(self) -> tuple[Array, Array, Array]:
        """Modes of the friction elements, of the contacts, and of switches and kinks."""
        return self.scene.split_modes(self.mode)

    def guide_loads(self, rest: Scalar) -> tuple[Float[Array, " guides"], Float[Array, " guides"]]:
        """Normal forces of `Scene.guides` [N], negative if they pull, and their errors.

        These are of rounding, and at least those by an acceleration of `rest`: where all forces are errors of stick, so
        is the sign of a load.
        """
        none = jnp.zeros(0, self.t.dtype)
        if not self.scene.guides:
            return none, none
        assert self.friction is not None
        assert self.friction_elements.loads is not None
        loads = self.friction_elements.loads
        at = np.array([self.scene.loaded.index(name) for name in self.scene.guides])
        unit = _ROUNDING * float(jnp.finfo(self.t.dtype).eps)
        cancelled = jax.lax.stop_gradient(jnp.abs(loads.normal_coupling) * jnp.abs(self.friction.force)[None, :])
        error = loads.rounding + unit * jnp.sum(cancelled, axis=1) + rest * loads.mass
        return self.friction.normal[at], error[at]

    @property
    def contact_forces(self) -> Float[Array, " n"]:
        """Multipliers of the contacts, negative if a closed one would pull."""
        assert self.multipliers is not None
        pushes = by_constraint(self.scene, self.t, self.y, self.multipliers)
        return jnp.concatenate([pushes[name] for name in self.scene.contacts])

    @property
    def pulls(self) -> Bool[Array, " n"]:
        """Which contacts are closed and would pull."""
        return (self._modes[1] > 0) & (self.contact_forces < 0)

    @property
    def stick_violation(self) -> Float[Array, " n"]:
        """Excess of the force of each sticking element over its limit, in limits; 0 in slip."""
        if not self._elements.size:
            return self._elements
        assert self.friction is not None
        return stick_violation(self.friction_elements, self.friction, self._elements)

    @property
    def friction_elements(self) -> FrictionElements:
        """`elements` of a scene with such elements."""
        assert self.elements is not None
        return self.elements


class Mobility(NamedTuple):
    """Accelerations of the mechanism by forces: `solve` without its constraints, the methods within them."""

    solve: Callable[[Array], Array]
    constraints: LinearizedConstraints | None

    def accelerate(self, force: PerDof) -> PerDof:
        """Accelerations under the generalised force `force`."""
        free, held = self.solve(force), self.constraints
        return free if held is None else free + held.apply_force(held.multipliers(free))

    def respond(self, force: Float[Array, "dof *k"]) -> Float[Array, "dof *k"]:
        """Change of the accelerations with the generalised force, one or several."""
        free = self.solve(force)
        return free if self.constraints is None else self.constraints.respond(free)


def load_and_mobility(
    scene: Scene, constraints: tuple[AbstractEquations, ...], t: Scalar, q: PerDof, qd: PerDof
) -> tuple[PerDof, Mobility]:
    """Load of the Lagrangian, and mobility within these constraints; the scene is that of this state."""
    mass, load = motion_equations(scene.lagrangian, t, q, qd, scene.params)
    held = linearize_constraints(constraints, t, q, qd, scene.params, mass) if constraints else None
    return load, Mobility(factor_positive_definite(mass), held)


def forward_dynamics(t: Scalar, y: State, scene: Scene, mode: Modes = None) -> Dynamics:
    """Solve for the accelerations, and for the forces that depend on them, for the modes `mode`.

    Those of kinks (`Scene.num_kinks`) may be zero, or left out: friction is then that on the side of the state.

    **Returns:**

    The `Dynamics` at this state: accelerations `qdd`, shape `[dof]`, forces, reactions, powers and guards.
    """
    q, qd, unbound = y.q, y.qd, scene
    if mode is not None and scene.num_kinks and (left_out := scene.num_modes(q.shape[0]) - mode.shape[0]):
        mode = jnp.pad(mode, (0, left_out))
    scene = scene.bind_state(t, q, qd)
    params = scene.params
    rhs, mobility = load_and_mobility(scene, scene.constraints_in(mode), t, q, qd)
    linearized, actions = mobility.constraints, {}
    compliant = _compliant(scene, t, y) if scene.compliant else None
    if compliant is not None:
        rhs = rhs + compliant.generalised
    sides, of_guides = {}, {name: jnp.zeros_like(t) for name in scene.guides}
    if mode is not None:
        values = jax.lax.stop_gradient(scene.split_modes(mode)[2])
        sides, scene = dict(zip(scene.switches, values, strict=False)), scene.on_sides(values)
        of_guides = dict(zip(of_guides, values[values.size - len(of_guides) :], strict=True))
    for name, effect in zip(scene.names, scene.effects, strict=True):
        if name in scene.event_driven or name in scene.reaction_loaded:
            continue
        if name in sides:
            action = scene.switches[name].act_on(sides[name], t, q, qd, params)
        else:
            action = effect.act(t, q, qd, y.z.get(name), params)
        actions[name] = action
        rhs = rhs + action.generalised
    if holding := {name: each for name, each in scene.friction.items() if each.karnopp}:
        held = karnopp_forces(holding, actions, mobility.accelerate, mobility.respond, rhs, t, q, qd, params)
        for name, action in held.items():
            rhs = rhs + action.generalised - actions[name].generalised
            actions[name] = action
    units = {name: each.force_per_load(t, q, qd, y.z.get(name), params) for name, each in scene.reaction_loaded.items()}
    pushes = [-each.apply_force(q, units[name][0], params) for name, each in scene.reaction_loaded.items()]
    friction = [*scene.event_driven.values()]
    # Columns: the motion without these elements, then a unit force along each of their rows.
    directions = [*(jnp.atleast_2d(each.direction(q, params)) for each in friction), *(push[None] for push in pushes)]
    free = mobility.solve(jnp.concatenate([rhs[None], *directions]).T if directions else rhs)
    moves, multipliers, yields, reported = free, None, None, linearized
    if linearized is not None:
        reactions = linearized.multipliers(free)
        moves = free + linearized.apply_force(reactions)
        multipliers, yields = (reactions[:, 0], reactions[:, 1:]) if directions else (reactions, None)
        if compliant is not None:
            multipliers = multipliers + compliant.force
            reported = linearized._replace(rows=linearized.rows + compliant.rate)
    if not directions:
        return Dynamics(t, y, mode, scene, unbound, actions, moves, None, None, reported, multipliers, None)

    qdd, minv_jt = moves[:, 0], moves[:, 1:].T
    along, loads, rounding = jnp.concatenate(directions), None, None
    if linearized is not None and multipliers is not None and yields is not None:
        unit = _ROUNDING * float(jnp.finfo(q.dtype).eps)
        rate = unit * jnp.sum(jnp.abs(along * free[None, :, 0]), axis=1) if scene.contacts else None
        rounding = unit * jnp.sum(along.T * free[:, 1:], axis=0), rate
        if scene.loaded:
            size = jnp.sum(jnp.abs(linearized.rows * free[None, :, 0]), axis=1) + jnp.abs(linearized.bias)
            size, scale = jax.lax.stop_gradient((size, jnp.diagonal(linearized.matrix)))
            mass = 1.0 / jnp.where(scale > 0, scale, 1.0)
            loads = _loads(scene, t, y, directions, linearized.rows, multipliers, yields, of_guides, mass, unit * size)
    modes = jnp.zeros(0, q.dtype) if mode is None else scene.split_modes(mode)[0]
    elements = assemble_friction(friction, along, minv_jt, rounding, loads, t, q, qd, params, qdd, modes)
    solved = solve_friction_forces(elements, modes)
    forces = [solved.force[part] for part in elements.parts]
    for force, (name, effect) in zip(forces, scene.event_driven.items(), strict=False):
        force = force if force.ndim == 0 else effect.stretch(force)
        actions[name] = Action(effect.apply_force(q, force, params), force)
    for force, push, name in zip(forces[len(friction) :], pushes, scene.reaction_loaded, strict=True):
        unit, rate = units[name]
        actions[name] = Action(-force * push, force * unit, rate)
    qdd = qdd - jnp.sum(elements.minv_jt * solved.force[:, None], axis=0)
    if multipliers is not None and yields is not None:
        multipliers = multipliers - apply_matrix(yields, solved.force)
    uniqueness = solved.margin if scene.loaded else None
    return Dynamics(t, y, mode, scene, unbound, actions, qdd, elements, solved, reported, multipliers, uniqueness)


def _loads(
    scene: Scene,
    t: Array,
    y: State,
    directions: list[Float[Array, "_ dof"]],
    constraints: Float[Array, "m dof"],
    multipliers: Float[Array, " m"],
    yields: Float[Array, "m n"],
    sides: dict[str, Scalar],
    mass: Float[Array, " m"],
    rounding: Float[Array, " m"],
) -> Loads:
    """Normal forces of the constraints that load friction, and their change by the friction forces.

    `directions`: the rows of each element. `constraints`: those of the constraints. `yields`: change of the multipliers
    with unit forces along the rows. `sides`: signs of the loads of guides. `mass`: multipliers per acceleration along
    the constraints. `rounding`: errors of these accelerations.
    """
    names, friction = scene.loaded, (*scene.event_driven.values(), *scene.reaction_loaded.values())
    rows = [(x, row) for x, each in zip(friction, directions, strict=True) for row in each]
    loaded = [x.load_constraint for x, _ in rows]
    where = by_constraint(scene, t, y, jnp.arange(multipliers.shape[0]))
    chosen = dict(zip(scene.constraint_names, scene.constraints, strict=True))
    at = jnp.concatenate([where[name] for name in names])
    size = jnp.stack([chosen[name].per_multiplier(t, y.q, scene.params) for name in names])
    loads = np.array([[name == each for name in names] for each in loaded])
    on = jnp.asarray(loads, y.q.dtype)
    drives: list[Scalar | None] = [None for _ in rows]
    for i, (element, row) in enumerate(rows):
        if element.transmits:
            k, square = names.index(loaded[i] or ""), jnp.sum(row * row)
            torque = -jnp.sum(jnp.unstack(constraints[at])[k] * row)
            torque = torque / (jnp.unstack(size)[k] * jnp.where(square > 0, square, 1.0))
            on = jnp.where(loads & (np.arange(len(rows)) == i)[:, None], jnp.abs(torque), on)
            drives[i] = jnp.where(torque < 0, -1.0, 1.0)
    mass = jax.lax.stop_gradient(jnp.abs(size)) * mass[at]
    return Loads(
        on,
        size * multipliers[at],
        size[:, None] * yields[at],
        jnp.asarray([0.0 if isinstance(chosen[name], Contact) else -1.0 for name in names], y.q.dtype),
        jnp.stack([sides.get(name, jnp.zeros_like(t)) for name in names]),
        mass,
        mass * rounding[at],
        tuple(drives),
    )


def _compliant(scene: Scene, t: Array, y: State) -> Action:
    """Forces of the compliant contacts, among the multipliers of all constraints, and in `rate` their rows."""
    where, dof = parts(scene.constraints, t, y.q, y.qd, scene.params), y.q.shape[0]
    force = jnp.zeros(where[-1].stop, y.q.dtype)
    rows = jnp.zeros((where[-1].stop, dof), y.q.dtype)
    for part, each in zip(where, scene.constraints, strict=True):
        if isinstance(each, Contact) and each.compliant is not None:
            rate, pull = jax.vjp(lambda qd, each=each: each.rate(t, y.q, qd, scene.params), y.qd)
            push = each.compliant.force(-each.error(t, y.q, scene.params)[0], -rate[0])
            force, rows = force.at[part].set(push), rows.at[part].set(pull(jnp.ones_like(rate))[0])
    return Action(jnp.sum(rows * force[:, None], axis=0), force, rows)


def by_constraint(scene: Scene, t: Array, y: State, values: Array) -> dict[str, Array]:
    """An array over the equations (multipliers, rows) in parts, by the names of the constraints."""
    where = parts(scene.constraints, t, y.q, y.qd, scene.params)
    return {name: values[part] for name, part in zip(scene.constraint_names, where, strict=True)}


def from_dynamics(get: Callable[[Dynamics], _Value], t: Scalar, y: State, scene: Scene, mode: Modes = None) -> _Value:
    """`get(forward_dynamics(t, y, scene, mode))`, a pytree of arrays, evaluated in scalars as a whole.

    Laws, loads and solves have small arrays like the terms of the Lagrangian; see `in_scalars`.

    **Returns:**

    The result of `get`.
    """
    return in_scalars(lambda t, y, mode: get(forward_dynamics(t, y, scene, mode)), t, y, mode, seed=y.q)


def vector_field(t: Scalar, y: State, scene: Scene, mode: Modes = None) -> State:
    """Right-hand side of `y' = field(t, y)`; NaN if the equations do not hold, see `Dynamics.uniqueness`.

    **Returns:**

    The rates, a `State`: velocities, accelerations, and rates of the effects' states.
    """
    return from_dynamics(lambda dynamics: dynamics.rate, t, y, scene, mode)
