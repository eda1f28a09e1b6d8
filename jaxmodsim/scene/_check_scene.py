"""Checks of the values that a scene's functions return, before it runs."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._core.functions import depends_on, real_array
from .._core.trace_checks import traced
from ..mechanics import AbstractConstraint
from ._dynamics import State
from ._scene import Scene
from ._signal import signals_at, signals_of


def check_scene(scene: Scene, y: State) -> None:
    """Check the shapes of all values that the scene's functions return, and the indices that they use.

    **Raises:**

    - `ValueError` naming the function, the shape it returned and the shape that is needed, or the index that is out of
      range (see `traced` for the indices that it checks); also if the number of coordinate names is wrong.
    """
    t, named = y.q[0], len(scene.coordinates)
    if named not in (0, y.q.shape[0]):
        raise ValueError(
            f"The scene has {named} names of coordinates ({', '.join(scene.coordinates)}), but q has the length"
            f" {y.q.shape[0]}: pass a q0 of {named} numbers, or a name for each number."
        )
    moving = signals_at(scene.params, t, linear=False)
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
    for name, effect in scene.impact_friction.items():
        if effect.slip_shape(y.q, scene.params) != ():
            raise ValueError(
                f"Friction {name!r} slides in several directions under the reaction of a Contact, whose impacts know"
                " friction in one direction alone: give the load as a Constraint or as a function, wrap the law as"
                " Regularized(law, width), which takes no part in impacts, or give a scalar displacement."
            )
    for name, constraint in zip(scene.constraint_names, scene.constraints, strict=True):
        constraint.check(y.q, y.qd, scene.params, name)
        if signals_of(moving):
            _check_at_rest(constraint, t, y, moving, name)
        size = jax.eval_shape(constraint.rate, t, y.q, y.qd, scene.params).shape[0]
        if name in scene.loaded and size != 1:
            raise ValueError(
                f"Constraint {name!r} loads friction (normal_force={name!r}), so it must be one equation, but it has"
                f" {size}. Give each direction a Constraint of its own."
            )


def _check_at_rest(constraint: AbstractConstraint, t: Array, y: State, params: PyTree, name: str) -> None:
    """Refuse a constraint that a linear signal moves; in `params` only linear signals are signals, the rest numbers."""

    def at(time: Array) -> Array:
        there = signals_at(params, time)
        values = constraint.error(t, y.q, there), constraint.rate(t, y.q, y.qd, there)
        return jnp.concatenate([x for x in values if x is not None])

    if depends_on(at, t):
        raise ValueError(
            f"Constraint {name!r} depends on a linear Signal, but constraints do not see the velocity of a Signal. Give"
            " the motion as a function of t in the constraint."
        )
