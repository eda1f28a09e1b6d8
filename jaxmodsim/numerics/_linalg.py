"""Linear algebra for the small systems of mechanics, written out in scalars.

XLA fuses scalar operations across a whole solver step, but a call into LAPACK in the loop stops it. Systems
above the sizes given here go to LAPACK, where its own speed pays for the call.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

MAX_UNROLLED_CHOLESKY = 12
MAX_UNROLLED_LU = 12

Scalar: TypeAlias = Inexact[Array, ""]
Factors: TypeAlias = tuple[list[list[Scalar]], list[Array]]
LinearSolver: TypeAlias = Callable[[Sequence[Scalar]], list[Scalar]]


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


def factor_lu(rows: Sequence[Sequence[Scalar]], *, pivot: bool) -> LinearSolver:
    """LU factorisation written out in scalars; returns the solver of the factored system.

    Pivoting is a bubble of conditional row swaps, without a branch. Still it costs a factor of 2.7 under `jax.vmap`,
    because the swapped rows enter so many sums that XLA computes them over and over. Without it the elimination is
    stable where the symmetric part of the matrix, in some scaling of the unknowns, is positive: so for
    `I/(gamma dt) - J` of a dissipative system, and of any system whose growing modes the step resolves.

    Quotients are kept as divisions: XLA never recomputes a division in several kernels, as it does sums and
    products, and that alone is worth a factor of three under `jax.vmap`.

    **Arguments:**

    - `rows`: the matrix as n rows of n scalars.
    - `pivot`: whether to swap rows so that every pivot is the largest in its column.

    **Returns:**

    A function from a right-hand side (n scalars) to the solution (n scalars), differentiable in the matrix and the
    right-hand side. A singular matrix, or without pivoting a zero pivot, gives values that are not finite.
    """
    # The factors stay differentiable although the rule of `_solve_lu` ignores their tangents: transposed in reverse
    # mode, a solve is plain arithmetic on the factors, and derivatives of that (Hessians) go through the elimination.
    factors = _eliminate([list(row) for row in rows], pivot)
    return lambda rhs: _solve_lu([list(row) for row in rows], factors, list(rhs))


def _eliminate(rows: list[list[Scalar]], pivot: bool) -> Factors:
    n = len(rows)
    table, swaps = [list(row) for row in rows], []
    for k in range(n):
        for i in range(k + 1, n if pivot else 0):
            swap = jnp.abs(table[i][k]) > jnp.abs(table[k][k])
            swaps.append(swap)
            above, below = table[k], table[i]
            table[k] = [jnp.where(swap, b, a) for a, b in zip(above, below, strict=True)]
            table[i] = [jnp.where(swap, a, b) for a, b in zip(above, below, strict=True)]
        for i in range(k + 1, n):
            table[i][k] = table[i][k] / table[k][k]
            for j in range(k + 1, n):
                table[i][j] = table[i][j] - table[i][k] * table[k][j]
    return table, swaps


def _substitute(factors: Factors, rhs: list[Scalar]) -> list[Scalar]:
    table, swaps = factors
    n = len(table)
    x = list(rhs)
    pairs = [(k, i) for k in range(n) for i in range(k + 1, n)]
    for (k, i), swap in zip(pairs if swaps else (), swaps, strict=True):
        x[k], x[i] = jnp.where(swap, x[i], x[k]), jnp.where(swap, x[k], x[i])
    for i in range(n):
        for k in range(i):
            x[i] = x[i] - table[i][k] * x[k]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            x[i] = x[i] - table[i][k] * x[k]
        x[i] = x[i] / table[i][i]
    return x


@jax.custom_jvp
def _solve_lu(rows: list[list[Scalar]], factors: Factors, rhs: list[Scalar]) -> list[Scalar]:
    """Solve with factors at hand; the rule below spares the derivative a pass through the elimination."""
    del rows
    return _substitute(factors, rhs)


@_solve_lu.defjvp
def _solve_lu_jvp(primals: tuple[Any, Any, Any], tangents: tuple[Any, Any, Any]) -> tuple[Any, Any]:
    """A x = b gives A dx = db - dA x."""
    rows, factors, rhs = primals
    rows_dot, _, rhs_dot = tangents
    x = _solve_lu(rows, factors, rhs)
    residual = [
        b_dot - sum(a_dot * xj for a_dot, xj in zip(row_dot, x, strict=True))
        for row_dot, b_dot in zip(rows_dot, rhs_dot, strict=True)
    ]
    return x, _solve_lu(rows, factors, residual)
