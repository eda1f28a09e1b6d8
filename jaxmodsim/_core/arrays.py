"""Array types, conversion of known numbers, look-up in increasing times, and fusion barriers."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree, Shaped

Scalar: TypeAlias = Float[Array, ""]
# One number per coordinate.
PerDof: TypeAlias = Float[Array, " dof"]
# One number or flag as diffrax passes it: an array, or a number of Python.
if TYPE_CHECKING:
    Real: TypeAlias = Any  # type checkers know no arithmetic of such a union
else:
    Real: TypeAlias = Shaped[ArrayLike, ""]
# A function of arrays.
Fn: TypeAlias = Callable[..., PyTree]
_Tree = TypeVar("_Tree")


def is_known(*values: object) -> bool:
    """Whether JAX traces none of the values."""
    for value in values:  # noqa: SIM110 - a generator takes three times as long
        if isinstance(value, jax.core.Tracer):
            return False
    return True


def on_device(x: ArrayLike | Sequence[ArrayLike]) -> Shaped[Array, "..."]:
    """Convert known numbers to a JAX array; `jnp.asarray` would compile a program for each shape."""
    return jax.device_put(np.asarray(x))


def after(times: Float[Array, " n"], t: Float[Array, ""]) -> Int[Array, ""]:
    """Index of the first of the increasing `times` after `t`."""
    # Unrolled: a loop inside the loop of a run prevents XLA from fusing a step.
    return jnp.searchsorted(times, t.astype(times.dtype), side="right", method="scan_unrolled")


def is_one_of(times: Float[Array, " n"], t: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether `t` is one of the increasing `times`."""
    return entry(times, jnp.maximum(after(times, t) - 1, 0)) == t


def apply_matrix(matrix: Float[Array, "m n"], vectors: Float[Array, "n *k"]) -> Float[Array, "m *k"]:
    """Product with one vector, or with several as columns, written as a sum: see `in_scalars`."""
    return jnp.sum((matrix if vectors.ndim == 1 else matrix[:, :, None]) * vectors[None], axis=1)


def entry(x: Array, i: Int[Array, ""]) -> Array:
    """`x[i]`."""
    return jax.lax.dynamic_index_in_dim(x, i, keepdims=False)


def fusion_barrier(tree: _Tree, unit: Float[Array, ""]) -> _Tree:
    """Divide the arrays of `tree` by one, so that XLA computes them once.

    XLA on CPU repeats cheap operations in every kernel that needs their result. Under `jax.vmap` it recomputes a long
    chain for each leaf of a loop state, but it computes a division only once. Barriers between the parts of a solver
    step save a factor of 5. `jax.lax.optimization_barrier` is no substitute: under `jax.vmap` over 256 runs a belt
    oscillator took 289 us per run with the division and 1003 us with that barrier (compilation 22 and 43 s), the LuGre
    box 99 and 95 us (two shared cores, float64, jax 0.10.2; equal results).

    **Arguments:**

    - `tree`: arrays of any shape.
    - `unit`: a one from `opaque_one`, which XLA does not recognize as one.
    """
    return jax.tree.map(lambda x: x / unit.astype(x.dtype), tree)


def opaque_one(x: Float[Array, ""]) -> Float[Array, ""]:
    """One, from any finite number that is unknown while compiling."""
    return 1.0 + 0.0 * x
