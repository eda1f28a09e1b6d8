"""The vector field of a scene, with only the terms the scene holds."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..effects import Action, Friction, Power
from ..friction import AbstractHoldingLaw
from ..mechanics import MotionEquations, motion_equations
from ..numerics import solve_positive_definite
from ._scene import Scene

# Sweeps of projected Gauss-Seidel over holding elements that are coupled through the mechanism.
_HOLDING_SWEEPS = 50


class State(NamedTuple):
    """State of a scene: coordinates and velocities, shape `[dof]`, and the effects' own states by name."""

    q: Float[Array, " dof"]
    qd: Float[Array, " dof"]
    z: dict[str, PyTree]


def _resolve(
    scene: Scene, t: Float[Array, ""], y: State
) -> tuple[MotionEquations, dict[str, Action], Float[Array, " dof"]]:
    """Equations of motion, every effect's action, and the right-hand side with all forces in it."""
    equations = motion_equations(scene.lagrangian, t, y.q, y.qd, scene.params)
    actions, rhs = {}, equations.load
    for name, effect in zip(scene.names, scene.effects, strict=True):
        action = effect.act(t, y.q, y.qd, y.z.get(name), scene.params)
        actions[name] = action
        rhs = rhs + action.generalised
    holding = {
        name: effect
        for name, effect in zip(scene.names, scene.effects, strict=True)
        if isinstance(effect, Friction) and effect.holding
    }
    if holding:
        held = _hold(scene, holding, actions, equations, rhs, t, y)
        for name, action in held.items():
            rhs = rhs + action.generalised - actions[name].generalised
            actions[name] = action
    return equations, actions, rhs


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


def scene_field(t: Float[Array, ""], y: State, scene: Scene) -> State:
    """Right-hand side of `y' = field(t, y)`, in the form diffrax's `ODETerm` takes."""
    equations, actions, rhs = _resolve(scene, t, y)
    qdd = solve_positive_definite(equations.mass, rhs)
    return State(y.qd, qdd, {name: actions[name].rate for name in y.z})


def scene_forces(t: Float[Array, ""], y: State, scene: Scene) -> dict[str, Array]:
    """Force of each effect in its own terms, by name."""
    return {name: action.force for name, action in _resolve(scene, t, y)[1].items()}


def scene_power(t: Float[Array, ""], y: State, scene: Scene) -> Power:
    """Power [W] from outside into the mechanism and its effects, and absorbed by friction.

    A Lagrangian that depends on time by itself supplies `-dL/dt`.
    """
    actions = _resolve(scene, t, y)[1]
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
