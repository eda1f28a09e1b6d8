"""Tests of residuals: whiteness, correlation in time, trends and inputs."""

import numpy as np
import pytest

from jaxmodsim.identify.model._observe import RecordedMotion
from jaxmodsim.identify.uncertainty._residual_tests import channel_tests, trend_over

from .test_how_sure import SINE, SLOW_SINE, T
from .test_profile import correlated


def judged(residual, inputs=None, motion=None, t=T):
    return channel_tests("record", "x", residual, inputs or {}, motion or RecordedMotion(t, {}, {}))


def test_white_residuals_are_called_white():
    # 200 series: p-values of a right test are uniform, so 5 % of them lie below 0.05, give or take 1.5 %.
    rng = np.random.default_rng(8)
    found = [judged(rng.standard_normal(T.size), {"u": SINE}) for _ in range(200)]
    for p in (lambda x: x.whiteness, lambda x: x.normality, lambda x: x.trends[0].p):
        assert np.mean([p(each) < 0.05 for each in found]) == pytest.approx(0.05, abs=0.046)
    assert np.mean([each.inputs["u"].p < 0.05 for each in found]) < 0.1
    assert np.median([each.independent for each in found]) == pytest.approx(T.size, rel=0.02)
    assert not found[0].warnings


def test_correlated_residuals_are_measured_and_do_not_fool_the_other_tests():
    rng = np.random.default_rng(9)
    found = [judged(correlated(rng, T.size, 0.9), {"u": SINE}) for _ in range(100)]
    interval = T[1] - T[0]
    assert all(each.whiteness < 1e-6 for each in found)
    # The sum of 0.9^k is 9, and the mean of such a series knows as much as a nineteenth of the samples.
    assert np.mean([each.length for each in found]) == pytest.approx(9 * interval, rel=0.15)
    assert np.mean([T.size / each.independent for each in found]) == pytest.approx(19, rel=0.15)
    # Twice what would be right is allowed; without the correlation it would be more than half of them.
    for p in (lambda x: x.trends[0].p, lambda x: x.normality, lambda x: x.inputs["u"].p):
        assert np.mean([p(each) < 0.05 for each in found]) < 0.13


ALTERNATING = (-1.0) ** np.arange(T.size)


@pytest.mark.parametrize(
    "residual",
    [
        ALTERNATING,
        ALTERNATING * np.exp(-T),
        correlated(np.random.default_rng(9), T.size, -0.3),
        correlated(np.random.default_rng(9), T.size, -0.6),
        correlated(np.random.default_rng(9), T.size, -0.99),
        np.diff(np.random.default_rng(9).standard_normal(T.size + 1)),
    ],
    ids=["alternating", "fading", "weak", "medium", "strong", "differences"],
)
def test_residuals_that_alternate_have_no_negative_memory(residual):
    """The sum of their autocorrelation over positive lags is negative, down to -1."""
    each = judged(residual, {"u": SINE})
    assert each.length == 0.0
    assert each.independent == T.size
    assert each.whiteness < 1e-6
    assert 0 <= each.normality <= 1
    assert any("not white, but without positive correlation" in warning for warning in each.warnings)
    assert not any("correlated over" in warning for warning in each.warnings)


@pytest.mark.parametrize("n", [2, 3, 5, 20])
@pytest.mark.parametrize("kind", ["zero", "constant", "one", "line"])
def test_residuals_of_few_samples_and_of_no_scatter(n, kind):
    t = np.linspace(0.0, 1.0, n)
    residual = {"zero": 0 * t, "constant": 0 * t + 3.0, "one": np.eye(1, n)[0], "line": t}[kind]
    each = judged(residual, {"u": t}, t=t)
    assert each.length >= 0.0
    assert 0 < each.independent <= n
    assert all(0 <= p <= 1 for p in (each.whiteness, each.normality, each.trends[0].p, each.inputs["u"].p))


def test_a_residual_with_a_cause_names_it():
    rng, noise = np.random.default_rng(10), 0.1 * np.random.default_rng(11).standard_normal(T.size)
    motion = RecordedMotion(T, {0: SLOW_SINE}, {0: np.cos(np.pi * T)})
    position = judged(noise + 0.1 * SLOW_SINE, {"u": SINE}, motion)
    share = {trend.over: trend.share for trend in position.trends}
    assert share["q[0]"] == pytest.approx(1 / 3, abs=0.05)  # variance 0.005 of 0.015
    assert any("goes with q[0]: something that depends on position" in warning for warning in position.warnings)
    assert not any("qd[0]" in warning for warning in position.warnings)
    drift = judged(noise + 0.1 * T, {}, motion)
    assert any("may drift" in warning for warning in drift.warnings)
    late = np.roll(rng.standard_normal(T.size), 0)
    follows = judged(noise + 0.05 * np.roll(late, 7), {"u": late}, motion)
    assert follows.inputs["u"].lag == pytest.approx(7 * (T[1] - T[0]))
    assert any("correlated with the input u" in warning for warning in follows.warnings)
    heavy = judged(rng.standard_t(4, T.size), {}, motion)
    assert any("tails are heavy" in warning for warning in heavy.warnings)
    assert trend_over("t", np.zeros(T.size), T).p == 1.0
