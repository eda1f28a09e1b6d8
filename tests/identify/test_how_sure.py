"""How sure a fit is: profiles, combinations and causes in words, tests of residuals, other records, files, figures."""

import json
import re
import zipfile
from dataclasses import fields, replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.optimize import brentq

import jaxmodsim as jms
from jaxmodsim._core.parameters import Range
from jaxmodsim.identify import FitResult, evaluate_on, law_force, profile, replay, residual_tests, warnings_for
from jaxmodsim.identify.data._record import cut, runs_of
from jaxmodsim.identify.estimate._problem import FitProblem, Prior, SquaredLoss
from jaxmodsim.identify.estimate._search import SearchOptions, solve_with_noise
from jaxmodsim.identify.model._engines import ModelOutput
from jaxmodsim.identify.model._observe import RecordedMotion, Slip
from jaxmodsim.identify.model._parameters import FreeParameters
from jaxmodsim.identify.uncertainty._estimate import (
    FitDiagnostics,
    FitProvenance,
    IdentifiabilityIssue,
    ParameterEstimate,
)
from jaxmodsim.identify.uncertainty._fit import result_of
from jaxmodsim.identify.uncertainty._identifiability import RULES, Element, identifiability_issues, slow
from jaxmodsim.identify.uncertainty._residual_tests import channel_tests, trend_over
from jaxmodsim.plot import profile_figure, result_figure
from jaxmodsim.scene import scene_numbers

from ..helpers.sprung import lagrangian, sprung

DT = 4e-3
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
    assert not any("do not trust" in remark for remark in warnings_for(curve.result))
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
    assert not any("The search" in remark for remark in warnings_for(result))
    never = fitted(Valley(jnp.asarray(1e6)), t, 0 * t, start)
    ending = "stopped at the limit of 400 iterations (max_steps); continued 3 times after 100 iterations each"
    assert never.diagnostics.ending == ending
    assert any(ending in remark for remark in warnings_for(never))


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
    assert any(sentence in remark for remark in warnings_for(result)), warnings_for(result)
    # The pair is explained, so it is not named a second time.
    assert not any("hardly told apart" in remark for remark in warnings_for(result))


def test_nothing_is_said_of_parameters_that_are_determined():
    t = np.linspace(0.0, 3.0, 100)
    y = 1.0 + t + 0.01 * np.random.default_rng(5).standard_normal(t.size)
    assert not warnings_for(fitted(Line(), t, y, {"a": 1.0, "b": 0.5}))


# Motions that show what a rule looks for, and nearly the same that do not.
T = np.linspace(0.0, 4.0, 2001)
LUGRE = {"sigma0": 1e4, "sigma1": 10.0, "sigma2": 1.0, "Fc": 1.0, "Fs": 1.5, "vs": 0.01}
SINE, SLOW_SINE = np.sin(2 * np.pi * T), np.sin(2 * np.pi * 0.5 * T)


def element(law, x, numbers=None, alike=None):
    slip = Slip(T, x, np.gradient(x, T))
    own = numbers or {k: float(v) for k, v in LUGRE.items()}
    return Element("", law, (slip,), {k: np.asarray(v) for k, v in own.items()}, tuple(own), alike or {})


def lugre(x, **alike):
    return element(jms.LuGre(**LUGRE), x, None, alike)


STRIBECK = {"Fc": 1.0, "Fs": 1.5, "vs": 0.01, "Fv": 0.5}
SIDES = {"forward.Fc": 1.0, "backward.Fc": 1.2}
MAXWELL = {"k": np.array([1e4, 1e4]), "Fc": np.array([0.1, 1.0])}


def stribeck(x):
    return element(jms.Regularized(jms.Stribeck(**STRIBECK), 1e-4), x, STRIBECK)


def sided(x):
    return element(jms.asymmetric(jms.Dahl(1e4, 1.0), Fc=1.2), x, SIDES)


def maxwell(x):
    found = element(jms.MaxwellSlip(**MAXWELL), x, MAXWELL)
    return found._replace(free=("Fc[0]", "Fc[1]"))


