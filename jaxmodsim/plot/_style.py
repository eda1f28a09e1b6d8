"""Colours and units that all figures share."""

from ..validation.behaviour import Verdict

BLUE, RED, GREY, GREEN = "#1f5fa8", "#c2452d", "#8a8a8a", "#2e8b57"
COLOURS = (BLUE, RED, GREEN, "#7b4fa3", "#b8860b")  # of lines in one panel
VERDICTS = {
    Verdict.PASS: GREEN,
    Verdict.FAIL: RED,
    Verdict.KNOWN_LIMITATION: "#b8860b",
    Verdict.NOT_APPLICABLE: GREY,
}


def small_unit(unit: str) -> tuple[float, str]:
    """Factor and name of a unit a thousand times smaller."""
    return (1e3, f"m{unit}") if unit in ("m", "N", "rad", "m/s") else (1.0, unit)


def with_unit(name: str, unit: str) -> str:
    """A label with its unit in brackets, where there is one."""
    return f"{name} [{unit}]" if unit else name
