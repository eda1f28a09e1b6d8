"""Numbers that are known, as JAX arrays."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Shaped


def on_device(x: ArrayLike | Sequence[ArrayLike]) -> Shaped[Array, "..."]:
    """A JAX array of numbers that are known: `jnp.asarray` would compile a program for each shape."""
    return jax.device_put(np.asarray(x))
