"""Information criteria that hold for residuals which are correlated in time."""

import numpy as np
from jaxtyping import Float

from ._result import FitResult
from ._solve import Found, by_channel

# Directions of the parameters known this much worse than the best one are nothing that double precision can weigh.
_LEAST = 1e-10


def deviance(found: Found) -> float:
    """Minus twice the logarithm of the likelihood at the noise levels of the fit, but for a constant.

    `sum over channels of n ln(noise^2) + sum of losses`; with levels estimated by least squares, `n ln(RSS/n) + n`.
    """
    problem = found.problem
    counts = {name: int(np.sum(np.asarray(weight) > 0)) for name, weight in problem.columns.items()}
    levels = sum(count * 2 * float(np.log(float(problem.noise[name]))) for name, count in counts.items())
    return levels + 2 * float(problem.loss.cost(found.search.residual[: problem.samples]))


def penalty(result: FitResult) -> float:
    """Trace of `H^-1 S` of Takeuchi (1976, Suri-Kagaku 153:12): information H, covariance S of the scores.

    The number of parameters where the residual is white noise, more where it is correlated. With the covariance
    `H^-1 S H^-1` of the estimate it is the trace of covariance times information. A direction that the record does not
    determine counts as one parameter.
    """
    covariance, information = result.covariance, result.information
    size = np.sqrt(np.diag(information))
    fine = np.isfinite(np.diag(covariance)) & (size > 0)
    pick, size = np.ix_(fine, fine), size[fine]
    if not fine.any():
        return float(len(fine))
    values, vectors = np.linalg.eigh(information[pick] / np.outer(size, size))
    scatter = np.einsum("ik,ij,jk->k", vectors, covariance[pick] * np.outer(size, size), vectors) * values
    known = values > _LEAST * values[-1]
    return float(np.sum(scatter[known]) + np.sum(~known) + np.sum(~fine))


def effective_samples(found: Found) -> float:
    """Number of samples over the correlation of the residual, `n / (1 + 2 sum of autocorrelations)`, of all series."""
    total = 0.0
    for residual, weight in by_channel(found.problem, found.search.residual).values():
        for row, counts in zip(residual, weight, strict=True):
            series = row[counts > 0]
            total += len(series) / correlation_time(series)
    return total


def correlation_time(series: Float[np.ndarray, " samples"]) -> float:
    """`1 + 2 sum of autocorrelations`, >= 1, by the initial positive sequence.

    Autocorrelations are added in pairs of neighbours until a pair is no longer positive, from where on they are noise
    (Geyer 1992, Statistical Science 7:473).
    """
    count = len(series)
    around = series - np.mean(series) if count else series
    if count < 2 or not np.any(around):
        return 1.0
    spectrum = np.abs(np.fft.rfft(around, 2 * count)) ** 2
    correlation = np.fft.irfft(spectrum)[:count]
    correlation = correlation / correlation[0]
    pairs = correlation[: count - count % 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0)
    return max(2 * float(np.sum(pairs[: ends[0] if ends.size else None])) - 1.0, 1.0)
