"""Functions as parts of pytrees, and parameters that depend on the state of the mechanism."""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Float, PyTree

from .arguments import check_real
from .trace_checks import traced


class Function(eqx.Module):
    """A plain function as part of a pytree: it has no leaves and compares by identity."""

    fn: Callable[..., PyTree] = eqx.field(static=True)

    def __call__(self, *args: object) -> PyTree:
        """Call the function."""
        return self.fn(*args)


def result_shape(fn: Callable[..., object], *, name: str, **args: object) -> tuple[int, ...] | None:
    """Shape of the result of `fn(*args.values())`, or None if that is not one array.

    **Raises:**

    - `ValueError` with `name` if the result holds anything but real numbers, or `fn` uses an index out of range of one
      of `args`; see `traced`.
    """
    shapes: list[tuple[int, ...] | None] = []

    def check(*args: object) -> None:
        value = fn(*args)
        for leaf in jtu.tree_leaves(value):
            check_real(leaf, name=f"The result of {name}")
        shapes.append(getattr(value, "shape", () if isinstance(value, int | float) else None))

    traced(check, name=name, **args)
    return shapes[0]


def real_array(value: object, *, name: str) -> Array:
    """The result of a function as an array; lists of numbers are converted.

    **Raises:**

    - `ValueError` with `name` if the result holds anything but real numbers.
    """
    for leaf in jtu.tree_leaves(value):
        check_real(leaf, name=f"The result of {name}")
    try:
        return jnp.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"The result of {name} must be an array of real numbers, but it is {value!r}.") from error


def as_function(value: object, *, name: str) -> Callable[..., PyTree]:
    """Convert a callable to part of a pytree: wrap it in `Function` unless it is an `eqx.Module`.

    **Raises:**

    - `ValueError` if `value` is not callable.
    """
    if not callable(value):
        raise ValueError(f"{name} must be a function, but {value!r} was given.")
    fn: Callable[..., PyTree] = value
    return fn if isinstance(value, eqx.Module) else Function(fn)


def depends_on(fn: Callable[[Array], Array], x: Float[Array, "..."]) -> bool:
    """Whether the result of `fn` is computed from `x`, even by a product with zero."""
    jaxpr = jax.make_jaxpr(fn)(x).jaxpr
    reached = set(jaxpr.invars)
    for equation in jaxpr.eqns:
        if any(var in reached for var in equation.invars if not hasattr(var, "val")):
            reached.update(equation.outvars)
    return any(var in reached for var in jaxpr.outvars if not hasattr(var, "val"))


# Least factor of a parameter, so that quotients by the parameter stay finite.
_LEAST = 1e-30

_Module = TypeVar("_Module", bound=eqx.Module)


class StateDependent(eqx.Module):
    """A parameter that depends on the state of the mechanism: a number times `fn(t, q, qd, params)`.

    It replaces the number in a module, whose type does not change; `bind_state` replaces it by the product. With the
    number None the value is that of `fn`, of either sign.
    """

    number: PyTree
    fn: Callable[..., ArrayLike]

    def __jax_array__(self) -> Array:
        """Refuse the conversion to a number."""
        raise TypeError(
            "This parameter depends on the state of the mechanism (scaled_by, or a torque), so it has no value without"
            " one. Call law.bind_state(t, q, qd, params) for the law at a state."
        )


class Reaction(eqx.Module):
    """A parameter that is the reaction of the constraint of this name; scenes solve for both together."""

    constraint: str = eqx.field(static=True)

    def __jax_array__(self) -> Array:
        """Refuse the conversion to a number."""
        raise TypeError(
            f"This parameter is the reaction of the constraint {self.constraint!r}, so it has no value outside a scene."
        )


def as_state_function(value: object, *, name: str) -> Callable[..., PyTree]:
    """Convert a function of the mechanism's state, `fn(t, q, qd, params)`, to part of a law.

    **Raises:**

    - `ValueError` if `value` is not callable, or holds numbers.
    """
    fn = as_function(value, name=name)
    if any(eqx.is_inexact_array(x) for x in jax.tree.leaves(fn)):
        raise ValueError(f"{name} holds numbers of its own; move them to the scene's params, and read them there.")
    return fn


def is_state_dependent(tree: object) -> bool:
    """Whether a parameter in `tree` depends on the state of the mechanism."""
    of_state = (StateDependent, Reaction)
    return any(isinstance(x, of_state) for x in jax.tree.leaves(tree, is_leaf=lambda x: isinstance(x, of_state)))


def need_values(tree: eqx.Module, wanted: str) -> None:
    """Refuse a law with parameters that depend on the state of the mechanism.

    **Raises:**

    - `ValueError` with the remedy.
    """
    if is_state_dependent(tree):
        raise ValueError(
            f"{wanted} needs the numbers of the law, but parameters of this {type(tree).__name__} depend on the state"
            " of the mechanism (scaled_by, or a torque). Pass the law at a state, law.bind_state(t, q, qd, params). A"
            " torque that is the name of a constraint needs a number."
        )


def bind_state(tree: _Module, t: Array, q: Array, qd: Array, params: object) -> _Module:
    """`tree` with the values of its parameters at a state of the mechanism; factors below 1e-30 count as 1e-30."""
    factors: dict[int, Array] = {}  # by function, so that parameters with the same function evaluate it once

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
    """The number of a parameter, without its factor."""
    return nominal(value.number) if isinstance(value, StateDependent) else value
