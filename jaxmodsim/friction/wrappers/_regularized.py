"""Smooth execution of a set-valued law."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._core.parameters import Number, parameter
from ..._core.safe import bounded_ratio
from .._law import AbstractForceLaw, AbstractSetValuedLaw
from .._refuse import set_valued_law


class Regularized(AbstractForceLaw):
    """A set-valued law made smooth over a stated width: `F = dry(v) tanh(v/width) + wet(v)`.

    A load below the limit creeps at about `width * load/limit` instead of resting, and the equations become
    stiff at the rate `dry(0)/(m width)`. Where the limit of stick is above the slip force at zero velocity (`Coulomb`
    with `Fs`), the force passes through a smooth hump about `2 width` wide.

    **Arguments:**

    - `law`: `Coulomb`, `Stribeck` or another set-valued law.
    - `width`: velocity at which the force has 76 % of its level [m/s], > 0; in runs with tolerances, >= `atol`.

    **Raises:**

    - `ValueError` if `law` is not set-valued or `width` is out of range.
    """

    law: AbstractSetValuedLaw = set_valued_law("Regularized")
    width: Number = parameter("width", "m/s", lower=0.0, strict=True, execution=True)
    stiff: ClassVar[bool] = True

    def force(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Friction force [N] at velocity `v` [m/s]."""
        v = jnp.asarray(v)
        level, spread = self.law.sliding_force(v), 0.5 * bounded_ratio(v, self.width)
        direction = jnp.where(v < 0, -1.0, 1.0).astype(v.dtype)
        # At rest, but on the side that v is on: a law may have other parameters for either direction.
        rest = direction * float(jnp.finfo(v.dtype).tiny)
        excess = self.law.static_limit(direction) - self.law.sliding_force(rest)
        return (level + excess * jnp.exp(-spread * spread)) * jnp.tanh(v / self.width) + self.law.viscous_force(v)