CASES = {
    "presliding": (lugre(2e-5 * SINE), lugre(1e-2 * SINE), ("sigma2", "Fc", "Fs", "vs"), "never leaves presliding"),
    "elements": (maxwell(2e-5 * SINE), maxwell(4e-4 * SINE), ("Fc[1]",), "never slip"),
    "never_sticks": (lugre(0.1 * T), lugre(0.1 * SINE), ("sigma0", "sigma1", "Fs", "vs"), "never sticks"),
    "one_direction": (lugre(0.1 * T, Fc=("offset",)), lugre(0.1 * SINE), ("Fc", "offset"), "one direction only"),
    "sides": (sided(0.1 * T), sided(0.1 * SINE), ("backward.Fc",), "nothing is seen of backward.Fc"),
    "stribeck_not_passed": (
        stribeck(1e-3 * SINE), stribeck(0.1 * SINE), ("Fc", "Fs", "vs", "Fv"), "speed never exceeds"
    ),
    "stribeck_unseen": (stribeck(0.1 * T), stribeck(0.1 * SLOW_SINE), ("Fs", "vs"), "Only 0 samples"),
    "one_speed": (stribeck(0.1 * T), stribeck(0.1 * SINE), ("Fc", "Fv"), "nearly one speed"),
}  # fmt: skip


@pytest.mark.quick
@pytest.mark.parametrize("case", CASES)
def test_causes_are_seen_in_the_motion(case):
    triggers, fine, about, sentence = CASES[case]
    issues, others = ([issue for rule in RULES if (issue := rule(x))] for x in (triggers, fine))
    assert [set(issue.about) for issue in issues if sentence in issue.sentence] == [set(about)]
    assert not any(sentence in issue.sentence for issue in others)


def test_slow_motion_does_not_show_the_mass():
    scene = sprung()
    numbers = {name: np.asarray(x) for name, x in scene_numbers(scene).items()}

    def motion(size):
        return (RecordedMotion(T, {0: size * SINE}, {0: size * 2 * np.pi * np.cos(2 * np.pi * T)}),)

    cause = slow(scene, motion(1e-4), numbers, ("m", "k"))
    assert cause is not None
    assert cause.about == ("m",)  # not the stiffness, which is no part of the mass
    assert "Inertia hardly shows" in cause.sentence
    assert slow(scene, motion(0.1), numbers, ("m", "k")) is None
    # Nothing is said of a parameter that the figures call certain.
    assert not identifiability_issues(scene, motion(1e-4), 1, numbers, ("m", "k"), {"k": ()})
    assert identifiability_issues(scene, motion(1e-4), 1, numbers, ("m", "k"), {"m": ()}) == (cause,)


@pytest.fixture(scope="module")
def presliding() -> FitResult:
    t = np.arange(0.0, 2.0, 5e-3)
    x = 3e-5 * np.sin(2 * np.pi * t)
    truth = jms.LuGre(**LUGRE)
    force = np.asarray(law_force(truth, jnp.asarray(t), jnp.asarray(x)))
    noise = 2e-2 * np.random.default_rng(6).standard_normal(t.size)
    start = replace(truth, Fc=0.9, Fs=1.7, vs=0.02)
    return jms.fit_law(start, jms.Record(t, force + noise, {"x": x}), ("sigma0", "Fc", "Fs", "vs"), max_steps=30)


def test_a_record_in_presliding_says_so_once(presliding):
    about = [remark for remark in warnings_for(presliding) if "presliding" in remark]
    assert len(about) == 1, warnings_for(presliding)
    assert "Fc, Fs and vs cannot be told apart" in about[0]
    assert not any("Fs and" in remark and "hardly told apart" in remark for remark in warnings_for(presliding))
    assert presliding.diagnostics.issues[0].about == ("Fc", "Fs", "vs")


@pytest.fixture(scope="module")
def clean():
    t = np.arange(0.0, 5.0, DT)
    u = 4.0 * np.sin(2 * np.pi * 0.5 * t) + 2.0 * np.sin(2 * np.pi * 1.3 * t)
    start = jnp.asarray([0.05]), jnp.asarray([0.1])
    q = replay(sprung(), jnp.asarray(t), {"u": jnp.asarray(u)}, *start, 1, lambda q, qd: q[0])
    return t, u, np.asarray(q)


