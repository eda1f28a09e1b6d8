"""Equations `x = free - A p(x)` with A positive semidefinite and `p` mostly increasing, however steep it is.

They are what an implicit step leaves of friction: x the slip velocities, p the impulses, A the mobility. Where p is
steep at x = 0 and level elsewhere, as friction is, plain Newton steps jump back and forth across it. Here they are kept
between points where the sign is known, so that the search always ends.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .lu import MAX_UNROLLED_LU, factor_lu, invert

# Evaluations of one search along a line, and Newton steps of several unknowns.
_MOST_EVALUATIONS = 200
_MOST_STEPS = 200
# Newton steps after which decreasing parts of p are left out of its model.
_PATIENCE = 15
# Every so many evaluations the bracket is halved whatever Newton's method says.
_HALVES = 4
# Rounding units of its terms below which a residual counts as zero, and above which a solution is none.
_ROUNDING = 4.0
_LOST = 1e4
# Part of its first size below which a residual along a line is small enough for the next Newton step.
_ENOUGH = 0.25


class RisingRoot(NamedTuple):
    """Root `x`, whether it was found to rounding, and how many evaluations that took."""

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

    Where a Newton step leaves the bracket the search goes on from its lower end, as functions that rise steeply there
    and level off lie below their tangent, and Newton steps from that side do not pass the root; or in the middle,
    geometrically as long as the ends differ by much. Of several roots it is one near `first`, where the function
    passes from below zero to above. Not differentiable: see `solve_monotone`.

    **Arguments:**

    - `fn`: `fn(x)` -> the value, and the size below which it counts as zero.
    - `first`: where to begin, >= 0; a root itself if zero.
    - `above`: where the function is known not to be negative, or infinity.
    - `least`: the lower end of the bracket to begin with, > 0: as near to 0 as makes no difference.
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
        settled = (jnp.abs(value) <= small) | still | (above - below <= 2.0 * eps * above)
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
    """Solution `x`, whether it was found, and how many evaluations (one unknown) or Newton steps (several) it took."""

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

    One unknown is found by `rising_root`, several by Newton steps with a search along each, which takes the places
    where a block vanishes for the kinks that they are in steep equations. Where `p` is not increasing there may be
    several solutions: it is one near that for constant p.

    Derivatives, forward and reverse, are those of the exact solution by the implicit function theorem; no
    differentiation runs through the search.

    **Arguments:**

    - `fn`: p, of x as a whole; each block of p depends on the same block of x alone.
    - `free`: shape `[n]`.
    - `coupling`: A, symmetric and positive semidefinite, shape `[n, n]`.
    - `blocks`: sizes of the blocks.
    """
    tiny = float(jnp.finfo(free.dtype).tiny)
    fixed, constants = jax.closure_convert(fn, free)
    constants, free0, a = jax.lax.stop_gradient((constants, free, coupling))

    def value(x: Array) -> Array:
        return fixed(x, *constants)

    solution = (_solve_one if free.shape[0] == 1 else _solve_several)(value, free0, a, blocks)
    x = jax.lax.stop_gradient(solution.x)
    # At x = 0 a law may have no derivative; it has one on either side.
    aside = jnp.where(x == 0, tiny, x)
    residual = aside - free + _times(coupling, fn(aside))
    slopes = _slopes(value, aside, blocks)[1]
    change = _newton(a, slopes, residual - jax.lax.stop_gradient(residual))
    return Monotone(x + change, solution.solved, solution.iterations)


def _times(matrix: Array, x: Array) -> Array:
    return jnp.sum(matrix * x[None, :], axis=1)


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
    if n > MAX_UNROLLED_LU:
        return -invert(matrix, pivot=True)(residual)
    solve = factor_lu([[matrix[i, j] for j in range(n)] for i in range(n)], pivot=True)
    return -jnp.stack(solve([residual[i] for i in range(n)]))


