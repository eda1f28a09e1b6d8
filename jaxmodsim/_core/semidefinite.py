"""Symmetric systems that may be singular, as those of redundant constraints are."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .cholesky import factor_positive_definite

# Steps of refinement: each multiplies the error that the shift makes by shift over the smallest eigenvalue.
_REFINEMENTS = 2


def solve_balanced(matrix: Float[Array, "n n"], rhs: Float[Array, " n"]) -> Float[Array, " n"]:
    """As `solve_semidefinite`, all rows active, with the weights that make every diagonal entry one."""
    diagonal = jnp.diagonal(matrix)
    weight = 1.0 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    return solve_semidefinite(matrix, rhs, weight, jnp.ones(rhs.shape, bool))


def solve_semidefinite(
    matrix: Float[Array, "n n"], rhs: Float[Array, " n"], weight: Float[Array, " n"], active: Bool[Array, " n"]
) -> Float[Array, " n"]:
    """Solve the active rows of a symmetric positive semidefinite system; where they are redundant, the smallest way.

    **Arguments:**

    - `matrix`: shape `[n, n]`.
    - `rhs`: shape `[n]`, in the range of the matrix.
    - `weight`: shape `[n]`, > 0: of all solutions the one with the smallest sum of `(x_i/weight_i)^2` is taken.
      Constant under differentiation.
    - `active`: which rows count; the unknowns of the others are zero.

    **Returns:**

    The solution, shape `[n]`: right to rounding where the matrix, scaled to a largest entry of one by the weights, has
    no eigenvalue below 1e-4 but those of zero.
    """
    n = rhs.shape[0]
    if n == 1:
        diagonal = matrix[0]
        return jnp.where(active, rhs / jnp.where(diagonal > 0, diagonal, jnp.inf), 0.0)
    weight = jax.lax.stop_gradient(weight)
    both = active[:, None] & active[None, :]
    scaled = jnp.where(both, matrix * weight[:, None] * weight[None, :], 0.0)
    scale = jnp.max(scaled)
    scale = jnp.where(scale > 0, scale, 1.0)
    scaled, right = scaled / scale, jnp.where(active, weight * rhs, 0.0) / scale
    # A shift keeps the factors of a redundant set finite, and picks the smallest solution; refinement takes its error
    # away, down to rounding where the set is not redundant.
    shift = float(jnp.finfo(rhs.dtype).eps) ** 0.5
    shifted = scaled + jnp.eye(n, dtype=rhs.dtype) * jnp.where(active, shift, 1.0)[None, :]
    solve = factor_positive_definite(shifted)
    solution = solve(right)
    for _ in range(_REFINEMENTS):
        solution = solution + solve(right - jnp.sum(scaled * solution[None, :], axis=1))
    # Rounding, divided by the shift, is left in the directions that the matrix does not see. These two solves return
    # them as they are, and what it sees times the square of the shift over an eigenvalue.
    solution = solution - shift**2 * solve(solve(solution))
    return jnp.where(active, weight * solution, 0.0)
