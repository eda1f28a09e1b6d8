"""Viscous friction."""

from collections.abc import Mapping
from typing import ClassVar

from .._core.parameters import Number, parameter
from .._core.shapes import Scalar
from ._law import NO_STRIBECK_EFFECT, AbstractForceLaw, register_law


@register_law
class Viscous(AbstractForceLaw):
    """Friction in proportion to velocity, `F = Fv v`.

    **Arguments:**

    - `Fv`: coefficient [N s/m], >= 0.

    **Raises:**

    - `ValueError` if `Fv` is out of range or no number.
    """

    Fv: Number = parameter("Fv", "N s/m", lower=0.0)
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "in proportion to velocity"
    equations: ClassVar[tuple[str, ...]] = ("Fv v",)
    valid_at_any_speed: ClassVar[bool] = True
    limitations: ClassVar[Mapping[str, str]] = {**AbstractForceLaw.limitations, "stick-slip": NO_STRIBECK_EFFECT}

    def force(self, v: Scalar) -> Scalar:
        """Friction force [N] at velocity `v` [m/s]."""
        return self.Fv * v

    def mujoco(self) -> dict[str, Number]:
        """Damping of a joint."""
        return {"damping": self.Fv}

    def modelica(self) -> str:
        """A table without a force at rest."""
        return ""