@pytest.fixture(scope="module")
def parts(clean) -> tuple[jms.Record, jms.Record]:
    t, u, q = clean
    noise = 1e-4 * np.random.default_rng(7).standard_normal(t.size)
    whole = jms.Record(t, {"x": q + noise}, {"u": u})
    return whole.samples(0, 750, "first part"), whole.samples(750, len(t), "second part")


TRACED = []


def position(q, qd):
    TRACED.append(qd)
    return q[0]


@pytest.fixture(scope="module")
def result(parts) -> FitResult:
    free = ("m", "friction.Fc", "viscous.Fv")
    start, limits = sprung(1.5, 1.0, 1.0), {"m": (0.0, None)}
    return jms.fit(start, parts[0], free, observe=position, q0=[0.05], qd0=[0.1], limits=limits)


@pytest.fixture(scope="module")
def scored(result, parts):
    return evaluate_on(result, parts[1])


def test_a_profile_of_a_simulated_record_compiles_nothing(result):
    before = len(TRACED)
    curve = profile(result, "friction.Fc", points=2)
    assert before > 0
    assert len(TRACED) == before  # nothing was traced again
    np.testing.assert_allclose(curve.interval, result.estimate.intervals()["friction.Fc"], rtol=1e-4)
    assert set(curve.others) == {"m", "viscous.Fv"}


@pytest.mark.parametrize(
    ("name", "options", "text"),
    [
        ("q0[0]", {}, "no profile; the parameters that have one are: m, friction.Fc"),
        ("m", {"level": 1.0}, "level must lie between"),
        ("m", {"points": 1}, "points must be an integer >= 2"),
    ],
)
def test_wrong_profiles_are_refused(result, name, options, text):
    with pytest.raises(ValueError, match=text):
        profile(result, name, **options)


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
    assert not found[0].remarks


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
    assert any("not white, but without positive correlation" in remark for remark in each.remarks)
    assert not any("correlated over" in remark for remark in each.remarks)


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
    assert any("goes with q[0]: something that depends on position" in remark for remark in position.remarks)
    assert not any("qd[0]" in remark for remark in position.remarks)
    drift = judged(noise + 0.1 * T, {}, motion)
    assert any("may drift" in remark for remark in drift.remarks)
    late = np.roll(rng.standard_normal(T.size), 0)
    follows = judged(noise + 0.05 * np.roll(late, 7), {"u": late}, motion)
    assert follows.inputs["u"].lag == pytest.approx(7 * (T[1] - T[0]))
    assert any("correlated with the input u" in remark for remark in follows.remarks)
    heavy = judged(rng.standard_t(4, T.size), {}, motion)
    assert any("tails are heavy" in remark for remark in heavy.remarks)
    assert trend_over("t", np.zeros(T.size), T).p == 1.0


def test_residuals_of_a_fit_are_tested_against_its_motion(result):
    (each,) = residual_tests(result).channels
    assert [trend.over for trend in each.trends] == ["q[0]", "qd[0]", "t"]
    assert set(each.inputs) == {"u"}
    assert each.whiteness > 1e-3
    text = str(residual_tests(result))
    assert "first part, x: 750 samples" in text
    assert "no trend over qd[0]" in text


def test_a_record_that_was_not_fitted_is_scored(scored, parts, clean):
    t, _, q = clean
    fitted = scored.start_fitted
    assert fitted.ending == "converged"
    assert fitted.rmse["x"] == pytest.approx(1e-4, rel=0.15)
    assert scored.rmse["x"] == pytest.approx(1e-4, rel=0.3)
    assert scored.fit["x"] == pytest.approx(100 * (1 - scored.rmse["x"] / np.std(parts[1].channels["x"])))
    # The initial state comes out as it was, the velocity of the true motion by difference.
    for each in (fitted, scored):
        assert each.q0 == pytest.approx(q[750], abs=1e-4)
        assert each.qd0 == pytest.approx(np.gradient(q, t)[750], abs=1e-2)
    assert set(fitted.away) == {"q0[0]", "qd0[0]"}
    assert max(abs(x) for x in fitted.away.values()) < 3
    assert scored.remarks == ()
    np.testing.assert_allclose(scored.residuals["x"], scored.outputs["x"] - parts[1].channels["x"])
    assert "fit 99.9" in str(scored)


