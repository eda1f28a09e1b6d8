"""One step of Gauss collocation, solved to rounding, on pytree states."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from .._core.arrays import fusion_barrier, opaque_one
from .._core.lu import MAX_UNROLLED_LU, factor_lu, invert
from ._state_layout import Layout, Parts, State

MAX_ITERATIONS = 50
# The last changes of a solved step are rounding: below this power of the rounding unit relative to the unknown, or
# below this number of rounding units of the largest unknown, if forces cancel.
_POWER = 0.5
_UNITS = 256.0

Rates = Callable[[Array, Parts], Parts]


def _lagrange(nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Values of the Lagrange polynomials of `nodes` (columns) at `points` (rows)."""
    return np.linalg.solve(np.vander(nodes, increasing=True).T, np.vander(points, nodes.size, increasing=True).T).T


def _bend(points: np.ndarray, powers: int) -> np.ndarray:
    """Derivatives of `s (1-s) s^j`, j < powers (columns), at `points` (rows)."""
    s, j = points[:, None], np.arange(powers)[None, :]
    return (1.0 - 2.0 * s) * s**j + s * (1.0 - s) * j * s ** np.maximum(j - 1, 0)


@dataclass(frozen=True)
class GaussCollocation:
    r"""Coefficients of the Gauss method with `s` stages, an implicit Runge-Kutta method of order `2 s`.

    With increments `l_j = dt b_j f(t + c_j dt, y_j)` its stages are `y_i = y + sum_j m_ij l_j`, `m_ij = a_ij/b_j`, and
    `y1 = y + sum_j l_j`. In this form the method is symplectic if `m_ij + m_ji = 1`, for any rounding of `b`.
    `coupling` satisfies that exactly, so that the rounding of coefficients causes no drift.

    **Arguments:**

    - `nodes`, `weights`: `c_i`, `b_i`, shape `[stages]`.
    - `lower`: `m_ij` for i > j, all between 1/2 and 2; zero elsewhere; shape `[stages, stages]`.

    ??? cite "Reference"

        ```bibtex
        @article{antonana2017reducing,
            author={Anto{\~n}ana, Mikel and Makazaga, Joseba and Murua, Ander},
            title={Reducing and monitoring round-off error propagation for symplectic implicit {R}unge--{K}utta
                   schemes},
            journal={Numerical Algorithms}, volume={76}, year={2017},
        }
        ```
    """

    nodes: np.ndarray
    weights: np.ndarray
    lower: np.ndarray

    def coupling(self, dtype: Any) -> np.ndarray:
        """`m` in numbers of `dtype`, with `m_ij + m_ji = 1` without rounding."""
        lower = np.tril(self.lower, -1).astype(dtype)
        upper = np.triu((1.0 - lower.T).astype(dtype), 1)
        return lower + upper + 0.5 * np.eye(self.nodes.size, dtype=dtype)

    def guess(self) -> np.ndarray:
        """Weights that extrapolate slopes to the next step of the same length, shape `[stages, stages]`."""
        return _lagrange(self.nodes - 1.0, self.nodes)

    def inner(self) -> np.ndarray:
        """Nodes whose slopes the dense output uses besides those of both ends."""
        return self.nodes[[0, -1]] if self.nodes.size > 2 else np.zeros(0)

    def dense(self) -> np.ndarray:
        """Weights that map slopes, less the mean slope, at 0, `inner` and 1 to the `K` of `CollocationStep`."""
        points = np.concatenate([[0.0], self.inner(), [1.0]])
        return np.linalg.inv(_bend(points, points.size))


_ROOT3, _ROOT15 = 3.0**0.5, 15.0**0.5
GAUSS = {
    1: GaussCollocation(np.array([0.5]), np.array([1.0]), np.zeros((1, 1))),
    2: GaussCollocation(
        np.array([0.5 - _ROOT3 / 6.0, 0.5 + _ROOT3 / 6.0]),
        np.array([0.5, 0.5]),
        np.array([[0.0, 0.0], [0.5 + _ROOT3 / 3.0, 0.0]]),
    ),
    3: GaussCollocation(
        np.array([0.5 - _ROOT15 / 10.0, 0.5, 0.5 + _ROOT15 / 10.0]),
        np.array([5.0 / 18.0, 4.0 / 9.0, 5.0 / 18.0]),
        np.array(
            [[0.0, 0.0, 0.0], [0.5 + 0.15 * _ROOT15, 0.0, 0.0], [0.5 + 0.12 * _ROOT15, 0.5 + 0.15 * _ROOT15, 0.0]]
        ),
    ),
}


