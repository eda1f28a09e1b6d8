"""Functions of the coordinates that may also ask for the parameters."""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PyTree

from .functions import as_function, real_array
from .parameters import Range, as_number, as_real


class PositionFn(eqx.Module):
    """A function `place(q)` or `place(q, params)`, called as the latter."""

    place: Callable[..., ArrayLike]
    with_params: bool = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __call__(self, q: Float[Array, " dof"], params: PyTree) -> Array:
        """What the function gives."""
        value = real_array(self.place(q, params) if self.with_params else self.place(q), name=self.name)
        return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(q.dtype)


def as_position_fn(value: Any, *, name: str) -> PositionFn:
    """Make a function of `q`, or of `q` and `params`, fit to sit in a pytree.

    Which of the two it is follows from the arguments without a default that it takes.

    **Raises:**

    - `ValueError` if `value` cannot be called, or takes neither one nor two arguments.
    """
    if isinstance(value, PositionFn):
        return value
    function = as_function(value, name=name)
    try:
        taken = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):  # a function written in C does not say
        return PositionFn(function, False, name)
    needed = [x for x in taken if x.default is x.empty and x.kind in (x.POSITIONAL_ONLY, x.POSITIONAL_OR_KEYWORD)]
    if len(needed) > 2:
        raise ValueError(f"{name} must be a function of q, or of q and params, but it takes {len(needed)} arguments.")
    return PositionFn(function, len(needed) == 2, name)


class ScalarOrFn(eqx.Module):
    """A number, or a function of the parameters that returns one."""

    amount: Callable[..., ArrayLike] | Array

    def __call__(self, params: PyTree) -> Array:
        """The number."""
        return jnp.asarray(self.amount(params) if callable(self.amount) else self.amount)


def as_scalar_or_fn(value: object, *, name: str, allowed: Range, array: bool = False) -> ScalarOrFn:
    """Make a number, or a function of `params`, fit to sit in a pytree; with `array` also an array of numbers.

    **Raises:**

    - `ValueError` if it is none of these, or a number out of the range `allowed`.
    """
    if isinstance(value, ScalarOrFn):
        return value
    if callable(value):
        return ScalarOrFn(as_function(value, name=name))
    number = (as_real if array else as_number)(value, name=name)
    allowed.check(number, name=name)
    return ScalarOrFn(number)