def _solve_one(fn: Callable[[Array], Array], free: Array, coupling: Array, blocks: tuple[int, ...]) -> Monotone:
    """Along x from 0 in the direction in which the root lies."""
    del blocks
    eps, tiny = float(jnp.finfo(free.dtype).eps), float(jnp.finfo(free.dtype).tiny)
    free0, a = free[0], coupling[0, 0]
    guess = free0 - a * fn(jnp.zeros_like(free))[0]
    side = jnp.where(guess < 0, -1.0, 1.0).astype(free.dtype)

    def residual(size: Array) -> tuple[Array, Array]:
        push = a * fn((side * size)[None])[0]
        small = _ROUNDING * eps * (size + jnp.abs(free0) + jnp.abs(push))
        return size + side * (push - free0), small

    never = jnp.full_like(free0, jnp.inf)
    root = rising_root(residual, jnp.abs(guess), never, jnp.full_like(free0, tiny))
    return Monotone((side * root.x)[None], root.solved, root.evaluations)


class _RootIterate(NamedTuple):
    x: Array
    # With `x = free - A push` but for rounding.
    push: Array
    settled: Array
    # Largest residual in rounding units of its terms.
    misfit: Array
    tries: Array


def _solve_several(fn: Callable[[Array], Array], free: Array, coupling: Array, blocks: tuple[int, ...]) -> Monotone:
    """Newton steps, each as long as the derivative along it of the energy that x minimises says.

    That derivative is `s.(p(x) - push)`; where p has no potential, or decreases, it still says how far to go.
    """
    eps = float(jnp.finfo(free.dtype).eps)

    def iterate(s: _RootIterate) -> _RootIterate:
        value, slopes = _slopes(fn, s.x, blocks)
        residual = s.x - free + _times(coupling, value)
        size = jnp.abs(value) + _times(jnp.abs(slopes), jnp.abs(s.x))
        scale = jnp.abs(s.x) + jnp.abs(free) + _times(jnp.abs(coupling), size)
        misfit = jnp.max(jnp.abs(residual) / jnp.where(scale > 0, eps * scale, 1.0))
        # Where p decreases, Newton steps may run in circles, and those of a model that does not decrease do not.
        slopes = jnp.where(s.tries < _PATIENCE, slopes, _increasing(slopes))
        step = _newton(coupling, slopes, residual)
        change = value - s.push + _times(slopes, step)
        descends = jnp.sum(step * (value - s.push)) < 0
        step = jnp.where(descends, step, -residual)
        change = jnp.where(descends, change, value - s.push)
        still = jnp.all(jnp.abs(step) <= eps * jnp.abs(s.x))
        # By how much p itself rounds is not known: where x is as good as found, it ends with the progress.
        ends = (misfit <= _LOST) & (misfit >= 0.5 * s.misfit)
        settled = (misfit <= _ROUNDING) | still | ends
        first = jnp.sum(step * (value - s.push))
        length = _length(fn, s.x, s.push, step, change, blocks, first, settled)
        # Blocks of several unknowns may have no potential, and steps circle there, too, until some are cut short.
        short = (s.tries >= 2 * _PATIENCE) & (s.tries % 3 == 0)
        length = jnp.where(settled, 0.0, jnp.where(short, 0.5, 1.0) * length)
        return _RootIterate(s.x + length * step, s.push + length * change, settled, misfit, s.tries + 1)

    push = fn(jnp.zeros_like(free))
    never = jnp.full_like(free[0], jnp.inf)
    start = _RootIterate(free - _times(coupling, push), push, jnp.array(False), never, jnp.array(0))
    end = jax.lax.while_loop(lambda s: ~s.settled & (s.tries < _MOST_STEPS), iterate, start)
    return Monotone(end.x, end.settled | (end.misfit <= _LOST), end.tries)


def _increasing(slopes: Array) -> Array:
    """Slopes without a decreasing part: the diagonal raised until it dominates."""
    even = 0.5 * (slopes + slopes.T)
    beside = jnp.sum(jnp.abs(even), axis=1) - jnp.abs(jnp.diagonal(even))
    return slopes + jnp.diag(jnp.maximum(beside - jnp.diagonal(even), 0.0))


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
    """Length of a Newton step, at most 1, along which the derivative begins with `first` < 0; 1 where `settled`."""

    def along(length: ArrayLike) -> Array:
        return jnp.sum(step * (fn(x + length * step) - push - length * change))

    eps, one = float(jnp.finfo(x.dtype).eps), jnp.ones_like(first)
    enough = -_ENOUGH * first
    kinks, start = [], 0
    for size in blocks:
        part = slice(start, start + size)
        square = jnp.sum(step[part] * step[part])
        kinks.append(-jnp.sum(x[part] * step[part]) / jnp.where(square > 0, square, 1.0))
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