class CollocationMemory(NamedTuple):
    """Memory from a step to the next: the slopes of its stages, and the rounding error of its end."""

    slopes: list[Parts]
    rest: Parts


@dataclass(frozen=True)
class CollocationStep:
    """Result of one step.

    - `y1`: the state at its end; NaN if the iteration did not converge.
    - `dense`: vectors `K` of `y(t + s dt) = (1-s) y0 + s (y1 + (1-s) (K_1 + s (K_2 + ...)))`.
    - `memory`: for the next step.
    - `solved`: whether the iteration converged.
    - `iterations`: number of evaluations of the stages.
    """

    y1: State
    dense: tuple[State, ...]
    memory: CollocationMemory
    solved: Bool[Array, ""]
    iterations: Int[Array, ""]


class _SolvedStages(NamedTuple):
    slopes: list[Parts]
    solved: Array
    iterations: Array


# Tangents of `solved` and `iterations`.
_NO_TANGENTS: Any = (None, None)


class _StageIteration(NamedTuple):
    slopes: list[Parts]
    # The largest change of any stage's slope in the last iteration, and the smallest such change above zero so far.
    change: Parts
    least: Parts
    settled: Array
    iterations: Array


def _sum(terms: list[Array]) -> Array:
    return reduce(jnp.add, terms)


def _largest(terms: list[Array]) -> Array:
    return reduce(jnp.maximum, terms)


def _increments(method: GaussCollocation, dt: Array, slopes: list[Parts]) -> list[Parts]:
    return [
        [(dt * float(b)).astype(x.dtype) * x for x in slope] for b, slope in zip(method.weights, slopes, strict=True)
    ]


def _combine(weights: np.ndarray, terms: list[Parts]) -> Parts:
    """`sum_j weights_j terms_j`."""
    return [
        _sum([float(weight) * x for weight, x in zip(weights, column, strict=True)])
        for column in zip(*terms, strict=True)
    ]


def _points(method: GaussCollocation, dt: Array, y: Parts, rest: Parts, slopes: list[Parts]) -> list[Parts]:
    """The stages."""
    steps = _increments(method, dt, slopes)
    points = []
    for i in range(method.nodes.size):
        point = []
        for m, (x, r) in enumerate(zip(y, rest, strict=True)):
            weights = method.coupling(x.dtype)[i]
            point.append(x + (r + _sum([float(w) * step[m] for w, step in zip(weights, steps, strict=True)])))
        points.append(point)
    return points


def _slopes(
    method: GaussCollocation, rates: Rates, t0: Array, dt: Array, y: Parts, rest: Parts, slopes: list[Parts]
) -> list[Parts]:
    """The map whose fixed point is the slopes of the stages."""
    points = _points(method, dt, y, rest, slopes)
    return [rates(t0 + float(c) * dt, point) for c, point in zip(method.nodes, points, strict=True)]


def _small(method: GaussCollocation, dt: Array, y: Parts, search: _StageIteration) -> Array:
    """Whether the last change of every unknown is rounding, which is not so if the iteration diverges."""
    steps = _increments(method, dt, search.slopes)
    scales = [jnp.abs(x) + _sum([jnp.abs(step[m]) for step in steps]) for m, x in enumerate(y)]
    overall = reduce(jnp.maximum, [jnp.max(scale) for scale in scales])
    small = jnp.array(True)
    for scale, change in zip(scales, search.change, strict=True):
        eps = float(jnp.finfo(scale.dtype).eps)
        bound = jnp.maximum(eps**_POWER * scale, (_UNITS * eps) * overall.astype(scale.dtype))
        small &= jnp.all(jnp.abs(dt).astype(scale.dtype) * change <= bound)
    return small


