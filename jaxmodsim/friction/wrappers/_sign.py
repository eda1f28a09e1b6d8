"""Naive execution of a set-valued law."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._law import AbstractForceLaw, AbstractSetValuedLaw
from .._refuse import set_valued_law


class Sign(AbstractForceLaw):
    """A set-valued law with a plain `sign(v)`: no stick at all. Kept to show why that fails.

    A fixed step chatters about zero velocity, and an adaptive one grinds to a halt there.

    **Arguments:**

    - `law`: `Coulomb`, `Stribeck` or another set-valued law.

    **Raises:**

    - `ValueError` if `law` is not set-valued.
    """

    law: AbstractSetValuedLaw = set_valued_law("Sign")
    stiff: ClassVar[bool] = False

    def force(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Friction force [N] at velocity `v` [m/s]; exactly zero at `v = 0`."""
        return self.law.sliding_force(v) * jnp.sign(v) + self.law.viscous_force(v)
