"""A step of a scene that is implicit in friction and explicit in everything else."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from .._core.arrays import PerDof, Scalar
from .._core.monotone import solve_monotone
from ._dynamics import State, load_and_mobility
from ._scene import Scene
from .forces._friction import Friction


class _StepElement(NamedTuple):
    """A friction element at the start of a step.

    - `effect`: the element, with its law at that state; `load`: its normal load, or None.
    - `rows`: slip velocities per unit of the velocities, shape `[components, dof]`.
    - `belt`: velocity of the surface at the end of the step, shape `[components]`.
    - `planar`: whether slip is a vector.
    """

    effect: Friction
    load: Scalar | None
    rows: Float[Array, "components dof"]
    belt: Float[Array, " components"]
    planar: bool

    def end(self, v: Float[Array, " components"], z: PyTree, h: Scalar) -> tuple[Array, PyTree]:
        """Force and state at the end of the step at the slip velocity `v` there."""
        force, z = self.effect.step_exact(v if self.planar else v[0], z, h, self.load)
        return jnp.atleast_1d(force), z


def check_step(scene: Scene) -> None:
    """Check that `scene_step` supports the scene.

    **Raises:**

    - `ValueError` naming the unsupported friction element or contact, and the remedy.
    """
    if events := {**scene.contacts, **scene.switches}:
        raise ValueError(f"ImplicitFriction takes no events, by which {', '.join(events)} changes: use another solver.")
    if scene.compliant:
        raise ValueError(
            f"ImplicitFriction takes no forces of contacts ({', '.join(scene.compliant)}): use another solver."
        )
    for name, effect in scene.friction.items():
        law, start = type(effect.law).__name__, f"ImplicitFriction: friction {name!r}"
        if effect.karnopp:
            raise ValueError(
                f"{start} is a DeadZone, which holds by knowing all other forces: wrap the law as Regularized(law,"
                " width) instead, or use another solver."
            )
        if effect.event_driven or effect.law.jumps:
            raise ValueError(
                f"{start} has a force that jumps at rest ({law}), so that position and velocity do not tell it: wrap"
                " the law as Regularized(law, width), however small the width, take a law with bristles (LuGre, Dahl,"
                " ElastoPlastic), or run it by events, with another solver."
            )
        if effect.load_constraint is not None:
            raise ValueError(
                f"{start} has the reaction of the constraint {effect.load_constraint!r} for its load, which this solver"
                " does not find together with friction: give normal_force as a function, or use another solver."
            )


def scene_step(scene: Scene, t0: Scalar, t1: Scalar, y: State) -> tuple[State, Bool[Array, ""]]:
    """State at `t1` after one step from `y` at `t0`, of order 1, and whether its equations were solved.

    Masses, directions, loads and all forces except friction are those at t0. Friction is that of the slip velocity and
    the state at t1: `v1 = v_free - h D M^-1 D^T F(v1, advance(v1, z0, h))`. Coordinates follow with the velocities at
    t1.

    **Returns:**

    `(State, solved)`, the second a boolean of shape `[]`.
    """
    q, qd, h = y.q, y.qd, t1 - t0
    scene = scene.bind_state(t0, q, qd)
    params = scene.params
    rhs, mobility = load_and_mobility(scene, scene.constraints, t0, q, qd)
    elements = {name: _element(effect, t0, t1, q, qd, params) for name, effect in scene.friction.items()}
    for name, effect in zip(scene.names, scene.effects, strict=True):
        if name not in elements:
            rhs = rhs + effect.act(t0, q, qd, y.z.get(name), params).generalised
    free = qd + h * mobility.accelerate(rhs)
    if not elements:
        return State(q + h * free, free, {}), jnp.array(True)

    def ends(v: Array) -> list[tuple[Array, PyTree]]:
        parts = jnp.split(v, starts)
        return [x.end(part, y.z.get(name), h) for part, (name, x) in zip(parts, elements.items(), strict=True)]

    def forces(v: Array) -> Array:
        return jnp.concatenate([force for force, _ in ends(v)])

    sizes = tuple(each.belt.shape[0] for each in elements.values())
    starts = [sum(sizes[:i]) for i in range(1, len(sizes))]
    rows = jnp.concatenate([each.rows for each in elements.values()])
    reach = mobility.respond(rows.T).T
    coupling = h * jnp.sum(rows[:, None, :] * reach[None, :, :], axis=2)
    belts = jnp.concatenate([each.belt for each in elements.values()])
    solution = solve_monotone(forces, jnp.sum(rows * free[None, :], axis=1) - belts, coupling, sizes)
    after = ends(solution.x)
    force = jnp.concatenate([force for force, _ in after])
    qd = free - h * jnp.sum(reach * force[:, None], axis=0)
    z = {name: z for name, (_, z) in zip(elements, after, strict=True) if name in y.z}
    return State(q + h * qd, qd, z), solution.solved


def _element(effect: Friction, t0: Array, t1: Array, q: Array, qd: Array, params: PyTree) -> _StepElement:
    slip = partial(effect.slip, t0, q, params=params)
    planar = jnp.ndim(slip(qd)) > 0
    rows = jax.jacfwd(slip)(qd) if planar else effect.direction(q, params)[None]
    belt = jnp.broadcast_to(effect.belt(t1), (rows.shape[0],))
    return _StepElement(effect, effect.load(t0, q, qd, params), rows, belt, planar)


def compensating_force(
    scene: Scene,
    t0: Scalar,
    t1: Scalar,
    y: State,
    advance: Callable[[Friction, Array, PyTree, Scalar, Scalar | None], tuple[Array, PyTree]] = Friction.step_exact,
) -> tuple[PerDof, dict[str, PyTree]]:
    """Force that compensates friction at the motion in `y`, and the states of the laws at `t1`.

    `advance(element, v, z, h, load)` returns the force of an element over the time h, and the state of its law after.

    **Returns:**

    Generalised force [N or N m], shape `[dof]`; and states by name.
    """
    scene = scene.bind_state(t0, y.q, y.qd)
    total, after = jnp.zeros_like(y.q), dict(y.z)
    for name, effect in scene.friction.items():
        v = effect.slip(t0, y.q, y.qd, scene.params)
        force, z = advance(effect, v, y.z.get(name), t1 - t0, effect.load(t0, y.q, y.qd, scene.params))
        total = total - effect.apply_force(y.q, force, scene.params)
        after |= {name: z} if name in y.z else {}
    return total, after