@eqx.filter_custom_jvp
def _solve(stages: int, rates: Rates, t0: Array, dt: Array, y: Parts, rest: Parts, guess: list[Parts]) -> _SolvedStages:
    """Slopes of the stages by fixed-point iteration; zeros if it does not converge.

    The iteration continues until no unknown changes less than before: any tolerance would leave an error of one sign,
    and energy would drift. A check after every second iteration is faster, and robust if changes of positions and of
    momenta alternate.
    """
    method, unit = GAUSS[stages], opaque_one(t0)

    def iterate(search: _StageIteration) -> _StageIteration:
        before = fusion_barrier(_slopes(method, rates, t0, dt, y, rest, search.slopes), unit)
        slopes = fusion_barrier(_slopes(method, rates, t0, dt, y, rest, before), unit)
        change, least, settled = [], [], jnp.array(True)
        for m, smallest in enumerate(search.least):
            size = _largest([jnp.abs(new[m] - old[m]) for new, old in zip(slopes, before, strict=True)])
            settled &= jnp.all((size == 0) | (size >= smallest))
            change.append(size)
            least.append(jnp.where(size > 0, jnp.minimum(size, smallest), smallest))
        return _StageIteration(slopes, change, least, settled, search.iterations + 2)

    def unsettled(search: _StageIteration) -> Array:
        return ~search.settled & (search.iterations < MAX_ITERATIONS)

    never = [jnp.full_like(x, jnp.inf) for x in y]
    search = jax.lax.while_loop(
        unsettled, iterate, _StageIteration(guess, never, never, jnp.array(False), jnp.array(0))
    )
    solved = search.settled & _small(method, dt, y, search)
    slopes = [[jnp.where(solved, x, 0.0) for x in slope] for slope in search.slopes]
    return _SolvedStages(slopes, solved, search.iterations)


def _jacobian(rates: Rates, t: Array, point: Parts, unrolled: bool) -> Any:
    """Jacobian of the field: rows of scalars, or one matrix."""
    _, push = jax.linearize(lambda p: rates(t, p), point)
    n = sum(x.size for x in point)
    if unrolled:
        columns = [push([jnp.full_like(x, float(i == j)) for i, x in enumerate(point)]) for j in range(n)]
        return [[column[i] for column in columns] for i in range(n)]
    basis = jnp.eye(n)
    if len(point) == 1:
        return jax.vmap(push, out_axes=1)([basis.astype(point[0].dtype)])[0]
    return jnp.stack(jax.vmap(push)([row.astype(x.dtype) for row, x in zip(basis, point, strict=True)]))


def _solve_linear(
    method: GaussCollocation, rates: Rates, t0: Array, dt: Array, points: list[Parts], rhs: list[Parts]
) -> list[Parts]:
    """`x` of `x_i - J_i sum_j dt a_ij x_j = rhs_i`, with the field's Jacobians `J_i` at the stages."""
    s, n = method.nodes.size, sum(x.size for x in points[0])
    dtype = jnp.result_type(*points[0])
    # dt a_ij, shape [stages, stages].
    a = dt.astype(dtype) * jnp.asarray(method.coupling(dtype) * method.weights, dtype)
    unrolled = s * n <= MAX_UNROLLED_LU
    jacobians = [
        _jacobian(rates, t0 + float(c) * dt, point, unrolled) for c, point in zip(method.nodes, points, strict=True)
    ]
    if unrolled:
        rows = [
            [float(i == k and p == q) - a[i, k] * jacobians[i][p][q] for k in range(s) for q in range(n)]
            for i in range(s)
            for p in range(n)
        ]
        # If the fixed-point iteration converged, the unit matrix less this one has a spectral radius well below one, so
        # that pivots are near one unless the field shears strongly. Swaps would cost a factor of three, and a minute of
        # compile time at twelve unknowns.
        x = factor_lu(rows, pivot=False)([b for slope in rhs for b in slope])
        return [[x[i * n + p].astype(b.dtype) for p, b in enumerate(slope)] for i, slope in enumerate(rhs)]
    matrix = jnp.eye(s * n, dtype=dtype) - jnp.concatenate([jnp.kron(a[i : i + 1], jacobians[i]) for i in range(s)])
    vector = jnp.concatenate([jnp.ravel(b).astype(dtype) for slope in rhs for b in slope])
    x = jnp.reshape(invert(matrix, pivot=True)(vector), (s, n))
    if len(points[0]) == 1:
        return [[x[i]] for i in range(s)]
    return [[x[i, p].astype(b.dtype) for p, b in enumerate(slope)] for i, slope in enumerate(rhs)]


