"""The first step of an adaptive run."""

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from .._core.arrays import Real

# A first step is no shorter than this many of the shortest steps.
_LEAST = 8.0


def first_step(
    y0: PyTree,
    slopes: tuple[PyTree, PyTree],
    order: Real,
    tolerances: tuple[Float[Array, ""], Float[Array, ""]],
    shortest: Float[Array, ""],
) -> Float[Array, ""]:
    r"""Guess of the first step [s], from the field at two points.

    This is the guess of the reference, as in diffrax, with two changes. It is not longer than the time in which the
    field changes by its own magnitude: a stiff method may step over the transient of a bristle and be accurate at the
    end of the step, but not at times saved inside it. And it is finite for a state of zero with `atol = 0`.

    **Arguments:**

    - `y0`: the start.
    - `slopes`: the rates of y at the start, and at the end of an Euler step of length `trial_step`.
    - `order`: of the error estimate.
    - `tolerances`: relative and absolute.
    - `shortest`: the shortest admissible step [s].

    **Returns:**

    The step [s], shape `[]`, at least `shortest`.

    ??? cite "Reference"

        ```bibtex
        @book{hairer2008solving-i,
            author={Hairer, E. and N{\o}rsett, S. P. and Wanner, G.},
            title={Solving Ordinary Differential Equations I: Nonstiff Problems},
            publisher={Springer}, edition={second revised}, year={2008}, note={section II.4},
        }
        ```
    """
    slope, there = slopes
    d1, known, trial = _try_out(y0, slope, tolerances)
    d2 = _size(jtu.tree_map(jnp.subtract, there, slope), y0, tolerances) / trial
    largest = jnp.maximum(d1, d2)
    slow = largest <= 1e-15
    step = jnp.where(slow, jnp.maximum(1e-6, 1e-3 * trial), (0.01 / jnp.where(slow, 1.0, largest)) ** (1.0 / order))
    step = jnp.minimum(100.0 * trial, step)
    changes = known & (d2 * step > d1)
    step = jnp.where(changes, d1 / jnp.where(changes, d2, 1.0), step)
    return jax.lax.stop_gradient(jnp.where(step > _LEAST * shortest, step, _LEAST * shortest))


def trial_step(y0: PyTree, slope: PyTree, tolerances: tuple[Float[Array, ""], Float[Array, ""]]) -> Float[Array, ""]:
    """Length [s] of the Euler step at whose end `first_step` needs the field.

    **Returns:**

    The length [s], shape `[]`.
    """
    return jax.lax.stop_gradient(_try_out(y0, slope, tolerances)[2])


def _size(tree: PyTree, y0: PyTree, tolerances: tuple[Array, Array]) -> Array:
    rtol, atol = tolerances
    return optx.rms_norm(jtu.tree_map(lambda x, y: x / (atol + rtol * jnp.abs(y)), tree, y0))


def _try_out(y0: PyTree, slope: PyTree, tolerances: tuple[Array, Array]) -> tuple[Array, Array, Array]:
    """Size of the rate, whether rate and state have a scale, and a trial step."""
    d0, d1 = _size(y0, y0, tolerances), _size(slope, y0, tolerances)
    known = (d0 >= 1e-5) & (d1 >= 1e-5)
    return d1, known, jnp.where(known, 0.01 * d0 / jnp.where(known, d1, 1.0), 1e-6)
