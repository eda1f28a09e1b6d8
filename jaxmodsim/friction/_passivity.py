"""The answer whether a law is passive, and searches over speed."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class Passivity:
    """Answer of `check_passivity`; true where the law is passive, and printed as a sentence.

    - `ok`: whether the law is passive.
    - `margin`: viscous coefficient [N s/m] that could be taken away before the law stops being passive; below zero,
      what has to be added, and -inf where that does not help.
    - `speed`: slip speed [m/s] up to which no more comes back than went in; infinite where that holds at all speeds.
    - `condition`: what decides, in words, with the law's numbers in it.
    """

    ok: bool
    margin: float
    speed: float
    condition: str

    def __bool__(self) -> bool:
        return self.ok

    def __str__(self) -> str:
        """All of it in a sentence or two."""
        if self.ok:
            return f"Passive, with a margin of {self.margin:g} N s/m. {self.condition}"
        return f"Not passive from {self.speed:g} m/s on; margin {self.margin:g} N s/m. {self.condition}"


def logarithmic(low: float, high: float, per_decade: int = 200) -> Array:
    """Speeds [m/s] from `low` to `high`, evenly in the logarithm."""
    if not 0 < high < math.inf or high <= low:
        raise ValueError(f"check_passivity: v_max must be finite and above {low:g} [m/s], but {high} was given.")
    return np.geomspace(low, high, 2 + math.ceil(per_decade * math.log10(high / low)))


def least_on(fn: Callable[[Array], Array], grid: Array) -> tuple[float, float]:
    """Least value of `fn` on `grid`, refined about the least, and where it is."""
    values = fn(grid)
    least, where = float(values.min()), float(grid[int(np.argmin(values))])
    for _ in range(4):
        i = int(np.argmin(values))
        grid = np.geomspace(grid[max(i - 1, 0)], grid[min(i + 1, grid.size - 1)], grid.size)
        values = fn(grid)
        if float(values.min()) < least:
            least, where = float(values.min()), float(grid[int(np.argmin(values))])
    return least, where


def first_negative(fn: Callable[[Array], Array], grid: Array) -> float:
    """Smallest speed on `grid` above which `fn` falls below zero, refined between its points."""
    for _ in range(4):
        i = int(np.argmax(fn(grid) < 0))
        if i == 0:
            return float(grid[0])
        grid = np.geomspace(grid[i - 1], grid[i], grid.size)
    return float(grid[0])
