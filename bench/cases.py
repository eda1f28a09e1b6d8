"""The matrix: each case with its task, the quantities that are measured of every peer, tolerances and goal."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench import quantities as measured
from bench.record import Result
from bench.tasks import BELT, PULLED, TESTBENCH, Belt, Box


def half_decades(first: float, last: float) -> tuple[float, ...]:
    """Tolerances 10^first, 10^(first - 1/2), ... down to 10^last: alike for every solver."""
    return tuple(float(10.0**k) for k in np.arange(first, last - 0.25, -0.5))


@dataclass(frozen=True)
class Case:
    """A column of the matrix.

    - `task`: scene, closed form or reference.
    - `quantities`: functions of `bench.quantities`.
    - `ladder`: tolerances; each peer is measured at the loosest one whose error `measure` is at most `goal`, at
      "chosen".
    - `goal`: None for the error of `jaxmodsim` at 1e-6, but for 5 %.
    - `small`: peers of a small run; `packages`: those whose versions matter; `settings`: numbers that captions name.
    """

    name: str
    task: Box | Belt
    quantities: tuple[Callable[[Any], None], ...]
    ladder: tuple[float, ...]
    measure: str
    goal: float | None = 1e-6
    small: tuple[str, ...] = ("jaxmodsim", "diffrax Heun", "CVODES (CasADi)", "CVODE (scikit-sundae)")
    packages: tuple[str, ...] = ("diffrax", "casadi", "scikit-sundae", "scipy", "numpy")
    settings: dict[str, Any] = field(default_factory=dict)

    def result(self) -> Result:
        """An empty result."""
        return Result(self.name, self.packages, {"atol_over_rtol": self.task.atol, "t1": self.task.t1} | self.settings)


_ONE_AND_MANY = (measured.errors, measured.run_time, measured.batch, measured.derivatives)
CASES = {
    case.name: case
    for case in (
        Case("lugre_testbench", TESTBENCH, _ONE_AND_MANY, half_decades(-3, -10), "error of v"),
        Case("lugre_testbench_untuned", TESTBENCH, _ONE_AND_MANY, half_decades(-3, -10), "error of v"),
        Case(
            "lugre_work_precision", TESTBENCH, (measured.errors, measured.time_at_each_tolerance),
            half_decades(-3, -10), "error of v",
        ),
        Case(
            "pulled_spring", PULLED, (measured.errors, measured.run_time, measured.our_time_at_each, measured.rk4),
            half_decades(-3, -12), "error of v and F",
        ),
        Case(
            "stick_slip", BELT,
            (*_ONE_AND_MANY, measured.compilation),
            tuple(10.0**-k for k in range(4, 10)), "error of x", None,
            ("jaxmodsim", "legs in `lax.scan`", "scipy RK45"),
            ("diffrax", "optimistix", "scipy", "numpy"),
            {"events": 122},
        ),
    )
}  # fmt: skip
