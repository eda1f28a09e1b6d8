"""Coulomb friction with stiction."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.parameters import Number, optional_parameter, parameter
from ._law import AbstractSetValuedLaw


class Coulomb(AbstractSetValuedLaw):
    """Coulomb friction: `Fc sign(v)` in slip, anything up to `Fs` in stick.

    **Arguments:**

    - `Fc`: force in slip [N], >= 0.
    - `Fs`: largest force in stick [N], >= Fc. By default Fc, so that there is no stiction.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.
    """

    Fc: Number = parameter("Fc", "N", lower=0.0)
    Fs: Number | None = optional_parameter("Fs", "N", lower="Fc")
    stiff: ClassVar[bool] = False

    def sliding_force(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Magnitude [N] of the force in slip."""
        return jnp.broadcast_to(self.Fc, jnp.shape(v))

    def viscous_force(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Coulomb friction has no viscous part: 0 N."""
        return jnp.zeros_like(v)

    def static_limit(self, direction: Float[Array, ""]) -> Float[Array, ""]:
        """Largest force in stick [N]."""
        del direction
        return jnp.asarray(self.Fc if self.Fs is None else self.Fs)
