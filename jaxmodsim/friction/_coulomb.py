"""Coulomb friction with stiction."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import PyTree

from .._core.parameters import Number, optional_parameter, parameter
from .._core.shapes import Scalar
from ._law import MOST_STICTION, NO_STICTION_IN_MUJOCO, AbstractSetValuedLaw, register_law
from ._law_case import STANDARD, LawCase, steady_curve


@register_law
class Coulomb(AbstractSetValuedLaw):
    """Coulomb friction: `Fc sign(v)` in slip, anything up to `Fs` in stick.

    **Arguments:**

    - `Fc`: force in slip [N], >= 0.
    - `Fs`: largest force in stick [N], >= Fc. By default Fc, so that there is no stiction.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.
    """

    Fc: Number = parameter("Fc", "N", lower=0.0)
    Fs: Number | None = optional_parameter("Fs", "N", lower="Fc", most=MOST_STICTION)
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "one force in slip, stiction up to `Fs`"
    equations: ClassVar[tuple[str, ...]] = ("Fc sign(v)",)
    valid_at_any_speed: ClassVar[bool] = True
    mujoco_lacks: ClassVar[str] = NO_STICTION_IN_MUJOCO

    def sliding_force(self, v: Scalar) -> Scalar:
        """Magnitude [N] of the force in slip."""
        return jnp.broadcast_to(self.Fc, jnp.shape(v))

    def viscous_force(self, v: Scalar) -> Scalar:
        """Coulomb friction has no viscous part: 0 N."""
        return jnp.zeros_like(v)

    def static_limit(self, direction: Scalar) -> Scalar:
        """Largest force in stick [N]."""
        return jnp.asarray(self.Fc if self.Fs is None else self.Fs)

    def lugre_numbers(self, vs: float) -> dict[str, PyTree]:
        """With stiction that falls over the velocity `vs`."""
        return {"Fc": self.Fc, "Fs": self.Fc if self.Fs is None else self.Fs, "vs": vs, "sigma2": 0.0}

    def mujoco(self) -> dict[str, PyTree] | str:
        """Dry friction of a joint, which is one force."""
        stiction = self.Fs is not None and float(self.Fs) > float(self.Fc)
        return AbstractSetValuedLaw.mujoco(self) if stiction else {"frictionloss": self.Fc}

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """Without and with stiction."""
        flat = steady_curve(STANDARD["Fc"], STANDARD["Fc"], 0.0)
        return (
            LawCase("Coulomb", cls.standard(Fs=STANDARD["Fc"]), flat),
            LawCase("Coulomb, stiction", cls.standard(), flat),
        )
