"""Tolerances, the same for every solver, and the loosest of them that is good enough."""

import math
from typing import Any

import numpy as np


def half_decades(first: float, last: float) -> tuple[float, ...]:
    """Tolerances 10^first, 10^(first - 1/2), ... down to 10^last: the ladder of every solver alike."""
    return tuple(float(10.0**k) for k in np.arange(first, last - 0.25, -0.5))


def loosest(rows: list[dict[str, Any]], key: str, goal: float) -> dict[str, Any] | None:
    """The row of the loosest tolerance whose error `key` reaches the goal; None where none does."""
    return next((row for row in rows if row.get(key, math.inf) <= goal), None)
