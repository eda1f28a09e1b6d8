"""How long the residual of a fit remembers, and how many independent samples it is worth."""

import numpy as np
from jaxtyping import Float

from ..estimate._search import SearchResult
from ..estimate._search import by_channel as residual_by_channel
from ..uncertainty._estimate import BLOCKS
from ..uncertainty._residual_tests import autocorrelation, positive_lags

# Independent samples that a block of them must be worth for its scores to be independent of those of the next one, and
# the number of blocks where there are too few samples for the usual number.
_WORTH, _FEW = 4, 6


def blocks_that_are_independent(search: SearchResult) -> int:
    """Number of blocks of samples whose scores are: few and long ones where the residual remembers for long."""
    return BLOCKS if effective_samples(search) >= _WORTH * BLOCKS else _FEW


def effective_samples(search: SearchResult) -> float:
    """Number of samples over the correlation of the residual, `n / (1 + 2 sum of autocorrelations)`, of all series."""
    total = 0.0
    for residual, weight in residual_by_channel(search.problem, search.state.residual).values():
        for row, counts in zip(residual, weight, strict=True):
            series = row[counts > 0]
            total += len(series) / correlation_time(series)
    return total


def correlation_time(series: Float[np.ndarray, " samples"]) -> float:
    """`1 + 2 sum of autocorrelations`, >= 1, by Geyer's initial positive sequence."""
    around = series - np.mean(series) if len(series) else series
    if len(series) < 2 or not np.any(around):
        return 1.0
    correlation = autocorrelation(around)
    return max(2 * float(np.sum(correlation[: positive_lags(correlation)])) - 1.0, 1.0)
