"""Laws with a bristle, an elastic element that follows slip and yields, and functions of such elements."""

import abc
import math
from collections.abc import Mapping
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from equinox import AbstractVar
from jaxtyping import Array, Float, PyTree

from .._core.arrays import Scalar
from .._core.functions import nominal
from .._core.parameters import Number, optional_parameter, parameter
from .._core.safe import bounded_ratio, decay_mean, magnitude
from ._law import (
    MOST_STICTION,
    STANDARD,
    STRIBECK_CURVE,
    AbstractDynamicLaw,
    AbstractPlanarLaw,
    AbstractSetValuedLaw,
    LawCase,
    Passivity,
    register_law,
    stribeck_case,
)
from ._passivity import first_negative, least_on, logarithmic
from ._wrappers import AbstractWrapper, need_set_valued

_ONE_STATE = {"memory": "One state stores one turning point."}
_YIELDS = {"creep": "The bristle yields at any load, and slightly more when loaded than when unloaded."}


def stribeck_curve(
    v: Float[Array, "..."], Fc: Float[Array, "..."], Fs: Float[Array, "..."], vs: Scalar
) -> Float[Array, "..."]:
    """Gaussian Stribeck curve `Fc + (Fs - Fc) exp(-(v/vs)^2)` [N], the force in steady slip at `v` [m/s]."""
    ratio = bounded_ratio(v, vs)
    return Fc + (Fs - Fc) * jnp.exp(-ratio * ratio)


def relax_exact(v: Float[Array, "..."], z: Float[Array, "..."], dt: Scalar, rate: Scalar) -> Float[Array, "..."]:
    """Exact solution after `dt` [s] of `z' = v - rate z` with constant `v` [m/s] and `rate` [1/s]."""
    x = rate * dt
    return z * jnp.exp(-x) + v * dt * decay_mean(x)


def slip_fraction(u: Float[Array, "..."], corner: Scalar) -> Float[Array, "..."]:
    """Fraction of the slip that an element does not follow; `u` is its force towards the slip, over the limit.

    0 up to `1 - corner`, 1 at the limit, and above 1 beyond it, so that the element returns to the limit.
    """
    return jnp.maximum(u - (1.0 - corner), 0.0) / corner


def advance_elastoplastic(
    v: Float[Array, "..."], z: Float[Array, "..."], dt: Scalar, limit: Float[Array, "..."], corner: Scalar
) -> Float[Array, "..."]:
    """Exact deflection after `dt` [s] of `z' = v (1 - slip_fraction(z sign(v)/limit))` with constant `v`.

    A straight line up to the corner, then a decay to the limit.
    """
    # At v = 0 the deflection is the same on either side, but a side of zero would lose the derivative by v.
    side = jnp.where(v < 0, -1.0, 1.0).astype(z.dtype)
    u, y = side * z / limit, side * v * dt / limit
    straight = jnp.minimum(y, jnp.maximum(1.0 - corner - u, 0.0))
    bent = 1.0 + (u + straight - 1.0) * jnp.exp(-(y - straight) / corner)
    return side * limit * bent


