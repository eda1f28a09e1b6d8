"""How solver steps hold a state."""

from typing import TypeAlias

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._core.lu import MAX_UNROLLED_LU

State: TypeAlias = PyTree[Array]
Parts: TypeAlias = list[Array]


class Layout:
    """How a pytree state maps to the parts the step computes with: one scalar per entry, or one long vector."""

    def __init__(self, y: State):
        leaves, self.structure = jtu.tree_flatten(y)
        self.shapes = [leaf.shape for leaf in leaves]
        self.sizes = [leaf.size for leaf in leaves]
        self.dtype = jnp.result_type(*leaves) if leaves else jnp.result_type(float)
        self.dtypes = [leaf.dtype for leaf in leaves]
        self.n = sum(self.sizes)
        self.unrolled = self.n <= MAX_UNROLLED_LU

    def split(self, y: State) -> Parts:
        """The parts of a state."""
        leaves = [jnp.ravel(leaf) for leaf in jtu.tree_leaves(y)]
        if self.unrolled:
            return [jnp.reshape(leaf, ()) if leaf.size == 1 else leaf[i] for leaf in leaves for i in range(leaf.size)]
        return [jnp.concatenate([leaf.astype(self.dtype) for leaf in leaves])]

    def join(self, parts: Parts) -> State:
        """The state of parts."""
        leaves, start = [], 0
        for shape, size, dtype in zip(self.shapes, self.sizes, self.dtypes, strict=True):
            if not self.unrolled:
                leaf = parts[0][start : start + size]
            elif size == 1:
                leaf = parts[start]
            else:
                leaf = jnp.stack(parts[start : start + size])
            leaves.append(jnp.reshape(leaf, shape).astype(dtype))
            start += size
        return jtu.tree_unflatten(self.structure, leaves)
