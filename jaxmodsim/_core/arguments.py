"""Arguments that are not numbers of a scene, and units: convert them, or refuse them by name."""

import difflib
import math
import re
from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree


def check_real(value: object, *, name: str) -> None:
    """Refuse anything but real numbers.

    **Raises:**

    - `ValueError` with `name` and the value.
    """
    if type(value) is np.ndarray and value.dtype.kind in "fiu":
        return  # the most frequent case
    kind = getattr(value, "dtype", None)
    if kind is None:
        try:
            kind = np.asarray(value).dtype
        except ValueError:  # lists of unequal length
            kind = np.dtype(object)
    column = None
    if hasattr(value, "__array__") and not isinstance(value, np.ndarray | np.generic | jax.Array):
        # Columns of tables have their own types, and print many lines.
        kind, column = np.asarray(value).dtype, f"a {type(value).__name__} of {kind}"
    # Other objects may also have an attribute `dtype`.
    if not isinstance(kind, np.dtype) or not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)):
        raise ValueError(f"{name} must hold real numbers, but {column or repr(value)} was given.")


def as_reals(value: object, *, name: str) -> Float[np.ndarray, "..."]:
    """Convert known real numbers to a NumPy array.

    **Raises:**

    - `ValueError` as `check_real` does.
    """
    check_real(value, name=name)
    return np.asarray(value, float)


def as_float(value: object, *, name: str, lower: float | None = None) -> float:
    """Convert a known finite number above `lower`.

    **Raises:**

    - `ValueError` with `name`, the value and the requirement.
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
    """Convert an integer, `least` or more, that fits into 63 bits.

    **Raises:**

    - `ValueError` with `name`, the value and the requirement.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not least <= value < 2**63:
        need = {0: "an integer >= 0", 1: "a positive integer"}.get(least, f"an integer >= {least}")
        given = f"one of {len(str(value))} digits" if isinstance(value, int) and value >= 2**63 else repr(value)
        raise ValueError(f"{name} must be {need}, but {given} was given.")
    return int(value)


def as_flag(value: object, *, name: str) -> bool:
    """Convert True or False; numbers are refused.

    **Raises:**

    - `ValueError` with `name` and the value.
    """
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, but {value!r} was given.")
    return bool(value)


def as_label(value: object, *, name: str) -> str | None:
    """Accept a text that is not empty, or None.

    **Raises:**

    - `ValueError` with `name` and the value.
    """
    if not (value is None or (isinstance(value, str) and value)):
        raise ValueError(f"{name} must be a text that is not empty, or None, but {value!r} was given.")
    return value


def as_names(value: object, *, name: str) -> tuple[str, ...]:
    """Convert names in a list, a tuple or a set.

    **Raises:**

    - `ValueError` with `name` and the value.
    """
    if not isinstance(value, tuple | list | set | frozenset) or not all(isinstance(each, str) for each in value):
        raise ValueError(f"{name} must be a list of names, such as ['m'], but {value!r} was given.")
    return tuple(value)


def as_mapping(value: object, *, name: str, example: str) -> dict[str, PyTree]:
    """Convert a mapping with names as keys; None is an empty mapping.

    **Raises:**

    - `ValueError` with `name`, the value and an `example`.
    """
    if value is None:
        return {}
    if not isinstance(value, Mapping) or not all(isinstance(each, str) for each in value):
        raise ValueError(f"{name} must be a mapping with names as keys, such as {example}, but {value!r} was given.")
    return dict(value)


def nearest(name: str, known: Iterable[str], least: float = 0.6) -> str | None:
    """The known name that is most similar; None if the similarity of all is below `least`, 1 for equal names."""
    matches = difflib.get_close_matches(name, list(known), n=1, cutoff=least)
    return matches[0] if matches else None


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The question " Did you mean 'NAME'?" for a message; "" if no known name is similar."""
    near = nearest(name, known)
    return f" Did you mean {near!r}?" if near else ""


# Symbols of units; "-" and "1" denote a number without a unit.
_SYMBOLS = (
    "m", "km", "cm", "mm", "um", "nm", "in", "ft", "rad", "mrad", "urad", "deg", "rev", "s", "ms", "us", "min", "h",
    "kg", "g", "N", "kN", "mN", "J", "kJ", "W", "kW", "Pa", "kPa", "MPa", "bar", "Hz", "A", "mA", "V", "mV", "C", "F",
    "H", "Ohm", "Wb", "T", "K", "L", "%", "-", "1",
)  # fmt: skip
_NAMES = {
    "meter": "m", "metre": "m", "millimeter": "mm", "millimetre": "mm", "inch": "in", "foot": "ft", "radian": "rad",
    "degree": "deg", "turn": "rev", "second": "s", "sec": "s", "kilogram": "kg", "newton": "N", "joule": "J",
}  # fmt: skip

# Units of a rotary axis, by those of a linear axis.
_ABOUT_AN_AXIS = {
    "kg": "kg m^2", "m": "rad", "m/s": "rad/s", "1/m": "1/rad", "s/m": "s/rad", "N": "N m", "N/m": "N m/rad",
    "N/s": "N m/s", "N s/m": "N m s/rad", "N s^2/m": "N m s^2/rad",
}  # fmt: skip


def axis_unit(unit: str, rotary: bool) -> str:
    """The unit on a linear axis, or the corresponding unit on a rotary axis."""
    return _ABOUT_AN_AXIS.get(unit, unit) if rotary else unit


def check_unit(unit: str, *, name: str) -> None:
    """Refuse a unit that is not a product or quotient of known symbols and their powers, such as `kg m^2/s`.

    **Raises:**

    - `ValueError` with `name`, the unknown symbol, the most similar symbol and the known symbols.
    """
    for factor in re.split(r"[\s*·⋅/]+", unit):
        symbol = re.sub(r"\^?[-+]?\d+$", "", factor) or factor
        plain = symbol.replace("µ", "u").replace("μ", "u").replace("°", "deg")
        if plain in _SYMBOLS:
            continue
        lower = plain.lower()
        names = {each.lower(): each for each in reversed(_SYMBOLS)} | _NAMES | {f"{x}s": y for x, y in _NAMES.items()}
        near = names.get(lower) or nearest(plain, _SYMBOLS)
        hint = f" Did you mean {near!r}?" if near else ""
        raise ValueError(
            f"{name} has the unit {unit!r}, where {symbol!r} is not known.{hint} Units are products, quotients and"
            f" powers of {', '.join(_SYMBOLS)}, such as 'N m/rad' or 'm^2'."
        )
