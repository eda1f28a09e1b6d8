"""Coulomb friction with stiction."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics import Number, Range, as_number, parameter
from ._law import AbstractSetValuedLaw


def _number_or_none(value: object) -> Number | None:
    return None if value is None else as_number(value, name="Fs")


class Coulomb(AbstractSetValuedLaw):
    """Coulomb friction: `Fc sign(v)` in slip, anything up to `Fs` in stick.

    **Arguments:**

    - `Fc`: force in slip [N], >= 0.
    - `Fs`: largest force in stick [N], >= Fc. By default Fc, so that there is no stiction.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.
    """

    Fc: Number = parameter("Fc", "N", lower=0.0)
    Fs: Number | None = eqx.field(default=None, converter=_number_or_none, metadata={"range": Range("N", "Fc")})
    stiff: ClassVar[bool] = False

    def dry(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Magnitude [N] of the force in slip."""
        return jnp.broadcast_to(self.Fc, jnp.shape(v))

    def wet(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Coulomb friction has no viscous part: 0 N."""
        return jnp.zeros_like(v)

    def limit(self, direction: Float[Array, ""]) -> Float[Array, ""]:
        """Largest force in stick [N]."""
        del direction
        return self.Fc if self.Fs is None else self.Fs
