"""The first step of an adaptive run."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, Float, PyTree

# A first step is no shorter than this many of the shortest steps.
_LEAST = 8.0


def first_step(
    rate: Callable[[Array, PyTree], PyTree],
    t0: Float[Array, ""],
    y0: PyTree,
    order: Any,
    tolerances: tuple[Float[Array, ""], Float[Array, ""]],
    shortest: Float[Array, ""],
) -> tuple[Float[Array, ""], PyTree]:
    r"""Guess at the first step [s], with two evaluations of the field, and the rate of `y0`.

    That of the literature below, which diffrax takes, too, with two changes. It is not longer than the time in which
    the field changes by itself: a stiff method may step over the transient of a bristle and be right at the end of
    the step, but not at times saved inside it. And it is a number where a state of zero without an absolute tolerance
    has no scale.

    **Arguments:**

    - `rate`: `rate(t, y)` -> the rate of y.
    - `t0`, `y0`: the start.
    - `order`: of the error estimate.
    - `tolerances`: relative and absolute.
    - `shortest`: the shortest step that there is [s].

    ??? cite "Reference"

        ```bibtex
        @book{hairer2008solving-i,
            author={Hairer, E. and N{\o}rsett, S. P. and Wanner, G.},
            title={Solving Ordinary Differential Equations I: Nonstiff Problems},
            publisher={Springer}, edition={second revised}, year={2008}, note={section II.4},
        }
        ```
    """
    (rtol, atol), t0, y0 = tolerances, jax.lax.stop_gradient(t0), jax.lax.stop_gradient(y0)

    def size(tree: PyTree) -> Array:
        return optx.rms_norm(jtu.tree_map(lambda x, y: x / (atol + rtol * jnp.abs(y)), tree, y0))

    d0 = size(y0)

    def try_out(slope: PyTree) -> tuple[Array, Array, Array]:
        """Size of the rate, whether it and the state have one, and a step to try out."""
        d1 = size(slope)
        known = (d0 >= 1e-5) & (d1 >= 1e-5)
        return d1, known, jnp.where(known, 0.01 * d0 / jnp.where(known, d1, 1.0), 1e-6)

    def evaluate(place: tuple[Array, PyTree], _: None) -> tuple[tuple[Array, PyTree], PyTree]:
        slope = rate(*place)
        trial = try_out(slope)[2]
        return (t0 + trial, jtu.tree_map(lambda y, f: y + trial * f, y0, slope)), slope

    # Both evaluations in a loop, which is compiled once.
    _, slopes = jax.lax.scan(evaluate, (t0, y0), None, length=2)
    slope, there = (jtu.tree_map(lambda f, i=i: f[i], slopes) for i in (0, 1))
    d1, known, trial = try_out(slope)
    d2 = size(jtu.tree_map(jnp.subtract, there, slope)) / trial
    largest = jnp.maximum(d1, d2)
    slow = largest <= 1e-15
    step = jnp.where(slow, jnp.maximum(1e-6, 1e-3 * trial), (0.01 / jnp.where(slow, 1.0, largest)) ** (1.0 / order))
    step = jnp.minimum(100.0 * trial, step)
    changes = known & (d2 * step > d1)
    step = jnp.where(changes, d1 / jnp.where(changes, d2, 1.0), step)
    return jax.lax.stop_gradient((jnp.where(step > _LEAST * shortest, step, _LEAST * shortest), slope))
