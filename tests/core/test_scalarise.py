"""Functions evaluated in scalars give what they give in arrays, whatever they are made of."""

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim._core import scalarise
from jaxmodsim._core.arrays import opaque_one
from jaxmodsim._core.scalarise import columns_of, in_scalars

TABLE = np.array([[0.0, 1.0, 2.0], [0.0, 0.0, 0.5], [1.0, -1.0, 3.0]])


def _last(x: Any) -> Any:
    """A loop, which is not known and gets its arrays whole."""
    return jax.lax.scan(lambda c, y: (jnp.sin(c * y), None), x[0], x)[0]


@jax.custom_jvp
def _cubed(x: Any) -> Any:
    return x**3


_cubed.defjvp(lambda x, dx: (_cubed(*x), 7.0 * dx[0]))  # a derivative that can be told from that of the cube

# Functions of one vector of three numbers, to an array of any shape.
FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "sums": lambda x: jnp.sum(x[:, None] * TABLE, axis=0) - jnp.sum(x[None, :] * TABLE),
    "running sums": lambda x: jnp.stack([jnp.cumsum(x), jnp.cumsum(x[::-1])[::-1], jax.lax.cumsum(x, reverse=True)]),
    "running sums of rows": lambda x: jnp.cumsum(x[:, None] + TABLE, axis=1),
    "matrix and vector": lambda x: TABLE @ x,
    "vector and matrix": lambda x: x @ TABLE,
    "dot": lambda x: jnp.dot(x, jnp.sin(x)),
    "matrices": lambda x: (TABLE * x[None, :]) @ jnp.outer(x, x),
    "batches": lambda x: jnp.einsum("ij,ik->ijk", TABLE, jnp.outer(x, x)) @ x,
    "batches of products": lambda x: jnp.einsum(
        "bij,bjk->bik", jnp.stack([TABLE, TABLE.T]) * x[0], jnp.ones((2, 3, 2))
    ),
    "a known NaN": lambda x: jnp.where(jnp.zeros(3) == 0, x, jnp.zeros(3) * jnp.inf),
    "parts": lambda x: jnp.concatenate([x[1:], x[:1], jnp.flip(x), x[::2], x[-1:]]),
    "padded": lambda x: jax.lax.pad(x, jnp.zeros((), x.dtype), ((1, -1, 2),)),
    "shapes": lambda x: jnp.reshape(jnp.outer(x, x).T, (1, 9))[0, 2:7],
    "tiles": lambda x: jnp.tile(x, (2, 1)),
    "split": lambda x: jnp.split(jnp.outer(x, x), [1], axis=1)[1],
    "unstacked": lambda x: jnp.unstack(jnp.outer(x, x), axis=1)[2] * jnp.unstack(x)[0],
    "entries": lambda x: x[jnp.array([2, 0, 2])],
    "rows and columns": lambda x: jnp.outer(x, x)[jnp.array([2, 0])][:, np.array([-1, 0, 1])],
    "single entries": lambda x: jnp.outer(x, x)[jnp.array([2, 0]), jnp.array([1, 1])],
    "windows": lambda x: jax.vmap(lambda i: jax.lax.dynamic_slice(x, (i,), (2,)))(jnp.array([1, 0, 9])),
    "entries by vmap": lambda x: jax.vmap(lambda row, i: row[i])(jnp.outer(x, x), jnp.array([2, 0, 1])),
    "out of range": lambda x: jnp.nan_to_num(x.at[jnp.array([5, 1])].get(mode="fill")) + x[jnp.array([7, 1])],
    "mask": lambda x: x[np.array([True, False, True])],
    "taken": lambda x: (
        jnp.take(jnp.outer(x, x), jnp.array([0, 2]), axis=1) + jnp.take_along_axis(x, jnp.array([2, 0, 1]), 0)[:, None]
    ),
    "diagonal": lambda x: jnp.diagonal(jnp.outer(x, x)) + jnp.trace(TABLE * x[0]),
    "set at indices": lambda x: (TABLE * x[0]).at[np.ix_([0, 2], [1, 2])].set(jnp.outer(x[:2], x[1:])),
    "added at indices": lambda x: jnp.zeros(3).at[jnp.array([2, 0, 2])].add(x).at[jnp.array([8, 1])].add(x[1:]),
    "updated": lambda x: jax.lax.dynamic_update_slice(jnp.outer(x, x), jnp.outer(x[:2], x[:2]), (1, 7)),
    "set": lambda x: (TABLE * x[0]).at[1].set(x).at[0, 0].add(x[1]),
    "choices": lambda x: jnp.where(x > 0.5, jnp.sqrt(jnp.abs(x)), jnp.where(jnp.eye(3) == 1, x, 2.0)),
    "bounds": lambda x: jnp.clip(x, 0.3, 0.6) + jnp.maximum(x, 0.5) - jnp.max(x) + jnp.round(3.0 * x),
    "cross": lambda x: jnp.cross(x, jnp.asarray(TABLE[2], x.dtype)),
    "norm": lambda x: jnp.linalg.norm(x) ** 1.5,
    "types": lambda x: jnp.arange(3) * x + (x > 0.4) * jnp.ones(3, jnp.int32),
    "sorted": jnp.sort,
    "solved": lambda x: jnp.linalg.solve(TABLE + jnp.diag(3.0 + x), x),
    "looked up": lambda x: jnp.interp(x, jnp.linspace(-1.0, 1.0, 9), jnp.linspace(-1.0, 1.0, 9) ** 3),
    "loop": _last,
    "known condition": lambda x: jax.lax.cond(jnp.array(True), jnp.sin, jnp.cos, x),
    "condition": lambda x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x),
    "own derivative": lambda x: _cubed(jnp.outer(x, x)),
    "inner jit": lambda x: jax.jit(lambda y: jnp.tanh(y) @ TABLE)(x) + x,
    "inner vmap": lambda x: jax.vmap(lambda y: jnp.sum(jnp.exp(y * x)))(x),
    "Hessian": jax.hessian(lambda x: jnp.prod(jnp.sin(x)) + jnp.sum(x * (TABLE @ x))),
    "empty": lambda x: jnp.concatenate([x[:0], x]) + jnp.sum(x[3:]),
    "constant": lambda x: TABLE + 0.0 * x[0],
    "nothing of it": lambda _: TABLE[0],
}

