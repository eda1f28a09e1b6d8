"""Filters of scenes with friction: consistency through stick and slip, derivatives, stick, single precision, and C."""

import ctypes
import subprocess
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

import jaxmodsim as jms
from jaxmodsim._core.compat import AVAILABLE
from jaxmodsim.control import FrictionFilter, linearized, unscented
from jaxmodsim.control._square_root import normalized_square

from ..helpers.compilers import COMPILER
from ..helpers.differences import central_difference

LEVEL = "friction.normal_force"
LAW = jms.LuGre(sigma0=1e4, sigma1=100.0, sigma2=1.0, Fc=2.0, Fs=3.0, vs=0.02)
DRIFT = {"qd[0]": 0.02, "friction.z": 1e-4, LEVEL: 0.05}
STD = {"q[0]": 1e-4, "qd[0]": 1e-2, "friction.z": 2e-5, LEVEL: 0.2}


def energy(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q
    return 0.5 * p["m"] * qd[0] ** 2


def motor(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return jnp.reshape(p["u"], (1,))


def axis(law: Any = LAW) -> jms.Scene:
    effects = (jms.AppliedForce(motor), jms.Friction(law, normal_force=1.0))
    return jms.Scene(energy, {"m": 1.0, "u": 0.0}, effects)


def axis_filter(transform: Any = linearized, noise: Any = 1e-5, law: Any = LAW, **options: Any) -> FrictionFilter:
    return FrictionFilter(axis(law), noise, DRIFT, numbers=(LEVEL,), transform=transform, **options)


def simulated(filter: FrictionFilter, start: Any, t: Any, u: Any, key: Any) -> tuple[Any, Any]:
    """States of the model with its own noise, and measurements."""
    first, inner, outer = jax.random.split(key, 3)
    size = start.mean.shape[0]
    drift = jnp.stack([filter.drift.get(name, jnp.zeros(())) for name in filter.names])
    x0 = start.mean + start.factor @ jax.random.normal(first, (size,))

    def step(x: Any, each: Any) -> tuple[Any, Any]:
        t0, t1, u, noise = each
        x = filter._advance(x, t0, t1, {"u": u}) + drift * jnp.sqrt(t1 - t0) * noise
        return x, x

    _, states = jax.lax.scan(step, x0, (t[:-1], t[1:], u[:-1], jax.random.normal(inner, (t.size - 1, size))))
    states = jnp.concatenate([x0[None], states])
    return states, states[:, :1] + filter.noise[None, :] * jax.random.normal(outer, (t.size, 1))


@pytest.mark.parametrize("runs", [25, 200])
@pytest.mark.parametrize("transform", [linearized, unscented])
def test_consistency_through_stick_and_slip(transform, runs):
    """NEES and NIS, averaged over runs, lie in their 95 % bands at about 95 % of all times."""
    filter = axis_filter(transform)
    t = jnp.arange(0.0, 2.0, 2e-3) if runs == 200 else jnp.arange(0.0, 1.0, 4e-3)
    u = 3.6 * jnp.sin(2.0 * jnp.pi * t)
    start = filter.start([0.0], [0.0], STD)

    @jax.jit
    @jax.vmap
    def one(key):
        states, measured = simulated(filter, start, t, u, key)
        run = filter.run(t, measured, {"u": u}, start)
        return states, jax.vmap(normalized_square)(run.states, states), jnp.sum(run.innovation**2, axis=1)

    states, nees, nis = one(jax.random.split(jax.random.key(0), runs))
    slip = np.abs(states[:, :, 1]) > 0.01
    assert 0.2 < slip.mean() < 0.9  # neither state alone
    for squares, degrees in ((nees, states.shape[2]), (nis, 1)):
        low, high = chi2.ppf([0.025, 0.975], degrees * runs) / runs
        mean = np.asarray(squares).mean(axis=0)
        assert np.mean((mean > low) & (mean < high)) > 0.88, (mean.mean(), degrees)
        # Times are correlated: the mean of all has a wider band than that of independent ones, 3 % here.
        np.testing.assert_allclose(mean.mean(), degrees, rtol=0.03 if runs == 200 else 0.1)


@pytest.mark.parametrize("transform", [linearized, unscented])
def test_gradient_of_the_likelihood_by_noise_levels(transform):
    """Second derivatives of the implicit step enter that of the extended filter.

    Without bristle damping, whose mean rate is clipped between two rates: a kink where all of them are equal.
    """
    law = jms.LuGre(sigma0=1e4, sigma1=0.0, sigma2=1.0, Fc=2.0, Fs=3.0, vs=0.02)
    filter = axis_filter(transform, law=law)
    t = jnp.concatenate([jnp.linspace(0.0, 0.2, 30), jnp.linspace(0.21, 0.4, 20)])
    u = 4.5 * jnp.sin(2.0 * jnp.pi * 2.0 * t)
    start = filter.start([0.0], [0.0], STD)
    _, measured = simulated(filter, start, t, u, jax.random.key(1))
    measured = measured.at[10:15].set(jnp.nan)

    @jax.jit
    def likelihood(logs):
        changed = eqx.tree_at(
            lambda f: (f.noise, f.drift["qd[0]"]), filter, (filter.noise * jnp.exp(logs[0]), 0.02 * jnp.exp(logs[1]))
        )
        return changed.run(t, measured, {"u": u}, start).log_likelihood

    gradient = jax.grad(likelihood)(jnp.zeros(2))
    for i in range(2):
        unit = np.eye(2)[i]
        # Truncation of order step^4; rounding 1e-13/step.
        slope = central_difference(lambda s, unit=unit: likelihood(jnp.asarray(s * unit)), 0.0, 2e-3)
        np.testing.assert_allclose(gradient[i], slope, rtol=1e-5)


def test_in_stick_the_level_keeps_its_value_and_its_band_grows():
    filter = axis_filter(rest=5e-3)
    t = jnp.linspace(0.0, 1.0, 101)
    start = filter.start([0.0], [0.0], {**STD, "qd[0]": 1e-4})
    held = filter.run(t, jnp.zeros((101, 1)), {"u": jnp.full(101, 1.0)}, start)
    np.testing.assert_allclose(held.band(LEVEL)[0], 1.0, rtol=1e-12)
    # A random walk from a variance of 0.2^2, with 0.05 in a second.
    np.testing.assert_allclose(held.states.std[:, -1] ** 2, 0.2**2 + 0.05**2 * t, rtol=1e-9)
    free = axis_filter().run(t, jnp.zeros((101, 1)), {"u": jnp.full(101, 1.0)}, start)
    assert free.states.std[-1, -1] < 0.9 * held.states.std[-1, -1]  # the bristle seems to contain information


@pytest.mark.parametrize("transform", [linearized, unscented])
def test_a_rising_level_is_in_the_band(transform):
    """The level rises by half in ten seconds; a wrong model would miss the band of the smoother."""
    filter = axis_filter(transform, rest=5e-3)
    t = jnp.arange(0.0, 10.0, 5e-3)
    u, level = 4.5 * jnp.sin(2.0 * jnp.pi * t), 1.0 + 0.05 * t

    def step(x, each):
        t0, t1, u, level = each
        x = filter._advance(x.at[-1].set(jnp.log(level)), t0, t1, {"u": u})
        return x, x[0]

    _, q = jax.lax.scan(step, jnp.zeros(4), (t[:-1], t[1:], u[:-1], level[:-1]))
    measured = jnp.concatenate([jnp.zeros(1), q]) + 1e-5 * jax.random.normal(jax.random.key(2), t.shape)
    run = filter.run(t, measured[:, None], {"u": u}, filter.start([0.0], [0.0], STD))
    for each in (run, run.smooth()):
        middle, low, high = (x[t > 1.0] for x in each.band(LEVEL))
        assert np.mean((low < level[t > 1.0]) & (level[t > 1.0] < high)) > 0.9
    assert low[-1] > 1.3
    assert middle[-1] < 1.7


def test_errors_name_what_is_wrong():
    with pytest.raises(ValueError, match=r"no number 'friction\.Fd'"):
        FrictionFilter(axis(), 1e-5, {}, numbers=("friction.Fd",))
    with pytest.raises(ValueError, match="drift names 'v'"):
        FrictionFilter(axis(), 1e-5, {"v": 1.0})
    with pytest.raises(ValueError, match="wrap the law as Regularized"):
        FrictionFilter(axis(jms.Coulomb(1.0)), 1e-5, {})
    filter, t = axis_filter(), jnp.linspace(0.0, 1.0, 3)
    with pytest.raises(ValueError, match=r"measured has shape \(3,\)"):
        filter.run(t, t, {}, filter.start([0.0], [0.0], {}))
    with pytest.raises(ValueError, match="no number 'w'"):
        filter.run(t, t[:, None], {"w": t}, filter.start([0.0], [0.0], {}))
    with pytest.raises(ValueError, match=r"'friction\.normal_force' is estimated"):
        filter.run(t, t[:, None], {LEVEL: t}, filter.start([0.0], [0.0], {}))
    with pytest.raises(ValueError, match="t decreases"):
        filter.run(-t, t[:, None], {}, filter.start([0.0], [0.0], {}))
    viscous = FrictionFilter(axis(jms.Viscous(0.0)), 1e-5, {}, numbers=("friction.Fv",))
    with pytest.raises(ValueError, match=r"logarithm of friction\.Fv, which starts at 0\.0"):
        viscous.start([0.0], [0.0], {"friction.Fv": 1.0})


@pytest.mark.skipif(COMPILER is None or "jaxprs" not in AVAILABLE, reason="needs a C compiler and traced programs")
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("transform", [linearized, unscented])
def test_the_cycle_in_c_is_that_in_jax(transform, dtype, tmp_path: Path):
    scene = jax.tree.map(lambda x: x.astype(dtype), axis())
    filter = FrictionFilter(scene, 1e-5, DRIFT, numbers=(LEVEL,), transform=transform)
    source, library = tmp_path / "filter.c", tmp_path / "filter.so"
    source.write_text(filter.to_c("axis_filter", inputs=("u",)))
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC"]
    subprocess.run([str(COMPILER), *flags, str(source), "-o", str(library), "-lm"], check=True)
    call = ctypes.CDLL(str(library)).axis_filter
    real = ctypes.c_double if dtype == jnp.float64 else ctypes.c_float
    x = filter.start([0.0], [0.0], STD)
    mean, factor, innovation = np.array(x.mean), np.array(x.factor), np.zeros(1, dtype)
    pointer = ctypes.POINTER(real)
    h, zero = jnp.asarray(2e-3, dtype), jnp.zeros((), dtype)

    @jax.jit
    def cycle(x, u, y):
        return filter.correct(filter.predict(x, zero, h, {"u": u}).ahead, h, {"u": u}, y)

    for k in range(20):
        u, y = np.full(1, 4.0, dtype), np.full(1, np.nan if k == 5 else 1e-6 * k**2, dtype)
        arrays = [a.ctypes.data_as(pointer) for a in (u, y, mean, factor, mean, factor, innovation)]
        call(real(float(h)), *arrays)
        done = cycle(x, jnp.asarray(u[0]), jnp.asarray(y))
        x = done.state
    scale = np.array([1e-4, 1e-2, 1e-5, 1.0])
    error = 1e-9 if dtype == jnp.float64 else 1e-2
    np.testing.assert_allclose(mean / scale, x.mean / scale, rtol=error, atol=error)
    np.testing.assert_allclose(factor @ factor.T, x.factor @ x.factor.T, rtol=error, atol=error * 1e-8)


EMPS = Path(__file__).parents[3] / "shared" / "data" / "emps" / "train.csv"


@pytest.mark.skipif(not EMPS.exists(), reason="the EMPS record is outside the repository")
def test_innovations_of_a_measured_axis_are_not_white() -> None:
    """Parameters of the authors, without a fit; the noise is that of rounding to the encoder step of 5e-8 m.

    A. Janot, M. Gautier, M. Brunot, "Data set and reference models of EMPS", 2019. The level agrees with their
    identification on average. Drift can adjust the variance of the innovations but not their colour: the model lacks a
    force.
    """
    t, q, _, u = np.loadtxt(EMPS, delimiter=",", skiprows=1, max_rows=6000).T
    law = jms.Regularized(jms.Stribeck(Fc=20.3935, Fs=20.3935, vs=0.01, Fv=203.5034), 1e-3)
    drive = jms.AppliedForce(lambda t, q, qd, p: jnp.reshape(p["u"] + 3.1648, (1,)))
    scene = jms.Scene(energy, {"m": 95.1089, "u": 0.0}, (drive, jms.Friction(law, normal_force=1.0)))
    filter = FrictionFilter(scene, noise=2e-8, drift={"qd[0]": 9.3e-4, LEVEL: 0.2}, numbers=(LEVEL,))
    start = filter.start([q[0]], [0.0], {"q[0]": 1e-5, "qd[0]": 1e-3, LEVEL: 0.2})
    run = filter.run(t, q[:, None], {"u": 35.15065188248547 * u}, start)
    white = np.asarray(run.innovation[1:, 0])
    np.testing.assert_allclose(np.mean(white**2), 1.0, atol=0.1)
    correlation = [np.mean(white[k:] * white[:-k]) / np.mean(white**2) for k in (1, 2)]
    # 95 % of white sequences of this length are below 1.96/sqrt(6000) = 0.025.
    assert 1.96 / np.sqrt(white.size) < abs(correlation[0]) < 0.15
    assert correlation[1] > 0.3
    np.testing.assert_allclose(np.mean(run.band(LEVEL)[0][1000:]), 1.0, atol=0.05)


@pytest.mark.parametrize("transform", [linearized, unscented])
def test_the_velocity_of_an_accelerated_slip_has_no_lag(transform):
    """Under a constant force, in closed form; a lag of half a step is four standard deviations here."""
    dry, drift = axis(jms.Regularized(jms.Coulomb(2.0), width=1e-3)), {"qd[0]": 0.02, LEVEL: 0.05}
    filter = FrictionFilter(dry, 1e-5, drift, numbers=(LEVEL,), transform=transform)
    t, rate = jnp.arange(0.0, 1.0, 5e-3), 5.0
    start = filter.start([0.0], [0.1], {"q[0]": 1e-4, "qd[0]": 1e-2, LEVEL: 0.2})
    run = filter.run(t, (0.1 * t + 0.5 * rate * t**2)[:, None], {"u": jnp.full(t.size, 2.0 + rate)}, start)
    error = (run.states.mean[20:, 1] - 0.1 - rate * t[20:]) / run.states.std[20:, 1]
    assert jnp.max(jnp.abs(error)) < 0.2
    np.testing.assert_allclose(run.band(LEVEL)[0][20:], 1.0, atol=0.01)
