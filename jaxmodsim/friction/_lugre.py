"""The LuGre law."""

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._core.parameters import Number, optional_parameter, parameter
from .._core.safe import bounded_ratio, magnitude
from .._core.shapes import Scalar
from ._bristle import (
    ONE_STATE,
    STRIBECK_CURVE,
    YIELDS,
    bristle_passivity,
    relax_exact,
    stribeck_curve,
)
from ._law import MOST_STICTION, AbstractPlanarLaw, register_law
from ._law_case import STANDARD, LawCase, stribeck_case

# A fit starts with a break-away distance of two milliseconds at top speed, a tenth of critical damping in stick, and a
# break-away force of 1.1 Fc that falls over a twentieth of the speed.
_BREAK_AWAY_TIME, _DAMPING, _BREAK_AWAY, _FALL = 2e-3, 0.1, 1.1, 0.05


@register_law
class LuGre(AbstractPlanarLaw):
    """The LuGre law: an elastic bristle of mean deflection z [m] that yields as the surfaces slip.

    `z' = v - sigma0 |v| z / g(v)`, `F = sigma0 z + sigma1 z' + sigma2 v`,
    `g(v) = Fc + (Fs - Fc) exp(-(v/vs)^2)`. At constant velocity F tends to `g(v) sign(v) + sigma2 v`, and
    `|z| <= Fs/sigma0` is never left. With a constant sigma1 the law is passive from v to F if and only if
    `sigma2 > sigma1 (Fs - Fc)/Fc`; the stick mode of a mass m is critically damped at
    `sigma1 + sigma2 = 2 sqrt(m sigma0)`.
    With `vd` the bristle damping fades as the surfaces slip, `sigma1 exp(-(v/vd)^2)`, which takes the condition away
    at high speed.

    Slip in the plane: v, z and F are vectors, |v| their magnitude.

    **Arguments:**

    - `sigma0`: bristle stiffness [N/m], > 0.
    - `sigma1`: bristle damping [N s/m], >= 0.
    - `sigma2`: viscous coefficient [N s/m], >= 0.
    - `Fc`: Coulomb force [N], > 0.
    - `Fs`: stiction force [N], >= Fc.
    - `vs`: Stribeck velocity [m/s], > 0.
    - `vd`: velocity over which sigma1 fades [m/s], > 0; by default it does not.

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
    Fs: Number = parameter("Fs", "N", lower="Fc", most=MOST_STICTION)
    vs: Number = parameter("vs", "m/s", lower=0.0, strict=True)
    vd: Number | None = optional_parameter("vd", "m/s", lower=0.0, strict=True)
    stiff: ClassVar[bool] = True
    description: ClassVar[str] = "bristle with a Stribeck effect; `vd` lets its damping fade with speed"
    equations: ClassVar[tuple[str, ...]] = (
        "sigma0 z + sigma1 z' + sigma2 v",
        "z' = v - sigma0 |v| z/g(v)",
        STRIBECK_CURVE,
    )
    limitations: ClassVar[Mapping[str, str]] = ONE_STATE | YIELDS
    mujoco_lacks: ClassVar[str] = (
        " whose sigma1 fades (vd): leave vd out, and see check_passivity(law) for what that means"
    )
    passivity = bristle_passivity

    def stribeck_curve(self, v: Float[Array, "..."]) -> Scalar:
        """g(v) [N]: the bristle force that steady slip at `v` [m/s] tends to."""
        return stribeck_curve(magnitude(v), self.Fc, self.Fs, self.vs)

    def initial_state(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        """Undeflected bristle, 0 m."""
        return jnp.zeros_like(v)

    def zdot(self, v: Float[Array, "..."], z: Float[Array, "..."]) -> Float[Array, "..."]:
        """Z' [m/s] at slip velocity `v` [m/s] and deflection `z` [m]."""
        return v - self.sigma0 * magnitude(v) / self.stribeck_curve(v) * z

    def force_given_zdot(
        self, v: Float[Array, "..."], z: Float[Array, "..."], rate: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Friction force [N] at slip velocity `v` [m/s], deflection `z` [m] and its `rate` [m/s]."""
        sigma1 = self.sigma1
        if self.vd is not None:
            ratio = bounded_ratio(magnitude(v), self.vd)
            sigma1 = sigma1 * jnp.exp(-ratio * ratio)
        return self.sigma0 * z + sigma1 * rate + self.sigma2 * v

    def stored_energy(self, z: Float[Array, "..."]) -> Scalar:
        """Elastic energy [J] of the bristle."""
        return 0.5 * self.sigma0 * jnp.sum(z * z)

    def step_exact(self, v: Float[Array, "..."], z: Float[Array, "..."], dt: Scalar) -> Float[Array, "..."]:
        """Deflection [m] after `dt` [s] at constant `v` [m/s], exactly: the rate is linear in z."""
        return relax_exact(v, z, dt, self.sigma0 * magnitude(v) / self.stribeck_curve(v))

    def mujoco(self) -> dict[str, PyTree] | str:
        """MuJoCo's motor has the bristle with a constant sigma1."""
        if self.vd is not None:
            return AbstractPlanarLaw.mujoco(self)
        return {"damping": self.sigma2, "lugre": (self.sigma0, self.sigma1, self.Fc, self.Fs, self.vs)}

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """With constant damping, which is not passive, and with damping that fades."""
        fading = cls.standard(vd=STANDARD["vs"])
        return stribeck_case("LuGre", cls.standard()), stribeck_case("LuGre, vd", fading)

    @classmethod
    def fit_start(cls, m: float, Fc: float, Fv: float, v_max: float) -> "LuGre":
        """A stiff bristle that is lightly damped."""
        sigma0 = Fc / (_BREAK_AWAY_TIME * v_max)
        sigma1 = 2.0 * _DAMPING * np.sqrt(m * sigma0)
        return cls(sigma0=sigma0, sigma1=sigma1, sigma2=Fv, Fc=Fc, Fs=_BREAK_AWAY * Fc, vs=_FALL * v_max)
