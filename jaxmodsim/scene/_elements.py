"""Single numbers of a scene by name: those of `scene_numbers`, with `[i]` behind for an entry of an array."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from ._names import replace_numbers, scene_numbers
from ._scene import Scene


def elements(scene: Scene) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Each single number by name: the name of its array, and where it is in there."""
    return {
        leaf + (f"[{','.join(map(str, index))}]" if index else ""): (leaf, index)
        for leaf, array in scene_numbers(scene).items()
        for index in np.ndindex(array.shape)
    }


def read_element(scene: Scene, name: str) -> float:
    """A single number."""
    leaf, index = elements(scene)[name]
    return float(np.asarray(scene_numbers(scene)[leaf])[index])


def replace_elements(scene: Scene, values: Mapping[str, Any]) -> Scene:
    """The scene with these single numbers replaced."""
    found, numbers, changed = elements(scene), scene_numbers(scene), {}
    for name, value in values.items():
        leaf, index = found[name]
        changed[leaf] = jnp.asarray(changed.get(leaf, numbers[leaf])).at[index].set(value)
    return replace_numbers(scene, changed)
