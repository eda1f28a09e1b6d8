"""The vector field of a scene, with only the terms the scene holds, and what a run asks beside it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core.depends import depends_on
from .._core.functions import real_array
from .._core.index_check import traced
from .._core.safe import safe_norm
from ..mechanics import energies, errors, motion_equations, project_position, project_velocity, rates
from ._event_driven import Contact, contact_guards, next_modes, stick_violation, stop_slip
from ._forward_dynamics import Dynamics, Modes, State, by_constraint, forward_dynamics
from ._scene import Scene
from .forces._effect import Power


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


def vector_field(t: Float[Array, ""], y: State, scene: Scene, mode: Modes = None) -> State:
    """Right-hand side of `y' = field(t, y)`; NaN where the equations do not hold, see `scene_validity_margins`."""
    resolved = forward_dynamics(scene, t, y, mode)
    qdd = resolved.qdd
    if resolved.validity_margins is not None:
        qdd = jnp.where(jnp.all(resolved.validity_margins > 0), qdd, jnp.nan)
    return State(y.qd, qdd, {name: resolved.actions[name].rate for name in y.z})


def scene_canonical(t: Float[Array, ""], y: State, scene: Scene, mode: Modes = None) -> State:
    """Rates of coordinates and momenta at the state `y`: `p' = dL/dq + Q + J^T lambda`, in the place of qd."""
    scene = scene.bind_time(t)
    resolved = forward_dynamics(scene, t, y, mode)
    push = jax.grad(scene.lagrangian, argnums=1)(t, y.q, y.qd, scene.params)
    for action in resolved.actions.values():
        push = push + action.generalised
    if resolved.restraint is not None and resolved.multipliers is not None:
        push = push + resolved.restraint.force(resolved.multipliers)
    if resolved.validity_margins is not None:
        push = jnp.where(jnp.all(resolved.validity_margins > 0), push, jnp.nan)
    return State(y.qd, push, {name: resolved.actions[name].rate for name in y.z})


def scene_guards(
    t: Float[Array, ""], y: State, scene: Scene, mode: Modes, rest: Float[Array, ""], tolerances: tuple[Array, Array]
) -> tuple[Float[Array, " guards"], Float[Array, " guards"]]:
    """Guards that are positive while the modes hold, and their tolerances; see `contact_guards`."""
    return contact_guards(_contact(t, y, scene, mode), mode, rest, tolerances)


def scene_switch(
    t: Float[Array, ""], y: State, scene: Scene, mode: Modes, fired: Bool[Array, " guards"]
) -> tuple[State, Float[Array, " n"]]:
    """State and modes after the guards that `fired`."""
    found = _contact(t, y, scene, mode)
    new = next_modes(found, mode, (mode == 0) | fired, fired & (mode == 0))
    return y._replace(qd=stop_slip(found, y.qd, new == 0)), new


def scene_modes(
    t: Float[Array, ""], y: State, scene: Scene, rest: Float[Array, ""]
) -> tuple[State, Float[Array, " n"]]:
    """State and modes to begin with: elements with no more slip velocity than `rest` or rounding stick if they can."""
    scene = scene.bind_time(t)
    elements = [*scene.event_driven.values()]
    none = jnp.zeros(len(elements), y.q.dtype)
    found = _contact(t, y, scene, none)
    speed = jnp.stack([jnp.sum(jnp.abs(e.direction(y.q, scene.params) * y.qd)) + jnp.abs(e.belt(t)) for e in elements])
    rounding = 8.0 * float(jnp.finfo(y.q.dtype).eps) * jax.lax.stop_gradient(speed)
    v = found.v[: len(elements)]
    still = jnp.abs(v) <= jnp.maximum(rounding, rest)
    mode = next_modes(found, jnp.sign(v), still, jnp.zeros_like(still))
    return y._replace(qd=stop_slip(found, y.qd, mode == 0)), mode


def scene_stick_violation(t: Float[Array, ""], y: State, scene: Scene, mode: Modes) -> Float[Array, " n"]:
    """By how much the force of each sticking element exceeds its limit, in limits; 0 in slip."""
    return stick_violation(_contact(t, y, scene, mode), mode)


def scene_stick(t: Float[Array, ""], y: State, scene: Scene, mode: Modes) -> State:
    """State with the slip velocity of sticking elements, which drifts with the error of integration, set to zero."""
    return y._replace(qd=stop_slip(_contact(t, y, scene, mode), y.qd, mode == 0))


def scene_drifts(scene: Scene) -> bool:
    """Whether stick drifts with the error of integration: not where it holds one coordinate at a constant speed."""
    return any(each.along is not None or callable(each.belt_velocity) for each in scene.event_driven.values())


def scene_energies(t: Float[Array, ""], y: State, scene: Scene) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Kinetic and potential energy [J] of the Lagrangian."""
    scene = scene.bind_time(t)
    return energies(scene.lagrangian, t, y.q, y.qd, scene.params)


