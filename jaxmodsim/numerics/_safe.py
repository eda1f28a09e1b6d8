"""Functions whose derivatives stay finite at zero."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def safe_power(base: Float[Array, "..."], exponent: Float[Array, "..."]) -> Float[Array, "..."]:
    """`base**exponent` for `base >= 0` and `exponent > 0`; value and derivatives are zero at `base = 0`.

    The derivative of a plain power is NaN there: by the exponent through `log(0)`, by the base for exponents
    below one. The inner `where` keeps that branch from being evaluated at zero at all.
    """
    positive = base > 0
    return jnp.where(positive, jnp.where(positive, base, 1.0) ** exponent, 0.0)


def safe_norm(x: Float[Array, " n"]) -> Float[Array, ""]:
    """Euclidean length; value and derivative are zero at zero, where the derivative of a plain square root is NaN."""
    square = jnp.sum(x * x)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
