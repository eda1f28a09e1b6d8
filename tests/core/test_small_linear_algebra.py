"""Small linear algebra against NumPy and against the closed forms of its derivatives."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim._core.cholesky import cholesky_pivots, solve_positive_definite
from jaxmodsim._core.lu import factor_lu, invert

from ..helpers.differences import central_difference

# Rounding of a solve is eps times the condition number (below 100 for the matrices here) times a small factor.
ROUNDING = 1e-12


def spd(n: int, seed: int = 0) -> np.ndarray:
    """A positive definite matrix with a condition number below 20."""
    factor = np.random.default_rng(seed).standard_normal((n, n))
    return factor @ factor.T + n * np.eye(n)


def solve_lu(matrix: jax.Array, rhs: jax.Array, pivot: bool = True) -> jax.Array:
    n = rhs.shape[0]
    solve = factor_lu([[matrix[i, j] for j in range(n)] for i in range(n)], pivot=pivot)
    return jnp.stack(solve([rhs[i] for i in range(n)]))


SPD_SIZES = [1, 2, 3, 12, 13]  # 13 goes to LAPACK


@pytest.mark.quick
@pytest.mark.parametrize("n", SPD_SIZES)
def test_positive_definite_solution(n: int) -> None:
    matrix, rhs = spd(n), np.random.default_rng(1).standard_normal(n)
    ours = solve_positive_definite(jnp.asarray(matrix), jnp.asarray(rhs))
    np.testing.assert_allclose(ours, np.linalg.solve(matrix, rhs), rtol=ROUNDING)


@pytest.mark.parametrize("n", [2, 12])
def test_positive_definite_reads_the_lower_triangle_only(n: int) -> None:
    matrix, rhs = spd(n), jnp.ones(n)
    spoilt = jnp.asarray(np.tril(matrix) + np.triu(np.full((n, n), np.nan), 1))
    np.testing.assert_allclose(solve_positive_definite(spoilt, rhs), np.linalg.solve(matrix, rhs), rtol=ROUNDING)


@pytest.mark.parametrize("n", [2, 3, 13])
def test_positive_definite_refuses_an_indefinite_matrix_by_nan(n: int) -> None:
    matrix = jnp.asarray(spd(n)).at[n - 1, n - 1].set(-1.0)
    assert np.isnan(solve_positive_definite(matrix, jnp.ones(n))).all()


@pytest.mark.parametrize("n", SPD_SIZES)
def test_pivots_of_cholesky(n: int) -> None:
    matrix = spd(n)
    expected = np.diag(np.linalg.cholesky(matrix)) ** 2 / np.diag(matrix)
    np.testing.assert_allclose(cholesky_pivots(jnp.asarray(matrix)), expected, rtol=ROUNDING)


def test_pivots_name_the_dependent_row() -> None:
    # The third row is the sum of the first two; what is left of its pivot is rounding of entries near 4.
    basis = np.array([[1.0, 0.3, 1.3], [0.2, 1.0, 1.2], [0.7, 0.4, 1.1]])
    pivots = np.asarray(cholesky_pivots(jnp.asarray(basis.T @ basis)))
    assert (pivots[:2] > 0.1).all()
    assert abs(pivots[2]) < 1e-14


@pytest.mark.parametrize("entry", [0.0, -2.0])
@pytest.mark.parametrize("k", [0, 1, 2])
def test_pivots_name_the_diagonal_entry_that_is_not_positive(entry: float, k: int) -> None:
    matrix = jnp.asarray(spd(3)).at[k, k].set(entry)
    pivots = np.asarray(cholesky_pivots(matrix))
    assert pivots[k] == entry
    assert (pivots[:k] > 0).all()


def lu_cases() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(2)
    zero_diagonal = rng.standard_normal((6, 6))
    np.fill_diagonal(zero_diagonal, 0.0)
    return {
        "one": np.array([[-3.0]]),
        "swap": np.array([[0.0, 2.0], [3.0, 0.0]]),
        "tiny pivot": np.array([[1e-20, 1.0], [1.0, 1.0]]),
        "cycle": np.roll(np.eye(5), 2, axis=0) * np.array([1.0, -2.0, 3.0, 0.5, 1.5])[:, None],
        "late zero": np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 1.0], [1.0, 1.0, 1.0]]),
        "zero diagonal": zero_diagonal,
        "random 12": rng.standard_normal((12, 12)),
    }


@pytest.mark.quick
@pytest.mark.parametrize("name", lu_cases())
def test_lu_solution(name: str) -> None:
    matrix = lu_cases()[name]
    rhs = np.random.default_rng(3).standard_normal(matrix.shape[0])
    ours = np.asarray(solve_lu(jnp.asarray(matrix), jnp.asarray(rhs)))
    # The residual of a pivoted elimination is rounding whatever the condition; the solution then agrees as far as that.
    scale = np.abs(matrix) @ np.abs(ours) + np.abs(rhs)
    np.testing.assert_array_less(np.abs(matrix @ ours - rhs), 1e-14 * scale)
    np.testing.assert_allclose(ours, np.linalg.solve(matrix, rhs), rtol=1e-15 * 10 * np.linalg.cond(matrix))


def test_lu_of_a_singular_matrix_is_not_finite() -> None:
    ours = np.asarray(solve_lu(jnp.array([[1.0, 2.0], [2.0, 4.0]]), jnp.array([1.0, 1.0])))
    assert not np.isfinite(ours).all()


@pytest.mark.parametrize("n", [1, 2, 7])
def test_lu_without_row_swaps(n: int) -> None:
    """Where the symmetric part is positive definite, no swap is needed, however large the rest."""
    rng = np.random.default_rng(6)
    turning = rng.standard_normal((n, n))
    matrix = spd(n, 7) / n + 30.0 * (turning - turning.T)
    rhs = rng.standard_normal(n)
    ours = solve_lu(jnp.asarray(matrix), jnp.asarray(rhs), pivot=False)
    # The growth of the elimination is at most the ratio of both parts, about 100, times the condition.
    np.testing.assert_allclose(ours, np.linalg.solve(matrix, rhs), rtol=100 * 1e-15 * np.linalg.cond(matrix))


def test_lu_without_row_swaps_says_where_it_cannot() -> None:
    matrix = jnp.asarray(lu_cases()["swap"])
    assert not np.isfinite(solve_lu(matrix, jnp.ones(2), pivot=False)).all()
    assert np.isfinite(solve_lu(matrix, jnp.ones(2))).all()


def test_lu_in_a_batch_of_different_pivots() -> None:
    cases = np.stack([np.array([[0.0, 2.0], [3.0, 1.0]]), np.array([[4.0, 2.0], [3.0, 1.0]])])
    rhs = jnp.array([1.0, -2.0])
    batch = jax.vmap(lambda a: solve_lu(a, rhs))(jnp.asarray(cases))
    np.testing.assert_allclose(batch, [np.linalg.solve(a, rhs) for a in cases], rtol=ROUNDING)


def solve_inverse(matrix: jax.Array, rhs: jax.Array) -> jax.Array:
    return invert(matrix, pivot=True)(rhs)


SOLVERS: dict[str, tuple[Any, int]] = {
    "cholesky 1": (solve_positive_definite, 1),
    "cholesky 3": (solve_positive_definite, 3),
    "lapack 13": (solve_positive_definite, 13),
    "lu 3": (solve_lu, 3),
    "inverse 13": (solve_inverse, 13),
}


@pytest.mark.parametrize("name", SOLVERS)
def test_derivatives_of_solutions(name: str) -> None:
    """x(s) = (A + s S)^-1 (b + s d): closed forms of x', of the gradient of w.x, and of x''."""
    solve, n = SOLVERS[name]
    rng = np.random.default_rng(4)
    a, b, d, w = spd(n, 5), *rng.standard_normal((3, n))
    s = rng.standard_normal((n, n))
    s = s + s.T
    if solve is not solve_positive_definite:  # a permutation of the rows makes the elimination swap
        a, s = np.roll(a, 1, axis=0), np.roll(s, 1, axis=0)

    def line(x: jax.Array) -> jax.Array:
        return solve(a + x * s, b + x * d)

    inverse = np.linalg.inv(a)
    x0 = inverse @ b
    slope = inverse @ (d - s @ x0)
    _, forward = jax.jvp(line, (jnp.array(0.0),), (jnp.array(1.0),))
    np.testing.assert_allclose(np.asarray(forward), slope, rtol=ROUNDING)

    by_matrix, by_rhs = jax.grad(lambda a, b: jnp.sum(w * solve(a, b)), argnums=(0, 1))(jnp.asarray(a), jnp.asarray(b))
    adjoint = inverse.T @ w
    np.testing.assert_allclose(by_rhs, adjoint, rtol=ROUNDING)
    # Along the symmetric direction S: which triangle of the matrix is read must not matter.
    np.testing.assert_allclose(np.sum(by_matrix * s), -adjoint @ s @ x0, rtol=ROUNDING)

    # Each nesting takes another way through the rules for derivatives.
    for outer in (jax.jacfwd, jax.grad):
        for inner in (jax.jacfwd, jax.grad):
            curvature = outer(inner(lambda x: jnp.sum(w * line(x))))(jnp.array(0.0))
            np.testing.assert_allclose(curvature, w @ (-2.0 * inverse @ s @ slope), rtol=10 * ROUNDING)


