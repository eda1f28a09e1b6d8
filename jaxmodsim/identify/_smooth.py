"""Velocity and acceleration of a measured position."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Motion(NamedTuple):
    """A smoothed motion, shape `[samples]` each, and how many samples at either end the smoothing spoils."""

    x: Float[np.ndarray, " samples"]
    v: Float[np.ndarray, " samples"]
    a: Float[np.ndarray, " samples"]
    edge: int


def smooth(x: Float[np.ndarray, " samples"], span: int) -> Float[np.ndarray, " samples"]:
    """Weighted mean over `span` samples to either side."""
    kernel = np.hanning(2 * span + 3)[1:-1]
    return np.convolve(np.pad(x, span, mode="edge"), kernel / kernel.sum(), mode="valid")


def smooth_span(samples: int) -> int:
    """Samples to either side over which a record of so many is smoothed."""
    return max(samples // 1000, 3)


def differentiate(t: Float[np.ndarray, " samples"], x: Float[np.ndarray, " samples"]) -> Motion:
    """Velocity and acceleration of a position, smoothed before either differentiation."""
    span = smooth_span(len(t))
    position = smooth(x, span)
    v = smooth(np.gradient(position, t), span)
    return Motion(position, v, np.gradient(v, t), 3 * span)
