"""Results of an experiment on a law."""

import enum
import math
from dataclasses import dataclass

import numpy as np

# A number below that is not told from zero: all limits are far above it, or zero but for rounding.
_NONE = 5e-4


class Verdict(enum.Enum):
    """How a law did in an experiment."""

    PASS = "pass"
    FAIL = "FAIL"
    KNOWN_LIMITATION = "known limitation"
    NOT_APPLICABLE = "n/a"


@dataclass(frozen=True)
class Threshold:
    """What a number must keep to pass.

    - `value`: the threshold, in the unit of the number.
    - `at_most`: whether the number must be at most that; at least that otherwise.
    """

    value: float
    at_most: bool

    def keeps(self, number: float) -> bool:
        """Whether `number` keeps the threshold; NaN never does."""
        return number <= self.value if self.at_most else number >= self.value


@dataclass(frozen=True)
class FigureLine:
    """A curve of a figure.

    - `label`: what it is.
    - `x`, `y`: in the units of the experiment's axes.
    - `reference`: whether it is what the law is held against.
    """

    label: str
    x: np.ndarray
    y: np.ndarray
    reference: bool = False


@dataclass(frozen=True)
class LawMeasurement:
    """What was measured on one law.

    - `number`: in the unit of the experiment; NaN where the experiment does not apply.
    - `sentence`: what it says of the law.
    - `lines`: curves for the figure.
    """

    number: float
    sentence: str
    lines: tuple[FigureLine, ...] = ()

    @property
    def rounded(self) -> str:
        """The number with two digits, in few characters; empty where there is none, and 0 for what is next to none."""
        if math.isnan(self.number):
            return ""
        if abs(self.number) < _NONE:
            return "0"
        if 100.0 <= abs(self.number) < 1e4:
            return f"{self.number:.0f}"
        return f"{self.number:.2g}".replace("e+0", "e")


@dataclass(frozen=True)
class ExperimentResult:
    """A measurement and its verdict.

    - `verdict`: `PASS`, `FAIL`, `KNOWN_LIMITATION` (misses the threshold, as is known of such laws), `NOT_APPLICABLE`.
    - `measured`: number, sentence and curves.
    - `reason`: why such a law misses the threshold, or why the experiment does not apply; empty otherwise.
    """

    verdict: Verdict
    measured: LawMeasurement
    reason: str = ""