def test_gradient_of_lu_by_every_entry() -> None:
    matrix, rhs = jnp.asarray(lu_cases()["late zero"]), jnp.array([1.0, -0.5, 2.0])
    gradient = jax.jit(jax.grad(lambda a: jnp.sum(solve_lu(a, rhs) ** 2)))(matrix)
    solve = jax.jit(lambda a: jnp.sum(solve_lu(a, rhs) ** 2))
    for i in range(3):
        for j in range(3):
            # Step 1e-3 of entries near one: truncation 1e-12 times derivatives up to 1e2, rounding 1e-12.
            slope = central_difference(lambda x, i=i, j=j: solve(matrix.at[i, j].add(x)), 0.0, 1e-3)
            np.testing.assert_allclose(gradient[i, j], slope, rtol=1e-8, atol=1e-8)


def sparse(n: int, seed: int) -> tuple[np.ndarray, list[list[Any]]]:
    """A matrix like that of a mechanism with bristles, and its rows with the zeros and ones of its structure known."""
    rng = np.random.default_rng(seed)
    eye, full = np.eye(n), rng.standard_normal((n, n))
    blocks = [
        [3.0 * eye, -eye, 0 * eye],
        [full, 6.0 * eye + full, rng.standard_normal((n, n))],
        [0 * eye, -2 * eye, 4 * eye],
    ]
    matrix = np.block(blocks)
    known = np.isin(matrix, (0.0, -1.0))
    rows = [
        [np.float64(x) if k else jnp.asarray(x) for x, k in zip(*each, strict=True)]
        for each in zip(matrix, known, strict=True)
    ]
    return matrix, rows


