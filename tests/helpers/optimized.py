"""Programs as users have them: for numbers that are compared with theirs, and for what runs longer than it compiles."""

from collections.abc import Iterator
from contextlib import contextmanager

import jax


@contextmanager
def optimized() -> Iterator[None]:
    """What is compiled meanwhile is optimized; what has been compiled stays. Also decorates tests and fixtures."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)