def test_a_start_that_takes_up_an_error_of_the_model_is_a_remark(result, parts):
    other = jms.Record(parts[1].t, parts[1].channels, {"u": 0.8 * parts[1].inputs["u"]}, "weak")
    found = evaluate_on(result, other)
    assert found.start_fitted is not None
    assert found.start_fitted.rmse["x"] < found.rmse["x"]
    assert any("standard errors from what its first samples show" in each for each in found.remarks)
    nothing = jms.Record(parts[1].t, parts[1].channels, {"u": np.full(len(parts[1].t), 1e200)}, "overflow")
    with pytest.raises(RuntimeError, match="not finite"):
        evaluate_on(result, nothing)


def test_a_start_that_is_given_is_not_moved(result, parts):
    given = evaluate_on(result, parts[0], q0=[0.05], qd0=[0.1])
    np.testing.assert_allclose(given.outputs["x"], result.provenance.outputs[0]["x"], rtol=0, atol=1e-12)
    from_rest = evaluate_on(result, parts[0], q0=[0.05], qd0=[0.0])
    assert from_rest.rmse["x"] > 10 * given.rmse["x"]  # it was not at rest
    with pytest.raises(ValueError, match="give q0 and qd0, or neither"):
        evaluate_on(result, parts[0], q0=[0.05])
    with pytest.raises(ValueError, match=r"q0 must be finite and of the shape \(1,\)"):
        evaluate_on(result, parts[0], q0=[0.0, 0.0], qd0=[0.0])
    other = jms.Record(parts[0].t, {"y": parts[0].channels["x"]}, parts[0].inputs)
    with pytest.raises(ValueError, match="has the channel 'y', but the fit observed: x"):
        evaluate_on(result, other)
    with pytest.raises(ValueError, match="has the inputs none"):
        evaluate_on(result, jms.Record(parts[0].t, parts[0].channels))


def test_a_law_is_scored_on_another_motion(presliding):
    t = np.arange(0.0, 1.0, 5e-3)
    x = 2e-5 * np.sin(2 * np.pi * 2 * t)
    force = np.asarray(law_force(jms.LuGre(**LUGRE), jnp.asarray(t), jnp.asarray(x)))
    other = evaluate_on(presliding, jms.Record(t, force, {"x": x}, "other"))
    assert other.q0 is None
    assert other.rmse["measured"] < 0.02
    assert other.fit["measured"] > 85


