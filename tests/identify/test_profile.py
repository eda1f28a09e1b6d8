"""Profiles of the likelihood, and directions that a record does not determine, for models in closed form."""

import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.optimize import brentq

import jaxmodsim as jms
from jaxmodsim._core.parameters import Range
from jaxmodsim.identify import FitResult, profile, warnings_for
from jaxmodsim.identify.data._record import cut, runs_of
from jaxmodsim.identify.estimate._problem import FitProblem, Prior, SquaredLoss
from jaxmodsim.identify.estimate._search import SearchOptions, solve_with_noise
from jaxmodsim.identify.model._engines import ModelOutput
from jaxmodsim.identify.model._parameters import FreeParameters
from jaxmodsim.identify.uncertainty._fit import result_of
from jaxmodsim.plot import profile_figure

ABOVE_ZERO = Range("N", 0.0, strict=True)


# Models of two or three parameters by a formula: they compile in no time, and their likelihood can be scanned.
class Line(eqx.Module):
    def __call__(self, values, start, run):
        del start
        return ModelOutput({"measured": values["a"] + values["b"] * run.t}, {}, None)


class Decay(eqx.Module):
    def __call__(self, values, start, run):
        del start
        return ModelOutput({"measured": values["A"] * jnp.exp(-values["k"] * run.t)}, {}, None)


class Sine(eqx.Module):
    def __call__(self, values, start, run):
        del start
        return ModelOutput({"measured": values["A"] * jnp.sin(values["w"] * run.t)}, {}, None)


class Valley(eqx.Module):
    """The valley of Rosenbrock (1960), the narrower the larger k: b = a^2 is its bottom, a = 1 its end."""

    k: jnp.ndarray

    def __call__(self, values, start, run):
        del start
        a, b = values["a"], values["b"]
        return ModelOutput({"measured": jnp.where(run.t < 0.5, self.k * (b - a**2), 1 - a)}, {}, None)


class Saturation(eqx.Module):
    """1 - exp(-stiffness t): above a certain stiffness all are alike."""

    def __call__(self, values, start, run):
        del start
        return ModelOutput({"measured": values["level"] * (1 - jnp.exp(-values["stiffness"] * run.t))}, {}, None)


class Product(eqx.Module):
    def __call__(self, values, start, run):
        del start
        return ModelOutput(
            {"measured": values["gain"] * values["area"] * jnp.sin(run.t) + values["c"] * run.t}, {}, None
        )


class Sum(eqx.Module):
    def __call__(self, values, start, run):
        del start
        return ModelOutput({"measured": (values["F1"] + values["F2"]) * jnp.sin(run.t) + values["c"] * run.t}, {}, None)


def fitted(engine, t, measured, start, ranges=None, prior=None) -> FitResult:
    record = jms.Record(t, measured)
    free = FreeParameters.of(start, ranges or {}, tuple(start))
    windows = cut((record,), None)
    means = jnp.asarray([(prior or {}).get(name, (0.0, jnp.inf))[0] for name in start])
    weights = jnp.asarray([1 / (prior or {}).get(name, (0.0, jnp.inf))[1] for name in start])
    problem = FitProblem(
        engine, free, (), None, runs_of((record,), windows), {"measured": jnp.asarray(1.0)}, SquaredLoss(),
        Prior(means, weights),
    )  # fmt: skip
    search = solve_with_noise(problem, problem.x0, SearchOptions(rtol=1e-10), frozenset())
    return result_of(search, (record,), windows, dict.fromkeys(start, "N"), engine)


def correlated(rng, n, memory=0.8):
    e = rng.standard_normal(n)
    for i in range(1, n):
        e[i] += memory * e[i - 1]
    return e


