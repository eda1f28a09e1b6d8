"""Laws whose parameters depend on the direction of slip."""

from typing import Any, ClassVar, TypeVar, cast, overload

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics import as_number, ranges_of
from ._law import AbstractForceLaw, AbstractSetValuedLaw

_Law = TypeVar("_Law", AbstractForceLaw, AbstractSetValuedLaw)


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


@overload
def asymmetric(law: AbstractForceLaw, **backward: Any) -> AbstractForceLaw: ...
@overload
def asymmetric(law: AbstractSetValuedLaw, **backward: Any) -> AbstractSetValuedLaw: ...
def asymmetric(law: Any, **backward: Any) -> AbstractForceLaw | AbstractSetValuedLaw:
    """A law with other parameters for negative slip velocities.

    **Arguments:**

    - `law`: the law for positive slip: `Viscous`, or a set-valued law not yet wrapped
      (`Regularized(asymmetric(Coulomb(20.0), Fc=24.0), width=1e-3)`).
    - `backward`: the parameters that differ for negative slip, by name, in the law's own units.

    **Returns:**

    A law of the same kind, holding the laws `forward` and `backward`.

    **Raises:**

    - `ValueError` for a name that the law has not, a value out of range, or a law of another kind.
    """
    if not isinstance(law, AbstractForceLaw | AbstractSetValuedLaw) or not ranges_of(law):
        raise ValueError(f"asymmetric takes Viscous or a set-valued law, but {type(law).__name__} was given.")
    unknown = sorted(set(backward) - set(ranges_of(law)))
    if unknown or not backward:
        raise ValueError(
            f"asymmetric({type(law).__name__}) needs the parameters that differ for negative slip, among"
            f" {', '.join(ranges_of(law))}; given: {', '.join(unknown) or 'none'}."
        )
    names = tuple(backward)
    other = eqx.tree_at(
        lambda x: tuple(getattr(x, name) for name in names),
        law,
        tuple(as_number(backward[name], name=name) for name in names),
    )
    other.__check_init__()
    if isinstance(law, AbstractSetValuedLaw):
        return _AsymmetricSetValued(law, cast(AbstractSetValuedLaw, other))
    return _AsymmetricForce(law, cast(AbstractForceLaw, other))
