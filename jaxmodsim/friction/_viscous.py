"""Viscous friction."""

from typing import ClassVar

from jaxtyping import Array, Float

from .._core.parameters import Number, parameter
from ._law import AbstractForceLaw


class Viscous(AbstractForceLaw):
    """Friction in proportion to velocity, `F = Fv v`.

    **Arguments:**

    - `Fv`: coefficient [N s/m], >= 0.

    **Raises:**

    - `ValueError` if `Fv` is out of range or no number.
    """

    Fv: Number = parameter("Fv", "N s/m", lower=0.0)
    stiff: ClassVar[bool] = False

    def force(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Friction force [N] at velocity `v` [m/s]."""
        return self.Fv * v
