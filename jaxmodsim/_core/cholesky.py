"""Linear algebra for the small systems of mechanics, written out in scalars.

XLA fuses scalar operations across a whole solver step, but a call into LAPACK in the loop stops it. Systems
above the sizes given here go to LAPACK, where its own speed pays for the call.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

MAX_UNROLLED_CHOLESKY = 12


def cholesky_pivots(matrix: Float[Array, "n n"]) -> Float[Array, " n"]:
    """Pivots of the Cholesky factorisation, each divided by the diagonal entry it started from.

    A symmetric matrix is positive definite if and only if every pivot is positive. A ratio near the rounding unit
    says that the row depends linearly on the ones before it. Pivots after the first one that is not positive are
    meaningless.

    **Arguments:**

    - `matrix`: symmetric, shape `[n, n]`.

    **Returns:**

    Shape `[n]`, dimensionless: at most 1 where the matrix is positive definite; where the diagonal entry itself
    is not positive, that entry (so never positive).
    """
    n = matrix.shape[0]
    rows = [[matrix[i, j] for j in range(n)] for i in range(n)]
    ratios = []
    for k in range(n):
        diagonal = matrix[k, k]
        pivot = rows[k][k]
        ratios.append(jnp.where(diagonal > 0, pivot / jnp.where(diagonal > 0, diagonal, 1.0), diagonal))
        safe = jnp.where(pivot > 0, pivot, 1.0)
        for i in range(k + 1, n):
            factor = rows[i][k] / safe
            for j in range(k + 1, n):
                rows[i][j] = rows[i][j] - factor * rows[k][j]
    return jnp.stack(ratios)


def solve_positive_definite(matrix: Float[Array, "n n"], rhs: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solve a symmetric positive definite system, by L D L^T written out for n <= 12, by Cholesky of LAPACK above.

    That is Cholesky without roots: alone it takes a third of the time, as a root and a quotient for each pivot wait
    for each other, and under `jax.vmap` less still, as XLA computes quotients once (see `factor_lu`).

    **Arguments:**

    - `matrix`: symmetric positive definite, shape `[n, n]`; only the lower triangle is read.
    - `rhs`: shape `[n]`.

    **Returns:**

    The solution, shape `[n]`. Where a pivot is negative, NaN (for n = 1 the quotient): callers who must know
    which row is at fault ask `cholesky_pivots`.
    """
    return factor_positive_definite(matrix)(rhs)


def factor_positive_definite(matrix: Float[Array, "n n"]) -> Callable[[Array], Array]:
    """Factor as `solve_positive_definite` does; returns the solver, for one right-hand side `[n]` or several `[n, k]`.

    Several go through as vectors of length k, which keeps what is traced and compiled small.
    """
    n = matrix.shape[0]
    if n == 1:
        return lambda rhs: rhs / matrix[0, 0]
    if n > MAX_UNROLLED_CHOLESKY:
        lower = jnp.linalg.cholesky(matrix)
        return lambda rhs: jax.scipy.linalg.cho_solve((lower, True), rhs)
    rows = [[matrix[i, j] for j in range(i + 1)] for i in range(n)]
    factors: dict[tuple[int, int], Array] = {}
    for k in range(n):
        rows[k][k] = jnp.where(rows[k][k] > 0, rows[k][k], jnp.nan)
        for i in range(k + 1, n):
            factors[i, k] = rows[i][k] / rows[k][k]
            for j in range(k + 1, i + 1):
                rows[i][j] = rows[i][j] - factors[i, k] * rows[j][k]

    def solve(rhs: Array) -> Array:
        x = [rhs[i] for i in range(n)]
        for k in range(n):
            for i in range(k + 1, n):
                x[i] = x[i] - factors[i, k] * x[k]
        for i in reversed(range(n)):
            for k in range(i + 1, n):
                x[i] = x[i] - rows[k][i] * x[k]
            x[i] = x[i] / rows[i][i]
        return jnp.stack(x)

    return solve
