"""The elasto-plastic law."""

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.parameters import Number, parameter
from .._core.safe import decay_mean
from .._core.shapes import Scalar
from ._bristle import ONE_STATE, STRIBECK_CURVE, bristle_passivity, stribeck_curve
from ._law import MOST_STICTION, AbstractDynamicLaw, register_law

# Steps of order 2 through the transition between elastic and plastic in `step_exact`, and the slip in limit deflections
# that they cover; after that the bristle is all but at its limit, and one step does the rest.
_SUBSTEPS = 6
_TRANSITION = 2.0


@register_law
class ElastoPlastic(AbstractDynamicLaw):
    """The elasto-plastic law: LuGre whose bristle gives way only beyond a break-away deflection.

    `z' = v (1 - alpha u)` with `u = sigma0 z sign(v)/g(v)` the bristle's force in limits,
    `F = sigma0 z + sigma1 z' + sigma2 v`, `g(v) = Fc + (Fs - Fc) exp(-(v/vs)^2)`. `alpha` is 0 below the break-away
    force `Fba` and while the surfaces move back, 1 at the limit, and half a sine between: below Fba the bristle is a
    spring, and nothing creeps, where LuGre does. The break-away deflection of the paper is `Fba/sigma0`.

    **Arguments:**

    - `sigma0`: bristle stiffness [N/m], > 0.
    - `sigma1`: bristle damping [N s/m], >= 0.
    - `sigma2`: viscous coefficient [N s/m], >= 0.
    - `Fba`: force up to which the bristle is elastic [N], >= 0.
    - `Fc`: Coulomb force [N], > Fba.
    - `Fs`: stiction force [N], >= Fc.
    - `vs`: Stribeck velocity [m/s], > 0.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.

    ??? cite "Reference"

        ```bibtex
        @article{dupont2002single,
            author={Dupont, Pierre and Hayward, Vincent and Armstrong, Brian and Altpeter, Friedhelm},
            title={Single state elastoplastic friction models},
            journal={IEEE Transactions on Automatic Control},
            volume={47}, number={5}, pages={787--792}, year={2002},
        }
        ```
    """

    sigma0: Number = parameter("sigma0", "N/m", lower=0.0, strict=True)
    sigma1: Number = parameter("sigma1", "N s/m", lower=0.0)
    sigma2: Number = parameter("sigma2", "N s/m", lower=0.0)
    Fba: Number = parameter("Fba", "N", lower=0.0)
    Fc: Number = parameter("Fc", "N", lower="Fba", strict=True)
    Fs: Number = parameter("Fs", "N", lower="Fc", most=MOST_STICTION)
    vs: Number = parameter("vs", "m/s", lower=0.0, strict=True)
    stiff: ClassVar[bool] = True
    description: ClassVar[str] = "bristle that is elastic below `Fba`: no creep"
    equations: ClassVar[tuple[str, ...]] = (
        "sigma0 z + sigma1 z' + sigma2 v",
        "z' = v (1 - alpha u)",
        "alpha = 0 for u <= Fba/g(v), half a sine up to 1 at u = 1",
        "u = sigma0 z sign(v)/g(v)",
        STRIBECK_CURVE,
    )
    limitations: ClassVar[Mapping[str, str]] = ONE_STATE
    mujoco_lacks: ClassVar[str] = (
        ", for its bristle has no break-away force: LuGre with the same sigma0, sigma1, sigma2, Fc, Fs and vs is the"
        " nearest, and creeps under a vibrating load"
    )
    example: ClassVar[Mapping[str, float]] = {"Fba": 0.7}
    passivity = bristle_passivity

    def stribeck_curve(self, v: Scalar) -> Scalar:
        """g(v) [N]: the bristle force that steady slip at `v` [m/s] tends to."""
        return stribeck_curve(v, self.Fc, self.Fs, self.vs)

    def _plastic(self, u: Scalar, elastic: Scalar) -> Scalar:
        """`alpha` at the load `u`; `elastic` is where it begins to rise. Both in limits."""
        span = jnp.clip((u - elastic) / (1.0 - elastic), 0.0, 1.0)
        return 0.5 - 0.5 * jnp.cos(jnp.pi * span)

    def initial_state(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        """Undeflected bristle, 0 m."""
        return jnp.zeros_like(v)

    def zdot(self, v: Scalar, z: Scalar) -> Scalar:
        """Z' [m/s] at slip velocity `v` [m/s] and deflection `z` [m]."""
        g = self.stribeck_curve(v)
        u = self.sigma0 * z * jnp.sign(v) / g
        return v * (1.0 - self._plastic(u, self.Fba / g) * u)

    def force_given_zdot(self, v: Scalar, z: Scalar, rate: Scalar) -> Scalar:
        """Friction force [N] at slip velocity `v` [m/s], deflection `z` [m] and its `rate` [m/s]."""
        return self.sigma0 * z + self.sigma1 * rate + self.sigma2 * v

    def stored_energy(self, z: Scalar) -> Scalar:
        """Elastic energy [J] of the bristle."""
        return 0.5 * self.sigma0 * z * z

    def step_exact(self, v: Scalar, z: Scalar, dt: Scalar) -> Scalar:
        """Deflection [m] after `dt` [s] at constant `v` [m/s].

        Exact in the elastic range and beyond the limit; between, steps of order 2 that cannot pass the limit.
        """
        # At rest either side will do: nothing moves, but the derivative by v must not be lost.
        g, side = self.stribeck_curve(v), jnp.where(v < 0, -1.0, 1.0).astype(z.dtype)
        elastic, u = self.Fba / g, side * self.sigma0 * z / g
        y = side * v * dt * self.sigma0 / g
        straight = jnp.minimum(y, jnp.maximum(elastic - u, 0.0))
        beyond = u > 1.0
        near = jnp.minimum(y - straight, _TRANSITION)
        inner, steps = u + straight, [near / _SUBSTEPS] * _SUBSTEPS + [y - straight - near]

        def leak(u: Array, y: Array, alpha: Array) -> Array:
            x = alpha * y
            return jnp.minimum(u * jnp.exp(-x) + y * decay_mean(x), 1.0)

        for step in steps:
            middle = leak(inner, 0.5 * step, self._plastic(inner, elastic))
            inner = leak(inner, step, self._plastic(middle, elastic))
        outer = 1.0 + (u - 1.0) * jnp.exp(-y)
        return side * g / self.sigma0 * jnp.where(beyond, outer, inner)
