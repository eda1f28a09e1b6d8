"""Laws without memory: functions of slip velocity, and set-valued laws."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from .._core.arrays import Scalar
from .._core.functions import as_function, real_array
from .._core.parameters import Number, optional_parameter, parameter
from .._core.safe import bounded_ratio, safe_power
from ._law import (
    MOST_STICTION,
    NO_STICTION_IN_MUJOCO,
    NO_STRIBECK_EFFECT,
    STANDARD,
    STRIBECK_CURVE,
    AbstractForceLaw,
    AbstractSetValuedLaw,
    LawCase,
    register_law,
    steady_curve,
    stribeck_case,
)


@register_law
class Viscous(AbstractForceLaw):
    """Friction proportional to velocity, `F = Fv v`.

    **Arguments:**

    - `Fv`: coefficient [N s/m], >= 0.

    **Raises:**

    - `ValueError` if `Fv` is out of range or no number.

    **Example:**

    ```python
    law = jms.Viscous(Fv=2.0)
    print(law.force(jnp.array(0.5)), "N")
    ```

    ```text
    1.0 N
    ```
    """

    Fv: Number = parameter("Fv", "N s/m", lower=0.0)
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "proportional to velocity"
    equations: ClassVar[tuple[str, ...]] = ("Fv v",)
    valid_at_any_speed: ClassVar[bool] = True
    limitations: ClassVar[Mapping[str, str]] = {**AbstractForceLaw.limitations, "stick-slip": NO_STRIBECK_EFFECT}

    def force(self, v: Scalar) -> Scalar:
        """Friction force [N] at velocity `v` [m/s]."""
        return self.Fv * v

    def mujoco(self) -> dict[str, Number]:
        """The damping of a joint."""
        return {"damping": self.Fv}

    def modelica(self) -> str:
        """Modelica has it as a table without a force at rest."""
        return ""


def _stribeck(v: Array) -> Array:
    """A smooth Stribeck curve with the standard parameters."""
    Fc, Fs, vs = STANDARD["Fc"], STANDARD["Fs"], STANDARD["vs"]
    return (Fc + (Fs - Fc) * jnp.exp(-((v / vs) ** 2))) * jnp.tanh(v / STANDARD["width"]) + STANDARD["Fv"] * v


@register_law
class Curve(AbstractForceLaw):
    """A friction force that is any function of slip velocity, `F = gain fn(v)`.

    `Friction(fn)` converts a plain function to this law.

    **Arguments:**

    - `fn`: `fn(v)` returns the force [N] at slip velocity `v` [m/s], a scalar for a scalar; a pure JAX function, smooth
      enough for the solver. Numbers to differentiate belong in the leaves of an `eqx.Module`.
    - `gain`: factor [N per unit of fn], >= 0.

    **Raises:**

    - `ValueError` if `fn` is not a function or `gain` is out of range.

    **Example:**

    ```python
    law = jms.Curve(jnp.tanh, gain=3.0)
    print(f"{law.force(jnp.array(0.5)):.3f} N")
    ```

    ```text
    1.386 N
    ```
    """

    fn: Callable[..., ArrayLike] = eqx.field(converter=partial(as_function, name="Curve fn"))
    gain: Number = parameter("gain", "N", lower=0.0, default=1.0)
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "any function of slip velocity; also `Friction(fn)`"
    equations: ClassVar[tuple[str, ...]] = ("gain fn(v)",)

    def force(self, v: Scalar) -> Scalar:
        """Friction force [N] at velocity `v` [m/s]."""
        value = real_array(self.fn(v), name="Curve fn")
        if value.shape != ():
            raise ValueError(f"A friction curve must return one number, but fn(v) returned the shape {value.shape}.")
        return self.gain * value

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """A smooth Stribeck curve."""
        return (stribeck_case("Curve", cls(_stribeck)),)


@register_law
class Coulomb(AbstractSetValuedLaw):
    """Coulomb friction: `Fc sign(v)` in slip, any force up to `Fs` in stick.

    **Arguments:**

    - `Fc`: force in slip [N], >= 0.
    - `Fs`: largest force in stick [N], >= Fc; by default Fc, which is no stiction.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.

    **Example:**

    ```python
    law = jms.Coulomb(Fc=5.0, Fs=8.0)
    print(law.sliding_force(jnp.array(0.1)), law.static_limit(jnp.array(1.0)), "N")
    ```

    ```text
    5.0 8.0 N
    ```
    """

    Fc: Number = parameter("Fc", "N", lower=0.0)
    Fs: Number | None = optional_parameter("Fs", "N", lower="Fc", most=MOST_STICTION)
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "constant force in slip, stiction up to `Fs`"
    equations: ClassVar[tuple[str, ...]] = ("Fc sign(v)",)
    valid_at_any_speed: ClassVar[bool] = True
    mujoco_lacks: ClassVar[str] = NO_STICTION_IN_MUJOCO

    def sliding_force(self, v: Scalar) -> Scalar:
        """Magnitude [N] of the force in slip."""
        return jnp.broadcast_to(self.Fc, jnp.shape(v))

    def viscous_force(self, v: Scalar) -> Scalar:
        """0 N: Coulomb friction has no viscous part."""
        return jnp.zeros_like(v)

    def static_limit(self, direction: Scalar) -> Scalar:
        """Largest force in stick [N]."""
        return jnp.asarray(self.Fc if self.Fs is None else self.Fs)

    def lugre_numbers(self, vs: float) -> dict[str, PyTree]:
        """Parameters with a stiction that falls over the velocity `vs`."""
        return {"Fc": self.Fc, "Fs": self.Fc if self.Fs is None else self.Fs, "vs": vs, "sigma2": 0.0}

    def mujoco(self) -> dict[str, PyTree] | str:
        """The dry friction of a joint, without stiction."""
        stiction = self.Fs is not None and float(self.Fs) > float(self.Fc)
        return AbstractSetValuedLaw.mujoco(self) if stiction else {"frictionloss": self.Fc}

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """Coulomb friction without and with stiction."""
        flat = steady_curve(STANDARD["Fc"], STANDARD["Fc"], 0.0)
        return (
            LawCase("Coulomb", cls.standard(Fs=STANDARD["Fc"]), flat),
            LawCase("Coulomb, stiction", cls.standard(), flat),
        )


# Velocity over vs below which a curve with an exponent below one is rounded.
_ROUNDED = 1e-12
# Largest deviation of `fall(0)` from 1.
_ROUNDING = 1e-6


def exponential(x: Scalar) -> Scalar:
    """`exp(-x)`, the fall of the Gaussian and the exponential Stribeck curve."""
    return jnp.exp(-x)


def lorentzian(x: Scalar) -> Scalar:
    """`1/(1 + x)`, the fall of the Lorentzian Stribeck curve (Hess and Soom 1990, Journal of Tribology 112:147).

    **Returns:**

    The factor, shape `[]`, 1 at x = 0.
    """
    return 1.0 / (1.0 + x)


def _power(x: Scalar, exponent: Scalar) -> Scalar:
    """`x^exponent`; for an exponent below one its slope at 0 is infinite, so the corner is rounded over `_ROUNDED`."""
    rounded = (x * x + _ROUNDED * _ROUNDED) ** (0.5 * exponent) - _ROUNDED**exponent
    return jnp.where(exponent < 1.0, rounded, safe_power(x, exponent))


def stribeck_power(v: Scalar, vs: Scalar, exponent: Scalar | None) -> Scalar:
    """`(|v|/vs)^exponent`, the argument of the fall of a Stribeck curve; the exponent None is 2."""
    ratio = bounded_ratio(v, vs)
    # A product costs a fifth of a power.
    return ratio * ratio if exponent is None else _power(ratio, exponent)


def _fall(value: object) -> object:
    if not callable(value):
        raise ValueError(
            f"Stribeck: fall must be a function such as jaxmodsim.friction.lorentzian, but {value!r} was given."
        )
    if value not in (exponential, lorentzian):
        with jax.ensure_compile_time_eval():
            start = float(jnp.asarray(value(jnp.zeros(()))))
        if not abs(start - 1.0) <= _ROUNDING:
            raise ValueError(f"Stribeck: fall(0) must be 1, so that slip begins at Fs, but fall(0) = {start:g}.")
    return value


@register_law
class Stribeck(AbstractSetValuedLaw):
    """Friction that falls from stiction to the Coulomb force as slip begins, with a viscous term.

    In slip `F = (Fc + (Fs - Fc) fall((|v|/vs)^exponent)) sign(v) + Fv v`; in stick any force up to `Fs`. Gaussian by
    default; exponential with `exponent=1`; Lorentzian with `fall=jaxmodsim.friction.lorentzian`.

    **Arguments:**

    - `Fc`: Coulomb force [N], >= 0.
    - `Fs`: largest force in stick [N], >= Fc.
    - `vs`: Stribeck velocity [m/s], > 0.
    - `Fv`: viscous coefficient [N s/m], >= 0.
    - `exponent`: shape of the fall, > 0: by default 2 (Gaussian), 1 for the exponential form.
    - `fall`: by default `exp(-x)`; `lorentzian` (`1/(1 + x)`), or another smooth function that falls from 1 at x = 0
      to 0.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.

    **Example:**

    ```python
    law = jms.Stribeck(Fc=1.0, Fs=1.5, vs=0.01, Fv=0.4)
    print(jax.vmap(law.sliding_force)(jnp.array([0.0, 0.01, 0.1])).round(3), "N")
    ```

    ```text
    [1.5   1.184 1.   ] N
    ```

    ??? cite "Reference"

        ```bibtex
        @article{armstrong1994survey,
            author={Armstrong-Helouvry, Brian and Dupont, Pierre and Canudas de Wit, Carlos},
            title={A survey of models, analysis tools and compensation methods for the control of machines
                   with friction},
            journal={Automatica}, volume={30}, number={7}, pages={1083--1138}, year={1994},
        }
        ```
    """

    Fc: Number = parameter("Fc", "N", lower=0.0)
    Fs: Number = parameter("Fs", "N", lower="Fc", most=MOST_STICTION)
    vs: Number = parameter("vs", "m/s", lower=0.0, strict=True)
    Fv: Number = parameter("Fv", "N s/m", lower=0.0, default=0.0)
    exponent: Number | None = optional_parameter("exponent", "1", lower=0.0, strict=True)
    fall: PyTree = eqx.field(default=exponential, static=True, converter=_fall)
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "stiction, Stribeck effect and viscous friction; Gaussian, exponential, Lorentzian"
    equations: ClassVar[tuple[str, ...]] = ("g(v) sign(v) + Fv v", STRIBECK_CURVE)
    valid_at_any_speed: ClassVar[bool] = True
    mujoco_lacks: ClassVar[str] = NO_STICTION_IN_MUJOCO

    def sliding_force(self, v: Scalar) -> Scalar:
        """Magnitude [N] of the dry part in slip."""
        return self.Fc + (self.Fs - self.Fc) * self.fall(stribeck_power(v, self.vs, self.exponent))

    def viscous_force(self, v: Scalar) -> Scalar:
        """Viscous part [N]."""
        return self.Fv * v

    def static_limit(self, direction: Scalar) -> Scalar:
        """Largest force in stick [N]."""
        return jnp.asarray(self.Fs)

    def lugre_numbers(self, vs: float) -> dict[str, PyTree] | None:
        """Its own parameters if the curve is Gaussian."""
        gaussian = self.fall is exponential and (self.exponent is None or bool(jnp.all(self.exponent == 2.0)))
        return {"Fc": self.Fc, "Fs": self.Fs, "vs": self.vs, "sigma2": self.Fv} if gaussian else None

    def mujoco(self) -> dict[str, Number] | str:
        """The dry friction of a joint, without stiction, and its damping."""
        if float(self.Fs) > float(self.Fc):
            return AbstractSetValuedLaw.mujoco(self)
        return {"frictionloss": self.Fc, "damping": self.Fv}

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """The Gaussian, the exponential and the Lorentzian curve."""
        return (
            stribeck_case("Stribeck, Gauss", cls.standard()),
            stribeck_case("Stribeck, exp", cls.standard(exponent=1.0), lambda x: np.exp(-x)),
            stribeck_case("Stribeck, Lorentz", cls.standard(fall=lorentzian), lambda x: 1.0 / (1.0 + x * x)),
        )

    @classmethod
    def fit_start(cls, m: float, Fc: float, Fv: float, v_max: float) -> "Stribeck":
        """A break-away force of 1.2 Fc, and a fall over a twentieth of the largest speed."""
        return cls(Fc=Fc, Fs=1.2 * Fc, vs=0.05 * v_max, Fv=Fv)