def test_the_profile_of_a_linear_model_is_the_interval_of_student():
    rng, t = np.random.default_rng(0), np.linspace(0.0, 3.0, 600)
    # Correlated noise, so that the interval is right only if the correlation is in the ratio, too.
    result = fitted(Line(), t, 2.0 - 0.7 * t + 0.1 * correlated(rng, t.size), {"a": 1.0, "b": 0.0})
    assert result.errors["b"] > 1.5 * np.sqrt(result.estimate.white[1, 1])
    for name in ("a", "b"):
        curve = profile(result, name, points=3)
        # As many degrees of freedom as the docstring says: Student's t of the intervals, squared.
        freedom = int(re.search(r"with 1 and (\d+) degrees", str(type(curve).__doc__))[1])  # pyright: ignore
        assert curve.threshold == pytest.approx(stats.t.ppf(0.975, freedom) ** 2, rel=1e-12)
        np.testing.assert_allclose(curve.interval, result.estimate.intervals()[name], rtol=2e-4)
        np.testing.assert_allclose(
            curve.ratio, ((curve.values - curve.estimate) / curve.error) ** 2, rtol=2e-3, atol=1e-6
        )
        assert not curve.notes
    # What the other parameter does along it, by the covariance: cov(a, b)/var(b) of white noise.
    along = profile(result, "b", points=2)
    slope = np.polyfit(along.values, along.others["a"], 1)[0]
    assert slope == pytest.approx(result.estimate.white[0, 1] / result.estimate.white[1, 1], rel=1e-3)


def test_the_profile_of_a_decay_is_what_a_scan_finds():
    rng, t = np.random.default_rng(12), np.linspace(0.0, 6.0, 200)
    y = np.exp(-0.5 * t) + 0.5 * rng.standard_normal(t.size)
    result = fitted(Decay(), t, y, {"A": 2.0, "k": 1.0}, {"k": Range("1/s", 0.0, strict=True)})
    curve = profile(result, "k", points=4)

    def squares(k):
        shape = np.exp(-k * t)
        return np.sum((y - shape * (shape @ y) / (shape @ shape)) ** 2)

    # Squared standard error of k in units of the sum of squares: the last of the normal equations, by hand.
    k, A = result.values["k"], result.values["A"]
    jacobian = np.column_stack([np.exp(-k * t), -A * t * np.exp(-k * t)])
    assert result.errors["k"] ** 2 > 0.5 * result.estimate.white[1, 1]
    unit = result.errors["k"] ** 2 / np.linalg.inv(jacobian.T @ jacobian)[1, 1]
    level = lambda x: (squares(x) - squares(k)) / unit - curve.threshold  # noqa: E731
    assert curve.interval[0] == pytest.approx(brentq(level, 1e-3, k), rel=2e-3)
    assert curve.interval[1] == pytest.approx(brentq(level, k, 10.0), rel=2e-3)
    # Far from symmetric, which neither the value nor its logarithm would give.
    assert curve.interval[1] - k != pytest.approx(k - curve.interval[0], rel=0.05)


def test_a_parameter_that_is_not_determined_has_an_open_profile():
    rng, t = np.random.default_rng(2), np.linspace(0.05, 2.0, 200)
    y = 1 - np.exp(-200.0 * t) + 0.02 * rng.standard_normal(t.size)
    result = fitted(Saturation(), t, y, {"level": 0.5, "stiffness": 50.0}, {"stiffness": ABOVE_ZERO})
    curve = profile(result, "stiffness", points=3)
    assert curve.interval[1] == np.inf
    assert 10.0 < curve.interval[0] < 200.0
    assert any("stiffness has no upper limit from this record" in note for note in curve.notes)
    assert len(curve.notes) == 1
    assert "inf" in str(curve)
    assert profile(result, "level", points=2).interval[1] < 1.1
    figure = profile_figure(curve)
    assert "stiffness [N]" in [axis.get_xlabel() for axis in figure.axes]


def test_what_was_known_before_counts_in_a_profile_and_limits_end_it():
    t = np.linspace(0.0, 1.0, 50)
    y = 0.05 + t + 0.1 * np.random.default_rng(3).standard_normal(t.size)
    free = fitted(Line(), t, y, {"a": 1.0, "b": 0.5}, {"a": Range("N", 0.0)})
    curve = profile(free, "a", points=2)
    assert curve.interval[0] == 0.0
    assert any("reaches its limit 0" in note for note in curve.notes)
    known = fitted(Line(), t, y, {"a": 1.0, "b": 0.5}, prior={"a": (0.05, 1e-3)})
    low, high = profile(known, "a", points=2).interval
    assert high - low < 0.1 * (curve.interval[1] - curve.interval[0])


