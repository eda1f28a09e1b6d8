"""Colours, units, ticks and panel letters that all figures share."""

from collections.abc import Iterable
from string import ascii_lowercase

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import LogLocator, StrMethodFormatter

# Blue, vermilion and bluish green of Okabe and Ito, Color universal design, 2008: told apart without red and green.
BLUE, RED, GREY, GREEN = "#0072b2", "#d55e00", "#8a8a8a", "#009e73"
COLOURS = (BLUE, RED, GREEN, "#7b4fa3", "#b8860b")  # of lines in one panel

# Ratio of the ends of a logarithmic axis up to which its numbers are written out.
_FEW_DECADES = 300.0


def plain_ticks(*axes: Axis) -> None:
    """Plain numbers, in place of 3 x 10^-1, on logarithmic axes that have few decades."""
    for axis in axes:
        low, high = sorted(axis.get_view_interval())
        if axis.get_scale() == "log" and high < _FEW_DECADES * low:
            axis.set_minor_locator(LogLocator(subs=(2.0, 3.0, 5.0)))
            for place in (axis.set_major_formatter, axis.set_minor_formatter):
                place(StrMethodFormatter("{x:g}"))


def panel_letters(panels: Iterable[Axes]) -> None:
    """Letters a, b, c above the left corners of panels."""
    for letter, panel in zip(ascii_lowercase, panels, strict=False):
        panel.set_title(letter, loc="left", fontweight="bold", fontsize=11)


def legend_above(panel: Axes, ncols: int = 2) -> None:
    """A legend above the right corner of a panel, where it covers nothing."""
    panel.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2, ncols=ncols, fontsize=9, frameon=False
    )


def legend_beside(panel: Axes) -> None:
    """A legend to the right of a panel."""
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9, frameon=False)


def small_unit(unit: str) -> tuple[float, str]:
    """Factor and name of a unit a thousand times smaller."""
    return (1e3, f"m{unit}") if unit in ("m", "N", "rad", "m/s") else (1.0, unit)


def with_unit(name: str, unit: str) -> str:
    """A label with its unit in brackets, where there is one."""
    return f"{name} [{unit}]" if unit else name
