"""The vector field of a scene, with only the terms the scene holds."""

from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ..effects import Action, Friction, Power
from ..friction import AbstractHoldingLaw
from ..mechanics import MotionEquations, motion_equations
from ..numerics import solve_positive_definite
from ._contact import Contact, contact, contact_forces, contact_guards, next_modes, stop_slip
from ._scene import Scene

# Modes of the set-valued friction elements; None where the scene has none.
Modes: TypeAlias = Any

# Sweeps of projected Gauss-Seidel over holding elements that are coupled through the mechanism.
_HOLDING_SWEEPS = 50


class State(NamedTuple):
    """State of a scene: coordinates and velocities, shape `[dof]`, and the effects' own states by name.

    The modes of set-valued friction elements come beside it, an array of -1, 0, +1 in the order of
    `Scene.exact_names`, or None where there are none.
    """

    q: Float[Array, " dof"]
    qd: Float[Array, " dof"]
    z: dict[str, PyTree]


class _Resolved(NamedTuple):
    """Equations of motion, every effect's action, accelerations, and the friction elements with a mode, if any."""

    equations: MotionEquations
    actions: dict[str, Action]
    qdd: Float[Array, " dof"]
    found: Contact | None


def _resolve(scene: Scene, t: Float[Array, ""], y: State, mode: Modes) -> _Resolved:
    """Solve for the accelerations, and for the forces that depend on them."""
    equations = motion_equations(scene.lagrangian, t, y.q, y.qd, scene.params)
    actions, rhs = {}, equations.load
    exact, holding = {}, {}
    for name, effect in zip(scene.names, scene.effects, strict=True):
        if isinstance(effect, Friction) and effect.exact:
            exact[name] = effect
            continue
        action = effect.act(t, y.q, y.qd, y.z.get(name), scene.params)
        actions[name] = action
        rhs = rhs + action.generalised
        if isinstance(effect, Friction) and effect.holding:
            holding[name] = effect
    if holding:
        held = _hold(scene, holding, actions, equations, rhs, t, y)
        for name, action in held.items():
            rhs = rhs + action.generalised - actions[name].generalised
            actions[name] = action
    qdd = solve_positive_definite(equations.mass, rhs)
    if not exact:
        return _Resolved(equations, actions, qdd, None)
    assert mode is not None
    found = contact(list(exact.values()), t, y.q, y.qd, scene.params, equations.mass, qdd)
    forces = contact_forces(found, mode)
    for i, (name, effect) in enumerate(exact.items()):
        actions[name] = Action(effect.push(y.q, forces[i]), forces[i])
    return _Resolved(equations, actions, qdd - jnp.sum(found.reach * forces[:, None], axis=0), found)


def _hold(
    scene: Scene,
    elements: dict[str, Friction],
    slipping: dict[str, Action],
    equations: MotionEquations,
    rhs: Float[Array, " dof"],
    t: Float[Array, ""],
    y: State,
) -> dict[str, Action]:
    """Forces of the elements that hold: what keeps the slip velocity constant, within the limits of stick.

    With directions D (rows), the slip acceleration is `D qdd + dD/dt qd - belt'`; each holding force F enters it
    as `-D M^-1 D^T F`. Elements are solved one after the other, several of them in repeated sweeps, which
    converge because that matrix is positive semidefinite.
    """
    names = list(elements)
    active, limits, rows = [], [], []
    free = rhs
    for name in names:
        effect, law = elements[name], elements[name].law
        assert isinstance(law, AbstractHoldingLaw)
        holds = law.holds(effect.slip(t, y.q, y.qd))
        free = free - jnp.where(holds, slipping[name].generalised, 0.0)
        load = effect.load(t, y.q, y.qd, scene.params)
        one = jnp.ones_like(t)
        pair = [law.limit(-one), law.limit(one)]
        limits.append(pair if load is None else [load * x for x in pair])
        active.append(holds)
        rows.append(effect.direction(y.q))
    reach = [solve_positive_definite(equations.mass, row) for row in rows]
    qdd = solve_positive_definite(equations.mass, free)
    drive = [_slip_acceleration(elements[name], t, y, qdd) for name in names]
    coupling = [[jnp.sum(a * b) for b in reach] for a in rows]

    def sweep(forces: list[Array]) -> list[Array]:
        new = list(forces)
        for i in range(len(names)):
            others = sum(coupling[i][j] * new[j] for j in range(len(names)) if j != i)
            force = jnp.clip((drive[i] - others) / coupling[i][i], -limits[i][0], limits[i][1])
            new[i] = jnp.where(active[i], force, 0.0)
        return new

    forces = sweep([jnp.zeros_like(t) for _ in names])
    if len(names) > 1:
        forces = jax.lax.fori_loop(0, _HOLDING_SWEEPS, lambda _, f: sweep(f), forces)
    return {
        name: Action(
            jnp.where(on, elements[name].push(y.q, force), slipping[name].generalised),
            jnp.where(on, force, slipping[name].force),
        )
        for name, on, force in zip(names, active, forces, strict=True)
    }


