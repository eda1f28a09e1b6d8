"""The model of a fit, a scene or a law by itself: its numbers by the names of the fit."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..friction import AbstractLaw
from ..scene import Friction, Scene, replace_numbers, scene_numbers

PREFIX = "law."


def _nothing(t: Array, q: Array, qd: Array, p: Any) -> Array:
    del t, q, p
    return 0.0 * qd[0]


def holder_of(law: AbstractLaw) -> Scene:
    """A scene of the law alone, which gives its numbers their names and ranges."""
    return Scene(_nothing, effects=(Friction(law, name="law"),))


def law_of(holder: Scene) -> AbstractLaw:
    """The law that such a scene holds."""
    friction = holder.effects[0]
    assert isinstance(friction, Friction)
    return friction.law


def model_numbers(model: eqx.Module | None) -> dict[str, np.ndarray]:
    """All numbers of a scene or of a law by name; none of anything else."""
    if isinstance(model, AbstractLaw):
        numbers = scene_numbers(holder_of(model))
        return {k.removeprefix(PREFIX): np.asarray(x) for k, x in numbers.items() if k != PREFIX + "belt_velocity"}
    return {k: np.asarray(x) for k, x in scene_numbers(model).items()} if isinstance(model, Scene) else {}


def with_numbers(model: eqx.Module, numbers: Mapping[str, Any]) -> eqx.Module:
    """The scene or law with all its numbers replaced.

    **Raises:**

    - `ValueError` if its numbers are others by name or shape.
    """
    if not isinstance(model, Scene | AbstractLaw):
        raise ValueError(f"model must be a Scene or a law, but {model!r} was given.")
    own = model_numbers(model)
    missing, extra = [k for k in numbers if k not in own], [k for k in own if k not in numbers]
    if missing or extra:
        raise ValueError(
            f"The model is not the one that was fitted: it lacks {', '.join(missing) or 'nothing'}, and has"
            f" {', '.join(extra) or 'nothing'} that was not there."
        )
    for name, number in numbers.items():
        if np.shape(number) != np.shape(own[name]):
            raise ValueError(
                f"The model is not the one that was fitted: {name} has the shape {np.shape(own[name])}, but"
                f" {np.shape(number)} was fitted."
            )
    if isinstance(model, Scene):
        return replace_numbers(model, {k: jnp.asarray(x) for k, x in numbers.items()})
    return law_of(replace_numbers(holder_of(model), {PREFIX + k: jnp.asarray(x) for k, x in numbers.items()}))
