"""One step of a Rosenbrock method, for any tableau, on pytree states."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._core.arrays import fusion_barrier, opaque_one
from .._core.lu import LinearSolver, factor_lu, invert, is_zero
from .._core.scalarise import columns_of, sizes_of
from ._state_layout import Layout, Parts, State

# Up to this many state entries, and values in the field, the stages are unrolled; above they are one loop. On two
# shared cores in float64, a box with one LuGre bristle (3 entries, 69 values) takes 43 us a run unrolled and 73 us in a
# loop under vmap over 256 runs, 132 and 142 us alone. A belt with a Stribeck curve (2 entries, 182 values) takes 1.04
# and 1.13 ms, 0.79 and 0.97 ms alone, and its reverse gradient compiles in 28 and 18 s of processor time; a puck on a
# turntable (4 entries, 219 values) takes 309 and 306 us, 343 and 347 us alone, and its gradient 52 and 34 s.
_MAX_WRITTEN_OUT, _MAX_VALUES = 4, 150

# Maps time, state, field there and a shift to the solver of `(shift I - J) x = rhs`, J the Jacobian of the field.
ShiftedSolver: TypeAlias = Callable[[Array, State, State, Array], Callable[[State], State]]
# The field at a node of the tableau, at a point moved by a sum of increments; and the increment of a stage from the
# field there, its sum of increments (None for none) and its share of the time derivative.
_Slope: TypeAlias = Callable[[ArrayLike, Parts], Parts]
_Increment: TypeAlias = Callable[[Parts, Parts | None, ArrayLike], Parts]


@dataclass(frozen=True)
class RosenbrockTableau:
    """Coefficients of a Rosenbrock method in the form that needs no product with the Jacobian.

    With `W = I/(dt gamma) - J`, stage i solves
    `W k_i = f(t + c_i dt, y + sum_j a_ij k_j) + (1/dt) sum_j c_ij k_j + dt d_i f_t`, and
    `y1 = y + sum_j b_j k_j`, error estimate `sum_j e_j k_j`. Equal rows share one field evaluation.

    **Arguments:**

    - `gamma`: diagonal coefficient.
    - `stage`: strictly lower triangular `a`, shape `[stages, stages]`.
    - `coupling`: strictly lower triangular `c`, shape `[stages, stages]`.
    - `nodes`: `c_i`, shape `[stages]`.
    - `time`: `d_i`, shape `[stages]`.
    - `solution`, `error`: `b`, `e`, shape `[stages]`.
    - `dense`: `H` of the dense output `y(t + s dt) = (1-s) y0 + s (y1 + (1-s) (K_1 + s (K_2 + s K_3)))`,
      `K = H k`, shape `[3, stages]`; None for a method without dense output.
    """

    gamma: float
    stage: np.ndarray
    coupling: np.ndarray
    nodes: np.ndarray
    time: np.ndarray
    solution: np.ndarray
    error: np.ndarray
    dense: np.ndarray | None = None


class RosenbrockStep(NamedTuple):
    """Result of one step: the state at its end, the error estimate, and the vectors `K` of the dense output."""

    y1: State
    error: State
    dense: tuple[State, ...]


def _combine(weights: np.ndarray, terms: list[Parts]) -> Parts:
    """`sum_j weights_j terms_j`, without zero weights and without products by one; one weight must not be zero."""
    scaled = [
        term if weight == 1.0 else [float(weight) * x for x in term]
        for weight, term in zip(weights, terms, strict=False)
        if weight != 0.0
    ]
    total = scaled[0]
    for term in scaled[1:]:
        total = _add(total, term)
    return total


def _add(a: Parts, b: Parts) -> Parts:
    return [x + y for x, y in zip(a, b, strict=True)]


def _linearise(flow: Callable[[Array, Parts], Parts], t: Array, parts: Parts, layout: Layout) -> tuple[Parts, Any, Any]:
    """Field, its time derivative and its Jacobian from one linearisation; known entries of the latter are NumPy's."""
    f0, push = jax.linearize(lambda t, *parts: flow(t, list(parts)), t, *parts)
    if layout.unrolled:
        f_t, *columns = columns_of(push, opaque_one(t), t, *parts)
        return f0, f_t, [list(row) for row in zip(*columns, strict=True)]
    f_t = push(jnp.ones_like(t), jnp.zeros_like(parts[0]))
    basis = jnp.eye(layout.n, dtype=layout.dtype)
    return f0, f_t, jax.vmap(lambda e: push(jnp.zeros_like(t), e)[0], out_axes=1)(basis)


def _factor(jacobian: Any, shift: Array, layout: Layout, pivot: bool) -> LinearSolver:
    """Solver of `(shift I - jacobian) x = rhs`."""
    if layout.unrolled:
        rows = [[-x for x in row] for row in jacobian]
        for i, row in enumerate(rows):
            row[i] = shift if is_zero(row[i]) else shift + row[i]
        return factor_lu(rows, pivot=pivot)
    solve = invert(shift * jnp.eye(layout.n, dtype=layout.dtype) - jacobian, pivot=pivot)
    return lambda rhs: [solve(rhs[0])]


