"""Karnopp's execution of a set-valued law."""

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..._core.parameters import Number, parameter
from ..._core.shapes import Scalar
from .._law import AbstractKarnoppLaw, AbstractSetValuedLaw, register_law
from ._wrapper import AbstractWrapper, set_valued_law


@register_law
class DeadZone(AbstractWrapper, AbstractKarnoppLaw):
    """A set-valued law run by Karnopp's rule: velocities up to `width` count as rest.

    In the band friction equals the load, up to the limit of stick, so that the velocity keeps its value, which need
    not be zero; outside it the law's slip force acts. Meant for a fixed step: the field jumps at the edges of the
    band, and a band narrower than one step's change of velocity is stepped over.

    **Arguments:**

    - `law`: `Coulomb`, `Stribeck` or another set-valued law.
    - `width`: half-width of the band [m/s], > 0.

    **Raises:**

    - `ValueError` if `law` is not set-valued or `width` is out of range.

    ??? cite "Reference"

        ```bibtex
        @article{karnopp1985computer,
            author={Karnopp, Dean},
            title={Computer simulation of stick-slip friction in mechanical dynamic systems},
            journal={Journal of Dynamic Systems, Measurement, and Control},
            volume={107}, number={1}, pages={100--103}, year={1985},
        }
        ```
    """

    law: AbstractSetValuedLaw = set_valued_law("DeadZone")
    width: Number = parameter("width", "m/s", lower=0.0, strict=True, execution=True)
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "Karnopp: velocities up to `width` count as rest"
    equations: ClassVar[tuple[str, ...]] = ("sliding_force(v) sign(v) + viscous_force(v) beyond the band",)
    execution: ClassVar[str] = "fixed step `dt=`"
    # One step changes the velocity of 1 kg under 1 N by half of the band, which is twice the width.
    example: ClassVar[Mapping[str, float]] = {"width": 1e-4}
    example_step: ClassVar[float | None] = 1e-4

    def holds(self, v: Scalar) -> Bool[Array, ""]:
        """Whether `v` [m/s] lies in the band, edges included."""
        return jnp.abs(v) <= self.width

    def static_limit(self, direction: Scalar) -> Scalar:
        """Largest holding force [N]."""
        return self.law.static_limit(direction)

    def force(self, v: Scalar) -> Scalar:
        """Slip force [N] at velocity `v` [m/s]."""
        return self.law.sliding_force(v) * jnp.sign(v) + self.law.viscous_force(v)
