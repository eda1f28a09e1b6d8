"""Naive execution of a set-valued law."""

from typing import ClassVar

import jax.numpy as jnp

from ..._core.shapes import Scalar
from .._law import AbstractForceLaw, AbstractSetValuedLaw, register_law
from ._wrapper import AbstractWrapper, set_valued_law


@register_law
class Sign(AbstractWrapper, AbstractForceLaw):
    """A set-valued law with a plain `sign(v)`: no stick at all. Kept to show why that fails.

    A fixed step chatters about zero velocity, and an adaptive one grinds to a halt there.

    **Arguments:**

    - `law`: `Coulomb`, `Stribeck` or another set-valued law.

    **Raises:**

    - `ValueError` if `law` is not set-valued.
    """

    law: AbstractSetValuedLaw = set_valued_law("Sign")
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "plain `sign(v)`, kept to show why it fails"
    equations: ClassVar[tuple[str, ...]] = ("sliding_force(v) sign(v) + viscous_force(v)",)
    execution: ClassVar[str] = "fixed step `dt=`"
    valid_at_any_speed: ClassVar[bool] = True
    jumps: ClassVar[bool] = True
    example_step: ClassVar[float | None] = 1e-4

    def force(self, v: Scalar) -> Scalar:
        """Friction force [N] at velocity `v` [m/s]; exactly zero at `v = 0`."""
        return self.law.sliding_force(v) * jnp.sign(v) + self.law.viscous_force(v)
