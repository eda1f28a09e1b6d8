"""The Dahl law."""

import math
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._core.parameters import Number, parameter
from .._core.safe import magnitude
from .._core.shapes import Scalar
from ._bristle import ONE_STATE, YIELDS, relax_exact
from ._law import AbstractPlanarLaw, register_law
from ._passivity import Passivity


@register_law
class Dahl(AbstractPlanarLaw):
    """The Dahl law: a force that grows with displacement like a stress with strain, up to the Coulomb force.

    `z' = v - sigma0 |v| z/Fc`, `F = sigma0 z`: a function of the displacement alone, whatever the speed. Cycled between
    +-A the force at reversal is `Fc tanh(sigma0 A/Fc)`, the loss per cycle `4 Fc [A - (Fc/sigma0) tanh(sigma0 A/Fc)]`.
    The form with exponent one of the paper. Slip in the plane: v, z and F are vectors.

    **Arguments:**

    - `sigma0`: stiffness at rest [N/m], > 0.
    - `Fc`: Coulomb force [N], > 0.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.

    ??? cite "Reference"

        ```bibtex
        @techreport{dahl1968solid,
            author={Dahl, P. R.},
            title={A solid friction model},
            institution={The Aerospace Corporation}, number={TOR-0158(3107-18)-1}, year={1968},
        }
        ```
    """

    sigma0: Number = parameter("sigma0", "N/m", lower=0.0, strict=True)
    Fc: Number = parameter("Fc", "N", lower=0.0, strict=True)
    stiff: ClassVar[bool] = True
    description: ClassVar[str] = "force grows with displacement up to `Fc`"
    equations: ClassVar[tuple[str, ...]] = ("sigma0 z", "z' = v - sigma0 |v| z/Fc")
    limitations: ClassVar[Mapping[str, str]] = ONE_STATE | YIELDS

    def initial_state(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        """Undeflected, 0 m."""
        return jnp.zeros_like(v)

    def zdot(self, v: Float[Array, "..."], z: Float[Array, "..."]) -> Float[Array, "..."]:
        """Z' [m/s] at slip velocity `v` [m/s] and deflection `z` [m]."""
        return v - self.sigma0 * magnitude(v) / self.Fc * z

    def force_given_zdot(
        self, v: Float[Array, "..."], z: Float[Array, "..."], rate: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Friction force [N] at deflection `z` [m]."""
        return self.sigma0 * z

    def stored_energy(self, z: Float[Array, "..."]) -> Scalar:
        """Elastic energy [J]."""
        return 0.5 * self.sigma0 * jnp.sum(z * z)

    def step_exact(self, v: Float[Array, "..."], z: Float[Array, "..."], dt: Scalar) -> Float[Array, "..."]:
        """Deflection [m] after `dt` [s] at constant `v` [m/s], exactly."""
        return relax_exact(v, z, dt, self.sigma0 * magnitude(v) / self.Fc)

    def passivity(self) -> Passivity:
        """Always passive: with the bristle force `Fc u` the dissipation is `|v| Fc u^2`."""
        return Passivity(True, 0.0, math.inf, "Dahl is always passive: it dissipates |v| (sigma0 z)^2/Fc.")

    def mujoco(self) -> dict[str, PyTree]:
        """LuGre without damping and Stribeck effect, at any Stribeck velocity."""
        return {"damping": 0.0, "lugre": (self.sigma0, 0.0, self.Fc, self.Fc, 1.0)}
