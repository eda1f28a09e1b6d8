"""Space-filling samples of a box of parameters."""

import math
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from .._core.arguments import as_whole

# (low, high), (low, high, "log"), or a frozen distribution of scipy.stats.
Span: TypeAlias = tuple[float, float] | tuple[float, float, str] | object


def latin_hypercube(ranges: Mapping[str, Span], count: int, *, seed: int = 0) -> dict[str, np.ndarray]:
    """Random samples, one in each of `count` equally likely strata of every parameter.

    **Arguments:**

    - `ranges`: by the name of a parameter: `(low, high)` for a uniform distribution, `(low, high, "log")` for a uniform
      distribution of the logarithm, or a frozen distribution such as `scipy.stats.norm(2.0, 0.1)`.
    - `count`: number of samples, > 0.
    - `seed`: of the random numbers.

    **Returns:**

    The samples of each parameter, shape `[count]`, in its own unit.

    **Raises:**

    - `ValueError` for a wrong range, with its name, and for a count below one.

    **Example:**

    ```python
    columns = jms.sweeps.latin_hypercube({"m": (1.0, 2.0), "friction.Fc": (0.1, 10.0, "log")}, 200)
    print(columns["m"].shape, (columns["friction.Fc"] < 1.0).mean())
    over = {"sample": columns}  # for `sweep`
    ```

    ```text
    (200,) 0.5
    ```
    """
    check_ranges(ranges)
    count, seed = as_whole(count, name="count"), as_whole(seed, name="seed", least=0)
    from scipy.stats import qmc  # takes half a second to import

    return spread(ranges, qmc.LatinHypercube(len(ranges), rng=np.random.default_rng(seed)).random(count))


def sobol(ranges: Mapping[str, Span], count: int, *, seed: int = 0) -> dict[str, np.ndarray]:
    """Scrambled Sobol' points, which fill several dimensions more evenly than `latin_hypercube`.

    The number of points must be a power of two: other numbers are less balanced than a smaller power of two (Owen 2020,
    arXiv:2008.08051).

    **Arguments:**

    - `ranges`, `seed`: as for `latin_hypercube`.
    - `count`: number of samples, a power of two.

    **Returns:**

    The samples of each parameter, shape `[count]`, in its own unit.

    **Raises:**

    - `ValueError` for a wrong range, with its name, and a count that is not a power of two.

    **Example:**

    ```python
    columns = jms.sweeps.sobol({"m": (1.0, 2.0), "friction.Fc": (0.1, 10.0, "log")}, 256)
    print(columns["m"].shape, (columns["friction.Fc"] < 1.0).mean())
    ```

    ```text
    (256,) 0.5
    ```
    """
    check_ranges(ranges)
    check_power(count)
    seed = as_whole(seed, name="seed", least=0)
    from scipy.stats import qmc  # takes half a second to import

    return spread(ranges, qmc.Sobol(len(ranges), rng=np.random.default_rng(seed)).random(count))


def check_ranges(ranges: Mapping[str, Span]) -> None:
    """Check ranges of parameters."""
    if not isinstance(ranges, Mapping) or not ranges:
        raise ValueError(
            f"ranges must name at least one parameter, as in {{'m': (1.0, 2.0)}}, but {ranges!r} was given."
        )
    for name, span in ranges.items():
        if hasattr(span, "ppf"):
            continue
        log = isinstance(span, tuple | list) and len(span) == 3
        if not isinstance(span, tuple | list) or not (len(span) == 2 or (log and span[2] == "log")):
            raise ValueError(
                f"In ranges the range of {name!r} must be (low, high), (low, high, 'log') or a frozen distribution of"
                f" scipy.stats, but {span!r} was given."
            )
        low, high = span[:2]
        real = all(isinstance(x, int | float | np.number) and math.isfinite(x) for x in (low, high))
        if not real or not low < high:
            raise ValueError(f"The range of {name!r} must be finite with low < high, but is {span!r}.")
        if log and not low > 0:
            raise ValueError(f"The logarithmic range of {name!r} must begin above zero, but is {span!r}.")


def check_power(count: int) -> None:
    """Check a number of Sobol' points, which must be a power of two."""
    count = as_whole(count, name="count")
    if count & (count - 1):
        below = 1 << (int(count).bit_length() - 1)
        raise ValueError(f"count must be a power of two for Sobol' points, but is {count}: use {below} or {2 * below}.")


def spread(ranges: Mapping[str, Span], unit: Float[np.ndarray, "count names"]) -> dict[str, np.ndarray]:
    """Samples of each parameter from those of the unit cube."""
    columns = {name: _scaled(span, x) for (name, span), x in zip(ranges.items(), unit.T, strict=True)}
    for name, column in columns.items():
        if not np.isfinite(column).all():
            raise ValueError(
                f"The distribution of {name!r} has samples that are not finite, as the method uses its end points: use"
                " a bounded one, such as scipy.stats.truncnorm, or a range (low, high)."
            )
    return columns


def _scaled(span: Any, x: np.ndarray) -> np.ndarray:
    if hasattr(span, "ppf"):
        return np.asarray(span.ppf(x), float)
    low, high = span[:2]
    return low * (high / low) ** x if len(span) == 3 else low + (high - low) * x
