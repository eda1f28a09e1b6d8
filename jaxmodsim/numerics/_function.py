"""Functions as parts of pytrees."""

from collections.abc import Callable
from typing import Any

import equinox as eqx


class Function(eqx.Module):
    """A plain function as part of a pytree: it holds no numbers and is compared by identity."""

    fn: Callable[..., Any] = eqx.field(static=True)

    def __call__(self, *args: Any) -> Any:
        """Call the function."""
        return self.fn(*args)


def as_function(value: Any, *, name: str) -> Callable[..., Any]:
    """Make a callable fit to sit in a pytree: an `eqx.Module` stays what it is, anything else is wrapped.

    **Raises:**

    - `ValueError` if `value` cannot be called.
    """
    if not callable(value):
        raise ValueError(f"{name} must be a function, but {value!r} was given.")
    fn: Callable[..., Any] = value
    return fn if isinstance(value, eqx.Module) else Function(fn)
