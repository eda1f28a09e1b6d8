"""Small symmetric systems, written out in scalars: positive definite, or semidefinite with redundant rows.

XLA fuses scalar operations across a whole solver step; a call of LAPACK in the loop prevents that. Larger systems use
LAPACK, where its speed outweighs the cost of the call.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .arrays import apply_matrix

MAX_UNROLLED_CHOLESKY = 12


def cholesky_pivots(matrix: Float[Array, "n n"]) -> Float[Array, " n"]:
    """Pivots of the Cholesky factorization, each divided by its diagonal entry of the matrix.

    A symmetric matrix is positive definite if and only if every pivot is positive. A ratio near the rounding unit means
    that the row depends linearly on previous rows. Pivots after the first one that is not positive are meaningless.

    **Arguments:**

    - `matrix`: symmetric, shape `[n, n]`.

    **Returns:**

    Shape `[n]`, dimensionless: at most 1 if the matrix is positive definite. For a diagonal entry that is not positive,
    the result is that entry.
    """
    n = matrix.shape[0]
    rows = [list(jnp.unstack(row)) for row in jnp.unstack(matrix)]
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
    """Solve a symmetric positive definite system, by L D L^T in scalars for n <= 12, by LAPACK's Cholesky above.

    L D L^T is Cholesky without roots. A single solution takes a third of the time, because a root and a quotient per
    pivot depend on each other. Under `jax.vmap` it takes less, because XLA computes quotients once (see `factor_lu`).

    **Arguments:**

    - `matrix`: symmetric positive definite, shape `[n, n]`; only the lower triangle is read.
    - `rhs`: shape `[n]`.

    **Returns:**

    The solution, shape `[n]`; NaN if a pivot is negative (for n = 1 the quotient). `cholesky_pivots` finds the row.
    """
    return factor_positive_definite(matrix)(rhs)


def factor_positive_definite(matrix: Float[Array, "n n"]) -> Callable[[Array], Array]:
    """Factor as `solve_positive_definite` does; return a solver for one right-hand side `[n]` or several `[n, k]`.

    Several are processed as vectors of length k, which keeps the traced program small.
    """
    n = matrix.shape[0]
    if n == 1:
        return lambda rhs: rhs / matrix[0, 0]
    if n > MAX_UNROLLED_CHOLESKY:
        lower = jnp.linalg.cholesky(matrix)
        return lambda rhs: jax.scipy.linalg.cho_solve((lower, True), rhs)
    rows = [list(jnp.unstack(row)) for row in jnp.unstack(matrix)]
    factors: dict[tuple[int, int], Array] = {}
    for k in range(n):
        rows[k][k] = jnp.where(rows[k][k] > 0, rows[k][k], jnp.nan)
        for i in range(k + 1, n):
            factors[i, k] = rows[i][k] / rows[k][k]
            for j in range(k + 1, i + 1):
                rows[i][j] = rows[i][j] - factors[i, k] * rows[j][k]

    def solve(rhs: Array) -> Array:
        x = list(jnp.unstack(rhs))
        for k in range(n):
            for i in range(k + 1, n):
                x[i] = x[i] - factors[i, k] * x[k]
        for i in reversed(range(n)):
            for k in range(i + 1, n):
                x[i] = x[i] - rows[k][i] * x[k]
            x[i] = x[i] / rows[i][i]
        return jnp.stack(x)

    return solve


# Systems of so many rows are solved by cofactors; rows are redundant below this power of the rounding unit.
_FEW, _REDUNDANT = 3, 2.0 / 3.0
# Steps of refinement: each multiplies the error of the shift by the shift over the smallest eigenvalue.
_REFINEMENTS = 2


def solve_balanced(matrix: Float[Array, "n n"], rhs: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """`solve_semidefinite` with all rows active and with weights that scale every diagonal entry to one."""
    diagonal = jnp.stack([jnp.unstack(row)[i] for i, row in enumerate(jnp.unstack(matrix))])  # see `_solve_few`
    weight = 1.0 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    return solve_semidefinite(matrix, rhs, weight, jnp.ones(diagonal.shape, bool))


def solve_semidefinite(
    matrix: Float[Array, "n n"], rhs: Float[Array, "n *k"], weight: Float[Array, " n"], active: Bool[Array, " n"]
) -> Float[Array, "n *k"]:
    """Solve the active rows of a symmetric positive semidefinite system; if they are redundant, with least norm.

    **Arguments:**

    - `matrix`: shape `[n, n]`.
    - `rhs`: shape `[n]`, or `[n, k]` for k right-hand sides; in the range of the matrix.
    - `weight`: shape `[n]`, > 0: the solution minimizes the sum of `(x_i/weight_i)^2`. Constant under differentiation.
    - `active`: which rows are active; the unknowns of the others are zero.

    **Returns:**

    The solution, of the shape of `rhs`. It is exact up to rounding for up to three rows. For more its relative error is
    `eps/e^2` for a matrix that has the smallest eigenvalue e > 0, scaled by the weights to a largest entry of one.
    """
    n = rhs.shape[0]

    def each(row: Array) -> Array:
        """Values of the rows, for every right-hand side."""
        return row[:, None] if rhs.ndim == 2 else row

    if n == 1:
        diagonal = each(matrix[0])
        return jnp.where(each(active), rhs / jnp.where(diagonal > 0, diagonal, jnp.inf), 0.0)
    weight = jax.lax.stop_gradient(weight)
    if n <= _FEW:
        return _solve_few(matrix, jnp.where(each(active), rhs, 0.0), weight * weight, active)
    both = active[:, None] & active[None, :]
    scaled = jnp.where(both, matrix * weight[:, None] * weight[None, :], 0.0)
    scale = jnp.max(scaled)
    scale = jnp.where(scale > 0, scale, 1.0)
    scaled, right = scaled / scale, jnp.where(each(active), each(weight) * rhs, 0.0) / scale
    solution = solve_shifted(scaled, right, active, factor_positive_definite)
    return jnp.where(each(active), each(weight) * solution, 0.0)


def _solve_few(
    matrix: Float[Array, "n n"], rhs: Float[Array, "n *k"], share: Float[Array, " n"], active: Bool[Array, " n"]
) -> Float[Array, "n *k"]:
    """`solve_semidefinite` of two or three rows in closed form, by cofactors.

    Of redundant rows the solution of least norm is `b/s1` for a matrix A of rank one, and `(s1 b - A b)/s2` for one of
    rank two (Cayley and Hamilton), with the sums s1 and s2 of its principal minors.

    **Arguments:**

    - `rhs`: zero in rows that are not active.
    - `share`: squares of the weights.
    """
    both = active[:, None] & active[None, :]
    matrix = jnp.where(both, matrix, jnp.eye(rhs.shape[0], dtype=matrix.dtype))
    share = jnp.where(active, share, 0.0)
    of_rows = share if rhs.ndim == 1 else share[:, None]
    weighted, least = of_rows * rhs, float(jnp.finfo(matrix.dtype).eps) ** _REDUNDANT
    # Indices would become scattered sums in reverse mode, which took three times as long as the rest of a step.
    rows, parts = [jnp.unstack(row) for row in jnp.unstack(matrix)], jnp.unstack(share)
    if rhs.shape[0] == 2:
        ((a, b), (_, d)), (p, q) = rows, parts
        cofactors, determinant, size, first = [[d, -b], [-b, a]], a * d - b * b, a * d, p * a + q * d
        redundant = weighted / jnp.where(first > 0, first, 1.0)
    else:
        ((a, b, c), (_, d, e), (_, _, f)), (p, q, r) = rows, parts
        of_b, of_c, of_e = c * e - b * f, b * e - c * d, b * c - a * e
        of_a, of_d, of_f = d * f - e * e, a * f - c * c, a * d - b * b
        cofactors = [[of_a, of_b, of_c], [of_b, of_d, of_e], [of_c, of_e, of_f]]
        determinant, size, first = a * of_a + b * of_b + c * of_c, a * d * f, p * a + q * d + r * f
        second = q * r * of_a + p * r * of_d + p * q * of_f
        two = second > least * first * first
        rest = of_rows * (first * rhs - apply_matrix(matrix, weighted)) / jnp.where(two, second, 1.0)
        redundant = jnp.where(two, rest, weighted / jnp.where(first > 0, first, 1.0))
    # The square of the volume of the rows, each scaled to one.
    regular = determinant > least * size
    inverse = jnp.stack([jnp.stack(row) for row in cofactors])
    return jnp.where(regular, apply_matrix(inverse, rhs) / jnp.where(regular, determinant, 1.0), redundant)


def solve_shifted(
    matrix: Float[Array, "n n"],
    rhs: Float[Array, "n *k"],
    active: Bool[Array, " n"],
    factor: Callable[[Array], Callable[[Array], Array]],
) -> Float[Array, "n *k"]:
    """Solve a system that may be singular, with a largest entry of one; `factor` returns the solver of a matrix.

    Rows and columns that are not `active` are zero.
    """
    # A shift keeps the factors of redundant rows finite, and selects the solution of least norm. Refinement removes its
    # error, down to rounding if the rows are not redundant.
    shift = float(jnp.finfo(rhs.dtype).eps) ** 0.5
    solve = factor(matrix + jnp.eye(rhs.shape[0], dtype=rhs.dtype) * jnp.where(active, shift, 1.0)[None, :])
    solution = solve(rhs)
    for _ in range(_REFINEMENTS):
        solution = solution + solve(rhs - apply_matrix(matrix, solution))
    # In the null space of the matrix the solution contains rounding divided by the shift. Two more solves isolate that
    # part: they scale the other components by (shift/eigenvalue)^2.
    return solution - shift**2 * solve(solve(solution))
