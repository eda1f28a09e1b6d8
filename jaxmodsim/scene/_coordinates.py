"""Names and units of coordinates."""

import re
from typing import NamedTuple

from .._core.arguments import check_unit

_LABEL = re.compile(r"\s*([^\[\]]*[^\[\]\s])\s*(?:\[\s*([^\[\]]*[^\[\]\s])\s*\])?\s*")


class Quantity(NamedTuple):
    """Name and unit of a series along a run; the unit is empty if unknown."""

    name: str
    unit: str

    @property
    def label(self) -> str:
        """The name, with its unit in brackets if it has one."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def read_label(text: str) -> Quantity:
    """The parts of a text such as "x [m]"."""
    match = _LABEL.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is no name with a unit in brackets, such as 'x [m]'.")
    return Quantity(match[1], match[2] or "")


def as_coordinates(given: object) -> tuple[str, ...]:
    """Texts such as "x [m]", one for each coordinate, with different names and known units.

    **Raises:**

    - `ValueError` naming the argument and the requirement.
    """
    if not isinstance(given, tuple | list) or not all(isinstance(x, str) and _LABEL.fullmatch(x) for x in given):
        raise ValueError(
            'coordinates must hold a name for each coordinate, with its unit in brackets, as in ("x [m]", "phi [rad]"),'
            f" but {given!r} was given."
        )
    for text in given:
        if unit := read_label(text).unit:
            check_unit(unit, name=f"The coordinate {text!r}")
    names = [read_label(text).name for text in given]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"Two coordinates have the name {name!r}; names of coordinates must differ.")
    return tuple(read_label(text).label for text in given)
