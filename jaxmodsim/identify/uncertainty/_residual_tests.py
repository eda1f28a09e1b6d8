"""Tests of the residual of a fit: whiteness, normality, correlation in time and with motion and inputs."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import special  # scipy.stats takes most of a second to import

from ..estimate._search import SearchResult
from ..model._observe import RecordedMotion
from ._estimate import BLOCKS, lag_number, whiteness
from ._result import FitResult

# A trend or an input is reported from this share of the variance, below this p-value.
_SHARE, _CHANCE = 0.01, 0.01
# Normal quantile of 95 %, two-sided: the band of the autocorrelation of white noise, times the root of the samples.
_WHITE_BAND = 1.96
# Least variance of a correlation, relative to that of white noise: negative correlations must not make it vanish.
_LEAST_VARIANCE = 0.1
# Least number of samples for each lag, and lags relative to the correlation time.
_SAMPLES_A_LAG, _MEMORIES = 5, 3
# Independent samples that a block must hold for its scores to be independent of those of the next one; the number of
# blocks if there are too few samples for the usual number.
_WORTH, _FEW = 4, 6
# Keeps divisions finite.
_TINY = 1e-300
_MEANING = {
    "q": "something that depends on position may be missing (friction, stiffness, gear ratio)",
    "qd": "friction may depend on velocity in another way, or a signal may be late",
    "t": "something may drift (temperature, wear, a sensor)",
}


@dataclass(frozen=True)
class Trend:
    """Linear regression of the residual on a coordinate, a velocity or time.

    - `over`: `q[0]`, `qd[0]`, `t`, and so on. `slope`: per unit of that.
    - `share`: of the residual's variance, 0 to 1.
    - `p`: probability of a slope as large by chance, with the correlation of the residual in time.
    """

    over: str
    slope: float
    share: float
    p: float


@dataclass(frozen=True)
class Cross:
    """Largest correlation of the residual with an input `lag` [s] earlier, and its p-value over all lags."""

    correlation: float
    lag: float
    p: float


@dataclass(frozen=True)
class ChannelTests:
    """Tests of the residual of one channel of one record; each p is the probability of at least as much by chance.

    - `samples`, `independent`: number of samples, and of independent ones that determine a mean as well.
    - `length`: correlation length [s], the sum of the autocorrelation over positive lags times the interval: 0 for
      white noise and for a negative sum, the time constant for an exponential decay.
    - `whiteness`: p of the test of Ljung and Box over `lags` lags. `autocorrelation`: at lags from 0, at least to
      `lags`, further for a longer correlation.
    - `skewness`, `kurtosis`: the second is the excess over that of a normal distribution. `normality`: p of both
      together by Jarque and Bera, for correlated series (Lobato, Velasco 2004, Econometric Theory 20:671).
    - `trends`: over position, velocity and time. `inputs`: by name.
    """

    record: str
    channel: str
    samples: int
    independent: float
    length: float
    lags: int
    whiteness: float
    autocorrelation: Float[np.ndarray, " lags"]
    skewness: float
    kurtosis: float
    normality: float
    trends: tuple[Trend, ...]
    inputs: dict[str, Cross]

    @property
    def warnings(self) -> tuple[str, ...]:
        """The meaning of the tests, in words."""
        sentences = []
        for trend in self.trends:
            if trend.p < _CHANCE and trend.share > _SHARE:
                meaning = _MEANING[trend.over.split("[")[0]]
                sentences.append(f"{100 * trend.share:.0f} % of its variance goes with {trend.over}: {meaning}.")
        for name, cross in self.inputs.items():
            if cross.p < _CHANCE and cross.correlation**2 > _SHARE:
                sentences.append(
                    f"It is correlated with the input {name} of {cross.lag:.3g} s earlier ({cross.correlation:+.2f}):"
                    " the model leaves some of its effect unexplained."
                )
        if self.whiteness < _CHANCE and self.length == 0:
            lag = 1 + int(np.argmax(np.abs(self.autocorrelation[1:])))
            sentences.append(
                "It is not white, but without positive correlation that makes samples redundant: its autocorrelation is"
                f" {self.autocorrelation[lag]:+.2f} at lag {lag}."
            )
        elif self.whiteness < _CHANCE:
            sentences.append(
                f"It is not white: it is correlated over {self.length:.3g} s, so {self.samples} samples are equivalent"
                f" to {self.independent:.0f} independent ones."
            )
        if self.normality < _CHANCE:
            tails = "heavy" if self.kurtosis > 0 else "light"
            sentences.append(f"It is not normal: tails are {tails} (excess kurtosis {self.kurtosis:+.2f}).")
        return tuple(sentences)


@dataclass(frozen=True)
class ResidualTests:
    """Tests of all residuals of a fit, a `ChannelTests` for each channel of each record."""

    channels: tuple[ChannelTests, ...]

    def __str__(self) -> str:
        """A table, and its meaning in words."""
        lines = []
        for each in self.channels:
            lines += [
                f"{each.record}, {each.channel}: {each.samples} samples, equivalent to {each.independent:.0f}"
                f" independent ones; correlation length {each.length:.3g} s",
                f"  {'white (Ljung-Box, ' + str(each.lags) + ' lags)':34} p = {each.whiteness:.2g}",
                f"  {'normal (Jarque-Bera)':34} p = {each.normality:.2g}   skewness {each.skewness:+.2f},"
                f" excess kurtosis {each.kurtosis:+.2f}",
            ]
            for trend in each.trends:
                lines.append(
                    f"  {'no trend over ' + trend.over:34} p = {trend.p:.2g}  "
                    f" {100 * trend.share:.2g} % of the variance"
                )
            for name, cross in each.inputs.items():
                lines.append(
                    f"  {'no trace of input ' + name:34} p = {cross.p:.2g}   correlation {cross.correlation:+.2f} at"
                    f" {cross.lag:.3g} s"
                )
            lines += [f"  - {warning}" for warning in each.warnings]
        return "\n".join(lines)


def residual_tests(result: FitResult) -> ResidualTests:
    """Test whether the residuals of a fit are noise, and what they are correlated with.

    Positions and velocities are those of the model's output, as far as channels show them.

    **Returns:**

    A `ResidualTests`, which prints as a table.
    """
    provenance, tests = result.provenance, []
    for record, residuals, motion in zip(provenance.records, provenance.residuals, provenance.motions, strict=True):
        for channel, residual in residuals.items():
            tests.append(channel_tests(record.name, channel, residual, record.inputs, motion))
    return ResidualTests(tuple(tests))


def channel_tests(
    record: str,
    channel: str,
    residual: Float[np.ndarray, " samples"],
    inputs: Mapping[str, Float[np.ndarray, " samples"]],
    motion: RecordedMotion,
) -> ChannelTests:
    """Tests of one residual, with samples at regular times."""
    n, interval = len(residual), float(np.median(np.diff(motion.t)))
    e = np.asarray(residual, float) - np.mean(residual)
    lags = lag_number(n)
    correlation = autocorrelation(e)
    memory = remembered(correlation)
    # Negative correlation helps the mean alone, so samples count as n at most.
    tau = max(1 + 2 * float(np.sum(correlation[1:memory])), 1.0)
    skewness, kurtosis, normality = _normality(e, correlation, memory)
    regressors = {f"q[{i}]": x for i, x in motion.q.items()} | {f"qd[{i}]": x for i, x in motion.qd.items()}
    regressors["t"] = motion.t
    trends = tuple(trend_over(name, e, x) for name, x in regressors.items() if np.ptp(x) > 0)
    crosses = {name: _cross(e, u, correlation, memory, lags, interval) for name, u in inputs.items() if np.ptp(u) > 0}
    return ChannelTests(
        record,
        channel,
        n,
        n / tau,
        interval * (tau - 1) / 2,
        lags,
        whiteness(correlation[1 : lags + 1], float(n)),
        correlation[: min(max(lags, 4 * memory), n - 1) + 1],
        skewness,
        kurtosis,
        normality,
        trends,
        crosses,
    )


def autocorrelation(e: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """Autocorrelation at all lags from 0; that of a constant is 1 at lag 0 and 0 at the others."""
    return _covariances(e, e) / max(float(e @ e), _TINY) if e @ e > 0 else np.eye(1, len(e))[0]


def _covariances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """`sum_i a[i + k] b[i]` for k = 0, 1, ..."""
    from scipy import signal  # most of a second to import, and only needed here

    return signal.correlate(a, b, method="fft")[len(a) - 1 :]


def positive_lags(correlation: Float[np.ndarray, " lags"]) -> int:
    """Number of lags, 0 included, up to which sums of two neighbours stay positive (Geyer 1992, Stat. Sci. 7:473).

    Beyond, an estimated autocorrelation is only noise.
    """
    even = len(correlation) - len(correlation) % 2
    ends = np.flatnonzero(correlation[:even].reshape(-1, 2).sum(axis=1) <= 0)
    return 2 * int(ends[0]) if ends.size else even


def remembered(correlation: Float[np.ndarray, " lags"]) -> int:
    """`positive_lags`, but not beyond the first value within the band of white noise."""
    inside = np.abs(correlation[1:]) < _WHITE_BAND / math.sqrt(len(correlation))
    first = 1 + int(np.argmax(inside)) if np.any(inside) else len(correlation)
    return max(min(positive_lags(correlation), first), 1)


def _normality(e: np.ndarray, correlation: np.ndarray, memory: int) -> tuple[float, float, float]:
    variance = float(np.mean(e**2))
    if variance == 0:
        return 0.0, 0.0, 1.0
    skewness, kurtosis = float(np.mean(e**3)) / variance**1.5, float(np.mean(e**4)) / variance**2 - 3
    cubes, fourths = (1 + 2 * float(np.sum(correlation[1:memory] ** k)) for k in (3, 4))
    statistic = len(e) * (skewness**2 / (6 * max(cubes, 1.0)) + kurtosis**2 / (24 * fourths))
    return skewness, kurtosis, float(special.chdtrc(2, statistic))


def _variance_of_correlation(correlation: np.ndarray, memory: int, other: np.ndarray) -> float:
    """Variance of the correlation of two independent series: `sum of the product of their autocorrelations / n`.

    Bartlett 1935, J. R. Stat. Soc. 98:536. It is 1/n if one of them is white.
    """
    of_other = autocorrelation(other - np.mean(other))[:memory]
    whole = 1 + 2 * float(np.sum(correlation[1:memory] * of_other[1:]))
    return max(whole, _LEAST_VARIANCE) / len(other)


def trend_over(name: str, e: Float[np.ndarray, " samples"], x: Float[np.ndarray, " samples"]) -> Trend:
    """Linear regression, with the standard error of the slope from its own residual."""
    x = x - np.mean(x)
    slope = float(e @ x / (x @ x))
    left = e - slope * x
    whole = float(e @ e)
    share = 1 - float(left @ left) / whole if whole > 0 else 0.0
    correlation = autocorrelation(left)
    variance = _variance_of_correlation(correlation, remembered(correlation), x)
    # The correlation under the null hypothesis, relative to the residual of the regression.
    score = abs(slope) * math.sqrt(float(x @ x)) / max(math.sqrt(float(left @ left)), _TINY)
    return Trend(name, slope, share, float(2 * special.ndtr(-score / math.sqrt(variance))) if whole > 0 else 1.0)


def _cross(e: np.ndarray, u: np.ndarray, correlation: np.ndarray, memory: int, lags: int, interval: float) -> Cross:
    """Largest correlation with the input over `lags + 1` lags, up to the correlation time or `lags`."""
    u = u - np.mean(u)
    size = math.sqrt(float(e @ e) * float(u @ u))
    if size == 0:
        return Cross(0.0, 0.0, 1.0)
    furthest = min(max(lags, _MEMORIES * memory), len(e) // _SAMPLES_A_LAG)
    looked_at = np.unique(np.linspace(0, furthest, lags + 1).astype(int))
    values = _covariances(e, u)[looked_at] / size
    best = int(np.argmax(np.abs(values)))
    deviation = math.sqrt(_variance_of_correlation(correlation, memory, u))
    p = float(2 * special.ndtr(-abs(values[best]) / deviation))
    # Sidak correction, conservative since the lags are dependent.
    chance = -math.expm1(len(looked_at) * math.log1p(-min(p, 1 - 1e-16)))
    return Cross(float(values[best]), interval * float(looked_at[best]), chance)


def independent_blocks(search: SearchResult) -> int:
    """Number of blocks of samples with independent scores: few and long ones if the residual's correlation is long."""
    return BLOCKS if effective_samples(search) >= _WORTH * BLOCKS else _FEW


def effective_samples(search: SearchResult) -> float:
    """Number of independent samples, `n / (1 + 2 sum of autocorrelations)`, of all series of the residual."""
    total = 0.0
    for residual, weight in search.residuals.values():
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
