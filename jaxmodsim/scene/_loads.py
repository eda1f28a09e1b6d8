"""Normal forces that are reactions, which the friction that they load changes in turn."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core.arrays import Scalar
from .._core.lu import factor_lu

_constant = jax.lax.stop_gradient


def solve_loads(
    normal: Float[Array, " k"], push: Float[Array, "k k"], pull: Float[Array, "k k"], side: Float[Array, " k"]
) -> tuple[Float[Array, " k"], Bool[Array, " k"], Scalar]:
    """Solution n of `n + G n = normal`, with column k of G that of `push` for n_k >= 0, and that of `pull` otherwise.

    A `side` that is not zero takes the place of the sign of n.

    The margin is the smallest determinant of `I + G` over all G with columns between those of `push` and `pull`. The
    determinant is linear in each column, so if it is positive for the columns themselves it is so in between, and then
    the solution is unique (J. Rohn, Systems of linear interval equations, Linear Algebra and its Applications 126:39,
    1989).

    **Returns:**

    n, which of them push, and the margin.
    """
    k = normal.shape[0]
    if k == 1:
        pushes = jnp.where(side == 0, normal, side) >= 0
        return normal / (1.0 + jnp.where(pushes, push[0], pull[0])), pushes, 1.0 + jnp.minimum(push, pull)[0, 0]

    # Cramer's rule for all choices of columns at once: entries are vectors of length 2^k.
    takes = np.array(list(product((False, True), repeat=k))).T
    rows = _rows(jnp.where(takes[None], pull[:, :, None], push[:, :, None]))
    determinant = _determinant(rows)
    right, violation = _constant(jnp.unstack(normal)), jnp.zeros(2**k, normal.dtype)
    rows, divisor = _constant(rows), _constant(determinant)
    for j in range(k):
        replaced = [[*row[:j], right[i] + 0.0 * row[j], *row[j + 1 :]] for i, row in enumerate(rows)]
        signed = _determinant(replaced) / jnp.where(divisor == 0, jnp.nan, divisor)
        opposed = jnp.where(side[j] == 0, signed, side[j] * jnp.inf)
        violation = violation + jnp.maximum(jnp.where(takes[j], opposed, -opposed), 0.0)
    # The choice whose signs agree with its columns; two agree where a load is zero, and either is right.
    best = jnp.min(jnp.where(jnp.isnan(violation), jnp.inf, violation))
    pushes = ~jnp.any(takes & (violation <= best)[None, :], axis=1)
    signed = jnp.stack(factor_lu(_rows(jnp.where(pushes[None], push, pull)), pivot=True)(list(jnp.unstack(normal))))
    return signed, jnp.where(side == 0, signed >= 0, pushes), jnp.min(determinant)


def _rows(gain: Float[Array, "k k *m"]) -> list[list[Array]]:
    """Entries of `I + gain`, for one matrix or several."""
    k = gain.shape[0]
    matrix = gain + jnp.eye(k, dtype=gain.dtype).reshape(k, k, *(1,) * (gain.ndim - 2))
    return [list(jnp.unstack(row)) for row in jnp.unstack(matrix)]


def _determinant(rows: list[list[Array]]) -> Array:
    """Determinants of matrices whose entries are vectors."""
    if len(rows) == 1:
        return rows[0][0]
    total = jnp.zeros_like(rows[0][0])
    for j, entry in enumerate(rows[0]):
        minor = entry * _determinant([row[:j] + row[j + 1 :] for row in rows[1:]])
        total = total - minor if j % 2 else total + minor
    return total