def _written_out(tableau: RosenbrockTableau, f0: Parts, slope_at: _Slope, increment: _Increment) -> list[Parts]:
    """The increments of all stages, unrolled."""
    stages: list[Parts] = []
    slope = f0
    for i, (a, c) in enumerate(zip(tableau.stage, tableau.coupling, strict=True)):
        if i > 0 and (tableau.nodes[i] != tableau.nodes[i - 1] or np.any(a != tableau.stage[i - 1])):
            slope = slope_at(float(tableau.nodes[i]), _combine(a, stages))
        stages.append(increment(slope, _combine(c, stages) if np.any(c) else None, float(tableau.time[i])))
    return stages


def _looped(tableau: RosenbrockTableau, f0: Parts, slope_at: _Slope, increment: _Increment) -> list[Parts]:
    """The increments of all stages in a loop; increments of later stages count as zero."""
    n = len(tableau.nodes)

    # One array over the stages for each part: with one matrix a batch of 256 boxes takes eight times as long. Reverse
    # mode evaluates stages again: arrays of their intermediate numbers take a fifth of the time to compile.
    @partial(jax.checkpoint, prevent_cse=False)
    def stage(stages: Parts, row: tuple[Array, ...]) -> tuple[Parts, None]:
        i, a, c, node, time = row

        def mix(weights: Array) -> Parts:
            shaped = [jnp.reshape(weights.astype(k.dtype), (n, *(1,) * (k.ndim - 1))) for k in stages]
            return [jnp.sum(w * k, axis=0) for w, k in zip(shaped, stages, strict=True)]

        new = increment(slope_at(node, mix(a)), mix(c), time)
        return [k.at[i].set(x.astype(k.dtype)) for k, x in zip(stages, new, strict=True)], None

    rows = np.arange(n), tableau.stage, tableau.coupling, tableau.nodes, tableau.time
    stages, _ = jax.lax.scan(stage, [jnp.zeros((n, *x.shape), x.dtype) for x in f0], jax.tree.map(jnp.asarray, rows))
    return [[k[i] for k in stages] for i in range(n)]


def rosenbrock_step(
    tableau: RosenbrockTableau,
    field: Callable[[Array, State], State],
    t0: Array,
    dt: Array,
    y0: State,
    *,
    pivot: bool,
    linear_solver: ShiftedSolver | None = None,
) -> RosenbrockStep:
    """Advance `y' = field(t, y)` from `t0` by `dt`.

    **Arguments:**

    - `tableau`: the method.
    - `field`: `(t, y) -> dy/dt`, differentiable by JAX.
    - `t0`, `dt`: start and length of the step, scalars.
    - `y0`: state at `t0`, any pytree of real floating arrays.
    - `pivot`: whether the elimination swaps rows; see `factor_lu`. Error control makes that unnecessary: it rejects a
      step with a bad pivot, and the next step has other pivots.
    - `linear_solver`: solves the systems of the stages; by default all columns of the Jacobian are formed.

    **Returns:**

    A `RosenbrockStep`.
    """
    # Under vmap and in reverse mode finished runs make unused steps of length zero. With 1/dt their derivatives would
    # be NaN, and zero times NaN is NaN. A short step keeps them finite.
    short = float(jnp.finfo(dt.dtype).eps) ** 0.5 * jnp.maximum(jnp.abs(t0), 1.0)
    dt = jnp.where(dt == 0, short, dt)
    layout = Layout(y0)
    parts = layout.split(y0)

    def flow(t: Array, p: Parts) -> Parts:
        return layout.split(field(t, layout.join(p)))

    inverse_dt = 1.0 / dt
    shift = inverse_dt / tableau.gamma
    if linear_solver is None:
        f0, f_t, jacobian = _linearise(flow, t0, parts, layout)
        solve = _factor(jacobian, shift, layout, pivot)
    else:
        f0, f_t = jax.jvp(lambda t: flow(t, parts), (t0,), (jnp.ones_like(t0),))
        solve_state = linear_solver(t0, y0, layout.join(f0), shift)
        solve = lambda rhs: layout.split(solve_state(layout.join(rhs)))  # noqa: E731

    def increment(slope: Parts, coupled: Parts | None, time: ArrayLike) -> Parts:
        rhs = slope
        if coupled is not None:
            rhs = [a + inverse_dt * b for a, b in zip(rhs, coupled, strict=True)]
        if not (isinstance(time, float) and time == 0.0):
            share = jnp.asarray(time, dt.dtype) * dt
            rhs = [a if is_zero(b) else a + share * b for a, b in zip(rhs, f_t, strict=True)]
        return solve(rhs)

    def slope_at(node: ArrayLike, move: Parts) -> Parts:
        point = _add(parts, move)
        if not layout.unrolled:  # for vectors: every entry of the field would compute its own sum of stages
            point = fusion_barrier(point, opaque_one(t0))
        return flow(t0 + jnp.asarray(node, dt.dtype) * dt, point)

    small = layout.n <= _MAX_WRITTEN_OUT and len(sizes_of(jax.make_jaxpr(field)(t0, y0).jaxpr)) <= _MAX_VALUES
    stages = (_written_out if small else _looped)(tableau, f0, slope_at, increment)
    y1 = layout.join(_add(parts, _combine(tableau.solution, stages)))
    error = layout.join(_combine(tableau.error, stages))
    dense = () if tableau.dense is None else tuple(layout.join(_combine(row, stages)) for row in tableau.dense)
    return RosenbrockStep(y1, error, dense)
