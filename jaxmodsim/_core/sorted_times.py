"""Look-up in increasing times, without a loop of its own."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def after(times: Float[Array, " n"], t: Float[Array, ""]) -> Int[Array, ""]:
    """Number of the increasing `times` that are not after `t`: the index of the first one that is."""
    # Unrolled: a loop inside the loop of a run would keep XLA from fusing a step.
    return jnp.searchsorted(times, t.astype(times.dtype), side="right", method="scan_unrolled")


def is_one_of(times: Float[Array, " n"], t: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether `t` is one of the increasing `times`."""
    return entry(times, jnp.maximum(after(times, t) - 1, 0)) == t


def entry(x: Array, i: Int[Array, ""]) -> Array:
    """`x[i]`."""
    return jax.lax.dynamic_index_in_dim(x, i, keepdims=False)
