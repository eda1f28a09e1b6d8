"""Values that XLA shall compute once."""

from typing import TypeVar

import jax
from jaxtyping import Array, Float

_Tree = TypeVar("_Tree")


def fusion_barrier(tree: _Tree, unit: Float[Array, ""]) -> _Tree:
    """The arrays of `tree`, divided by one.

    XLA on CPU puts cheap operations into every kernel that needs their result, so that under `jax.vmap` a long chain is
    computed over and over, once for each leaf of what a loop carries. A division it computes once, and keeps.
    At the joints of a solver step that is worth a factor of 5. `jax.lax.optimization_barrier` does not do it: under
    `jax.vmap` over 256 runs a belt oscillator took 289 us a run with the division and 1003 us with the barrier
    (compiling 22 and 43 s), the LuGre box 99 and 95 us (two shared cores, float64, jax 0.10.2; equal results).

    **Arguments:**

    - `tree`: arrays of any shape.
    - `unit`: a one that XLA cannot know to be one, from `opaque_one`.
    """
    return jax.tree.map(lambda x: x / unit.astype(x.dtype), tree)


def opaque_one(x: Float[Array, ""]) -> Float[Array, ""]:
    """One, made from any finite number that is not known while compiling."""
    return 1.0 + 0.0 * x
