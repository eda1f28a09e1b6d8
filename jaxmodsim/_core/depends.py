"""Whether a function looks at its argument."""

from collections.abc import Callable

import jax
from jaxtyping import Array, Float


def depends_on(fn: Callable[[Array], Array], x: Float[Array, "..."]) -> bool:
    """Whether anything that `fn` returns is computed from `x`, be it by a product with zero."""
    traced = jax.make_jaxpr(fn)(x).jaxpr
    reached = set(traced.invars)
    for equation in traced.eqns:
        if any(var in reached for var in equation.invars if not hasattr(var, "val")):
            reached.update(equation.outvars)
    return any(var in reached for var in traced.outvars if not hasattr(var, "val"))
