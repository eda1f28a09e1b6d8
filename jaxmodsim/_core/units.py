"""Units of an axis, linear and rotary."""

# What takes the place of a unit along a displacement where the displacement is an angle.
_ABOUT_AN_AXIS = {
    "kg": "kg m^2", "m": "rad", "m/s": "rad/s", "1/m": "1/rad", "s/m": "s/rad", "N": "N m", "N/m": "N m/rad",
    "N/s": "N m/s", "N s/m": "N m s/rad", "N s^2/m": "N m s^2/rad",
}  # fmt: skip


def axis_unit(unit: str, rotary: bool) -> str:
    """The unit of a linear axis, or what takes its place on a rotary one."""
    return _ABOUT_AN_AXIS.get(unit, unit) if rotary else unit
