"""Names of the numbers of a scene, or of a law alone."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from .._core.functions import StateDependent
from .._core.parameters import Range, ranges_of
from ..friction import AbstractAsymmetric
from ._quantities import in_units_of, slip_unit
from ._scene import Scene
from ._signal import Signal
from .forces._friction import Friction

# Levels of the scene that do not appear in names.
_SILENT = ("law", "place", "amount", "number")

_Module = TypeVar("_Module", bound=eqx.Module)


def scene_numbers(scene: eqx.Module) -> dict[str, Array]:
    """All numbers of a scene, or of another module such as a law, by name.

    The name of an entry of `params` is its key (`m`, nested `arm.m`), that of a number of an effect is `effect.number`
    (`friction.Fc`, `friction.belt_velocity`). Wrapped laws add no level (`friction.width`); the two sides of a law that
    depends on direction do (`friction.forward.Fc`). The names of a law alone have no effect in front (`Fc`,
    `forward.Fc`). A `Signal` has its values (`u.values`); its times are constants.

    **Returns:**

    The arrays by name, in the order of the leaves.

    **Raises:**

    - `ValueError` if two numbers have the same name; give one of the effects another name.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    print(list(jms.scene.scene_numbers(scene)))
    ```

    ```text
    ['k', 'm', 'friction.Fc', 'friction.Fs', 'friction.belt_velocity']
    ```
    """
    return {name: leaf for name, leaf in _named_leaves(scene) if name is not None}


def _named_leaves(scene: eqx.Module) -> list[tuple[str | None, Any]]:
    """All leaves in order; times of signals, which are constants, have no name."""
    leaves, _ = jtu.tree_flatten_with_path(scene)
    named: list[tuple[str | None, Any]] = []
    for path, leaf in leaves:
        if isinstance(_owners(scene, path)[-1], Signal) and path[-1].name == "t":
            named.append((None, leaf))
            continue
        name = _name(scene, path)
        if any(name == other for other, _ in named):
            raise ValueError(f"Two numbers of the scene come to the name {name!r}; give the effect another name.")
        named.append((name, leaf))
    return named


def _owners(scene: eqx.Module, path: tuple[Any, ...]) -> list[Any]:
    """The objects around the leaf at `path`, from the scene inwards."""
    owners: list[Any] = [scene]
    for key in path[:-1]:
        owners.append(_step(owners[-1], key))
    return owners


def scene_ranges(scene: eqx.Module) -> dict[str, Range]:
    """Admissible range of each number that has one, by the names of `scene_numbers`.

    A limit that is another number has that number's full name.

    **Returns:**

    The ranges by name.
    """
    leaves, _ = jtu.tree_flatten_with_path(scene)
    ranges: dict[str, Range] = {}
    for path, _ in leaves:
        owners = _owners(scene, path)
        while isinstance(owners[-1], StateDependent):  # the range is that of the parameter
            owners, path = owners[:-1], path[:-1]
        owner, last = owners[-1], path[-1]
        if isinstance(last, jtu.GetAttrKey):
            allowed, beside = ranges_of(owner).get(last.name), path[:-1]
        elif isinstance(owners[-2], AbstractAsymmetric):  # a number of an asymmetric law for negative slip
            allowed, beside = ranges_of(owners[-2].forward).get(last.key), (*path[:-2], jtu.GetAttrKey("forward"))
        else:
            continue
        if allowed is None:
            continue
        if isinstance(allowed.lower, str):
            there = isinstance(owner, dict) and allowed.lower in owner
            limit = (*path[:-1], jtu.DictKey(allowed.lower)) if there else (*beside, jtu.GetAttrKey(allowed.lower))
            allowed = replace(allowed, lower=_name(scene, limit))
        if isinstance(scene, Scene) and path[0].name == "effects" and not isinstance(owner, Friction):
            allowed = in_units_of(scene, scene.effects[path[1].idx], allowed)
        ranges[_name(scene, path)] = allowed
    return ranges


def scene_units(scene: eqx.Module) -> dict[str, str]:
    """Unit of each number with a known unit, by the names of `scene_numbers`.

    **Returns:**

    The units by name, such as `N s/m`; `""` for a number without a unit.
    """
    units = {name: allowed.unit for name, allowed in scene_ranges(scene).items()}
    if isinstance(scene, Scene):
        for name, effect in scene.friction.items():
            units[f"{name}.belt_velocity"] = slip_unit(scene, effect).replace(" ", "/s ", 1) + "/s"
    return units


def replace_numbers(scene: _Module, values: dict[str, Any]) -> _Module:
    """The scene or law with new values of the numbers of these names, which are those of `scene_numbers`.

    **Returns:**

    A new object of the same structure. Unknown names have no effect; ranges are not checked.

    **Raises:**

    - `ValueError` as `scene_numbers`.
    """
    leaves = [leaf if name is None else values.get(name, leaf) for name, leaf in _named_leaves(scene)]
    return jtu.tree_unflatten(jtu.tree_structure(scene), leaves)


def _step(node: Any, key: Any) -> Any:
    if isinstance(key, jtu.GetAttrKey):
        return getattr(node, key.name)
    return node[key.idx if isinstance(key, jtu.SequenceKey) else key.key]


def _name(scene: eqx.Module, path: tuple[Any, ...]) -> str:
    words = [str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))) for key in path]
    if not isinstance(scene, Scene):
        return ".".join(_telling(words))
    if words[0] == "effects":
        words = [scene.names[int(words[1])], *_telling(words[2:])]
    elif words[0] == "constraints":
        words = [scene.constraint_names[int(words[1])], *_telling(words[2:])]
    elif words[0] == "lagrangian":
        words = _telling(words)
    elif words[0] == "params":
        words = words[1:] or ["params"]
    return ".".join(words)


def _telling(words: list[str]) -> list[str]:
    return [word for word in words if word not in _SILENT]


def elements(scene: Scene) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Each single number by name: the name of its array, and its index there.

    **Returns:**

    Name, such as `friction.k[0]`, to `(friction.k, (0,))`; a number alone has the empty index `()`.

    **Raises:**

    - `ValueError` as `scene_numbers`.
    """
    return {
        leaf + (f"[{','.join(map(str, index))}]" if index else ""): (leaf, index)
        for leaf, array in scene_numbers(scene).items()
        for index in np.ndindex(array.shape)
    }


def read_element(scene: Scene, name: str) -> float:
    """A single number.

    **Returns:**

    The number as a `float`, in its own unit.

    **Raises:**

    - `KeyError` for a name that is not in `elements`.
    """
    leaf, index = elements(scene)[name]
    return float(np.asarray(scene_numbers(scene)[leaf])[index])


def replace_elements(scene: Scene, values: Mapping[str, Any]) -> Scene:
    """The scene with new values of these single numbers.

    **Returns:**

    A new scene of the same structure.

    **Raises:**

    - `KeyError` for a name that is not in `elements`.
    """
    known, numbers, changed = elements(scene), scene_numbers(scene), {}
    for name, value in values.items():
        leaf, index = known[name]
        changed[leaf] = jnp.asarray(changed.get(leaf, numbers[leaf])).at[index].set(value)
    return replace_numbers(scene, changed)
