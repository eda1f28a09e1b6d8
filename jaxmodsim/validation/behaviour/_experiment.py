"""An experiment: a measurement and the limit that makes a verdict of it."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from ...simulation import SimulationError
from ._laws import LawCase
from ._outcome import Finding, Limit, Outcome, Verdict


@dataclass(frozen=True)
class Experiment:
    """A standard experiment on a friction law.

    - `name`: short, for tables and file names.
    - `title`: what is looked at, for the figure.
    - `quantity`: what the number is.
    - `unit`: of the number.
    - `limit`: what the number must keep to pass.
    - `axes`: labels of the figure's axes, with units.
    - `measure`: does the experiment on one law.
    - `window`: range of the figure's vertical axis, the same for all laws.
    - `log_x`: whether the horizontal axis is logarithmic.
    """

    name: str
    title: str
    quantity: str
    unit: str
    limit: Limit
    axes: tuple[str, str]
    window: tuple[float, float]
    measure: Callable[[LawCase], Finding]
    log_x: bool = False

    def __call__(self, case: LawCase) -> Outcome:
        """Do the experiment on a law and judge what comes out.

        A number beyond the limit is a failure, unless the law says why it must miss it (`known_limitations`). A law
        that says so and keeps the limit passes. A run that ends early is a failure.
        """
        try:
            finding = self.measure(case)
        except SimulationError as error:
            return Outcome(Verdict.FAIL, Finding(math.nan, str(error)))
        if math.isnan(finding.number):
            return Outcome(Verdict.NOT_APPLICABLE, finding, finding.sentence)
        if self.limit.keeps(finding.number):
            return Outcome(Verdict.PASS, finding)
        reason = case.law.known_limitations().get(self.name)
        return Outcome(Verdict.FAIL if reason is None else Verdict.BY_NATURE, finding, reason or "")
