"""Levenberg-Marquardt within a box, one visible iteration after the other, alone or many side by side."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._losses import AbstractLoss

# `x` -> residual and its Jacobian.
Evaluate: TypeAlias = Callable[[Float[Array, " n"]], tuple[Float[Array, " m"], Float[Array, "m n"]]]

# A step whose effect on the residual is smaller than this against the residual itself is lost in rounding.
_ROUNDING = 8.0
_LARGEST_DAMPING = 1e14

# The cost is flat to second order around its minimum, so it must be known better than the parameters.
_FLAT = 0.1

# Models that stick and slip by fixed steps have a cost with small steps in it, on which a search never ends by itself:
# it has settled after so many evaluations in a row that each lowered the cost by less than so many `rtol` of itself.
_PATIENCE, _SLOW = 8, 10.0


class Box(NamedTuple):
    """Bounds of x, and the longest change of each in one iteration, shape `[n]` each."""

    lower: Float[Array, " n"]
    upper: Float[Array, " n"]
    longest: Float[Array, " n"]


class Search(NamedTuple):
    """Where the search stands.

    - `x`, `residual`, `jacobian`, `cost`: the best so far; the cost is half the sum of losses.
    - `damping`, `growth`: of the next step, and what a refused one multiplies it by.
    - `steps`: number of evaluations; `slow`: of these, the last ones that changed little.
    - `done`: 1 where it converged, 2 where it settled on a cost that is not smooth, else 0.
    """

    x: Float[Array, " n"]
    residual: Float[Array, " m"]
    jacobian: Float[Array, "m n"]
    cost: Float[Array, ""]
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    steps: Int[Array, ""]
    slow: Int[Array, ""]
    done: Int[Array, ""]


def search_start(x: Float[Array, " n"], rows: int) -> Search:
    """A search that knows nothing yet: its first iteration evaluates `x`."""
    inf, zero = jnp.asarray(jnp.inf, x.dtype), jnp.asarray(0.0, x.dtype)
    return Search(
        x,
        jnp.zeros(rows, x.dtype),
        jnp.zeros((rows, x.shape[0]), x.dtype),
        inf,
        zero + 1e-3,
        zero + 2.0,
        jnp.asarray(0),
        jnp.asarray(0),
        jnp.asarray(0),
    )


def search_step(evaluate: Evaluate, loss: AbstractLoss, box: Box, search: Search, rtol: Float[Array, ""]) -> Search:
    """One iteration: a trial point, which is taken if it is better.

    Normal equations in columns of unit length; parameters on a bound that the gradient pushes outwards stay there,
    the others move and are clipped (Kanzow, Yamashita, Fukushima 2004, J. Comput. Appl. Math. 172:375). The damping
    follows Nielsen (1999, IMM-REP-1999-05). The search is done when the linear model promises to lower the cost by no
    more than a tenth of `rtol` and the trial does not do better, or when only rounding is left.
    """
    x, eps = search.x, jnp.finfo(search.x.dtype).eps
    r, jacobian = loss.weighted(search.residual, search.jacobian)
    gradient, matrix = jacobian.T @ r, jacobian.T @ jacobian
    size = jnp.sqrt(jnp.diagonal(matrix))
    size = jnp.where(size > 0, size, 1.0)
    held = ((x <= box.lower) & (gradient > 0)) | ((x >= box.upper) & (gradient < 0))
    moves = ~held
    normal = jnp.where(jnp.outer(moves, moves), matrix / jnp.outer(size, size), 0.0)
    normal = normal + jnp.diag(jnp.where(moves, search.damping, 1.0))
    step = -jnp.linalg.solve(normal, jnp.where(moves, gradient / size, 0.0)) / size
    trial = jnp.clip(x + jnp.clip(step, -box.longest, box.longest), box.lower, box.upper)
    step = trial - x

    residual, trial_jacobian = evaluate(trial)
    cost = loss.cost(residual)
    finite = jnp.isfinite(cost) & jnp.isfinite(trial_jacobian).all()
    first = search.steps == 0
    better = finite & (first | (cost < search.cost))

    predicted = -(gradient @ step + 0.5 * step @ matrix @ step)
    gain = jnp.where(predicted > 0, (search.cost - cost) / jnp.where(predicted > 0, predicted, 1.0), 0.0)
    gain = jnp.clip(jnp.where(jnp.isfinite(gain), gain, 0.0), -1.0, 2.0)
    shrink = jnp.maximum(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
    damping = jnp.where(better, search.damping * shrink, search.damping * search.growth)
    damping = jnp.where(first, search.damping, jnp.maximum(damping, eps))

    little = _FLAT * rtol * search.cost
    flat = (predicted >= 0) & (predicted <= little) & (~better | (search.cost - cost <= little))
    still = jnp.sqrt(step @ matrix @ step) <= _ROUNDING * eps * jnp.sqrt(2 * search.cost)
    converged = ~first & (flat | still | (damping > _LARGEST_DAMPING)) | (better & (cost == 0))
    fell = jnp.where(better, search.cost - cost, 0.0)
    slow = jnp.where(fell <= _SLOW * rtol * search.cost, search.slow + 1, 0)
    done = jnp.where(converged, 1, jnp.where(slow >= _PATIENCE, 2, 0))
    return Search(
        jnp.where(better, trial, x),
        jnp.where(better, residual, search.residual),
        jnp.where(better, trial_jacobian, search.jacobian),
        jnp.where(better, cost, search.cost),
        damping,
        jnp.where(better, 2.0, 2.0 * search.growth),
        search.steps + 1,
        slow,
        jnp.where(search.done > 0, search.done, done),
    )
