"""Information criteria that hold for residuals which are correlated in time."""

import numpy as np
from jaxtyping import Float

from ._solve import Found, by_channel, sample_blocks

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


def penalty(found: Found) -> float:
    """Trace of `H^-1 S` of Takeuchi (1976, Suri-Kagaku 153:12): information H, covariance S of the scores.

    The number of parameters where the residual is white noise of its level, more where it is correlated. S comes from
    the scatter of the scores of blocks of samples, as in the covariance of the estimate; that one has H^-1 on both
    sides, which leaves nothing to be read where parameters are hardly told apart, so the trace is formed in the
    principal directions of H. A direction that the record does not determine counts as one parameter.
    """
    rows = found.problem.samples
    weighted = found.problem.loss.weighted(found.search.residual[:rows], found.search.jacobian[:rows])
    residual, jacobian = (np.asarray(each) for each in weighted)
    size = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian / np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    known = values > _LEAST * values[-1]
    blocks, count = sample_blocks(found.problem)
    scores = np.zeros((count, len(size)))
    np.add.at(scores, np.asarray(blocks), scaled * residual[:, None])
    across = (scores - np.mean(scores, axis=0)) @ vectors[:, known]
    return float(np.sum(across**2 / values[known]) * count / (count - 1) + np.sum(~known))


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