X = jnp.array([0.3, -0.7, 0.9])


def scalar(fn: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda x: in_scalars(fn, x, seed=x)


def primitives(fn: Callable[..., Any], *args: Any) -> Counter[str]:
    return Counter(eqn.primitive.name for eqn in jax.make_jaxpr(fn)(*args).jaxpr.eqns)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_derivatives(name: str) -> None:
    fn = FUNCTIONS[name]
    with jax.numpy_rank_promotion("allow"):
        for derive, x in ((lambda f: f, X), (jax.jacfwd, X), (jax.jacrev, X), (jax.vmap, jnp.stack([X, 2.0 * X]))):
            ours, theirs = jax.jit(derive(scalar(fn)))(x), jax.jit(derive(fn))(x)
            assert (ours.shape, ours.dtype) == (theirs.shape, theirs.dtype)
            np.testing.assert_allclose(ours, theirs, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_single_precision(name: str) -> None:
    fn, x = FUNCTIONS[name], X.astype(jnp.float32)
    with jax.numpy_rank_promotion("allow"):
        ours, theirs = jax.jit(scalar(fn))(x), jax.jit(fn)(x)
    assert ours.dtype == theirs.dtype
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)


def test_trees_go_in_and_out() -> None:
    def fn(x: Any, tree: Any) -> Any:
        return {"sum": x + tree["a"], "rest": (tree["b"] * x[0], None)}

    tree = {"a": jnp.arange(3.0), "b": jnp.array(2.0)}
    ours = jax.jit(lambda x, tree: in_scalars(fn, x, tree, seed=x))(X, tree)
    assert jax.tree.structure(ours) == jax.tree.structure(fn(X, tree))
    np.testing.assert_allclose(ours["sum"], X + tree["a"])
    np.testing.assert_allclose(ours["rest"][0], 2.0 * X[0])


def test_numbers_that_are_no_arrays() -> None:
    """Parameters in a dictionary of Python's numbers, as a user writes them down."""
    fn = lambda x, p: p["a"] * x + p["n"]  # noqa: E731
    ours = jax.jit(lambda x: in_scalars(fn, x, {"a": 2.5, "n": 3}, seed=x))(X)
    np.testing.assert_allclose(ours, 2.5 * X + 3)


def test_what_is_known_is_not_computed() -> None:
    """The columns of a linear function by unit vectors are its coefficients: no product is left, and no sum."""

    def columns(x: Any) -> Any:
        return jax.vmap(lambda e: jnp.stack([e[0] * x[0] + e[1], e[2] * x[1], e[1] - e[0]]))(jnp.eye(3))

    found = primitives(scalar(columns), X)
    assert not {"mul", "add", "sub"} & set(found - primitives(lambda x: 1.0 + 0.0 * x[0], X))
    np.testing.assert_array_equal(jax.jit(scalar(columns))(X), columns(X))


def test_a_zero_that_is_known_takes_away_infinity_and_another_one_does_not() -> None:
    def fn(x: Any) -> Any:
        return jnp.array([0.0, 1.0]) * jnp.stack([jnp.exp(x[0]), x[1]]) + jnp.zeros(2) * x[0] * jnp.exp(x[0])

    x = jnp.array([1e9, 3.0])
    np.testing.assert_array_equal(jax.jit(lambda x: in_scalars(fn, x, seed=x))(x), [0.0, 3.0])
    assert np.isnan(jax.jit(lambda x: in_scalars(lambda x: x * jnp.exp(x[::-1]), x, seed=x))(jnp.array([0.0, 1e9]))[0])


def test_equal_terms_are_formed_once() -> None:
    found = primitives(scalar(lambda x: jnp.sin(x) * jnp.sin(x) + jnp.sum(jnp.sin(x)) * jnp.cos(x)), X)
    assert (found["sin"], found["cos"]) == (3, 3)


def test_large_functions_and_single_numbers_stay_as_they_are() -> None:
    def long(x: Any) -> Any:
        for _ in range(100):
            x = jnp.sin(x)
        return x

    for fn, x in ((long, jnp.linspace(0.0, 1.0, 100)), (lambda x: jnp.sin(x[0]), X[:1])):
        assert primitives(partial(in_scalars, fn, seed=x), x) == primitives(fn, x)


@pytest.mark.parametrize("most", [1, scalarise.MAX_SCALARS])
def test_known_indices_are_slices_in_functions_of_any_size(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """No gather, whose derivative is a scatter, which a kernel cannot hold."""
    monkeypatch.setattr(scalarise, "MAX_SCALARS", most)
    for name in ("rows and columns", "single entries", "mask", "taken", "diagonal", "set at indices"):

        def slope(x: Any, fn: Callable[[Any], Any] = FUNCTIONS[name]) -> Any:
            return jax.grad(lambda x: jnp.sum(fn(x) ** 2))(x)

        with jax.numpy_rank_promotion("allow"):
            assert not {"gather", "scatter", "scatter-add"} & set(primitives(scalar(slope), X)), name
            np.testing.assert_allclose(jax.jit(scalar(slope))(X), slope(X), rtol=1e-12)


def test_a_function_of_entries() -> None:
    """JAX has no derivative of it."""
    np.testing.assert_array_equal(
        jax.jit(scalar(lambda x: x.at[jnp.array([2, 0])].apply(jnp.abs)))(-X), [0.3, 0.7, 0.9]
    )


def test_large_arrays_stay_whole() -> None:
    """A table of a thousand numbers, and the few that are looked up in it."""
    table = jnp.linspace(0.0, 3.0, 1000)

    def fn(x: Any) -> Any:
        return jnp.sin(jnp.sum(table) * x) + jnp.interp(x, table, table**2)

    found = primitives(scalar(fn), X)
    assert found["sin"] == 3
    assert found.total() < 200
    np.testing.assert_allclose(jax.jit(scalar(fn))(X), fn(X), rtol=1e-12)


def test_outside_of_jit_nothing_is_taken_apart() -> None:
    np.testing.assert_array_equal(in_scalars(jnp.sin, X, seed=X), jnp.sin(X))


def test_values_from_around_are_seen() -> None:
    """A function may use what is being traced outside of it, and be differentiated by it."""

    def outer(a: Any) -> Any:
        return scalar(lambda x: a * x * x)(X * a)[1]

    np.testing.assert_allclose(jax.jit(jax.grad(outer))(2.0), 3 * 2.0**2 * 0.7**2)


def test_columns_of_a_linear_function_know_their_zeros_and_ones() -> None:
    def field(q: Any, v: Any, z: Any) -> list[Any]:
        return [v, jnp.sin(q) * v - 3.0 * z, v - jnp.abs(v) * z]

    at = [jnp.asarray(x) for x in (0.3, -0.7, 0.2)]
    found: list[Any] = []

    def run(*at: Any) -> list[Any]:
        _, push = jax.linearize(field, *at)
        found.extend(columns_of(push, opaque_one(at[0]), *at))
        return [[jnp.asarray(x) for x in column] for column in found]

    columns = jax.jit(run)(*at)
    expected = jnp.stack([jnp.stack(row) for row in jax.jacfwd(lambda x: field(*x))(at)]).T
    np.testing.assert_allclose(np.array(columns), expected, rtol=1e-14)
    known = [[float(x) if isinstance(x, np.generic) else None for x in column] for column in found]
    assert known == [[0.0, None, 0.0], [1.0, None, None], [0.0, -3.0, None]]
