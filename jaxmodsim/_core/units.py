"""Units: those that are known, and those of an axis, linear and rotary."""

import re

from .arguments import nearest

# Symbols that make up a unit; "-" and "1" stand for a number without one.
_SYMBOLS = (
    "m", "km", "cm", "mm", "um", "nm", "in", "ft", "rad", "mrad", "urad", "deg", "rev", "s", "ms", "us", "min", "h",
    "kg", "g", "N", "kN", "mN", "J", "kJ", "W", "kW", "Pa", "kPa", "MPa", "bar", "Hz", "A", "mA", "V", "mV", "C", "F",
    "H", "Ohm", "Wb", "T", "K", "L", "%", "-", "1",
)  # fmt: skip
_NAMES = {
    "meter": "m", "metre": "m", "millimeter": "mm", "millimetre": "mm", "inch": "in", "foot": "ft", "radian": "rad",
    "degree": "deg", "turn": "rev", "second": "s", "sec": "s", "kilogram": "kg", "newton": "N", "joule": "J",
}  # fmt: skip

# What takes the place of a unit along a displacement where the displacement is an angle.
_ABOUT_AN_AXIS = {
    "kg": "kg m^2", "m": "rad", "m/s": "rad/s", "1/m": "1/rad", "s/m": "s/rad", "N": "N m", "N/m": "N m/rad",
    "N/s": "N m/s", "N s/m": "N m s/rad", "N s^2/m": "N m s^2/rad",
}  # fmt: skip


def axis_unit(unit: str, rotary: bool) -> str:
    """The unit of a linear axis, or what takes its place on a rotary one."""
    return _ABOUT_AN_AXIS.get(unit, unit) if rotary else unit


def check_unit(unit: str, *, name: str) -> None:
    """Refuse a unit that is no product or quotient of known symbols and their powers, such as `kg m^2/s`.

    **Raises:**

    - `ValueError` that names `name`, the symbol, the one that was probably meant, and those that are known.
    """
    for factor in re.split(r"[\s*·⋅/]+", unit):
        symbol = re.sub(r"\^?[-+]?\d+$", "", factor) or factor
        plain = symbol.replace("µ", "u").replace("μ", "u").replace("°", "deg")
        if plain in _SYMBOLS:
            continue
        lower = plain.lower()
        meant = {each.lower(): each for each in reversed(_SYMBOLS)} | _NAMES | {f"{x}s": y for x, y in _NAMES.items()}
        near = meant.get(lower) or nearest(plain, _SYMBOLS)
        hint = f" Did you mean {near!r}?" if near else ""
        raise ValueError(
            f"{name} has the unit {unit!r}, where {symbol!r} is not known.{hint} A unit is made of"
            f" {', '.join(_SYMBOLS)} by products, quotients and powers, as in 'N m/rad' or 'm^2'."
        )
