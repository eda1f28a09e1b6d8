"""An experiment: a measurement and the threshold that makes a verdict of it."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from ...simulation import SimulationError
from ._laws import LawCase
from ._result import ExperimentResult, LawMeasurement, Threshold, Verdict


@dataclass(frozen=True)
class Experiment:
    """A standard experiment on a friction law.

    - `name`: short, for tables and file names.
    - `title`: what is looked at, for the figure.
    - `quantity`: what the number is.
    - `unit`: of the number.
    - `threshold`: what the number must keep to pass.
    - `axes`: labels of the figure's axes, with units.
    - `measure`: does the experiment on one law.
    - `window`: range of the figure's vertical axis, the same for all laws.
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
        """Do the experiment on a law and judge what comes out.

        A number beyond the threshold is a failure, unless the law says why it must miss it (`known_limitations`). A law
        that says so and keeps the threshold passes. A run that ends early is a failure.
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