def same(a, b):
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.tobytes() == b.tobytes()
    if isinstance(a, jms.Record):
        return same(vars(a), vars(b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, tuple) and not isinstance(a, IdentifiabilityIssue):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return type(a) is type(b) and (a == b or (a != a and b != b))


@pytest.fixture(scope="module")
def odd(result) -> FitResult:
    """With what JSON does not know, and numbers whose decimals are long."""
    covariance = result.estimate.covariance.copy()
    covariance[0, 0], covariance[1, 1] = np.inf, np.nan
    issues = (IdentifiabilityIssue("Too slow.", ("m",)),)
    return replace(
        result,
        estimate=replace(result.estimate, covariance=covariance),
        diagnostics=replace(result.diagnostics, step_error=0.1 + 0.2, issues=issues),
    )


PARTS = {"estimate": ParameterEstimate, "diagnostics": FitDiagnostics, "provenance": FitProvenance}


def test_a_file_gives_back_every_bit(odd, tmp_path):
    path = tmp_path / "axis.fit"
    odd.save(path)
    assert [x.name for x in tmp_path.iterdir()] == ["axis.fit"]
    again = FitResult.load(path)
    for part, kind in PARTS.items():
        for field in fields(kind):
            if field.name != "model":
                kept, read = (getattr(getattr(each, part), field.name) for each in (odd, again))
                assert same(kept, read), field.name
    assert again.search is None
    assert again.model is None
    assert warnings_for(again) == warnings_for(odd)
    assert str(residual_tests(again)) == str(residual_tests(odd))
    result_figure(again)
    with pytest.raises(ValueError, match="loaded result"):
        profile(again, "m")
    with pytest.raises(ValueError, match="loaded result"):
        evaluate_on(again, odd.record)
    again.save(path)  # what was loaded can be kept again
    assert same(FitResult.load(path).provenance.numbers, odd.provenance.numbers)


def test_a_file_puts_its_numbers_into_a_model(result, presliding, tmp_path):
    path = tmp_path / "axis.fit"
    result.save(path)
    scene = FitResult.load(path, sprung(9.0, 9.0, 9.0)).model
    assert same(
        {k: np.asarray(x) for k, x in scene_numbers(scene).items()},  # pyright: ignore[reportArgumentType]
        {k: np.asarray(x) for k, x in scene_numbers(result.model).items()},  # pyright: ignore[reportArgumentType]
    )
    other = jms.Scene(lagrangian, params={"m": 1.0, "k": 1.0}, effects=(jms.Friction(jms.Coulomb(1.0)),))
    with pytest.raises(ValueError, match=r"not the fitted one: it lacks .*viscous.Fv"):
        FitResult.load(path, other)
    presliding.save(path)
    law = FitResult.load(path, jms.LuGre(**{**LUGRE, "sigma0": 1.0})).model
    assert isinstance(law, jms.LuGre)
    assert float(law.sigma0) == presliding.values["sigma0"]


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (lambda path: path.write_text("m = 2.0"), "not written by FitResult.save, or it is damaged"),
        (lambda path: path.write_bytes(path.read_bytes()[:2000]), "not written by FitResult.save"),
        (lambda path: flip(path), "damaged"),
        (lambda path: rewrite(path, {"kind": "other"}), "is no result of a fit"),
        (lambda path: rewrite(path, {"format": 99}), "has the format 99, written by jaxmodsim"),
        (lambda path: rewrite(path, {"fields": {}}), "lacks bounds, coordinates"),
        (lambda path: rewrite(path, {}, "other.json"), r"holds no result\.json"),
    ],
)
def test_files_that_are_something_else_are_refused(result, tmp_path, spoil, text):
    path = tmp_path / "axis.fit"
    result.save(path)
    spoil(path)
    with pytest.raises(ValueError, match=text):
        FitResult.load(path)


def flip(path: Path) -> None:
    """Change one bit in the middle of the samples."""
    body = bytearray(path.read_bytes())
    body[len(body) // 2] ^= 1
    path.write_bytes(bytes(body))


def rewrite(path: Path, change, name: str = "result.json") -> None:
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    parts[name] = json.dumps({**json.loads(parts.pop("result.json")), **change}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, part in parts.items():
            archive.writestr(name, part)


def test_a_save_that_fails_leaves_the_old_file(result, tmp_path):
    path = tmp_path / "axis.fit"
    result.save(path)
    before = path.read_bytes()
    with pytest.raises(TypeError, match="units"):
        replace(result, estimate=replace(result.estimate, units={"m": object()})).save(path)
    assert path.read_bytes() == before
    assert [x.name for x in tmp_path.iterdir()] == ["axis.fit"]


def test_the_figure_of_a_result_has_axes_with_units(result, presliding):
    figure = result_figure(result, units={"x": "m"})
    labels = {axis.get_ylabel() for axis in figure.axes} | {axis.get_xlabel() for axis in figure.axes}
    assert {"x [m]", "residual [mm]", "time [s]", "lag [s]", "autocorrelation"} <= labels
    assert "half-width of the 95 % interval [% of the value]" in labels
    figure.canvas.draw()  # layout and texts, warnings being errors
    result_figure(presliding).canvas.draw()  # with parameters that are not determined
    with pytest.raises(ValueError, match="record must be 0 to 0"):
        result_figure(result, record=1)
    with pytest.raises(ValueError, match="units names y"):
        result_figure(result, units={"y": "m"})
