"""Functions with finite derivatives at zero or without derivatives, and rounding errors."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, PyTree

# Rounding units in each term of a function.
_ROUNDING = 4.0


def safe_power(base: Float[Array, "..."], exponent: Float[Array, "..."]) -> Float[Array, "..."]:
    """`base**exponent` for `base >= 0` and `exponent > 0`; value and derivatives are zero at `base = 0`.

    The derivatives of a plain power are NaN there: with respect to the exponent by `log(0)`, with respect to the base
    for exponents below one. The inner `where` prevents the evaluation at zero.
    """
    positive = base > 0
    return jnp.where(positive, jnp.where(positive, base, 1.0) ** exponent, 0.0)


def constant(x: PyTree, why: str) -> PyTree:
    """`x` itself, whose derivatives raise a `ValueError` with the sentence `why`."""

    def refuse(*_: PyTree) -> PyTree:
        raise ValueError(why)

    itself = jax.custom_jvp(lambda x: x)
    itself.defjvp(refuse)
    return itself(x)


def magnitude(v: Float[Array, "..."]) -> Float[Array, ""]:
    """Absolute value of a number, or Euclidean norm of a vector; the derivative is zero at zero."""
    return jnp.abs(v) if jnp.ndim(v) == 0 else safe_norm(v)


@jax.custom_jvp
def bounded_ratio(v: Float[Array, "..."], scale: Float[Array, ""]) -> Float[Array, "..."]:
    """`|v|/scale`, bounded by the fourth root of the largest floating-point number: powers up to four do not overflow.

    Functions that decay with the ratio are zero at the bound; without it their derivative is zero times infinity.
    """
    return jnp.minimum(jnp.abs(v) / scale, _most(v))


def _most(v: Float[Array, "..."]) -> float:
    return float(jnp.finfo(jnp.result_type(v)).max) ** 0.25


def _bounded_ratio_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array | SymbolicZero, Array | SymbolicZero]
) -> tuple[Array, Array]:
    """Derivatives of `|v|/scale`, zero beyond the bound.

    JAX's own derivatives of the minimum and the absolute value took a fifth of a step of the LuGre box in batches.
    """
    (v, scale), (dv, dscale) = primals, tangents
    ratio = bounded_ratio(v, scale)
    inside, tangent = ratio < _most(v), jnp.zeros_like(ratio)
    if not isinstance(dv, SymbolicZero):
        tangent = tangent + jnp.where(inside, jnp.sign(v) / scale, 0.0) * dv
    if not isinstance(dscale, SymbolicZero):
        tangent = tangent - jnp.where(inside, ratio / scale, 0.0) * dscale
    return ratio, tangent


bounded_ratio.defjvp(_bounded_ratio_jvp, symbolic_zeros=True)


def decay_mean(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """`(1 - exp(-x))/x` for `x >= 0`, the mean of a decay from 1 over x time constants; 1 at `x = 0`."""
    small = x < 1e-4
    safe = jnp.where(small, 1.0, x)
    return jnp.where(small, 1.0 - 0.5 * x + x * x / 6.0, -jnp.expm1(-safe) / safe)


def safe_norm(x: Float[Array, "..."], *, axis: int = -1) -> Float[Array, "..."]:
    """Euclidean norm along `axis`, with a derivative of zero at `x = 0`, where that of a plain norm is NaN.

    Division by the largest entry prevents underflow of the squares: only zero has the norm zero.
    """
    # The norm does not depend on the divisor, and neither does its derivative.
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(x), axis=axis, keepdims=True))
    vanishes = largest == 0
    scale = jnp.where(vanishes, 1.0, largest)
    squares = jnp.sum((x / scale) ** 2, axis=axis, keepdims=True)
    norm = jnp.where(vanishes, 0.0, scale * jnp.sqrt(jnp.where(vanishes, 1.0, squares)))
    return jnp.squeeze(norm, axis)


def rounding_of(
    fn: Callable[..., Float[Array, ""]], *at: Float[Array, "..."], least: tuple[Float[Array, ""], ...] = ()
) -> Float[Array, ""]:
    """Error of `fn(*at)` by the rounding of its arguments, and by errors of the last ones, `least`; constant."""
    at = jax.lax.stop_gradient(at)
    slopes = jax.grad(fn, tuple(range(len(at))))(*at)
    eps = float(jnp.finfo(at[0].dtype).eps)
    error = _ROUNDING * eps * sum(jnp.sum(jnp.abs(slope * x)) for slope, x in zip(slopes, at, strict=True))
    for slope, each in zip(slopes[len(at) - len(least) :], least, strict=True):
        error += each * jnp.sum(jnp.abs(slope))
    return jax.lax.stop_gradient(jnp.asarray(error))
