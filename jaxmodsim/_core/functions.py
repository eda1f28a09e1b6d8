"""Functions as parts of pytrees."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree

from .arguments import check_real
from .index_check import traced


class Function(eqx.Module):
    """A plain function as part of a pytree: it holds no numbers and is compared by identity."""

    fn: Callable[..., PyTree] = eqx.field(static=True)

    def __call__(self, *args: object) -> PyTree:
        """Call the function."""
        return self.fn(*args)


def result_shape(fn: Callable[..., object], *, name: str, **args: object) -> tuple[int, ...] | None:
    """Shape of what `fn(*args.values())` returns, or None where that is not one array.

    **Raises:**

    - `ValueError` naming `name` where it holds anything but real numbers, or `fn` uses an index out of range of one of
      `args`, which are named as they are here; see `traced`.
    """
    shapes: list[tuple[int, ...] | None] = []

    def look(*args: object) -> None:
        value = fn(*args)
        for leaf in jtu.tree_leaves(value):
            check_real(leaf, name=f"What {name} returns")
        shapes.append(getattr(value, "shape", () if isinstance(value, int | float) else None))

    traced(look, name=name, **args)
    return shapes[0]


def real_array(value: object, *, name: str) -> Array:
    """What a function has returned, as an array; lists of numbers become one.

    **Raises:**

    - `ValueError` naming `name` where it holds anything but real numbers.
    """
    for leaf in jtu.tree_leaves(value):
        check_real(leaf, name=f"What {name} returns")
    try:
        return jnp.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"What {name} returns must be an array of real numbers, but it is {value!r}.") from error


def as_function(value: object, *, name: str) -> Callable[..., PyTree]:
    """Make a callable fit to sit in a pytree: an `eqx.Module` stays what it is, anything else is wrapped.

    **Raises:**

    - `ValueError` if `value` cannot be called.
    """
    if not callable(value):
        raise ValueError(f"{name} must be a function, but {value!r} was given.")
    fn: Callable[..., PyTree] = value
    return fn if isinstance(value, eqx.Module) else Function(fn)


def depends_on(fn: Callable[[Array], Array], x: Float[Array, "..."]) -> bool:
    """Whether anything that `fn` returns is computed from `x`, be it by a product with zero."""
    traced = jax.make_jaxpr(fn)(x).jaxpr
    reached = set(traced.invars)
    for equation in traced.eqns:
        if any(var in reached for var in equation.invars if not hasattr(var, "val")):
            reached.update(equation.outvars)
    return any(var in reached for var in traced.outvars if not hasattr(var, "val"))
