"""A confidence interval from a value and its standard error."""

import numpy as np
from scipy import special  # scipy.stats takes most of a second to import

from ._covariance import BLOCKS


def interval(
    value: float, error: float, limits: tuple[float, float], logarithmic: bool, level: float
) -> tuple[float, float]:
    """Interval by Student's t with one degree of freedom less than there are blocks of samples.

    Symmetric in the logarithm of the distance from the lower limit for a parameter that must stay above it, cut at the
    limits for others.

    **Arguments:**

    - `value`, `error`: estimate and its standard error.
    - `limits`: lower and upper limit of the parameter, infinite where it has none.
    - `logarithmic`: whether it must stay above its lower limit.
    - `level`: of confidence, between 0 and 1.

    **Raises:**

    - `ValueError` unless 0 < level < 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1, but it is {level}.")
    low, high = limits
    margin = float(special.stdtrit(BLOCKS - 1, 0.5 + level / 2)) * error
    if logarithmic and value > low:
        with np.errstate(over="ignore"):
            ratio = float(np.exp(margin / (value - low)))
        return low + (value - low) / ratio, min(low + (value - low) * ratio, high)
    return max(value - margin, low), min(value + margin, high)