def bristle_passivity(self: PyTree) -> Passivity:
    """Passivity of a bristle `F = sigma0 z + sigma1 z' + sigma2 v`, with constant damping or with damping that fades.

    At v > 0 with the bristle force `g u`, `u <= Fs/g`, the dissipation D satisfies
    `D/v = g alpha u^2 + v (sigma2 + sigma1 (1 - alpha u))`. Here alpha = 1 for LuGre, and for ElastoPlastic at u >= 1.
    D can be negative only for u > 1, after slow loading and an increase of speed. At high speed the last term
    dominates, with the largest `u = Fs/Fc`: the law is passive if and only if `sigma2 >= sigma1 (Fs - Fc)/Fc`. No other
    storage function changes this. If the condition fails, ever faster jerks after slow loading extract unlimited
    energy, of order `sigma1 v^2` for the time `Fc/(sigma0 v)`. With `vd` the damping is `sigma1 exp(-(v/vd)^2)`. Then
    sigma2 must be at least the largest `sigma1 exp(-(v/vd)^2) (u - 1) - g u^2/v`, which is searched over v. The worst
    u is `v sigma1(v)/(2 g)`, clipped to the range from 1 to Fs/g.
    """
    fade = nominal(getattr(self, "vd", None))
    vd = None if fade is None else float(fade)
    s1, s2, fc, fs, vs = (float(nominal(x)) for x in (self.sigma1, self.sigma2, self.Fc, self.Fs, self.vs))

    def least(v: np.ndarray) -> np.ndarray:
        """Least `D/v^2` [N s/m] over the deflections beyond the limit, at the speeds v > 0."""
        g = fc + (fs - fc) * np.exp(-np.square(v / vs))
        damping = s1 if vd is None else s1 * np.exp(-np.square(v / vd))
        u = np.clip(v * damping / (2.0 * g), 1.0, fs / g)
        return s2 + g * u * u / v - damping * (u - 1.0)

    scales = [vs] if vd is None else [vs, vd]
    scales += [fc / s1] if s1 > 0 else []
    if vd is None:
        margin, bound = s2 - s1 * (fs - fc) / fc, "sigma1 (Fs - Fc)/Fc"
    else:
        grid = logarithmic(1e-3 * min(scales), 1e3 * max(scales))
        margin, bound = min(least_on(least, grid)[0], s2), "the largest sigma1 exp(-(v/vd)^2) (u - 1) - g(v) u^2/v"
    if abs(margin) <= 8.0 * float(jnp.finfo(nominal(self.Fc).dtype).eps) * s2:
        margin = 0.0  # equality up to rounding of the product
    condition = (
        f"{type(self).__name__} is passive if and only if sigma2 >= {bound}: {s2:g} against {s2 - margin:g} N s/m."
    )
    speed = math.inf
    if margin < 0:
        speed = first_negative(least, logarithmic(1e-3 * min(scales), 2.0 * max(*scales, fs * fs / fc / -margin)))
    return Passivity(margin >= 0, margin, speed, condition)


