"""A law given as a function."""

from collections.abc import Callable
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from .._core.functions import as_function, real_array
from .._core.parameters import Number, parameter
from .._core.shapes import Scalar
from ._law import AbstractForceLaw, register_law
from ._law_case import STANDARD, LawCase, stribeck_case


def _stribeck(v: Array) -> Array:
    """A smooth Stribeck curve."""
    Fc, Fs, vs = STANDARD["Fc"], STANDARD["Fs"], STANDARD["vs"]
    return (Fc + (Fs - Fc) * jnp.exp(-((v / vs) ** 2))) * jnp.tanh(v / STANDARD["width"]) + STANDARD["Fv"] * v


@register_law
class Curve(AbstractForceLaw):
    """A friction force that is any function of slip velocity, `F = gain fn(v)`.

    `Friction(fn)` makes one of a plain function.

    **Arguments:**

    - `fn`: `fn(v)` returns the force [N] at slip velocity `v` [m/s], one number for one; a pure JAX function, smooth
      enough for the solver. Numbers that are to be differentiated go into the leaves of an `eqx.Module`.
    - `gain`: factor [N per unit of fn], >= 0.

    **Raises:**

    - `ValueError` if `fn` is no function or `gain` is out of range.
    """

    fn: Callable[..., ArrayLike] = eqx.field(converter=partial(as_function, name="Curve fn"))
    gain: Number = parameter("gain", "N", lower=0.0, default=1.0)
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "any function of slip velocity; `Friction(fn)` makes one"
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
