"""Layout of a state in the steps of a solver, and dense output between their ends."""

from typing import TypeAlias

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._core.arrays import Real
from .._core.lu import MAX_UNROLLED_LU

State: TypeAlias = PyTree[Array]
Parts: TypeAlias = list[Array]


class Layout:
    """Map between a pytree state and the parts of a step: one scalar per entry, or one long vector."""

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


class PolynomialInterpolation(dfx.AbstractLocalInterpolation):
    """Dense output `y(t0 + s dt) = (1-s) y0 + s (y1 + (1-s) (K1 + s (K2 + ...)))`, exact at both ends."""

    t0: Real
    t1: Real
    y0: PyTree[Array]
    y1: PyTree[Array]
    # K1, K2, ...: at least one.
    k: tuple[PyTree[Array], ...]

    def evaluate(self, t0: Real, t1: Real | None = None, left: bool = True) -> PyTree[Array]:
        """State at `t0`, or the increment from `t0` to `t1`."""
        del left
        if t1 is not None:
            return jtu.tree_map(lambda a, b: a - b, self.evaluate(t1), self.evaluate(t0))
        # A finished run under vmap makes steps of length zero; see `rosenbrock_step`.
        length = jnp.subtract(self.t1, self.t0)
        s = jnp.subtract(t0, self.t0) / jnp.where(length == 0, 1.0, length)

        def at(y0: Array, y1: Array, *k: Array) -> Array:
            r = s.astype(y0.dtype)
            bend = k[-1]
            for term in reversed(k[:-1]):
                bend = term + r * bend
            return (1 - r) * y0 + r * (y1 + (1 - r) * bend)

        return jtu.tree_map(at, self.y0, self.y1, *self.k)