class AbstractLinearBristle(AbstractPlanarLaw):
    """A bristle z with `z' = v - sigma0 |v| z/g(v)`, which is linear in z, and the elastic force `sigma0 z`."""

    sigma0: AbstractVar[Number]
    stiff: ClassVar[bool] = True
    limitations: ClassVar[Mapping[str, str]] = _ONE_STATE | _YIELDS

    @abc.abstractmethod
    def stribeck_curve(self, v: Float[Array, "..."]) -> Scalar:
        """g(v) [N], the bristle force in steady slip at `v` [m/s]."""

    def initial_state(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        """Undeflected bristle, 0 m."""
        return jnp.zeros_like(v)

    def zdot(self, v: Float[Array, "..."], z: Float[Array, "..."]) -> Float[Array, "..."]:
        """Rate of z [m/s] at slip velocity `v` [m/s] and deflection `z` [m]."""
        return v - self.sigma0 * magnitude(v) / self.stribeck_curve(v) * z

    def stored_energy(self, z: Float[Array, "..."]) -> Scalar:
        """Elastic energy [J] of the bristle."""
        return 0.5 * self.sigma0 * jnp.sum(z * z)

    def step_exact(self, v: Float[Array, "..."], z: Float[Array, "..."], dt: Scalar) -> Float[Array, "..."]:
        """Exact deflection [m] after `dt` [s] at constant `v` [m/s], since the rate is linear in z."""
        return relax_exact(v, z, dt, self.sigma0 * magnitude(v) / self.stribeck_curve(v))


@register_law
class Dahl(AbstractLinearBristle):
    """The Dahl law: a force that grows with displacement, like stress with strain, up to the Coulomb force.

    `z' = v - sigma0 |v| z/Fc`, `F = sigma0 z`: a function of displacement, independent of speed. In cycles between +-A
    the force at reversal is `Fc tanh(sigma0 A/Fc)`, the loss per cycle `4 Fc [A - (Fc/sigma0) tanh(sigma0 A/Fc)]`. The
    exponent of the paper is 1. For slip in the plane v, z and F are vectors.

    **Arguments:**

    - `sigma0`: stiffness at rest [N/m], > 0.
    - `Fc`: Coulomb force [N], > 0.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.

    **Example:**

    ```python
    law = jms.Dahl(sigma0=1e4, Fc=2.0)
    z = law.step_exact(jnp.array(0.01), jnp.array(0.0), jnp.array(0.02))  # slip by 0.2 mm
    print(f"{law.force(jnp.array(0.01), z):.3f} N")
    ```

    ```text
    1.264 N
    ```

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
    description: ClassVar[str] = "force grows with displacement up to `Fc`"
    equations: ClassVar[tuple[str, ...]] = ("sigma0 z", "z' = v - sigma0 |v| z/Fc")

    def stribeck_curve(self, v: Float[Array, "..."]) -> Scalar:
        """Fc [N] at any velocity."""
        return self.Fc

    def force_given_zdot(
        self, v: Float[Array, "..."], z: Float[Array, "..."], rate: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Friction force [N] at deflection `z` [m]."""
        return self.sigma0 * z

    def passivity(self) -> Passivity:
        """Always passive: with the bristle force `Fc u` the dissipation is `|v| Fc u^2`."""
        return Passivity(True, 0.0, math.inf, "Dahl is always passive: it dissipates |v| (sigma0 z)^2/Fc.")

    def mujoco(self) -> dict[str, PyTree]:
        """LuGre without damping and Stribeck effect; its Stribeck velocity is arbitrary."""
        return {"damping": 0.0, "lugre": (self.sigma0, 0.0, self.Fc, self.Fc, 1.0)}


# Start of a fit: a break-away distance of 2 ms at the largest speed, 0.1 of critical damping in stick, and a break-away
# force of 1.1 Fc that falls over a twentieth of the largest speed.
_BREAK_AWAY_TIME, _DAMPING, _BREAK_AWAY, _FALL = 2e-3, 0.1, 1.1, 0.05


@register_law
class LuGre(AbstractLinearBristle):
    """The LuGre law: an elastic bristle of mean deflection z [m] that yields as the surfaces slip.

    `z' = v - sigma0 |v| z / g(v)`, `F = sigma0 z + sigma1 z' + sigma2 v`, `g(v) = Fc + (Fs - Fc) exp(-(v/vs)^2)`. At
    constant velocity F tends to `g(v) sign(v) + sigma2 v`, and `|z| <= Fs/sigma0` always holds. With a constant sigma1
    the law is passive from v to F if and only if `sigma2 >= sigma1 (Fs - Fc)/Fc`. The stick mode of a mass m is
    critically damped for `sigma1 + sigma2 = 2 sqrt(m sigma0)`. With `vd` the bristle damping fades with slip speed,
    `sigma1 exp(-(v/vd)^2)`, which relaxes the condition at high speed.

    For slip in the plane v, z and F are vectors, and |v| is the magnitude.

    **Arguments:**

    - `sigma0`: bristle stiffness [N/m], > 0.
    - `sigma1`: bristle damping [N s/m], >= 0.
    - `sigma2`: viscous coefficient [N s/m], >= 0.
    - `Fc`: Coulomb force [N], > 0.
    - `Fs`: stiction force [N], >= Fc.
    - `vs`: Stribeck velocity [m/s], > 0.
    - `vd`: velocity over which sigma1 fades [m/s], > 0; by default sigma1 is constant.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.

    **Example:**

    ```python
    law = jms.LuGre(sigma0=1e5, sigma1=300.0, sigma2=0.4, Fc=1.0, Fs=1.5, vs=0.01)
    z = law.step_exact(jnp.array(0.01), jnp.array(0.0), jnp.array(1.0))  # slip by 10 mm
    print(f"{law.force(jnp.array(0.01), z):.3f} N with {law.sigma2 * 0.01:.3f} N of viscous friction")
    ```

    ```text
    1.188 N with 0.004 N of viscous friction
    ```

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
    description: ClassVar[str] = "bristle with a Stribeck effect; with `vd` its damping fades with speed"
    equations: ClassVar[tuple[str, ...]] = (
        "sigma0 z + sigma1 z' + sigma2 v",
        "z' = v - sigma0 |v| z/g(v)",
        STRIBECK_CURVE,
    )
    mujoco_lacks: ClassVar[str] = (
        " whose sigma1 fades (vd): leave vd out, and check the result with check_passivity(law)"
    )
    passivity = bristle_passivity

    def stribeck_curve(self, v: Float[Array, "..."]) -> Scalar:
        """g(v) [N], the bristle force in steady slip at `v` [m/s]."""
        return stribeck_curve(magnitude(v), self.Fc, self.Fs, self.vs)

    def force_given_zdot(
        self, v: Float[Array, "..."], z: Float[Array, "..."], rate: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Friction force [N] at slip velocity `v` [m/s], deflection `z` [m] and its `rate` [m/s]."""
        sigma1 = self.sigma1
        if self.vd is not None:
            ratio = bounded_ratio(magnitude(v), self.vd)
            sigma1 = sigma1 * jnp.exp(-ratio * ratio)
        return self.sigma0 * z + sigma1 * rate + self.sigma2 * v

    def mujoco(self) -> dict[str, PyTree] | str:
        """A motor of MuJoCo has the bristle with a constant sigma1."""
        if self.vd is not None:
            return AbstractPlanarLaw.mujoco(self)
        return {"damping": self.sigma2, "lugre": (self.sigma0, self.sigma1, self.Fc, self.Fs, self.vs)}

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """Constant damping, which is not passive, and damping that fades."""
        fading = cls.standard(vd=STANDARD["vs"])
        return stribeck_case("LuGre", cls.standard()), stribeck_case("LuGre, vd", fading)

    @classmethod
    def fit_start(cls, m: float, Fc: float, Fv: float, v_max: float) -> "LuGre":
        """A stiff bristle with light damping."""
        sigma0 = Fc / (_BREAK_AWAY_TIME * v_max)
        sigma1 = 2.0 * _DAMPING * np.sqrt(m * sigma0)
        return cls(sigma0=sigma0, sigma1=sigma1, sigma2=Fv, Fc=Fc, Fs=_BREAK_AWAY * Fc, vs=_FALL * v_max)


# `step_exact` of ElastoPlastic covers the transition from elastic to plastic in this many steps of order 2, over this
# slip in limit deflections. The bristle is then close to its limit, and one step covers the remaining slip.
_SUBSTEPS = 6
_TRANSITION = 2.0


@register_law
class ElastoPlastic(AbstractDynamicLaw):
    """The elasto-plastic law: LuGre with a bristle that yields only beyond a break-away deflection.

    `z' = v (1 - alpha u)`, where `u = sigma0 z sign(v)/g(v)` is the bristle force over its limit,
    `F = sigma0 z + sigma1 z' + sigma2 v`, `g(v) = Fc + (Fs - Fc) exp(-(v/vs)^2)`. `alpha` is 0 below the break-away
    force `Fba` and in reversed motion, 1 at the limit, and half a sine between. Below Fba the bristle is a spring, so
    the law does not creep, unlike LuGre. The break-away deflection of the paper is `Fba/sigma0`.

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

    **Example:**

    ```python
    law = jms.ElastoPlastic(sigma0=1e5, sigma1=300.0, sigma2=0.4, Fba=0.7, Fc=1.0, Fs=1.5, vs=0.01)
    z = law.step_exact(jnp.array(1e-3), jnp.array(0.0), jnp.array(5e-3))  # slip by 5 um: elastic
    print(f"{law.sigma0 * z:.3f} N")
    ```

    ```text
    0.500 N
    ```

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
    limitations: ClassVar[Mapping[str, str]] = _ONE_STATE
    mujoco_lacks: ClassVar[str] = (
        ": its bristle has no break-away force. The nearest law is LuGre with the same sigma0, sigma1, sigma2, Fc, Fs"
        " and vs, which creeps under a vibrating load"
    )
    example: ClassVar[Mapping[str, float]] = {"Fba": 0.7}
    passivity = bristle_passivity

    def stribeck_curve(self, v: Scalar) -> Scalar:
        """g(v) [N], the bristle force in steady slip at `v` [m/s]."""
        return stribeck_curve(v, self.Fc, self.Fs, self.vs)

    def _plastic(self, u: Scalar, elastic: Scalar) -> Scalar:
        """`alpha` at the bristle force `u`; it rises from the force `elastic` on. Both are relative to the limit."""
        span = jnp.clip((u - elastic) / (1.0 - elastic), 0.0, 1.0)
        return 0.5 - 0.5 * jnp.cos(jnp.pi * span)

    def initial_state(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        """Undeflected bristle, 0 m."""
        return jnp.zeros_like(v)

    def zdot(self, v: Scalar, z: Scalar) -> Scalar:
        """Rate of z [m/s] at slip velocity `v` [m/s] and deflection `z` [m]."""
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

        Exact in the elastic range and beyond the limit. Between, steps of order 2 that cannot exceed the limit.
        """
        # At v = 0 the deflection is the same on either side, but a side of zero would lose the derivative by v.
        g, side = self.stribeck_curve(v), jnp.where(v < 0, -1.0, 1.0).astype(z.dtype)
        elastic, u = self.Fba / g, side * self.sigma0 * z / g
        y = side * v * dt * self.sigma0 / g
        straight = jnp.minimum(y, jnp.maximum(elastic - u, 0.0))
        beyond = u > 1.0
        near = jnp.minimum(y - straight, _TRANSITION)
        inner, steps = u + straight, [near / _SUBSTEPS] * _SUBSTEPS + [y - straight - near]

        def relax(u: Array, y: Array, alpha: Array) -> Array:
            x = alpha * y
            return jnp.minimum(u * jnp.exp(-x) + y * decay_mean(x), 1.0)

        for step in steps:
            middle = relax(inner, 0.5 * step, self._plastic(inner, elastic))
            inner = relax(inner, step, self._plastic(middle, elastic))
        outer = 1.0 + (u - 1.0) * jnp.exp(-y)
        return side * g / self.sigma0 * jnp.where(beyond, outer, inner)


@register_law
class Bristle(AbstractWrapper, AbstractDynamicLaw):
    """A set-valued law that runs with a bristle z between -1 and 1, which follows slip over the displacement `h`.

    `z' = (v - |v| z)/h`, `F = mean z + half z^2 + viscous_force(v)`. Here `mean` is the mean of the sliding forces in
    both directions at the speed |v|, and `half` is half of their difference. In steady slip z = +-1, and F is the force
    of the law. z has no unit and the limit 1, so a varying load or temperature scales the force and leaves z unchanged.
    There is no stiction above the sliding force.

    With `Coulomb` it is `Dahl` with `sigma0 = Fc/h`. With the load-dependent part of `Geared` the force is
    `mu_avg |tau| z + mu_dif tau z^2` for the transmitted torque tau. Here mu_avg is the mean of the coefficients of
    drive and back, and mu_dif is half of drive minus back.

    **Arguments:**

    - `law`: `Coulomb`, `Stribeck`, `Geared` or another set-valued law.
    - `h`: displacement over which the force builds up [m], > 0.

    **Raises:**

    - `ValueError` if `law` is not set-valued or `h` is out of range.

    **Example:**

    ```python
    law = jms.Bristle(jms.Coulomb(Fc=2.0), h=1e-4)
    z = law.step_exact(jnp.array(0.01), jnp.array(0.0), jnp.array(0.01))  # slip by h
    print(f"{law.force(jnp.array(0.01), z):.3f} N")
    ```

    ```text
    1.264 N
    ```
    """

    law: AbstractSetValuedLaw = eqx.field(converter=partial(need_set_valued, owner="Bristle"))
    h: Number = parameter("h", "m", lower=0.0, strict=True)
    stiff: ClassVar[bool] = True
    description: ClassVar[str] = "one bristle, whose limit is 1 at any load"
    equations: ClassVar[tuple[str, ...]] = (
        "mean z + half z^2 + viscous_force(v)",
        "z' = (v - |v| z)/h",
        "mean, half = (sliding_force(|v|) +- sliding_force(-|v|))/2",
    )
    limitations: ClassVar[Mapping[str, str]] = _ONE_STATE | _YIELDS
    execution: ClassVar[str] = "default solver `Rodas5P`"

    def _levels(self, v: Scalar) -> tuple[Scalar, Scalar]:
        """Mean and half the difference of the sliding forces [N] in both directions."""
        speed = jnp.abs(v) + float(jnp.finfo(v.dtype).tiny)
        forward, backward = self.law.sliding_force(speed), self.law.sliding_force(-speed)
        return 0.5 * (forward + backward), 0.5 * (forward - backward)

    def initial_state(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        """Undeflected bristle, 0."""
        return jnp.zeros_like(v)

    def zdot(self, v: Scalar, z: Scalar) -> Scalar:
        """Rate of z [1/s] at slip velocity `v` [m/s] and deflection `z`."""
        return (v - jnp.abs(v) * z) / self.h

    def force_given_zdot(self, v: Scalar, z: Scalar, rate: Scalar) -> Scalar:
        """Friction force [N] at slip velocity `v` [m/s] and deflection `z`; the bristle is not damped."""
        del rate
        mean, half = self._levels(v)
        return mean * z + half * z * z + self.law.viscous_force(v)

    def stored_energy(self, z: Scalar) -> Scalar:
        """Energy [J] of the bristle at rest: `h (mean z^2/2 + half z^3/3)`."""
        mean, half = self._levels(jnp.zeros_like(z))
        return self.h * z * z * (0.5 * mean + half * z / 3.0)

    def step_exact(self, v: Scalar, z: Scalar, dt: Scalar) -> Scalar:
        """Exact deflection after `dt` [s] at constant `v` [m/s], since the rate is linear in z."""
        return relax_exact(v / self.h, z, dt, jnp.abs(v) / self.h)

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """None: a wrapped Coulomb law is Dahl, which the benches run."""
        return ()
