"""LU factorization in scalars, which skips operations on known zeros."""

import functools
import operator
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact, PyTree

from .arrays import apply_matrix

MAX_UNROLLED_LU = 12

# An array, or a NumPy scalar for a number that is known while tracing.
Scalar: TypeAlias = Inexact[Array, ""] | np.generic
LinearSolver: TypeAlias = Callable[[list[Array]], list[Array]]
_Entry: TypeAlias = Any  # a `Scalar`; type checkers know no arithmetic of `np.generic`
_Rows: TypeAlias = list[list[_Entry]]


class _Pattern(NamedTuple):
    """Rows of a matrix with its known entries; None stands for an unknown entry."""

    rows: tuple[tuple[_Entry, ...], ...]

    @classmethod
    def of(cls, rows: _Rows) -> tuple["_Pattern", list[Array]]:
        """The pattern of a matrix, and the list of its unknown entries."""
        pattern = cls(tuple(tuple(x if is_constant(x) else None for x in row) for row in rows))
        return pattern, [x for row in rows for x in row if not is_constant(x)]

    def fill(self, unknown: list[Array], known: object = None) -> _Rows:
        """The matrix with these unknown entries; the number `known`, if any, replaces all known entries."""
        left = iter(unknown)
        return [[next(left) if x is None else x if known is None else known for x in row] for row in self.rows]


class _Shape(NamedTuple):
    """Static data of a factored matrix: order of elimination, patterns, and pairs of rows that may be swapped."""

    order: tuple[int, ...]
    matrix: _Pattern
    factors: _Pattern
    pairs: tuple[tuple[int, int], ...]


def is_constant(x: object) -> bool:
    """Whether a number is known while tracing."""
    return isinstance(x, np.generic)


def is_zero(x: object) -> bool:
    """Whether a number is known to be zero while tracing."""
    return is_constant(x) and bool(x == 0)


def product(row: Sequence[_Entry], x: Sequence[Array]) -> Array:
    """Product of a row that is not zero and a vector, without terms that are known to be zero."""
    terms: list[_Entry] = [a * b for a, b in zip(row, x, strict=True) if not is_zero(a)]
    return functools.reduce(operator.add, terms)


def factor_lu(rows: Sequence[Sequence[Scalar]], *, pivot: bool) -> LinearSolver:
    """LU factorization in scalars; returns the solver of the factored system.

    Pivoting is a sequence of conditional row swaps without branches. It costs a factor of 2.7 under `jax.vmap`, because
    XLA recomputes the swapped rows in many sums. Elimination without pivoting is stable if the symmetric part of the
    matrix is positive in some scaling of the unknowns. This holds for `I/(gamma dt) - J` of a dissipative system, and
    of any system with growing modes that the step resolves. Without pivoting the order of elimination preserves most
    known zeros. In a mechanism the first unknowns are the coordinates, whose rates are the velocities, and the
    bristles, each of which depends on its own velocity alone.

    Quotients remain divisions: XLA recomputes sums and products in several kernels, but never a division. This saves a
    factor of three under `jax.vmap`.

    **Arguments:**

    - `rows`: the matrix as n rows of n scalars; entries that are known while tracing are NumPy scalars.
    - `pivot`: whether to swap rows so that every pivot is the largest in its column.

    **Returns:**

    A function from a right-hand side (n scalars) to the solution (n scalars), differentiable in the matrix and the
    right-hand side. For a singular matrix, or for a zero pivot without pivoting, its values are not finite.
    """
    n = len(rows)
    order = tuple(range(n)) if pivot else _order(rows)
    # The rule of `_solve` ignores tangents of the factors, but they must be differentiable: the transposed solve of
    # reverse mode is plain arithmetic on the factors, and its derivatives (Hessians) pass through the elimination.
    table, swaps = _eliminate([[rows[i][j] for j in order] for i in order], pivot)
    factors, unknown_factors = _Pattern.of(table)
    matrix, unknown = _Pattern.of([list(row) for row in rows])
    shape = _Shape(order, matrix, factors, tuple(swaps))
    return lambda rhs: _solve(shape, unknown, unknown_factors, list(swaps.values()), list(rhs))


def factor_matrix(matrix: Float[Array, "n n"]) -> Callable[[Array], Array]:
    """`factor_lu` with swaps of rows, for a matrix and right-hand sides that are arrays."""
    solve = factor_lu([list(jnp.unstack(row)) for row in jnp.unstack(matrix)], pivot=True)
    return lambda rhs: jnp.stack(solve(list(jnp.unstack(rhs))))


