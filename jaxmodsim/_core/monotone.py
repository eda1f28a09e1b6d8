"""Equations `x = free - A p(x)` with A positive semidefinite and `p` mostly increasing, of any steepness.

An implicit step with friction leads to these equations: x are the slip velocities, p the impulses, A the mobility. Like
friction, p is steep at x = 0 and level elsewhere, so plain Newton steps jump back and forth across zero. A bracket of
points with known signs limits the steps here, so that the search always ends.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .arrays import apply_matrix
from .lu import MAX_UNROLLED_LU, factor_matrix, invert

# Largest numbers of evaluations in one line search, and of Newton steps for several unknowns.
_MOST_EVALUATIONS = 200
_MOST_STEPS = 200
# Newton steps after which the model of p ignores decreasing parts.
_PATIENCE = 15
# Period of evaluations that halve the bracket instead of a Newton step.
_HALVES = 4
# Residual, in rounding units of its terms, below which it counts as zero, and above which the solution is rejected.
_ROUNDING = 4.0
_LOST = 1e4
# Fraction of its first value below which the residual of a line search is small enough for the next Newton step.
_ENOUGH = 0.25


class RisingRoot(NamedTuple):
    """Root `x`, whether it is exact to rounding, and the number of evaluations."""

    x: Float[Array, ""]
    solved: Bool[Array, ""]
    evaluations: Int[Array, ""]


class _Bracket(NamedTuple):
    x: Array
    below: Array
    above: Array
    settled: Array
    tries: Array


def rising_root(
    fn: Callable[[Array], tuple[Array, Array]],
    first: Float[Array, ""],
    above: Float[Array, ""],
    least: Float[Array, ""],
) -> RisingRoot:
    """Root of a function on `x > 0` that is negative at 0 and rises through the root, by Newton steps in a bracket.

    If a Newton step leaves the bracket, the search continues from its lower end: functions that rise steeply there and
    level off lie below their tangent, so Newton steps from that side do not pass the root. Otherwise it continues in
    the middle, geometrically while the ends differ by a large factor. Of several roots it finds one near `first` where
    the function changes from negative to positive. Not differentiable, see `solve_monotone`.

    **Arguments:**

    - `fn`: `fn(x)` -> the value, and the size below which it counts as zero.
    - `first`: start value, >= 0; 0 is a root itself.
    - `above`: a point where the function is not negative, or infinity.
    - `least`: initial lower end of the bracket, > 0: negligibly small.
    """
    eps = float(jnp.finfo(first.dtype).eps)

    def iterate(s: _Bracket) -> _Bracket:
        (value, small), (slope, _) = jax.jvp(fn, (s.x,), (jnp.ones_like(s.x),))
        below = jnp.where(value < 0, s.x, s.below)
        above = jnp.where(value < 0, s.above, s.x)
        rises = slope > 0
        newton = s.x - value / jnp.where(rises, slope, 1.0)
        inside = rises & (newton > below) & (newton < above)
        forced = (s.tries % _HALVES == _HALVES - 1) & jnp.isfinite(above)
        x = jnp.where(inside & ~forced, newton, _between(below, above, least))
        still = rises & (jnp.abs(newton - s.x) <= eps * s.x)
        closed = jnp.isfinite(above) & (above - below <= 2.0 * eps * above)  # inf <= inf is true
        settled = (jnp.abs(value) <= small) | still | closed
        return _Bracket(jnp.where(settled, s.x, x), below, above, settled, s.tries + 1)

    start = _Bracket(first, jnp.zeros_like(first), above, jnp.array(False), jnp.array(0))
    end = jax.lax.while_loop(lambda s: ~s.settled & (s.tries < _MOST_EVALUATIONS), iterate, start)
    return RisingRoot(end.x, end.settled, end.tries)


def _between(below: Array, above: Array, least: Array) -> Array:
    """A point inside a bracket."""
    finite = jnp.where(jnp.isfinite(above), above, 4.0 * jnp.maximum(below, least))
    spread = finite > 4.0 * below
    middle = jnp.where(spread, jnp.sqrt(below) * jnp.sqrt(finite), 0.5 * (below + finite))
    middle = jnp.where(below == 0, jnp.where(least < finite, least, 0.5 * finite), middle)
    return jnp.where(jnp.isfinite(above), middle, finite)


class Monotone(NamedTuple):
    """Solution `x`, whether it is valid, and the number of evaluations (one unknown) or Newton steps (several)."""

    x: Float[Array, " n"]
    solved: Bool[Array, ""]
    iterations: Int[Array, ""]


def solve_monotone(
    fn: Callable[[Array], Array],
    free: Float[Array, " n"],
    coupling: Float[Array, "n n"],
    blocks: tuple[int, ...],
) -> Monotone:
    """Solve `x = free - A p(x)`.

    `rising_root` finds one unknown. Several unknowns need Newton steps with line searches, which start between the
    points where a block vanishes: steep equations have kinks there. If `p` is not increasing there may be several
    solutions; the result is one near that for constant p.

    Derivatives of any order, forward and reverse, are those of the exact solution, by the implicit function theorem.
    They do not pass through the search.

    **Arguments:**

    - `fn`: p as a function of x; each block of p depends only on the same block of x.
    - `free`: shape `[n]`.
    - `coupling`: A, symmetric and positive semidefinite, shape `[n, n]`.
    - `blocks`: sizes of the blocks.
    """
    tiny = float(jnp.finfo(free.dtype).tiny)
    fixed, constants = jax.closure_convert(fn, free)

    @jax.custom_jvp
    def root(free: Array, coupling: Array, *constants: Array) -> Monotone:
        return (_solve_one if free.shape[0] == 1 else _solve_several)(
            lambda x: fixed(x, *constants), free, coupling, blocks
        )

    def derivative(primals: tuple[Array, ...], tangents: tuple[Array | SymbolicZero, ...]) -> tuple[Monotone, Monotone]:
        solution = root(*primals)
        # A law may have no derivative at x = 0, but it has one on either side.
        aside = jnp.where(solution.x == 0, tiny, solution.x)
        moving = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero)]

        def residual(*values: Array) -> Array:
            free, coupling, *constants = [values[moving.index(i)] if i in moving else x for i, x in enumerate(primals)]
            return aside - free + apply_matrix(coupling, fixed(aside, *constants))

        _, change = jax.jvp(residual, tuple(primals[i] for i in moving), tuple(tangents[i] for i in moving))
        _, slopes = _slopes(lambda x: fixed(x, *primals[2:]), aside, blocks)
        flags = [np.zeros(x.shape, jax.dtypes.float0) for x in solution[1:]]
        change = _newton(primals[1], slopes, change)
        return solution, Monotone(change, *flags)  # pyright: ignore[reportArgumentType] # float0 is NumPy's

    root.defjvp(derivative, symbolic_zeros=True)
    return root(free, coupling, *constants)


def _slopes(fn: Callable[[Array], Array], x: Array, blocks: tuple[int, ...]) -> tuple[Array, Array]:
    """`fn(x)` and its Jacobian, which has entries within the blocks only."""
    starts = [sum(blocks[:i]) for i in range(len(blocks))]
    value, jacobian = x, jnp.zeros((x.shape[0],) * 2, x.dtype)
    for offset in range(max(blocks)):
        parts = [(start, size) for start, size in zip(starts, blocks, strict=True) if offset < size]
        unit = jnp.zeros_like(x).at[jnp.asarray([start + offset for start, _ in parts])].set(1.0)
        value, column = jax.jvp(fn, (x,), (unit,))
        rows = jnp.asarray([start + i for start, size in parts for i in range(size)])
        columns = jnp.asarray([start + offset for start, size in parts for _ in range(size)])
        jacobian = jacobian.at[rows, columns].set(column[rows])
    return value, jacobian


def _newton(coupling: Array, slopes: Array, residual: Array) -> Array:
    """`-(I + A p')^-1 residual`."""
    n = residual.shape[0]
    if n == 1:
        slope = 1.0 + coupling[0, 0] * slopes[0, 0]
        return -residual / jnp.where(slope > 0, slope, 1.0)
    matrix = jnp.eye(n, dtype=residual.dtype) + jnp.sum(coupling[:, :, None] * slopes[None, :, :], axis=1)
    solve = invert(matrix, pivot=True) if n > MAX_UNROLLED_LU else factor_matrix(matrix)
    return -solve(residual)


def _solve_one(fn: Callable[[Array], Array], free: Array, coupling: Array, blocks: tuple[int, ...]) -> Monotone:
    """Search from x = 0 in the direction of the root."""
    del blocks
    eps, tiny = float(jnp.finfo(free.dtype).eps), float(jnp.finfo(free.dtype).tiny)
    free0, a = free[0], coupling[0, 0]
    guess = free0 - a * fn(jnp.zeros_like(free))[0]
    side = jnp.where(guess < 0, -1.0, 1.0).astype(free.dtype)

    def residual(size: Array) -> tuple[Array, Array]:
        push = a * fn((side * size)[None])[0]
        # Below the normal numbers rounding is absolute.
        small = _ROUNDING * eps * (size + jnp.abs(free0) + jnp.abs(push)) + tiny
        return size + side * (push - free0), small

    never = jnp.full_like(free0, jnp.inf)
    root = rising_root(residual, jnp.abs(guess), never, jnp.full_like(free0, tiny))
    return Monotone((side * root.x)[None], root.solved, root.evaluations)


class _RootIterate(NamedTuple):
    x: Array
    # `x = free - A push` up to rounding.
    push: Array
    settled: Array
    # Largest residual in rounding units of its terms.
    misfit: Array
    tries: Array


def _solve_several(fn: Callable[[Array], Array], free: Array, coupling: Array, blocks: tuple[int, ...]) -> Monotone:
    """Newton steps with a length from the derivative, along the step, of the energy that x minimizes.

    That derivative is `s.(p(x) - push)`. It also determines the length if p has no potential or decreases.
    """
    eps, tiny = float(jnp.finfo(free.dtype).eps), float(jnp.finfo(free.dtype).tiny)

    def iterate(s: _RootIterate) -> _RootIterate:
        value, slopes = _slopes(fn, s.x, blocks)
        residual = s.x - free + apply_matrix(coupling, value)
        size = jnp.abs(value) + apply_matrix(jnp.abs(slopes), jnp.abs(s.x))
        scale = jnp.abs(s.x) + jnp.abs(free) + apply_matrix(jnp.abs(coupling), size)
        misfit = jnp.max(jnp.abs(residual) / (eps * scale + tiny))
        # If p decreases, Newton steps may cycle; those of an increasing model do not.
        slopes = jnp.where(s.tries < _PATIENCE, slopes, _increasing(slopes))
        step = _newton(coupling, slopes, residual)
        change = value - s.push + apply_matrix(slopes, step)
        # Products with a step underflow, unless it is in units of its largest entry.
        descends = jnp.sum(step / jnp.maximum(jnp.max(jnp.abs(step)), tiny) * (value - s.push)) < 0
        step = jnp.where(descends, step, -residual)
        change = jnp.where(descends, change, value - s.push)
        still = jnp.all(jnp.abs(step) <= eps * jnp.abs(s.x))
        # The rounding error of p is unknown: close to the solution the search ends when progress stops.
        ends = (misfit <= _LOST) & (misfit >= 0.5 * s.misfit)
        settled = (misfit <= _ROUNDING) | still | ends
        length = _length(fn, s.x, s.push, step, change, blocks, value - s.push, settled)
        # Blocks of several unknowns may have no potential; shorter steps then end their cycles.
        short = (s.tries >= 2 * _PATIENCE) & (s.tries % 3 == 0)
        length = jnp.where(settled, 0.0, jnp.where(short, 0.5, 1.0) * length)
        return _RootIterate(s.x + length * step, s.push + length * change, settled, misfit, s.tries + 1)

    push = fn(jnp.zeros_like(free))
    never = jnp.full_like(free[0], jnp.inf)
    start = _RootIterate(free - apply_matrix(coupling, push), push, jnp.array(False), never, jnp.array(0))
    end = jax.lax.while_loop(lambda s: ~s.settled & (s.tries < _MOST_STEPS), iterate, start)
    return Monotone(end.x, end.settled | (end.misfit <= _LOST), end.tries)


def _increasing(slopes: Array) -> Array:
    """Slopes without a decreasing part: a larger diagonal makes the symmetric part diagonally dominant."""
    symmetric = 0.5 * (slopes + slopes.T)
    off_diagonal = jnp.sum(jnp.abs(symmetric), axis=1) - jnp.abs(jnp.diagonal(symmetric))
    return slopes + jnp.diag(jnp.maximum(off_diagonal - jnp.diagonal(symmetric), 0.0))


def _length(
    fn: Callable[[Array], Array],
    x: Array,
    push: Array,
    step: Array,
    change: Array,
    blocks: tuple[int, ...],
    first: Array,
    settled: Array,
) -> Array:
    """Length of a Newton step, at most 1; `first` is `p(x) - push` at its beginning. 1 if `settled`."""
    largest = jnp.maximum(jnp.max(jnp.abs(step)), float(jnp.finfo(x.dtype).tiny))
    towards = step / largest

    def along(length: ArrayLike) -> Array:
        return jnp.sum(towards * (fn(x + length * step) - push - length * change))

    eps, one = float(jnp.finfo(x.dtype).eps), jnp.ones_like(largest)
    enough = -_ENOUGH * jnp.sum(towards * first)
    kinks, start = [], 0
    for size in blocks:
        part = slice(start, start + size)
        square = jnp.sum(towards[part] * towards[part])
        kinks.append(-jnp.sum(x[part] / largest * towards[part]) / jnp.where(square > 0, square, 1.0))
        start += size
    places = jnp.stack(kinks)
    between = (places > 0) & (places < 1)

    def search() -> Array:
        values = jax.vmap(along)(places)
        below = jnp.max(jnp.where(between & (values < 0), places, 0.0))
        above = jnp.min(jnp.where(between & (values >= 0), places, 1.0))
        width = above - below
        least = jnp.where(below > 0, 4.0 * eps * below, width / 64.0)
        return below + rising_root(lambda s: (along(below + s), jnp.abs(enough)), 0.5 * width, width, least).x

    return jax.lax.cond(settled | (along(one) <= enough), lambda: one, search)
