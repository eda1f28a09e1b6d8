"""Parameters that change with the state of the mechanism."""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, PyTree

from .functions import Function, as_function

# Least factor: what is divided by a parameter stays finite.
_LEAST = 1e-30


class StateDependent(eqx.Module):
    """A parameter that changes with the state of the mechanism: a number times `fn(t, q, qd, params)`.

    It takes the number's place in its module, which keeps its kind; `bind_state` puts the product there. Without a
    number (None) the value is that of `fn` itself, of either sign.
    """

    number: PyTree
    fn: Callable[..., ArrayLike]

    def __jax_array__(self) -> Array:
        """Refuse to be taken for a number."""
        raise TypeError(
            "This parameter depends on the state of the mechanism (scaled_by, or a torque), so it has no value by"
            " itself: ask law.bind_state(t, q, qd, params) for the law at a state."
        )


def as_state_function(value: object, *, name: str) -> Callable[..., PyTree]:
    """A function of the mechanism's state, `fn(t, q, qd, params)`, as part of a law.

    **Raises:**

    - `ValueError` if `value` cannot be called, or holds numbers of its own.
    """
    fn = as_function(value, name=name)
    if any(eqx.is_inexact_array(x) for x in jax.tree.leaves(fn)):
        raise ValueError(f"{name} holds numbers of its own; put them into the scene's params, and read them there.")
    return fn


_Module = TypeVar("_Module", bound=eqx.Module)


def is_state_dependent(tree: object) -> bool:
    """Whether a parameter in `tree` depends on the state of the mechanism."""
    return any(
        isinstance(x, StateDependent) for x in jax.tree.leaves(tree, is_leaf=lambda x: isinstance(x, StateDependent))
    )


def need_values(tree: eqx.Module, wanted: str) -> None:
    """Refuse a law that has values only at a state of the mechanism.

    **Raises:**

    - `ValueError` that says how to get the law at a state.
    """
    if is_state_dependent(tree):
        raise ValueError(
            f"{wanted} needs the numbers of the law, but parameters of this {type(tree).__name__} depend on the state"
            " of the mechanism (scaled_by, or a torque): ask law.bind_state(t, q, qd, params) for the law at a state,"
            " and give that."
        )


def bind_state(tree: _Module, t: Array, q: Array, qd: Array, params: object) -> _Module:
    """`tree` with the values of its parameters at a state of the mechanism; factors below 1e-30 count as that."""
    factors: dict[int, Array] = {}  # by function: parameters that share one evaluate it once

    def value(x: object) -> PyTree:
        if not isinstance(x, StateDependent):
            return x
        key = id(x.fn.fn if isinstance(x.fn, Function) else x.fn)
        if key not in factors:
            factors[key] = jnp.asarray(x.fn(t, q, qd, params))
        if x.number is None:
            return factors[key]
        number = value(x.number)
        return number * jnp.maximum(factors[key], _LEAST).astype(number.dtype)

    return jax.tree.map(value, tree, is_leaf=lambda x: isinstance(x, StateDependent))


def nominal(value: object) -> PyTree:
    """The number of a parameter, without the factor it varies by."""
    return nominal(value.number) if isinstance(value, StateDependent) else value