def invert(matrix: Float[Array, "n n"], *, pivot: bool) -> Callable[[Array], Array]:
    """Solver of a system that is too large for scalars, by the inverse, in a loop of rank-one updates.

    A step with 18 unknowns takes 47 us; with LAPACK, whose calls leave the loop over steps, it takes 341 us.

    **Arguments:**

    - `matrix`: shape `[n, n]`.
    - `pivot`: as for `factor_lu`.

    **Returns:**

    A function from a right-hand side to the solution, shape `[n]`, differentiable in the matrix and the right-hand
    side. For a singular matrix its values are not finite.
    """
    places = jnp.arange(matrix.shape[0])

    def eliminate(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        a, order = carry
        if pivot:
            largest = jnp.argmax(jnp.where(places >= k, jnp.abs(a[:, k]), -1.0))
            swapped = jnp.where(places == k, largest, jnp.where(places == largest, k, places))
            a, order = a[swapped], order[swapped]
        here = places == k
        row = jnp.where(here, 1.0, a[k]) / a[k, k]
        others = jnp.where(here[None, :], 0.0, a) - jnp.where(here, 0.0, a[:, k])[:, None] * row[None, :]
        return jnp.where(here[:, None], row[None, :], others), order

    # Derivatives are those of the solution; none passes through the elimination.
    inverse, order = jax.lax.fori_loop(0, matrix.shape[0], eliminate, (jax.lax.stop_gradient(matrix), places))

    def transposed(_: object, x: Array) -> Array:
        out = apply_matrix(inverse.T, x)
        return jnp.zeros_like(x).at[order].set(out) if pivot else out

    def solve(_: object, b: Array) -> Array:
        return apply_matrix(inverse, b[order] if pivot else b)

    return lambda rhs: jax.lax.custom_linear_solve(lambda x: apply_matrix(matrix, x), rhs, solve, transposed)


def _order(rows: Sequence[Sequence[Scalar]]) -> tuple[int, ...]:
    """Order of elimination by Markowitz (1957): the next unknown is the one that can fill the fewest zeros."""
    left = set(range(len(rows)))
    across = {i: {j for j in left if j == i or not is_zero(rows[i][j])} for i in left}
    order: list[int] = []
    while left:
        filled = {k: (len(across[k] & left) - 1) * (sum(k in across[i] for i in left) - 1) for k in left}
        k = min(left, key=lambda k: (filled[k], k))
        left.remove(k)
        for i in left:
            if k in across[i]:
                across[i] |= across[k]
        order.append(k)
    return tuple(order)


def _eliminate(table: _Rows, pivot: bool) -> tuple[_Rows, dict[tuple[int, int], Array]]:
    """Both factors in one table, and the condition for each possible swap of two rows."""
    n, swaps = len(table), {}
    for k in range(n):
        for i in range(k + 1, n if pivot else 0):
            if is_zero(table[i][k]):
                continue
            swap = swaps[k, i] = jnp.abs(table[i][k]) > jnp.abs(table[k][k])
            pairs = list(zip(table[k], table[i], strict=True))
            table[k] = [_choose(swap, b, a) for a, b in pairs]
            table[i] = [_choose(swap, a, b) for a, b in pairs]
        for i in range(k + 1, n):
            if is_zero(table[i][k]):
                continue
            table[i][k] = table[i][k] / table[k][k]
            for j in range(k + 1, n):
                table[i][j] = _reduce(table[i][j], table[i][k], table[k][j])
    return table, swaps


def _choose(condition: Array, a: _Entry, b: _Entry) -> _Entry:
    return a if is_constant(a) and is_constant(b) and a == b else jnp.where(condition, a, b)


def _reduce(x: _Entry, a: _Entry, b: _Entry) -> _Entry:
    """`x - a b`."""
    if is_zero(a) or is_zero(b):
        return x
    return -(a * b) if is_zero(x) else x - a * b


def _substitute(table: _Rows, swaps: dict[tuple[int, int], Array], rhs: list[_Entry]) -> list[_Entry]:
    n, x = len(table), list(rhs)
    for (k, i), swap in swaps.items():
        x[k], x[i] = jnp.where(swap, x[i], x[k]), jnp.where(swap, x[k], x[i])
    for i in range(n):
        for k in range(i):
            x[i] = _reduce(x[i], table[i][k], x[k])
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            x[i] = _reduce(x[i], table[i][k], x[k])
        x[i] = x[i] / table[i][i]
    return x


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _solve(
    shape: _Shape, matrix: list[Array], factors: list[Array], swaps: list[Array], rhs: list[Array]
) -> list[Array]:
    """Solve with known factors; the rule below keeps derivatives out of the elimination."""
    del matrix
    table = shape.factors.fill(factors)
    y = _substitute(table, dict(zip(shape.pairs, swaps, strict=True)), [rhs[i] for i in shape.order])
    return [y[shape.order.index(i)] for i in range(len(y))]


@_solve.defjvp
def _solve_jvp(
    shape: _Shape, primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]
) -> tuple[list[Array], list[Array]]:
    """From A x = b follows A dx = db - dA x."""
    matrix, factors, swaps, rhs = primals
    matrix_dot, _, _, rhs_dot = tangents
    x = _solve(shape, matrix, factors, swaps, rhs)
    residual = []
    for row_dot, b_dot in zip(shape.matrix.fill(matrix_dot, known=np.float64(0)), rhs_dot, strict=True):
        for a_dot, xj in zip(row_dot, x, strict=True):
            b_dot = _reduce(b_dot, a_dot, xj)
        residual.append(b_dot)
    return x, _solve(shape, matrix, factors, swaps, residual)
