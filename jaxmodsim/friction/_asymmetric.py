"""Laws whose parameters depend on the direction of slip."""

import dataclasses
from typing import Any, ClassVar, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics import Varying, ranges_of
from ._law import AbstractDynamicLaw, AbstractForceLaw, AbstractLaw, AbstractSetValuedLaw

_Law = TypeVar("_Law")


def _side(v: Float[Array, ""], forward: _Law, backward: _Law) -> _Law:
    """The law that holds at velocity `v`."""
    return jax.tree.map(lambda a, b: jnp.where(v < 0, b, a), forward, backward)


class _AsymmetricForce(AbstractForceLaw):
    """A function of velocity with a set of parameters for either direction."""

    forward: AbstractForceLaw
    backward: AbstractForceLaw
    stiff: ClassVar[bool] = False

    def force(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Friction force [N] at velocity `v` [m/s]."""
        return _side(v, self.forward, self.backward).force(v)


class _AsymmetricSetValued(AbstractSetValuedLaw):
    """A set-valued law with a set of parameters for either direction."""

    forward: AbstractSetValuedLaw
    backward: AbstractSetValuedLaw
    stiff: ClassVar[bool] = False

    def dry(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Magnitude [N] of the dry part in slip."""
        return _side(v, self.forward, self.backward).dry(v)

    def wet(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Smooth part [N]."""
        return _side(v, self.forward, self.backward).wet(v)

    def limit(self, direction: Float[Array, ""]) -> Float[Array, ""]:
        """Largest force in stick [N] against a load towards `direction`."""
        return _side(direction, self.forward, self.backward).limit(direction)


class _AsymmetricDynamic(AbstractDynamicLaw):
    """A law with a state, with a set of parameters for either direction."""

    forward: AbstractDynamicLaw
    backward: AbstractDynamicLaw

    @property
    def stiff(self) -> bool:  # type: ignore[override]
        """As the law is."""
        return self.forward.stiff

    def state0(self, v: Float[Array, "..."]) -> Any:
        """State at rest and unloaded."""
        return self.forward.state0(v)

    def rate(self, v: Float[Array, ""], z: Any) -> Any:
        """Time derivative of the state."""
        return _side(v, self.forward, self.backward).rate(v, z)

    def force(self, v: Float[Array, ""], z: Any) -> Float[Array, ""]:
        """Friction force [N]."""
        return _side(v, self.forward, self.backward).force(v, z)

    def stored(self, z: Any) -> Float[Array, ""]:
        """Energy [J] in the state: stiffness is one for both directions."""
        return self.forward.stored(z)

    def advance(self, v: Float[Array, ""], z: Any, dt: Float[Array, ""]) -> Any:
        """State after `dt` [s] at constant velocity."""
        return _side(v, self.forward, self.backward).advance(v, z, dt)


_KINDS = (
    (AbstractSetValuedLaw, _AsymmetricSetValued),
    (AbstractForceLaw, _AsymmetricForce),
    (AbstractDynamicLaw, _AsymmetricDynamic),
)


def asymmetric(law: _Law, **backward: Any) -> _Law:
    """A law with other parameters for negative slip velocities.

    **Arguments:**

    - `law`: the law for positive slip, any one with named parameters. Of a wrapped law the law inside is meant:
      `asymmetric(Regularized(Coulomb(20.0), width=1e-3), Fc=24.0)`.
    - `backward`: the parameters that differ for negative slip, by name, in the law's own units. Not the stiffness of
      an elastic element: what is stored in one direction comes back in the other.

    **Returns:**

    A law of the same kind, for slip along a line.

    **Raises:**

    - `ValueError` for a name that the law has not, a value out of range, or what is no such law.
    """
    inner = getattr(law, "law", None)
    if isinstance(inner, AbstractLaw):
        return eqx.tree_at(lambda x: x.law, cast(Any, law), asymmetric(inner, **backward))
    kinds = [wrapper for kind, wrapper in _KINDS if isinstance(law, kind)]
    if not kinds or hasattr(law, "forward"):
        given = "a law that is asymmetric already" if hasattr(law, "forward") else repr(law)
        raise ValueError(f"asymmetric needs a law with parameters of its own, but {given} was given.")
    module = cast(eqx.Module, law)
    allowed = ranges_of(module)
    unknown = sorted(set(backward) - set(allowed))
    if unknown or not backward:
        raise ValueError(
            f"asymmetric({type(law).__name__}) needs the parameters that differ for negative slip, among"
            f" {', '.join(allowed)}; given: {', '.join(unknown) or 'none'}."
        )
    for name in backward:
        if allowed[name].unit == "N/m":
            raise ValueError(
                f"asymmetric({type(law).__name__}): {name} stores energy, so it must be the same in both directions."
            )
    converters = {f.name: f.metadata["converter"] for f in dataclasses.fields(cast(Any, law)) if f.name in backward}
    values = [_like(getattr(law, name), converters[name](value)) for name, value in backward.items()]
    other = eqx.tree_at(
        lambda x: [getattr(x, name) for name in backward], law, values, is_leaf=lambda x: isinstance(x, Varying)
    )
    other.__check_init__()
    return cast(_Law, kinds[0](cast(Any, law), cast(Any, other)))


def _like(old: Any, number: Any) -> Any:
    """The new number, varying as the old one does."""
    return Varying(_like(old.number, number), old.fn) if isinstance(old, Varying) else number
