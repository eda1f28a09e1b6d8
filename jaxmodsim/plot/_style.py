"""The class of all figures, and the colours, units, ticks and panel letters that they share."""

import io
from collections.abc import Iterable
from string import ascii_lowercase

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure as _Figure
from matplotlib.ticker import LogLocator, StrMethodFormatter


class Figure(_Figure):
    """A matplotlib figure that a notebook displays, with or without pyplot."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png")
        return file.getvalue()


# Blue, vermilion and bluish green of Okabe and Ito, Color universal design, 2008: distinct for colour-blind readers.
BLUE, RED, GREY, GREEN = "#0072b2", "#d55e00", "#8a8a8a", "#009e73"
COLOURS = (BLUE, RED, GREEN, "#7b4fa3", "#b8860b")  # of the lines in one panel

# A logarithmic axis with a smaller ratio of its limits has plain numbers as tick labels.
_FEW_DECADES = 300.0


def plain_ticks(*axes: Axis) -> None:
    """Label logarithmic axes that span few decades with plain numbers, 0.3 in place of 3 x 10^-1."""
    for axis in axes:
        low, high = sorted(axis.get_view_interval())
        if axis.get_scale() == "log" and high < _FEW_DECADES * low:
            axis.set_minor_locator(LogLocator(subs=(2.0, 3.0, 5.0)))
            for place in (axis.set_major_formatter, axis.set_minor_formatter):
                place(StrMethodFormatter("{x:g}"))


def panel_letters(panels: Iterable[Axes]) -> None:
    """Write the letters a, b, c above the left corners of the panels."""
    for letter, panel in zip(ascii_lowercase, panels, strict=False):
        panel.set_title(letter, loc="left", fontweight="bold", fontsize=11)


def legend_above(panel: Axes) -> None:
    """Place a legend above the right corner of a panel, outside the data."""
    panel.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2, ncols=2, fontsize=9, frameon=False)


def legend_beside(panel: Axes) -> None:
    """Place a legend to the right of a panel."""
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9, frameon=False)


def small_unit(unit: str) -> tuple[float, str]:
    """Factor and name of the unit that is a thousand times smaller; a unit without one stays."""
    return (1e3, f"m{unit}") if unit in ("m", "N", "rad", "m/s") else (1.0, unit)


def with_unit(name: str, unit: str) -> str:
    """A label with its unit, if any, in brackets."""
    return f"{name} [{unit}]" if unit else name