def scene_mass(t: Float[Array, ""], y: State, scene: Scene) -> Float[Array, "dof dof"]:
    """Mass matrix [kg for lengths, kg m^2 for angles]."""
    scene = scene.bind_time(t)
    return motion_equations(scene.lagrangian, t, y.q, y.qd, scene.params).mass


def scene_project(t: Float[Array, ""], y: State, scene: Scene) -> State:
    """State moved onto the constraints: the coordinates, then the velocities there."""
    scene = scene.bind_time(t)
    mass = motion_equations(scene.lagrangian, t, y.q, y.qd, scene.params).mass
    q = project_position(scene.constraints, t, y.q, scene.params, mass)
    return y._replace(q=q, qd=project_velocity(scene.constraints, t, q, y.qd, scene.params, mass))


def scene_constraint_residual(t: Float[Array, ""], y: State, scene: Scene) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """How far coordinates and velocities are from the constraints, relative to their own size or to one.

    Each error is divided by the length of its gradient, which makes it a distance from its own surface: constraints
    that contradict each other show, too.
    """
    scene = scene.bind_time(t)
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
    return _reactions(t, y, scene, forward_dynamics(scene, t, y, mode))


def _reactions(t: Float[Array, ""], y: State, scene: Scene, resolved: Dynamics) -> dict[str, ConstraintReaction]:
    scene = scene.bind_time(t)
    if resolved.restraint is None or resolved.multipliers is None:
        return {}
    multipliers = by_constraint(scene, t, y, resolved.multipliers)
    rows = by_constraint(scene, t, y, resolved.restraint.rows)
    return {
        name: ConstraintReaction(
            multipliers[name],
            jnp.sum(rows[name] * multipliers[name][:, None], axis=0),
            each.force(t, y.q, scene.params, multipliers[name]),
        )
        for name, each in zip(scene.constraint_names, scene.constraints, strict=True)
    }


def _contact(t: Float[Array, ""], y: State, scene: Scene, mode: Modes) -> Contact:
    found = forward_dynamics(scene, t, y, mode).found
    assert found is not None
    return found


def scene_forces(t: Float[Array, ""], y: State, scene: Scene, mode: Modes = None) -> dict[str, Array]:
    """Force of each effect in its own terms, by name."""
    actions = forward_dynamics(scene, t, y, mode).actions
    return {name: actions[name].force for name in scene.names}


def scene_power(t: Float[Array, ""], y: State, scene: Scene, mode: Modes = None) -> dict[str, Power]:
    """Power [W] from outside into the mechanism and its effects, and absorbed by friction: of each effect by its name.

    Besides, under the name of a constraint what its motion in time supplies, and under `lagrangian` what a Lagrangian
    does that depends on time by itself, `-dL/dt`; not there where it does not.
    """
    scene = scene.bind_time(t)
    resolved = forward_dynamics(scene, t, y, mode)
    powers = {
        name: effect.power(t, y.q, y.qd, scene.params, resolved.actions[name])
        for name, effect in zip(scene.names, scene.effects, strict=True)
    }
    for name, reaction in _reactions(t, y, scene, resolved).items():
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
