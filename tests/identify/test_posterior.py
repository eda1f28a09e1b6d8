"""The posterior of a fit: its density against closed forms, its samples against what they should be."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxmodsim as jms
from jaxmodsim._core.parameters import Range
from jaxmodsim.identify import Huber, Posterior, log_density, sample_posterior
from jaxmodsim.identify.data._record import cut, runs_of
from jaxmodsim.identify.estimate._problem import AbstractLoss, FitProblem, Prior, SquaredLoss
from jaxmodsim.identify.estimate._search import SearchOptions, solve_with_noise
from jaxmodsim.identify.model._engines import ModelOutput
from jaxmodsim.identify.model._parameters import FreeParameters
from jaxmodsim.identify.uncertainty._fit import result_of
from jaxmodsim.identify.uncertainty._posterior import _SoftBox
from jaxmodsim.identify.uncertainty._result import FitResult
from jaxmodsim.plot import posterior_figure

from ..helpers.sprung import DRIVE, sprung_mass

T = np.linspace(0.0, 3.0, 120)


class Decay(eqx.Module):
    def __call__(self, values, start, run):
        del start
        return ModelOutput({"measured": values["A"] * jnp.exp(-values["k"] * run.t)}, {}, None)


def fitted(measured, ranges=None, prior=None, loss: AbstractLoss | None = None, start=(1.0, 1.0)) -> FitResult:
    record = jms.Record(T, measured)
    values: dict[str, float] = dict(zip(("A", "k"), start, strict=True))
    free = FreeParameters.of(values, ranges or {}, tuple(values))
    windows = cut((record,), None)
    known = prior or {}
    means = jnp.asarray([known.get(name, (0.0, jnp.inf))[0] for name in values])
    weights = jnp.asarray([1 / known.get(name, (0.0, jnp.inf))[1] for name in values])
    problem = FitProblem(
        Decay(),
        free,
        (),
        None,
        runs_of((record,), windows),
        {"measured": jnp.asarray(1.0)},
        loss or SquaredLoss(),
        Prior(means, weights),
    )
    search = solve_with_noise(problem, problem.x0, SearchOptions(), frozenset())
    return result_of(search, (record,), windows, {}, jms.Viscous(1.0))


def noisy(seed: int = 0, level: float = 0.05, memory: float = 0.6, A: float = 2.0, k: float = 0.7) -> np.ndarray:
    rng = np.random.default_rng(seed)
    e = rng.standard_normal(T.size)
    for i in range(1, T.size):
        e[i] = memory * e[i - 1] + np.sqrt(1 - memory**2) * e[i]
    return A * np.exp(-k * T) + level * e


def test_the_density_is_that_of_correlated_normal_noise() -> None:
    """By the covariance matrix of the noise, level^2 memory^|i - j|, and the changes of variables by differences."""
    measured = noisy()
    positive = {name: Range("", 0.0, strict=True) for name in ("A", "k")}
    density = log_density(fitted(measured, positive, prior={"k": (0.8, 0.05)}))
    assert density.names == ("A", "k", "noise.measured", "memory.measured")

    def reference(u: np.ndarray) -> float:
        A, k, level, memory = np.asarray(density.vector(jnp.asarray(u)))
        lags = np.abs(np.subtract.outer(np.arange(T.size), np.arange(T.size)))
        likelihood = stats.multivariate_normal.logpdf(measured, A * np.exp(-k * T), level**2 * memory**lags)
        slope = np.asarray(jax.jacfwd(density.vector)(jnp.asarray(u)))
        prior = stats.norm.logpdf(k, 0.8, 0.05) - np.log(level)
        return float(likelihood + prior + np.log(abs(np.linalg.det(slope))))

    us = np.random.default_rng(1).standard_normal((6, 4))
    offsets = [float(density(jnp.asarray(u))) - reference(u) for u in us]
    np.testing.assert_allclose(offsets, offsets[0], rtol=0, atol=1e-8)


def test_it_is_white_and_its_gradient_right_in_both_modes() -> None:
    density = log_density(fitted(noisy(memory=0.0)))
    curvature = jax.hessian(density)(density.start)
    # But for the derivative of the residual's curvature, of the size of the noise over the motion.
    np.testing.assert_allclose(curvature, -np.eye(4), atol=0.1)
    u, step = jnp.asarray([0.5, -1.0, 0.3, 0.8]), 1e-5
    gradient = jax.grad(density)(u)
    np.testing.assert_allclose(gradient, jax.jacfwd(density)(u), rtol=1e-12, atol=1e-12)
    by_differences = [(density(u + e) - density(u - e)) / (2 * step) for e in step * jnp.eye(4)]
    np.testing.assert_allclose(gradient, by_differences, rtol=1e-6, atol=1e-6)
    many = jax.vmap(jax.value_and_grad(density))(jnp.stack([u, density.start]))
    np.testing.assert_allclose(many[1][0], gradient, rtol=1e-12)


@pytest.mark.parametrize(("lower", "upper"), [(-np.inf, np.inf), (0.0, np.inf), (-np.inf, 1.0), (0.0, 1.0)])
def test_soft_bounds_go_back_and_forth(lower: float, upper: float) -> None:
    box = _SoftBox(*(jnp.asarray([x]) for x in (lower, upper, 0.02)))
    for x in (1e-4, 0.03, 0.5, 0.999):
        v = box.outside(jnp.asarray([x]))
        np.testing.assert_allclose(box.inside(v), x, rtol=1e-9)
        np.testing.assert_allclose(box.log_slope(v), jnp.log(jax.grad(lambda v: box.inside(v)[0])(v)), atol=1e-9)


def test_a_parameter_at_its_limit_stays_on_its_side() -> None:
    result = fitted(noisy(k=-0.01, level=0.2), {"k": Range("", 0.0)})
    assert result.values["k"] == 0.0
    density = log_density(result)
    us = jnp.asarray(np.random.default_rng(2).standard_normal((200, 4)) * 3)
    values = jax.vmap(density.vector)(us)
    assert bool((values[:, 1] > 0).all())
    assert bool(jnp.isfinite(jax.vmap(jax.grad(density))(us)).all())


def test_a_robust_loss_keeps_outliers_from_the_noise() -> None:
    measured = noisy(memory=0.0)
    measured[[10, 50, 90]] += 3.0
    level = [
        float(log_density(fitted(measured, loss=loss)).values(jnp.zeros(4))["noise.measured"])
        for loss in (SquaredLoss(), Huber())
    ]
    assert level[1] < 0.6 * level[0]


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    # An offset of the model from white noise would show in the noise: the truth is within what was drawn.
    return sample_posterior(fitted(noisy(level=0.01)), draws=300, warmup=200)


def test_samples_have_the_covariance_of_a_model_that_is_nearly_linear(posterior: Posterior) -> None:
    density_sd = {name: float(x.std()) for name, x in posterior.draws.items()}
    slopes = np.stack([np.exp(-0.7 * T), -2 * T * np.exp(-0.7 * T)], axis=1)
    lags = np.abs(np.subtract.outer(np.arange(T.size), np.arange(T.size)))
    memory, level = (float(np.median(posterior.draws[f"{name}.measured"])) for name in ("memory", "noise"))
    information = slopes.T @ np.linalg.solve(level**2 * memory**lags, slopes)
    expected = np.sqrt(np.diag(np.linalg.inv(information)))
    # 600 samples or so know a standard deviation to 3 %; that of the noise widens it by a few more.
    np.testing.assert_allclose([density_sd["A"], density_sd["k"]], expected, rtol=0.2)
    for name, truth in {"A": 2.0, "k": 0.7, "noise.measured": 0.01, "memory.measured": 0.6}.items():
        low, high = posterior.intervals(0.999)[name]
        assert low < truth < high
    assert max(posterior.rhat.values()) < 1.02
    assert min(posterior.effective.values()) > 200
    assert posterior.divergences == 0


def test_it_says_what_is_wrong(posterior: Posterior) -> None:
    assert "4 chains of 300 draws, 0 divergences" in str(posterior)
    wrong = replace(
        posterior, rhat={**posterior.rhat, "A": 1.3}, effective={**posterior.effective, "k": 9.0}, divergences=3
    )
    text = str(wrong)
    assert "The chains do not agree (R-hat of A 1.3" in text
    assert "k has 9 effective samples, fewer than the 400" in text
    assert "3 samples diverged" in text
    wide = replace(posterior, draws={**posterior.draws, "A": 2 + 2 * (posterior.draws["A"] - 2)})
    assert "A: its standard deviation is" in str(wide)
    with pytest.raises(ValueError, match="level must lie between 0 and 1"):
        posterior.intervals(1.5)


def test_its_figure_has_a_panel_for_each_pair(posterior: Posterior) -> None:
    figure = posterior_figure(posterior)
    drawn = [axis for axis in figure.axes if axis.axison]
    assert len(drawn) == 10
    assert drawn[-1].get_xlabel() == "memory.measured"


def test_it_refuses_what_it_cannot_do(tmp_path) -> None:
    result = fitted(noisy())
    for numbers in ({"draws": 3}, {"warmup": 5}, {"chains": 1}):
        with pytest.raises(ValueError, match="must be an integer >= "):
            sample_posterior(result, **numbers)
    result.save(tmp_path / "fit.npz")
    with pytest.raises(ValueError, match="a loaded result does not have"):
        log_density(FitResult.load(tmp_path / "fit.npz"))


def test_without_blackjax_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "blackjax", None)
    with pytest.raises(ImportError, match=r"jaxmodsim\[posterior\]"):
        sample_posterior(fitted(noisy()))


def test_delays_and_free_starts_and_events_are_among_the_unknowns() -> None:
    scene = sprung_mass(DRIVE, jms.Friction(jms.Coulomb(0.4)), m=1.0)
    t = np.linspace(0.0, 1.0, 101)
    u = 3.0 * np.sin(2 * np.pi * t)
    signal = {"m": 1.0, "k": 20.0, "u": jms.Signal(t, u)}
    run = jms.simulate(eqx.tree_at(lambda s: s.params, scene, signal), [0.01], [0.0], 1.0, ts=t)
    noise = 1e-4 * np.random.default_rng(0).standard_normal(t.size)
    record = jms.Record(t, {"x": np.asarray(run.q[:, 0]) + noise}, {"u": u})
    result = jms.fit(scene, record, ("friction.Fc", "q0", "delay.u"), observe={"x": "q[0]"}, delay={"u": 1e-3})
    density = log_density(result)
    assert density.names == ("friction.Fc", "delay.u", "q0[0]", "qd0[0]", "noise.x", "memory.x")
    values, u0 = density.values(density.start), density.start
    assert float(values["q0[0]"]) == pytest.approx(result.values["q0[0]"])
    gradient, step = jax.jit(jax.grad(density))(u0 + 0.1), 1e-4
    differences = [(density(u0 + 0.1 + e) - density(u0 + 0.1 - e)) / (2 * step) for e in step * jnp.eye(6)]
    np.testing.assert_allclose(gradient, differences, rtol=1e-3, atol=2e-3)
