"""Dense output."""

from typing import Any

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree


class PolynomialInterpolation(dfx.AbstractLocalInterpolation):
    """Dense output `y(t0 + s dt) = (1-s) y0 + s (y1 + (1-s) (K1 + s (K2 + ...)))`, exact at both ends."""

    t0: Any
    t1: Any
    y0: PyTree[Array]
    y1: PyTree[Array]
    # K1, K2, ...: at least one.
    k: tuple[PyTree[Array], ...]

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> PyTree[Array]:
        """State at `t0`, or the increment from `t0` to `t1`."""
        del left
        if t1 is not None:
            return jtu.tree_map(lambda a, b: a - b, self.evaluate(t1), self.evaluate(t0))
        # A step of length zero is one of a finished lane under vmap; see `rosenbrock_step`.
        length = self.t1 - self.t0
        s = (t0 - self.t0) / jnp.where(length == 0, 1.0, length)

        def at(y0: Array, y1: Array, *k: Array) -> Array:
            r = s.astype(y0.dtype)
            bend = k[-1]
            for term in reversed(k[:-1]):
                bend = term + r * bend
            return (1 - r) * y0 + r * (y1 + (1 - r) * bend)

        return jtu.tree_map(at, self.y0, self.y1, *self.k)
