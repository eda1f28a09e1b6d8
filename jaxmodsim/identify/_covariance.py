"""Covariance of an estimate from the residuals themselves: correlated in time, of any size, of a model that errs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

# Blocks of samples: enough for the scatter of the scores of a dozen parameters, and each far longer than what the
# residual of a mechanism is correlated over.
BLOCKS = 32


class Spread(NamedTuple):
    """How sure an estimate is.

    - `covariance`: of the parameters, correlation of the residual in time taken into account.
    - `white`: what it would be if the residual were white noise.
    - `information`: Fisher information of the samples, in noise levels, and of the prior.
    """

    covariance: Float[Array, "free free"]
    white: Float[Array, "free free"]
    information: Float[Array, "free free"]


def block_numbers(weights: Float[Array, "runs samples"], channels: int) -> tuple[Int[Array, " rows"], int]:
    """Number of the block of each sample row, in the order of the residual, and the number of blocks.

    All channels of a time are in one block. Runs share the blocks by their numbers of samples.
    """
    samples = weights.shape[1]
    counts = [int(x) for x in jnp.sum(weights > 0, axis=1)]
    whole = sum(counts)
    numbers, used = [], 0
    for count in counts:
        own = max(round(BLOCKS * count / whole), 1)
        here = jnp.minimum(jnp.arange(samples) * own // max(count, 1), own - 1)
        numbers.append(jnp.tile(used + here, channels))
        used += own
    return jnp.concatenate(numbers), used


def spread(
    residual: Float[Array, " rows"],
    jacobian: Float[Array, "rows n"],
    extra: Float[Array, "others n"],
    slopes: Float[Array, "n n"],
    blocks: Int[Array, " rows"],
    count: int,
    kept: int,
) -> Spread:
    """Covariance `H^-1 S H^-1` with S from the scatter of the scores of blocks of samples.

    Residuals may be correlated in any way within a block. Each block's score `J_b' r_b` is divided by what the block
    itself took from its residual, `(I - J_b'J_b H^-1)^-1`, which makes the sum the jackknife over blocks (Bell,
    McCaffrey 2002, Survey Methodology 28:169): without it errors come out too small where few samples decide.

    **Arguments:**

    - `residual`, `jacobian`: of the samples, by the coordinates x.
    - `extra`: rows of the Jacobian that are no samples: what was known before, links between windows.
    - `slopes`: derivatives of the parameters by x.
    - `blocks`, `count`: number of each row's block, and of blocks.
    - `kept`: number of parameters, the first entries of x; the others are nuisance.
    """
    n = jacobian.shape[1]
    beside = extra.T @ extra
    matrix = jacobian.T @ jacobian + beside
    scale = jnp.sqrt(jnp.diagonal(matrix))
    silent = scale == 0
    scale = jnp.where(silent, 1.0, scale)
    bread = _inverse(matrix / jnp.outer(scale, scale))
    scaled = jacobian / scale[None, :]
    scores = jax.ops.segment_sum(scaled * residual[:, None], blocks, count)

    def fair_score(sample: tuple[Array, Array]) -> Array:
        b, score = sample
        own = jnp.where((blocks == b)[:, None], scaled, 0.0)
        rest = jnp.eye(n, dtype=scaled.dtype) - own.T @ own @ bread
        # A block that alone decides something has no residual to be judged by.
        fair = jnp.abs(jnp.linalg.det(rest)) > 1e-6
        return jnp.linalg.solve(jnp.where(fair, rest, jnp.eye(n, dtype=scaled.dtype)), score)

    scores = jax.lax.map(fair_score, (jnp.arange(count), scores))
    samples = jnp.sum(jnp.any(jacobian != 0, axis=1))
    meat = scores.T @ scores * ((count - 1) / count) + beside / jnp.outer(scale, scale)
    variance = jnp.sum(residual**2) / jnp.maximum(samples - n, 1)
    change = slopes / scale[None, :]

    def of_parameters(middle: Array) -> Array:
        found = (change @ middle @ change.T)[:kept, :kept]
        return found.at[jnp.diag_indices(kept)].set(jnp.where(silent[:kept], jnp.inf, jnp.diagonal(found)))

    white = bread @ ((matrix - beside) / jnp.outer(scale, scale) * variance + beside / jnp.outer(scale, scale)) @ bread
    back = jnp.linalg.pinv(slopes[:kept, :kept])
    information = back.T @ matrix[:kept, :kept] @ back
    return Spread(of_parameters(bread @ meat @ bread), of_parameters(white), information)


def _inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of a scaled normal matrix, with eigenvalues kept off zero.

    A direction that the record says nothing about gets a huge error, not none.
    """
    values, vectors = jnp.linalg.eigh(matrix)
    least = 10 * jnp.finfo(matrix.dtype).eps * jnp.maximum(values[-1], 1.0)
    return vectors / jnp.maximum(values, least)[None, :] @ vectors.T
