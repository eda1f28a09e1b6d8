"""The LuGre law."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics import Number, parameter
from ._law import AbstractDynamicLaw


class LuGre(AbstractDynamicLaw):
    """The LuGre law: an elastic bristle of mean deflection z [m] that yields as the surfaces slip.

    `z' = v - sigma0 |v| z / g(v)`, `F = sigma0 z + sigma1 z' + sigma2 v`,
    `g(v) = Fc + (Fs - Fc) exp(-(v/vs)^2)`. At constant velocity F tends to `g(v) sign(v) + sigma2 v`, and
    `|z| <= Fs/sigma0` is never left. With a constant sigma1 the law is passive from v to F if and only if
    `sigma2 > sigma1 (Fs - Fc)/Fc`; the stick mode of a mass m is critically damped at `sigma1 = 2 sqrt(m sigma0)`.

    **Arguments:**

    - `sigma0`: bristle stiffness [N/m], > 0.
    - `sigma1`: bristle damping [N s/m], >= 0.
    - `sigma2`: viscous coefficient [N s/m], >= 0.
    - `Fc`: Coulomb force [N], > 0.
    - `Fs`: stiction force [N], >= Fc.
    - `vs`: Stribeck velocity [m/s], > 0.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.

    ??? cite "Reference"

        ```bibtex
        @article{canudas1995new,
            author={Canudas de Wit, C. and Olsson, H. and Astrom, K. J. and Lischinsky, P.},
            title={A new model for control of systems with friction},
            journal={IEEE Transactions on Automatic Control},
            volume={40}, number={3}, pages={419--425}, year={1995},
        }
        ```
    """

    sigma0: Number = parameter("sigma0", "N/m", lower=0.0, strict=True)
    sigma1: Number = parameter("sigma1", "N s/m", lower=0.0)
    sigma2: Number = parameter("sigma2", "N s/m", lower=0.0)
    Fc: Number = parameter("Fc", "N", lower=0.0, strict=True)
    Fs: Number = parameter("Fs", "N", lower="Fc")
    vs: Number = parameter("vs", "m/s", lower=0.0, strict=True)
    stiff: ClassVar[bool] = True

    def _level(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """g(v) [N]: the bristle force that steady slip at `v` tends to."""
        ratio = v / self.vs
        return self.Fc + (self.Fs - self.Fc) * jnp.exp(-ratio * ratio)

    def state0(self) -> Float[Array, ""]:
        """Undeflected bristle, 0 m."""
        return jnp.zeros_like(self.sigma0)

    def rate(self, v: Float[Array, ""], z: Float[Array, ""]) -> Float[Array, ""]:
        """Z' [m/s] at slip velocity `v` [m/s] and deflection `z` [m]."""
        return v - self.sigma0 * jnp.abs(v) / self._level(v) * z

    def force(self, v: Float[Array, ""], z: Float[Array, ""]) -> Float[Array, ""]:
        """Friction force [N] at slip velocity `v` [m/s] and deflection `z` [m]."""
        return self.sigma0 * z + self.sigma1 * self.rate(v, z) + self.sigma2 * v

    def stored(self, z: Float[Array, ""]) -> Float[Array, ""]:
        """Elastic energy [J] of the bristle."""
        return 0.5 * self.sigma0 * z * z

    def advance(self, distance: Float[Array, ""], v: Float[Array, ""], z: Float[Array, ""]) -> Float[Array, ""]:
        """Deflection [m] after slipping `distance` [m] at constant `v` [m/s].

        z' = v - sigma0 |v| z / g is linear in z at fixed v: with `x = sigma0 |distance| / g`,
        `z1 = z exp(-x) + distance (1 - exp(-x))/x`.
        """
        x = self.sigma0 * jnp.abs(distance) / self._level(v)
        small = x < 1e-4
        safe = jnp.where(small, 1.0, x)
        growth = jnp.where(small, 1.0 - 0.5 * x + x * x / 6.0, -jnp.expm1(-safe) / safe)
        return z * jnp.exp(-x) + distance * growth
