"""Units of the columns of a record: from --units, from the header, or SI."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from .._core.arguments import did_you_mean

# SI units per unit, by quantity.
_FACTORS = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "nm": 1e-9, "in": 0.0254},
    "angle": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": math.pi / 180, "rev": 2 * math.pi},
    "velocity": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "um/s": 1e-6, "m/min": 1 / 60, "mm/min": 1e-3 / 60},
    "angular velocity": {
        "rad/s": 1.0, "mrad/s": 1e-3, "deg/s": math.pi / 180, "rpm": math.pi / 30, "rev/s": 2 * math.pi
    },
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "torque": {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "Ncm": 1e-2, "kNm": 1e3},
    "current": {"A": 1.0, "mA": 1e-3},
    "voltage": {"V": 1.0, "mV": 1e-3},
}  # fmt: skip
_QUANTITIES = {unit: quantity for quantity, units in _FACTORS.items() for unit in units}
_SPELLINGS = {
    "sec": "s", "seconds": "s", "msec": "ms", "degree": "deg", "degrees": "deg", "1/min": "rpm", "min-1": "rpm",
    "turns": "rev", "volt": "V", "ampere": "A",
}  # fmt: skip
# Quantities of each column. A drive signal needs a factor to become a force.
_ROLES = {
    "time": ("time",),
    "position": ("length", "angle", "velocity", "angular velocity"),
    "force": ("force", "torque"),
}
_DRIVE = ("current", "voltage")
# At the end of a name without brackets, these often mean something else: q_m, F_min, u_in.
_AMBIGUOUS = ("m", "in", "min", "h", "rev")
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)?\s*(.*?)\s*\Z", re.DOTALL)
_UNKNOWN = re.compile(r"\[[^\[\]]*[^\W\d][^\[\]]*\]\s*\Z")
_IN_BRACKETS = re.compile(r"(.*?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))\s*\Z", re.DOTALL)


@dataclass(frozen=True)
class Unit:
    """A unit.

    - `factor`: SI units per unit. `quantity`: None for a plain factor. `text`: as typed.
    """

    factor: float
    quantity: str | None
    text: str

    @property
    def rotary(self) -> bool | None:
        """Whether the unit implies a rotary axis; None if it implies neither kind."""
        if self.quantity in ("angle", "angular velocity", "torque"):
            return True
        return False if self.quantity in ("length", "velocity", "force") else None

    @property
    def velocity(self) -> bool:
        """Whether the unit is one of velocity."""
        return self.quantity in ("velocity", "angular velocity")


def known_unit(text: str) -> Unit | None:
    """The unit with this name, in any usual spelling; None for another text."""
    plain = re.sub(r"[\s*·⋅.]", "", text.replace("µ", "u").replace("μ", "u").replace("°", "deg"))
    plain = _SPELLINGS.get(plain, plain)
    quantity = _QUANTITIES.get(plain)
    return None if quantity is None else Unit(_FACTORS[quantity][plain], quantity, text.strip())


def split_header(header: str) -> tuple[str, Unit | None]:
    """Name and unit of a column: `phi [deg]`, `phi (deg)` or `phi_deg`. Without a unit, the header is the name."""
    brackets = _IN_BRACKETS.match(header)
    if brackets is not None:
        unit = known_unit(brackets[2] if brackets[2] is not None else brackets[3])
        return (header, None) if unit is None else (brackets[1].strip(), unit)
    *names, last = header.split("_")
    candidates = [(names, last)] if names else []
    if len(names) > 1:
        candidates.insert(0, (names[:-1], f"{names[-1]}/{last}"))  # v_mm_s
    for before, text in candidates:
        unit = None if text in _AMBIGUOUS else known_unit(text)
        if unit is not None and any(before):
            return "_".join(before), unit
    return header, None


def parse_units(texts: Sequence[str]) -> dict[str, Unit]:
    """Parse `time=ms,position=deg,force=12.5 N`.

    **Raises:**

    - `ValueError` for an unknown column or unit, a unit of another quantity, and a factor of zero.
    """
    units: dict[str, Unit] = {}
    for entry in (part for text in texts for part in text.split(",") if part.strip()):
        role, equals, text = (part.strip() for part in entry.partition("="))
        if role not in _ROLES or not equals:
            raise ValueError(
                "--units needs COLUMN=UNIT entries, separated by commas, where COLUMN is time, position or force, as in"
                f" time=ms,position=deg,force=12.5, but {entry.strip()!r} was given."
            )
        units[role] = _parse_unit(role, text)
    return units


def _parse_unit(role: str, text: str) -> Unit:
    match = _NUMBER.match(text)
    assert match is not None  # matches everything
    number, name = match[1], match[2]
    factor = 1.0 if number is None else float(number)
    if not (math.isfinite(factor) and factor != 0) or (number is None and not name):
        raise ValueError(f"--units {role}={text}: the factor must be finite and not zero.")
    if not name:
        return Unit(factor, None, text)
    # N/A is newtons per unit of the column.
    unit = known_unit(name) or (known_unit(name.split("/")[0]) if role == "force" else None)
    allowed = [each for quantity in _ROLES[role] for each in _FACTORS[quantity]]
    if unit is None:
        raise ValueError(
            f"--units {role}={text}: there is no unit {name!r}; the units are: {', '.join(allowed)}."
            f"{did_you_mean(name, allowed)}"
        )
    if unit.quantity in _DRIVE:
        raise ValueError(f"--units {role}={text}: {_drive_sentence(unit)}")
    if unit.quantity not in _ROLES[role]:
        raise ValueError(
            f"--units {role}={text}: {name} is a unit of {unit.quantity}; the units are: {', '.join(allowed)}."
        )
    return Unit(factor * unit.factor, unit.quantity, text)


def _drive_sentence(unit: Unit) -> str:
    """Error for a drive signal in the place of the force."""
    return (
        f"{unit.text} is a unit of {unit.quantity}, which needs a factor to become a force: give the newtons (or N m)"
        f" per {unit.text} of the column, as in --units force=12.5."
    )


def column_unit(role: str, header: str, option: Unit | None) -> tuple[Unit, str]:
    """The unit of a column, and a note if the header contradicts the `option` --units, else "".

    **Raises:**

    - `ValueError` without the option, for a header with the unit of a drive signal or of another quantity.
    """
    in_header = split_header(header)[1]
    if option is None:
        if in_header is None:
            unknown = _UNKNOWN.search(header)
            note = unknown and f"{header!r}: {unknown[0]} is no known unit, so SI is assumed; give --units {role}=UNIT."
            return Unit(1.0, None, ""), note or ""
        if role == "force" and in_header.quantity in _DRIVE:
            raise ValueError(f"column {header!r}: {_drive_sentence(in_header)}")
        if in_header.quantity not in _ROLES[role]:
            raise ValueError(
                f"column {header!r} is in {in_header.text}, a unit of {in_header.quantity}, and cannot be the {role}."
                f" Name another column by --{role}, or the unit by --units {role}=UNIT."
            )
        return in_header, ""
    quantity = option.quantity or (in_header.quantity if in_header and in_header.quantity in _ROLES[role] else None)
    unit = Unit(option.factor, quantity, option.text)
    if in_header is None or in_header.quantity in _DRIVE:
        return unit, ""
    if in_header.quantity == unit.quantity and math.isclose(abs(in_header.factor), abs(unit.factor), rel_tol=1e-9):
        return unit, ""
    return unit, f"column {header!r} says {in_header.text}, but --units {role}={option.text} takes precedence."