@pytest.mark.quick
@pytest.mark.parametrize("pivot", [False, True])
def test_lu_of_a_matrix_whose_zeros_are_known(pivot: bool) -> None:
    matrix, rows = sparse(3, 5)
    rhs = np.random.default_rng(6).standard_normal(9)
    x = factor_lu(rows, pivot=pivot)(list(jnp.asarray(rhs)))
    np.testing.assert_allclose(jnp.stack(x), np.linalg.solve(matrix, rhs), rtol=ROUNDING, atol=ROUNDING)


def test_lu_leaves_out_what_is_known_to_be_zero() -> None:
    """Coordinates and bristles first: what is left to eliminate are the velocities alone."""
    matrix, rows = sparse(3, 5)
    dense = [[jnp.asarray(x) for x in row] for row in matrix]

    def products(rows: list[list[Any]]) -> int:
        """In two substitutions."""
        solve = factor_lu(rows, pivot=False)
        return str(jax.make_jaxpr(lambda b: solve(list(b)))(jnp.ones(9))).count(" mul ")

    # Of two dense triangles of 9 rows all; of these each velocity with both others, and with all coordinates and
    # bristles below, with its own alone above.
    assert (products(dense), products(rows)) == (72, 6 + 18 + 6)


@pytest.mark.parametrize("entry", [(3, 0), (4, 4), (3, 7), (0, 0)])
def test_derivatives_of_lu_with_known_zeros(entry: tuple[int, int]) -> None:
    matrix, rows = sparse(3, 5)
    rhs = jnp.asarray(np.random.default_rng(6).standard_normal(9))
    i, j = entry

    def solve(value: jax.Array) -> jax.Array:
        changed = [[value if (a, b) == entry else x for b, x in enumerate(row)] for a, row in enumerate(rows)]
        return jnp.stack(factor_lu(changed, pivot=False)(list(rhs)))

    inverse = np.linalg.inv(matrix)
    expected = -inverse[:, i] * (inverse @ rhs)[j]
    value = jnp.asarray(matrix[i, j])
    np.testing.assert_allclose(jax.jacfwd(solve)(value), expected, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(jax.jacrev(solve)(value), expected, rtol=1e-11, atol=1e-13)