@_solve.def_jvp
def _solve_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[_SolvedStages, Any]:
    """Implicit function theorem at the solution; guess and rounding errors have no derivative."""
    stages, rates, t0, dt, y, rest, guess = primals
    method = GAUSS[stages]
    solution = _solve(stages, rates, t0, dt, y, rest, guess)
    inputs, motions = primals[1:5], tangents[1:5]
    still = jax.tree.map(lambda x: x is None, motions, is_leaf=lambda x: x is None)
    fixed, moving = eqx.partition(inputs, still)

    def slopes(moving: Any) -> list[Parts]:
        rates, t0, dt, y = eqx.combine(moving, fixed)
        return _slopes(method, rates, t0, dt, y, rest, solution.slopes)

    _, rhs = jax.jvp(slopes, (moving,), (motions,))
    points = _points(method, dt, y, rest, solution.slopes)
    return solution, _SolvedStages(_solve_linear(method, rates, t0, dt, points, rhs), *_NO_TANGENTS)


def collocation_start(stages: int, field: Callable[[Array, State], State], t0: Array, y0: State) -> CollocationMemory:
    """Memory for the first step, as if the slope had been constant before."""
    layout = Layout(y0)
    parts = layout.split(y0)
    slope = [r.astype(x.dtype) for r, x in zip(layout.split(field(t0, y0)), parts, strict=True)]
    return jax.lax.stop_gradient(CollocationMemory([slope] * stages, [jnp.zeros_like(x) for x in parts]))


def collocation_step(
    stages: int,
    field: Callable[[Array, State], State],
    t0: Array,
    dt: Array,
    y0: State,
    memory: CollocationMemory,
) -> CollocationStep:
    """Advance `y' = field(t, y)` from `t0` by `dt` with a method of `GAUSS`.

    **Arguments:**

    - `stages`: 1, 2 or 3.
    - `field`: `(t, y) -> dy/dt`, differentiable by JAX.
    - `t0`, `dt`: start and length of the step, scalars.
    - `y0`: state at `t0`, any pytree of real floating arrays.
    - `memory`: that of the step before, or `collocation_start`. Its slopes only start the iteration; its `rest`,
      below one rounding unit, is added to `y0`.

    **Returns:**

    A `CollocationStep`.
    """
    method, layout = GAUSS[stages], Layout(y0)
    y = layout.split(y0)

    def flow(t: Array, p: Parts) -> Parts:
        return [r.astype(x.dtype) for r, x in zip(layout.split(field(t, layout.join(p))), p, strict=True)]

    guess = [_combine(weights, memory.slopes) for weights in method.guess()]
    rates = eqx.filter_closure_convert(flow, t0, y)
    slopes, solved, iterations = _solve(stages, rates, t0, dt, y, memory.rest, jax.lax.stop_gradient(guess))

    # Compensated summation: the rounding error of y1 is added in the next step.
    moves = [_sum([r, *column]) for r, *column in zip(memory.rest, *_increments(method, dt, slopes), strict=True)]
    y1 = [x + move for x, move in zip(y, moves, strict=True)]
    rest = [move - (end - x) for x, end, move in zip(y, y1, moves, strict=True)]
    dense = _dense(method, rates, t0, dt, (y, y1), slopes)
    return CollocationStep(
        layout.join([jnp.where(solved, x, jnp.nan) for x in y1]),
        tuple(layout.join(k) for k in dense),
        jax.lax.stop_gradient(CollocationMemory(slopes, rest)),
        solved,
        iterations,
    )


def _dense(
    method: GaussCollocation, rates: Rates, t0: Array, dt: Array, ends: tuple[Parts, Parts], slopes: list[Parts]
) -> list[Parts]:
    """Hermite interpolation from both ends; with three stages in two rounds.

    The stages' slopes have errors of order 4 in dt. A polynomial through them has order 5, and the slopes at its own
    points then give one of order 6.
    """
    y0, y1 = ends
    weights, inner = method.dense(), method.inner()
    length = [dt.astype(x.dtype) for x in y0]

    def bends(slopes: list[Parts]) -> list[Parts]:
        against = [
            [h * r - (b - a) for h, r, a, b in zip(length, slope, y0, y1, strict=True)]
            for slope in (first, *slopes, last)
        ]
        return [_combine(row, against) for row in weights]

    first, last = rates(t0, y0), rates(t0 + dt, y1)
    if inner.size == 0:
        return bends([])
    k = bends([slopes[0], slopes[-1]])
    refined = []
    for c in inner:
        bend = _combine(c * (1.0 - c) * c ** np.arange(len(k)), k)
        point = [a + (float(c) * (b - a) + e) for a, b, e in zip(y0, y1, bend, strict=True)]
        refined.append(rates(t0 + float(c) * dt, point))
    return bends(refined)
