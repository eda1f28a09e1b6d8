"""Coulomb friction with stiction, Stribeck effect and viscous term."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._core.parameters import Number, optional_parameter, parameter
from .._core.safe import bounded_ratio, safe_power
from .._core.shapes import Scalar
from ._bristle import STRIBECK_CURVE
from ._law import MOST_STICTION, NO_STICTION_IN_MUJOCO, AbstractSetValuedLaw, register_law
from ._law_case import LawCase, stribeck_case

# Velocity over vs below which a curve with an exponent below one is rounded off.
_ROUNDED = 1e-12
# Deviation from 1 at rest that counts as rounding of a fall.
_ROUNDING = 1e-6


def exponential(x: Scalar) -> Scalar:
    """`exp(-x)`, the fall of the Gaussian and the exponential Stribeck curve."""
    return jnp.exp(-x)


def lorentzian(x: Scalar) -> Scalar:
    """`1/(1 + x)`, the fall of the Lorentzian Stribeck curve (Hess and Soom 1990, Journal of Tribology 112:147)."""
    return 1.0 / (1.0 + x)


def _power(x: Scalar, exponent: Scalar) -> Scalar:
    """`x^exponent`; below an exponent of one its slope at 0 has no bound, and the corner is rounded over `_ROUNDED`."""
    rounded = (x * x + _ROUNDED * _ROUNDED) ** (0.5 * exponent) - _ROUNDED**exponent
    return jnp.where(exponent < 1.0, rounded, safe_power(x, exponent))


def stribeck_power(v: Scalar, vs: Scalar, exponent: Scalar | None) -> Scalar:
    """`(|v|/vs)^exponent`, what the fall of a Stribeck curve goes by; a square without an exponent."""
    ratio = bounded_ratio(v, vs)
    # A square costs a fifth of a power.
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
            raise ValueError(f"Stribeck: fall must be 1 at 0, where slip begins at Fs, but fall(0) = {start:g}.")
    return value


@register_law
class Stribeck(AbstractSetValuedLaw):
    """Friction that falls from stiction to Coulomb level as slip begins, and then rises viscously.

    In slip `F = (Fc + (Fs - Fc) fall((|v|/vs)^exponent)) sign(v) + Fv v`; in stick anything up to `Fs`. Gaussian by
    default; exponential with `exponent=1`; Lorentzian with `fall=jaxmodsim.friction.lorentzian`.

    **Arguments:**

    - `Fc`: Coulomb force [N], >= 0.
    - `Fs`: largest force in stick [N], >= Fc.
    - `vs`: Stribeck velocity [m/s], > 0.
    - `Fv`: viscous coefficient [N s/m], >= 0.
    - `exponent`: shape of the fall, > 0: by default the square (Gaussian), 1 for the exponential form.
    - `fall`: by default `exp(-x)`; `lorentzian` (`1/(1 + x)`), or another smooth function that falls from 1 at 0
      to 0.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.

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
        """Of the Gaussian curve its own."""
        gaussian = self.fall is exponential and (self.exponent is None or bool(jnp.all(self.exponent == 2.0)))
        return {"Fc": self.Fc, "Fs": self.Fs, "vs": self.vs, "sigma2": self.Fv} if gaussian else None

    def mujoco(self) -> dict[str, Number] | str:
        """Dry friction of a joint, which is one force, and its damping."""
        if float(self.Fs) > float(self.Fc):
            return AbstractSetValuedLaw.mujoco(self)
        return {"frictionloss": self.Fc, "damping": self.Fv}

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """The three curves."""
        return (
            stribeck_case("Stribeck, Gauss", cls.standard()),
            stribeck_case("Stribeck, exp", cls.standard(exponent=1.0), lambda x: np.exp(-x)),
            stribeck_case("Stribeck, Lorentz", cls.standard(fall=lorentzian), lambda x: 1.0 / (1.0 + x * x)),
        )

    @classmethod
    def fit_start(cls, m: float, Fc: float, Fv: float, v_max: float) -> "Stribeck":
        """A break-away force of 1.2 Fc, and a fall over a twentieth of the speed."""
        return cls(Fc=Fc, Fs=1.2 * Fc, vs=0.05 * v_max, Fv=Fv)
