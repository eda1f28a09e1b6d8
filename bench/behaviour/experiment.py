"""Laws of the bench, experiments, their measurements, and verdicts by a threshold."""

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Array

from jaxmodsim.friction import STANDARD, LawCase, LuGre, Stribeck, asymmetric, laws, scaled_by
from jaxmodsim.simulation import SimulationError

FC, FS, VS, SIGMA0, WIDTH = (STANDARD[name] for name in ("Fc", "Fs", "vs", "sigma0", "width"))
# Deflection [m] of a contact of this stiffness at break-away.
DEFLECTION = FS / SIGMA0
# Ratio of backward to forward friction of the asymmetric law.
BACKWARD = 1.3


def _double(t: Array, q: Array, qd: Array, p: object) -> float:
    return 2.0


def law_cases() -> tuple[LawCase, ...]:
    """Examples of all registered laws, and of laws with modifiers."""
    stribeck, viscous = Stribeck.cases()[0].steady, STANDARD["Fv"]
    halved = Stribeck.standard(Fc=0.5 * FC, Fs=0.5 * FS, Fv=0.5 * viscous)
    worn = asymmetric(LuGre.standard(), Fc=BACKWARD * FC, Fs=BACKWARD * FS)

    def worn_curve(v: np.ndarray) -> np.ndarray:
        """The Stribeck curve, stronger backward."""
        return np.where(v < 0, BACKWARD, 1.0) * (stribeck(v) - viscous * v) + viscous * v

    return (
        *(case for law in laws().values() for case in law.cases()),
        LawCase("Stribeck, scaled", scaled_by(halved, _double), stribeck),
        LawCase("LuGre, asymmetric", worn, worn_curve),
    )


# Smaller numbers count as zero: all thresholds are far above this value, or zero up to rounding.
_NONE = 5e-4


class Verdict(enum.Enum):
    """Verdict of an experiment on a law."""

    PASS = "pass"
    FAIL = "FAIL"
    KNOWN_LIMITATION = "known limitation"
    NOT_APPLICABLE = "n/a"


@dataclass(frozen=True)
class Threshold:
    """The limit of a number.

    - `value`: in the unit of the number.
    - `at_most`: whether the limit is an upper one.
    """

    value: float
    at_most: bool

    def keeps(self, number: float) -> bool:
        """Whether `number` is within the limit; NaN is not."""
        return number <= self.value if self.at_most else number >= self.value


@dataclass(frozen=True)
class FigureLine:
    """A curve of a figure.

    - `label`: in the legend.
    - `x`, `y`: in the units of the axes.
    - `reference`: whether it is the reference for the law.
    """

    label: str
    x: np.ndarray
    y: np.ndarray
    reference: bool = False


@dataclass(frozen=True)
class LawMeasurement:
    """A measurement on one law.

    - `number`: in the unit of the experiment; NaN if the experiment does not apply.
    - `sentence`: interpretation of the number.
    - `lines`: curves for the figure.
    """

    number: float
    sentence: str
    lines: tuple[FigureLine, ...] = ()

    @property
    def rounded(self) -> str:
        """The number with two digits; "" for NaN, and 0 for values near zero."""
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

    - `verdict`: `PASS`, `FAIL`, `KNOWN_LIMITATION` (a failure that the law declares), `NOT_APPLICABLE`.
    - `measured`: number, sentence and curves.
    - `reason`: reason of a known limitation, or why the experiment does not apply; otherwise "".
    """

    verdict: Verdict
    measured: LawMeasurement
    reason: str = ""


@dataclass(frozen=True)
class Experiment:
    """A standard experiment on a friction law.

    - `name`: short, for tables and file names.
    - `title`: of the figure.
    - `quantity`: name of the number.
    - `unit`: of the number.
    - `threshold`: limit of the number.
    - `axes`: labels of the axes, with units.
    - `measure`: performs the experiment on one law.
    - `window`: range of the vertical axis, the same for all laws.
    - `log_x`: whether the horizontal axis is logarithmic.
    """

    name: str
    title: str
    quantity: str
    unit: str
    threshold: Threshold
    axes: tuple[str, str]
    window: tuple[float, float]
    measure: Callable[[LawCase], LawMeasurement]
    log_x: bool = False

    def __call__(self, case: LawCase) -> ExperimentResult:
        """Perform the experiment on a law, and judge the number.

        A number beyond the threshold is a failure, unless the law declares it in `known_limitations`. A law that
        declares it but keeps the threshold passes. A run that ends early is a failure.
        """
        try:
            measured = self.measure(case)
        except SimulationError as error:
            return ExperimentResult(Verdict.FAIL, LawMeasurement(math.nan, str(error)))
        if math.isnan(measured.number):
            return ExperimentResult(Verdict.NOT_APPLICABLE, measured, measured.sentence)
        if self.threshold.keeps(measured.number):
            return ExperimentResult(Verdict.PASS, measured)
        reason = case.law.known_limitations().get(self.name)
        return ExperimentResult(Verdict.FAIL if reason is None else Verdict.KNOWN_LIMITATION, measured, reason or "")
