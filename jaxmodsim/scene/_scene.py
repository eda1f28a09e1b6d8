"""What is in a scene: data only."""

from functools import partial
from typing import Any

import equinox as eqx
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from ..effects import AbstractEffect, Friction
from ..mechanics import Lagrangian
from ..numerics import as_function, as_real


def _params(params: PyTree) -> PyTree:
    return jtu.tree_map_with_path(lambda path, leaf: as_real(leaf, name=f"params{jtu.keystr(path)}"), params)


def _effects(effects: Any) -> tuple[AbstractEffect, ...]:
    if isinstance(effects, AbstractEffect) or not isinstance(effects, tuple | list):
        raise ValueError(f"effects must be a tuple of effects, as in effects=(effect,), but got {effects!r}.")
    for effect in effects:
        if not isinstance(effect, AbstractEffect):
            raise ValueError(
                f"effects must hold AppliedForce or Friction objects, but it holds {effect!r}. A friction law goes"
                " into Friction(law)."
            )
    return tuple(effects)


class Scene(eqx.Module):
    """A mechanism and the effects on it.

    A scene is a pytree whose leaves are all its numbers, so `jax.grad`, `jax.vmap` and `equinox.tree_at` work on it,
    and changing a number never recompiles. Functions are compared by identity: define a Lagrangian once, not as a
    fresh lambda in every call.

    **Arguments:**

    - `lagrangian`: `L(t, q, qd, params)` -> energy [J], a scalar; a pure JAX function, q and qd of shape `[dof]`.
    - `params`: pytree of real numbers or arrays for the Lagrangian and the applied forces. Integers become
      floating; what is no number (sizes, options) belongs into the functions.
    - `effects`: tuple of `AppliedForce` and `Friction`.

    **Raises:**

    - `ValueError` naming the entry that is no number, no effect, or has another's name.
    """

    lagrangian: Lagrangian = eqx.field(converter=partial(as_function, name="Scene lagrangian"))
    params: PyTree[Array] = eqx.field(default_factory=dict, converter=_params)
    effects: tuple[AbstractEffect, ...] = eqx.field(default=(), converter=_effects)

    def __check_init__(self) -> None:
        """Refuse two effects of one name."""
        given = [effect.name for effect in self.effects if effect.name is not None]
        for name in given:
            if given.count(name) > 1:
                raise ValueError(f"Two effects have the name {name!r}; names of effects must differ.")
        if self.exact_names and any(isinstance(x, Friction) and x.holding for x in self.effects):
            raise ValueError(
                f"{', '.join(self.exact_names)}: set-valued laws of one scene run either all by events or all by"
                " DeadZone, as each must know the forces of the others. Wrap all of them in DeadZone, or none."
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each effect: its own, or its kind's with a number from the second of the kind on."""
        taken = {effect.name for effect in self.effects if effect.name is not None}
        names: list[str] = []
        for effect in self.effects:
            name, count = effect.name or effect.default_name, 1
            while effect.name is None and (name in taken or name in names):
                count += 1
                name = f"{effect.default_name}_{count}"
            names.append(name)
        return tuple(names)

    @property
    def exact_names(self) -> tuple[str, ...]:
        """Names of the friction elements that run by events, in the order of their modes."""
        return tuple(
            name
            for name, effect in zip(self.names, self.effects, strict=True)
            if isinstance(effect, Friction) and effect.exact
        )

    def state0(self) -> dict[str, PyTree]:
        """Own state of each effect that has one, at rest, by effect name."""
        states = {name: effect.state0() for name, effect in zip(self.names, self.effects, strict=True)}
        return {name: state for name, state in states.items() if state is not None}