def _slip_acceleration(effect: Friction, t: Float[Array, ""], y: State, qdd: Float[Array, " dof"]) -> Float[Array, ""]:
    """Rate of the slip velocity if the accelerations were `qdd`."""
    return jax.jvp(effect.slip, (t, y.q, y.qd), (jnp.ones_like(t), y.qd, qdd))[1]


def scene_field(t: Float[Array, ""], y: State, scene: Scene, mode: Modes = None) -> State:
    """Right-hand side of `y' = field(t, y)`."""
    resolved = _resolve(scene, t, y, mode)
    return State(y.qd, resolved.qdd, {name: resolved.actions[name].rate for name in y.z})


def scene_guards(
    t: Float[Array, ""], y: State, scene: Scene, mode: Modes, rest: Float[Array, ""]
) -> Float[Array, " guards"]:
    """Guards that are positive while the modes hold; see `contact_guards`."""
    return contact_guards(_contact(t, y, scene, mode), mode, rest)


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
    none = jnp.zeros(len(scene.exact_names), y.q.dtype)
    found = _contact(t, y, scene, none)
    elements = [effect for effect in scene.effects if isinstance(effect, Friction) and effect.exact]
    speed = jnp.stack([jnp.sum(jnp.abs(e.direction(y.q) * y.qd)) + jnp.abs(e.belt(t)) for e in elements])
    rounding = 8.0 * float(jnp.finfo(y.q.dtype).eps) * jax.lax.stop_gradient(speed)
    still = jnp.abs(found.v) <= jnp.maximum(rounding, rest)
    mode = next_modes(found, jnp.sign(found.v), still, jnp.zeros_like(still))
    return y._replace(qd=stop_slip(found, y.qd, mode == 0)), mode


def scene_overload(t: Float[Array, ""], y: State, scene: Scene, mode: Modes) -> Float[Array, " n"]:
    """By how much the force of each sticking element exceeds its limit, in limits; 0 in slip."""
    found = _contact(t, y, scene, mode)
    force = contact_forces(found, mode)
    limit = jnp.where(force > 0, found.upper, found.lower)
    excess = (jnp.abs(force) - limit) / jnp.where(limit > 0, limit, 1.0)
    return jnp.where(mode == 0, excess, 0.0)


def scene_stick(t: Float[Array, ""], y: State, scene: Scene, mode: Modes) -> State:
    """State with the slip velocity of sticking elements, which drifts with the error of integration, set to zero."""
    return y._replace(qd=stop_slip(_contact(t, y, scene, mode), y.qd, mode == 0))


def scene_drifts(scene: Scene) -> bool:
    """Whether stick drifts with the error of integration: not where it holds one coordinate at a constant speed."""
    elements = [effect for effect in scene.effects if isinstance(effect, Friction) and effect.exact]
    return any(element.along is not None or callable(element.belt_velocity) for element in elements)


def _contact(t: Float[Array, ""], y: State, scene: Scene, mode: Modes) -> Contact:
    found = _resolve(scene, t, y, mode).found
    assert found is not None
    return found


def scene_forces(t: Float[Array, ""], y: State, scene: Scene, mode: Modes = None) -> dict[str, Array]:
    """Force of each effect in its own terms, by name."""
    actions = _resolve(scene, t, y, mode).actions
    return {name: actions[name].force for name in scene.names}


def scene_power(t: Float[Array, ""], y: State, scene: Scene, mode: Modes = None) -> Power:
    """Power [W] from outside into the mechanism and its effects, and absorbed by friction.

    A Lagrangian that depends on time by itself supplies `-dL/dt`.
    """
    actions = _resolve(scene, t, y, mode).actions
    own = jax.grad(lambda t: scene.lagrangian(t, y.q, y.qd, scene.params))(t)
    supplied, absorbed = -own, jnp.zeros_like(t)
    for name, effect in zip(scene.names, scene.effects, strict=True):
        power = effect.power(t, y.q, y.qd, actions[name])
        supplied, absorbed = supplied + power.supplied, absorbed + power.absorbed
    return Power(supplied, absorbed)


def check_scene(scene: Scene, y: State) -> None:
    """Check shapes of everything the scene's functions return.

    **Raises:**

    - `ValueError` naming the function, the shape it returned and the shape that is needed.
    """
    t = y.q[0]
    energy: Any = jax.eval_shape(scene.lagrangian, t, y.q, y.qd, scene.params)
    if getattr(energy, "shape", None) != ():
        raise ValueError(
            f"The Lagrangian must return one number [J], shape (), but it returned {energy}. With q and qd of shape"
            f" {y.q.shape}, index the coordinates (qd[0]) or sum over them."
        )
    for name, effect in zip(scene.names, scene.effects, strict=True):
        effect.check(y.q, y.qd, scene.params, name)
