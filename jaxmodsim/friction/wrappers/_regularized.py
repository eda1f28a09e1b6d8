"""Smooth execution of a set-valued law."""

from typing import ClassVar

import jax.numpy as jnp

from ..._core.parameters import Number, parameter
from ..._core.safe import bounded_ratio
from ..._core.shapes import Scalar
from .._law import AbstractForceLaw, AbstractSetValuedLaw, register_law
from ._wrapper import AbstractWrapper, set_valued_law


@register_law
class Regularized(AbstractWrapper, AbstractForceLaw):
    """A set-valued law made smooth over a stated width: `F = sliding_force(v) tanh(v/width) + viscous_force(v)`.

    A load below the limit creeps at about `width * load/static_limit` instead of resting, and the equations become
    stiff at the rate `sliding_force(0)/(m width)`. Where the limit of stick is above the slip force at zero velocity
    (`Coulomb` with `Fs`), the force passes through a smooth hump about `2 width` wide.

    **Arguments:**

    - `law`: `Coulomb`, `Stribeck` or another set-valued law.
    - `width`: velocity at which the force has 76 % of its level [m/s], > 0; in runs with tolerances, >= `atol`.

    **Raises:**

    - `ValueError` if `law` is not set-valued or `width` is out of range.
    """

    law: AbstractSetValuedLaw = set_valued_law("Regularized")
    width: Number = parameter("width", "m/s", lower=0.0, strict=True, execution=True)
    stiff: ClassVar[bool] = True
    description: ClassVar[str] = "smooth over `width`; creeps below the limit"
    equations: ClassVar[tuple[str, ...]] = ("sliding_force(v) tanh(v/width) + viscous_force(v)",)
    execution: ClassVar[str] = "default solver `Rodas5P`"
    valid_at_any_speed: ClassVar[bool] = True

    def formulas(self) -> tuple[str, ...]:
        """Of the law inside, with its sign made smooth."""
        first, *rest = self.law.formulas()
        return first.replace("sign(v)", "tanh(v/width)"), *rest, f"width = {float(self.width):.4g} m/s"

    def force(self, v: Scalar) -> Scalar:
        """Friction force [N] at velocity `v` [m/s]."""
        v = jnp.asarray(v)
        level, spread = self.law.sliding_force(v), 0.5 * bounded_ratio(v, self.width)
        direction = jnp.where(v < 0, -1.0, 1.0).astype(v.dtype)
        # At rest, but on the side that v is on: a law may have other parameters for either direction.
        rest = direction * float(jnp.finfo(v.dtype).tiny)
        excess = self.law.static_limit(direction) - self.law.sliding_force(rest)
        return (level + excess * jnp.exp(-spread * spread)) * jnp.tanh(v / self.width) + self.law.viscous_force(v)
