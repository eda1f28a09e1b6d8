"""The cases of the matrix: for each its task, the quantities measured for every peer, tolerances and goal."""

import numpy as np

from bench import quantities as measured
from bench.tasks import BELT, PULLED, TESTBENCH, Case


def half_decades(first: float, last: float) -> tuple[float, ...]:
    """Tolerances 10^first, 10^(first - 1/2), ... down to 10^last, the same for every solver."""
    return tuple(float(10.0**k) for k in np.arange(first, last - 0.25, -0.5))


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
