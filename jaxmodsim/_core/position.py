"""Functions of the coordinates and of the parameters, as parts of pytrees."""

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PyTree

from .functions import as_function, real_array
from .parameters import Range, as_number, as_real, unless_none


class PositionFn(eqx.Module):
    """A function `place(q)` or `place(q, params)`; the call takes both arguments."""

    place: Callable[..., ArrayLike]
    with_params: bool = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __call__(self, q: Float[Array, " dof"], params: PyTree) -> Array:
        """The result of the function, of floating type."""
        value = real_array(self.place(q, params) if self.with_params else self.place(q), name=self.name)
        return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(q.dtype)


def as_position_fn(value: Any, *, name: str) -> PositionFn:
    """Convert a function of `q`, or of `q` and `params`, to part of a pytree.

    The number of its arguments without a default distinguishes the two.

    **Raises:**

    - `ValueError` if `value` is not callable, or needs more than two arguments.
    """
    if isinstance(value, PositionFn):
        return value
    function = as_function(value, name=name)
    try:
        arguments = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):  # functions in C have no signature
        return PositionFn(function, False, name)
    needed = [x for x in arguments if x.default is x.empty and x.kind in (x.POSITIONAL_ONLY, x.POSITIONAL_OR_KEYWORD)]
    if len(needed) > 2:
        raise ValueError(f"{name} must be a function of q, or of q and params, but it takes {len(needed)} arguments.")
    return PositionFn(function, len(needed) == 2, name)


as_optional_position_fn = partial(unless_none, convert=as_position_fn)


class ScalarOrFn(eqx.Module):
    """A number, or a function `amount(params)` that returns one."""

    amount: Callable[..., ArrayLike] | Array

    def __call__(self, params: PyTree) -> Array:
        """The number."""
        return jnp.asarray(self.amount(params) if callable(self.amount) else self.amount)


def as_scalar_or_fn(value: object, *, name: str, allowed: Range, array: bool = False) -> ScalarOrFn:
    """Convert a number, or a function of `params`, to part of a pytree; with `array` also an array of numbers.

    **Raises:**

    - `ValueError` for other types, or if a number is out of the range `allowed`.
    """
    if isinstance(value, ScalarOrFn):
        return value
    if callable(value):
        return ScalarOrFn(as_function(value, name=name))
    number = (as_real if array else as_number)(value, name=name)
    allowed.check(number, name=name)
    return ScalarOrFn(number)
