"""Arguments that are no numbers of a scene: converted, or refused by their name."""

import difflib
import math
from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree


def check_real(value: object, *, name: str) -> None:
    """Refuse what holds anything but real numbers.

    **Raises:**

    - `ValueError` naming `name` and what was given.
    """
    if type(value) is np.ndarray and value.dtype.kind in "fiu":
        return  # what is usual is told apart soonest
    kind = getattr(value, "dtype", None)
    if kind is None:
        try:
            kind = np.asarray(value).dtype
        except ValueError:  # of lists of unequal length
            kind = np.dtype(object)
    column = None
    if hasattr(value, "__array__") and not isinstance(value, np.ndarray | np.generic | jax.Array):
        # Columns of tables have types of their own, and print over many lines.
        kind, column = np.asarray(value).dtype, f"a {type(value).__name__} of {kind}"
    # What merely calls something its dtype is no array.
    if not isinstance(kind, np.dtype) or not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)):
        raise ValueError(f"{name} must hold real numbers, but {column or repr(value)} was given.")


def as_reals(value: object, *, name: str) -> Float[np.ndarray, "..."]:
    """Real numbers that are known, as an array of NumPy.

    **Raises:**

    - `ValueError` as `check_real` does.
    """
    check_real(value, name=name)
    return np.asarray(value, float)


def as_float(value: object, *, name: str, lower: float | None = None) -> float:
    """One finite number that is known, above `lower`.

    **Raises:**

    - `ValueError` naming `name`, what was given and what is needed.
    """
    array = as_reals(value, name=name)
    if array.shape != () or not math.isfinite(array) or not (lower is None or array > lower):
        above = "" if lower is None else f" > {lower:g}"
        raise ValueError(f"{name} must be one finite number{above}, but {value!r} was given.")
    return float(array)


def as_share(value: object, *, name: str) -> float:
    """One number that is known, above 0 and below 1.

    **Raises:**

    - `ValueError` naming `name` and what was given.
    """
    array = as_reals(value, name=name)
    if array.shape != () or not 0 < array < 1:
        raise ValueError(f"{name} must lie between 0 and 1, but it is {value!r}.")
    return float(array)


def as_whole(value: object, *, name: str, least: int = 1) -> int:
    """A whole number, `least` or more, that fits into 63 bits.

    **Raises:**

    - `ValueError` naming `name`, what was given and what is needed.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not least <= value < 2**63:
        need = {0: "an integer >= 0", 1: "a positive integer"}.get(least, f"an integer >= {least}")
        given = f"one of {len(str(value))} digits" if isinstance(value, int) and value >= 2**63 else repr(value)
        raise ValueError(f"{name} must be {need}, but {given} was given.")
    return int(value)


def as_flag(value: object, *, name: str) -> bool:
    """True or False, no number that stands for it.

    **Raises:**

    - `ValueError` naming `name` and what was given.
    """
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, but {value!r} was given.")
    return bool(value)


def as_label(value: object, *, name: str) -> str | None:
    """A text that is not empty, or None.

    **Raises:**

    - `ValueError` naming `name` and what was given.
    """
    if not (value is None or (isinstance(value, str) and value)):
        raise ValueError(f"{name} must be a text that is not empty, or None, but {value!r} was given.")
    return value


def as_names(value: object, *, name: str) -> tuple[str, ...]:
    """Names in a list, a tuple or a set.

    **Raises:**

    - `ValueError` naming `name` and what was given.
    """
    if not isinstance(value, tuple | list | set | frozenset) or not all(isinstance(each, str) for each in value):
        raise ValueError(f"{name} must be a list of names, as in ['m'], but {value!r} was given.")
    return tuple(value)


def as_mapping(value: object, *, name: str, example: str) -> dict[str, PyTree]:
    """A mapping by names; None is an empty one.

    **Raises:**

    - `ValueError` naming `name`, what was given, and an `example` of what is needed.
    """
    if value is None:
        return {}
    if not isinstance(value, Mapping) or not all(isinstance(each, str) for each in value):
        raise ValueError(f"{name} must be a mapping by names, as in {example}, but {value!r} was given.")
    return dict(value)


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The known name that is most like this one; None where none is."""
    matches = difflib.get_close_matches(name, list(known), n=1)
    return matches[0] if matches else None


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A question whether the nearest of the known names was meant, to end a sentence with; "" where none is near."""
    near = nearest(name, known)
    return f" Did you mean {near!r}?" if near else ""
