"""LU factorisation written out in scalars, without the operations on what is known to be zero."""

import functools
import operator
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact, PyTree

MAX_UNROLLED_LU = 12

# An array, or one of NumPy's scalars where the number is known while tracing.
Scalar: TypeAlias = Inexact[Array, ""] | np.generic
LinearSolver: TypeAlias = Callable[[list[Array]], list[Array]]
_Entry: TypeAlias = Any  # a `Scalar`: type checkers know no arithmetic of `np.generic`
_Rows: TypeAlias = list[list[_Entry]]


class _Pattern(NamedTuple):
    """Rows whose known entries are written here, and whose others (None) are in a list."""

    rows: tuple[tuple[_Entry, ...], ...]

    @classmethod
    def of(cls, rows: _Rows) -> tuple["_Pattern", list[Array]]:
        """The pattern of a matrix, and the list of its unknown entries."""
        pattern = cls(tuple(tuple(x if is_known(x) else None for x in row) for row in rows))
        return pattern, [x for row in rows for x in row if not is_known(x)]

    def fill(self, unknown: list[Array], known: object = None) -> _Rows:
        """The matrix again; with the known entries in it replaced by another number, if one is given."""
        left = iter(unknown)
        return [[next(left) if x is None else x if known is None else known for x in row] for row in self.rows]


class _Shape(NamedTuple):
    """What is known of a factored matrix while tracing: order of elimination, patterns, and pairs of rows to swap."""

    order: tuple[int, ...]
    matrix: _Pattern
    factors: _Pattern
    pairs: tuple[tuple[int, int], ...]


def is_known(x: object) -> bool:
    """Whether a number is known while tracing."""
    return isinstance(x, np.generic)


def is_zero(x: object) -> bool:
    """Whether a number is known to be zero while tracing."""
    return is_known(x) and bool(x == 0)


def product(row: Sequence[_Entry], x: Sequence[Array]) -> Array:
    """Of a row that is not zero and a vector, without the terms that are known to be zero."""
    terms: list[_Entry] = [a * b for a, b in zip(row, x, strict=True) if not is_zero(a)]
    return functools.reduce(operator.add, terms)


def factor_lu(rows: Sequence[Sequence[Scalar]], *, pivot: bool) -> LinearSolver:
    """LU factorisation written out in scalars; returns the solver of the factored system.

    Pivoting is a bubble of conditional row swaps, without a branch. Still it costs a factor of 2.7 under `jax.vmap`,
    because the swapped rows enter so many sums that XLA computes them over and over. Without it the elimination is
    stable where the symmetric part of the matrix, in some scaling of the unknowns, is positive: so for
    `I/(gamma dt) - J` of a dissipative system, and of any system whose growing modes the step resolves. Then, too, the
    unknowns are eliminated in the order that leaves most of the known zeros what they are: of a mechanism first the
    coordinates, whose rates are the velocities, and the bristles, each of which knows its own velocity alone.

    Quotients are kept as divisions: XLA never recomputes a division in several kernels, as it does sums and
    products, and that alone is worth a factor of three under `jax.vmap`.

    **Arguments:**

    - `rows`: the matrix as n rows of n scalars; those known while tracing as NumPy's scalars.
    - `pivot`: whether to swap rows so that every pivot is the largest in its column.

    **Returns:**

    A function from a right-hand side (n scalars) to the solution (n scalars), differentiable in the matrix and the
    right-hand side. A singular matrix, or without pivoting a zero pivot, gives values that are not finite.
    """
    n = len(rows)
    order = tuple(range(n)) if pivot else _order(rows)
    # The factors stay differentiable although the rule of `_solve` ignores their tangents: transposed in reverse
    # mode, a solve is plain arithmetic on the factors, and derivatives of that (Hessians) go through the elimination.
    table, swaps = _eliminate([[rows[i][j] for j in order] for i in order], pivot)
    factors, unknown_factors = _Pattern.of(table)
    matrix, unknown = _Pattern.of([list(row) for row in rows])
    shape = _Shape(order, matrix, factors, tuple(swaps))
    return lambda rhs: _solve(shape, unknown, unknown_factors, list(swaps.values()), list(rhs))


def invert(matrix: Float[Array, "n n"], *, pivot: bool) -> Callable[[Array], Array]:
    """Solver of a system too large to be written out, by the inverse, in a loop of rank-one updates.

    LAPACK would leave the loop of the steps at every call: 341 us for a step with 18 unknowns, and 47 us by this.

    **Arguments:**

    - `matrix`: shape `[n, n]`.
    - `pivot`: as for `factor_lu`.

    **Returns:**

    A function from a right-hand side to the solution, shape `[n]`, differentiable in both. A singular matrix gives
    values that are not finite.
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

    # Derivatives are those of the solution: none goes through the elimination.
    inverse, order = jax.lax.fori_loop(0, matrix.shape[0], eliminate, (jax.lax.stop_gradient(matrix), places))

    def product(a: Array, x: Array) -> Array:
        return jnp.sum(a * x[None, :], axis=1)

    def transposed(_: object, x: Array) -> Array:
        return jnp.zeros_like(x).at[order].set(product(inverse.T, x)) if pivot else product(inverse.T, x)

    return lambda rhs: jax.lax.custom_linear_solve(
        lambda x: product(matrix, x), rhs, lambda _, b: product(inverse, b[order] if pivot else b), transposed
    )


def _order(rows: Sequence[Sequence[Scalar]]) -> tuple[int, ...]:
    """Order of elimination: next the unknown whose elimination can fill the fewest zeros (Markowitz 1957)."""
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
    """Both factors in one table, and for each pair of rows that may have been swapped whether they were."""
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
    return a if is_known(a) and is_known(b) and a == b else jnp.where(condition, a, b)


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
    """Solve with factors at hand; the rule below spares the derivative a pass through the elimination."""
    del matrix
    table = shape.factors.fill(factors)
    y = _substitute(table, dict(zip(shape.pairs, swaps, strict=True)), [rhs[i] for i in shape.order])
    return [y[shape.order.index(i)] for i in range(len(y))]


@_solve.defjvp
def _solve_jvp(
    shape: _Shape, primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]
) -> tuple[list[Array], list[Array]]:
    """A x = b gives A dx = db - dA x."""
    matrix, factors, swaps, rhs = primals
    matrix_dot, _, _, rhs_dot = tangents
    x = _solve(shape, matrix, factors, swaps, rhs)
    residual = []
    for row_dot, b_dot in zip(shape.matrix.fill(matrix_dot, known=np.float64(0)), rhs_dot, strict=True):
        for a_dot, xj in zip(row_dot, x, strict=True):
            b_dot = _reduce(b_dot, a_dot, xj)
        residual.append(b_dot)
    return x, _solve(shape, matrix, factors, swaps, residual)
