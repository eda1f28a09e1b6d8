"""Finite differences against which the tests hold derivatives."""

from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util
import numpy as np


def central_difference(fn: Callable[[float], Any], x: float, step: float) -> np.ndarray:
    """Derivative of `fn` at `x` by the five-point rule, whose error is step^4 times the fifth derivative over 30.

    The rounding error is about 1.5 eps |fn|/step, so the best step is near eps^(1/5), about 1e-3 of the length over
    which `fn` changes.
    """
    near = np.asarray(fn(x + step)) - np.asarray(fn(x - step))
    far = np.asarray(fn(x + 2 * step)) - np.asarray(fn(x - 2 * step))
    return (8 * near - far) / (12 * step)


def gradient_by_differences(fn: Callable[[Any], Any], tree: Any, relative_step: float) -> np.ndarray:
    """Gradient of a scalar `fn` by all leaves of `tree`, flattened, with steps relative to each number.

    A number that is zero gets `relative_step` itself as its step.
    """
    flat, unravel = jax.flatten_util.ravel_pytree(tree)
    columns = []
    for i, value in enumerate(np.asarray(flat)):
        step = relative_step * (abs(value) or 1.0)
        columns.append(central_difference(lambda x, i=i: fn(unravel(flat.at[i].set(x))), value, step))
    return np.array(columns)


def flat(tree: Any) -> np.ndarray:
    """All leaves of `tree` in one vector."""
    return np.asarray(jax.flatten_util.ravel_pytree(tree)[0])