def test_a_profile_goes_on_from_a_better_value():
    rng, t = np.random.default_rng(0), np.linspace(0.0, 6.0, 300)
    y = np.sin(3.0 * t) + 0.2 * rng.standard_normal(t.size)
    # The first search ends in a minimum of its own, with a frequency that is none of the record.
    result = fitted(Sine(), t, y, {"A": 0.5, "w": 2.2})
    assert result.rmse > 0.7
    assert abs(result.values["w"]) < 2.5
    curve = profile(result, "w", points=3)
    assert curve.result.rmse == pytest.approx(0.2, rel=0.05)
    assert curve.estimate == curve.result.values["w"]
    assert curve.interval[0] < np.sign(curve.estimate) * 3.0 < curve.interval[1]
    assert np.min(curve.ratio) > -1e-3
    assert "search continued from there in" in curve.notes[-1]
    assert "; continued once from a better value of w" in str(curve.result)
    assert curve.result.diagnostics.evaluations > result.diagnostics.evaluations
    assert not any("do not trust" in warning for warning in warnings_for(curve.result))
    # What is good already is left as it is.
    assert profile(curve.result, "w", points=3).result is curve.result


def test_a_profile_goes_on_within_a_limit():
    t = np.linspace(0.0, 6.0, 300)
    result = fitted(Sine(), t, np.sin(3.0 * t), {"A": 0.5, "w": 2.2})
    still = profile(result, "w", points=3, max_steps=0)
    assert still.result is result
    assert "the limit of 0 iterations (max_steps)" in still.notes[-1]
    with pytest.raises(ValueError, match="max_steps must be an integer >= 0, but -1 was given"):
        profile(result, "w", max_steps=-1)


def test_a_search_goes_on_at_a_hundred_iterations_within_its_limit():
    t, start = np.linspace(0.0, 1.0, 10), {"a": -1.2, "b": 1.0}
    result = fitted(Valley(jnp.asarray(1e3)), t, 0 * t, start)
    assert result.diagnostics.evaluations > 200
    assert result.diagnostics.ending == "converged; continued 2 times after 100 iterations each"
    assert result.values == pytest.approx({"a": 1.0, "b": 1.0})
    assert not any("The search" in warning for warning in warnings_for(result))
    never = fitted(Valley(jnp.asarray(1e6)), t, 0 * t, start)
    ending = "stopped at the limit of 400 iterations (max_steps); continued 3 times after 100 iterations each"
    assert never.diagnostics.ending == ending
    assert any(ending in warning for warning in warnings_for(never))


@pytest.mark.parametrize(
    ("engine", "start", "sentence"),
    [
        (Product(), {"gain": 2.0, "area": 0.5, "c": 1.0}, "only the product gain area; their ratio is not known"),
        (Sum(), {"F1": 2.0, "F2": 2.6, "c": 1.0}, "only the sum F1 + F2; how it is shared"),
    ],
)
def test_a_direction_that_is_not_determined_is_named(engine, start, sentence):
    t = np.linspace(0.0, 6.0, 200)
    y = 3.0 * np.sin(t) + 0.5 * t + 0.01 * np.random.default_rng(4).standard_normal(t.size)
    result = fitted(engine, t, y, start)
    assert any(sentence in warning for warning in warnings_for(result)), warnings_for(result)
    # The pair is explained, so it is not named a second time.
    assert not any("hardly told apart" in warning for warning in warnings_for(result))


def test_nothing_is_said_of_parameters_that_are_determined():
    t = np.linspace(0.0, 3.0, 100)
    y = 1.0 + t + 0.01 * np.random.default_rng(5).standard_normal(t.size)
    assert not warnings_for(fitted(Line(), t, y, {"a": 1.0, "b": 0.5}))
