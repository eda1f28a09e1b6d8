"""Kalman filters and smoothers in square-root form: covariances are `S S^T` with lower triangular factors S.

All of them need the mean and the spread of a function of a Gaussian variable, which a `Transform` gives. Every factor
comes from one triangularization, so that covariances are never subtracted (P. Kaminski, A. Bryson, S. Schmidt,
"Discrete square root filtering", IEEE Transactions on Automatic Control 16, 1971). It is written out in elementary
operations, which C code needs too.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.arrays import Scalar


class Gaussian(NamedTuple):
    """A Gaussian variable: `mean`, shape `[n]`, and a lower triangular `factor` S, the covariance being `S S^T`."""

    mean: Float[Array, "*time n"]
    factor: Float[Array, "*time n n"]

    @property
    def std(self) -> Float[Array, "*time n"]:
        """Standard deviations, shape `[n]`."""
        return jnp.sqrt(jnp.sum(self.factor**2, axis=-1))


class Spread(NamedTuple):
    """Mean of a function of a Gaussian variable, and factors of its covariance and cross-covariance.

    - `mean`: shape `[m]`.
    - `out`, `of`: shapes `[m, k]` and `[n, k]`: the covariance of the function is `out out^T`, its cross-covariance
      with the variable `of out^T`, and the covariance of the variable `of of^T`.
    """

    mean: Float[Array, " m"]
    out: Float[Array, "m k"]
    of: Float[Array, "n k"]


Transform: TypeAlias = Callable[[Callable[[Array], Array], Gaussian], Spread]


def linearized(fn: Callable[[Array], Array], x: Gaussian) -> Spread:
    """Mean and spread of `fn(x)` by its derivative at the mean: the extended Kalman filter.

    **Arguments:**

    - `fn`: a function from shape `[n]` to `[m]`.
    - `x`: its argument.

    **Returns:**

    A `Spread` with k = n.
    """
    return Spread(fn(x.mean), jax.jacfwd(fn)(x.mean) @ x.factor, x.factor)


def unscented(fn: Callable[[Array], Array], x: Gaussian) -> Spread:
    """Mean and spread of `fn(x)` from 2 n + 1 points: the unscented Kalman filter, without derivatives.

    The weight of the mean is `max(3 - n, 0)/max(3, n)`, so that no weight is negative. For n >= 3 it is zero, and these
    are the points of the cubature filter (I. Arasaratnam and S. Haykin, IEEE Transactions on Automatic Control 54,
    2009). S. Julier and J. Uhlmann, Proceedings of the IEEE 92, 2004.

    **Arguments:**

    - `fn`: a function from shape `[n]` to `[m]`.
    - `x`: its argument.

    **Returns:**

    A `Spread` with k = 2 n, or 2 n + 1 for n < 3.
    """
    n = x.mean.shape[0]
    total = max(3.0, float(n))
    steps = math.sqrt(total) * x.factor.T
    points = jnp.concatenate([steps, -steps, *([jnp.zeros((1, n), steps.dtype)] if n < 3 else [])])
    weights = jnp.asarray([0.5 / total] * (2 * n) + ([1.0 - n / total] if n < 3 else []), steps.dtype)
    values = jax.vmap(fn)(x.mean[None, :] + points)
    mean = jnp.sum(weights[:, None] * values, axis=0)
    roots = jnp.sqrt(weights)[None, :]
    return Spread(mean, roots * (values - mean[None, :]).T, roots * points.T)


def triangular_factor(matrix: Float[Array, "n k"]) -> Float[Array, "n n"]:
    """Lower triangular L with `L L^T = A A^T` and a diagonal that is not negative, for k >= n, by reflections.

    A row without a part of its own has a zero on the diagonal, and finite derivatives.
    """
    rest, columns = matrix, []
    for i in range(matrix.shape[0]):
        row = rest[0]
        largest = jax.lax.stop_gradient(jnp.max(jnp.abs(row)))
        scale = jnp.where(largest > 0, largest, 1.0)
        squares = jnp.sum((row / scale) ** 2)
        size = jnp.where(largest > 0, scale * jnp.sqrt(jnp.where(largest > 0, squares, 1.0)), 0.0)
        side = jnp.where(row[0] < 0, -1.0, 1.0).astype(row.dtype)
        # The reflection along `normal` moves the row to -side size in its first place.
        normal = (row + jnp.where(jnp.arange(row.size) == 0, side * size, 0.0)) / scale
        square = jnp.sum(normal**2)
        share = 2.0 / jnp.where(square > 0, square, 1.0)
        turned = rest - share * jnp.sum(rest * normal[None, :], axis=1)[:, None] * normal[None, :]
        columns.append(jnp.pad(jnp.where(jnp.arange(len(rest)) == 0, size, -side * turned[:, 0]), (i, 0)))
        if i + 1 < matrix.shape[0]:
            rest = turned[1:, 1:]
    return jnp.stack(columns, axis=1)


def solve_lower(factor: Float[Array, "n n"], rhs: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """`L^-1 B` for a lower triangular L; rows whose diagonal is zero give zeros."""
    rows: list[Array] = []
    for i in range(factor.shape[0]):
        known = sum((factor[i, j] * row for j, row in enumerate(rows)), jnp.zeros_like(rhs[i]))
        pivot = factor[i, i]
        rows.append(jnp.where(pivot > 0, (rhs[i] - known) / jnp.where(pivot > 0, pivot, 1.0), 0.0))
    return jnp.stack(rows)


class Step(NamedTuple):
    """A prediction, and what a smoother needs of it.

    - `ahead`: the predicted state.
    - `gain`: regression of the state before on the predicted state, shape `[n, n]`.
    - `rest`: factor of the covariance of the state before, if the state after were known.
    """

    ahead: Gaussian
    gain: Float[Array, "*time n n"]
    rest: Float[Array, "*time n n"]


def predict(fn: Callable[[Array], Array], x: Gaussian, noise: Float[Array, " n"], transform: Transform) -> Step:
    """The state after `x1 = fn(x) + w`, where w has the standard deviations `noise`."""
    spread = transform(fn, x)
    n = x.mean.shape[0]
    above = jnp.concatenate([spread.out, jnp.diag(noise)], axis=1)
    below = jnp.concatenate([spread.of, jnp.zeros((n, n), noise.dtype)], axis=1)
    joint = jnp.concatenate([above, below])
    # The joint factor has 2 n rows, and needs as many columns.
    short = max(0, 2 * n - joint.shape[1])
    factor = triangular_factor(jnp.pad(joint, ((0, 0), (0, short))))
    ahead, cross, rest = factor[:n, :n], factor[n:, :n], factor[n:, n:]
    return Step(Gaussian(spread.mean, ahead), _divide(cross, ahead), rest)


def _divide(left: Float[Array, "m n"], factor: Float[Array, "n n"]) -> Float[Array, "m n"]:
    """`B L^-1` for a lower triangular L; zeros for columns without a pivot."""
    # L' X' = B', where L' is lower triangular in the reverse order.
    return solve_lower(factor.T[::-1, ::-1], left.T[::-1])[::-1].T


class Correction(NamedTuple):
    """A state after a measurement.

    - `state`: the state.
    - `innovation`: measurement minus prediction, in units of its standard deviations and without correlation, shape
      `[m]`: standard normal if the model is right. NaN for a channel without a measurement.
    - `log_likelihood`: logarithm of the density of the measurement.
    """

    state: Gaussian
    innovation: Float[Array, "*time m"]
    log_likelihood: Float[Array, "*time"]


def correct(
    fn: Callable[[Array], Array],
    x: Gaussian,
    measured: Float[Array, " m"],
    noise: Float[Array, " m"],
    transform: Transform,
    free: Float[Array, " n"] | None = None,
) -> Correction:
    """The state after the measurement `y = fn(x) + r`, where r has the standard deviations `noise`.

    A channel that is NaN has no measurement. The entries of `free` are factors of the rows of the gain: a state with a
    zero keeps its value and its variance, and its uncertainty still counts (S. Schmidt's consider filter, 1966).
    """
    spread = transform(fn, x)
    present = jnp.isfinite(measured)
    # An absent channel becomes an exact measurement of an independent standard variable.
    out = jnp.where(present[:, None], spread.out, 0.0)
    noise = jnp.where(present, noise, 1.0)
    error = jnp.where(present, measured - spread.mean, 0.0)
    own = triangular_factor(jnp.concatenate([out, jnp.diag(noise)], axis=1))
    gain = _divide(solve_lower(own, out @ spread.of.T).T, own)
    gain = gain if free is None else gain * free[:, None]
    innovation = solve_lower(own, error[:, None])[:, 0]
    factor = triangular_factor(jnp.concatenate([spread.of - gain @ out, gain * noise[None, :]], axis=1))
    density = -0.5 * innovation**2 - jnp.log(jnp.diagonal(own)) - 0.5 * math.log(2.0 * math.pi)
    state = Gaussian(x.mean + jnp.sum(gain * error[None, :], axis=1), factor)
    return Correction(state, jnp.where(present, innovation, jnp.nan), jnp.sum(jnp.where(present, density, 0.0)))


def smoothed(state: Gaussian, step: Step, after: Gaussian) -> Gaussian:
    """The state given all measurements, from that after its own, the step to the next, and the next one smoothed.

    H. Rauch, F. Tung, C. Striebel, AIAA Journal 3, 1965, with factors.
    """
    mean = state.mean + jnp.sum(step.gain * (after.mean - step.ahead.mean)[None, :], axis=1)
    return Gaussian(mean, triangular_factor(jnp.concatenate([step.rest, step.gain @ after.factor], axis=1)))


def normalized_square(x: Gaussian, value: Float[Array, " n"]) -> Scalar:
    """`(v - mean)^T P^-1 (v - mean)`, which has a chi-square distribution with n degrees of freedom."""
    return jnp.sum(solve_lower(x.factor, (value - x.mean)[:, None]) ** 2)
