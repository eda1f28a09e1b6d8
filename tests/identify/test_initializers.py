"""Where a fit begins, and whether its intervals hold: starts that are far off, many at once, and the truth known."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxmodsim as jms
from jaxmodsim.identify import (
    Continuation,
    MultiStart,
    Staged,
    Stochastic,
    coverage,
    law_force,
    replay,
)
from jaxmodsim.scene import replace_numbers

from ..helpers.sprung import DRIVE, sprung_mass

DATA = Path(__file__).parents[3] / "shared" / "data"
TRUTH = {"sigma0": 1e4, "sigma1": 40.0, "sigma2": 2.0, "Fc": 1.0, "Fs": 1.5, "vs": 0.02}
# Each wrong by a factor of ten, Fs as far as Fc lets it.
WRONG = {"sigma0": 1e5, "sigma1": 4.0, "sigma2": 0.2, "Fc": 10.0, "Fs": 15.0, "vs": 0.2}
NOISE = 1e-5


def sprung(law, m=1.0):
    return sprung_mass(DRIVE, jms.Friction(law), m=m, k=200.0)


@pytest.fixture(scope="module")
def driven():
    """1000 samples of a mass on a spring, driven through stick and slip."""
    t = np.arange(1000) * 3e-3
    u = 3 * np.sin(2 * np.pi * 0.7 * t) + 2 * np.sin(2 * np.pi * 1.9 * t) + 1.2 * np.sin(2 * np.pi * 0.31 * t)
    zero = jnp.zeros(1)
    run = jax.jit(replay, static_argnums=(5, 6))
    q = run(sprung(jms.LuGre(**TRUTH)), jnp.asarray(t), {"u": jnp.asarray(u)}, zero, zero)
    return jms.Record(t, np.asarray(q) + NOISE * np.random.default_rng(0).standard_normal(t.size), {"u": u})


@pytest.fixture(scope="module")
def moved():
    """Force of the law under a motion that creeps, rushes and reverses."""
    t = np.arange(600) * 5e-3
    x = 2e-4 * np.sin(2 * np.pi * 1.5 * t) + 0.02 * np.sin(2 * np.pi * 0.4 * t) ** 3
    clean = np.asarray(law_force(jms.LuGre(**TRUTH), jnp.asarray(t), jnp.asarray(x)))
    return jms.Record(t, clean + 0.01 * np.random.default_rng(1).standard_normal(t.size), {"x": x})


def near_truth(result, prefix=""):
    return all(
        abs(result.values[prefix + name] - true) < 4.5 * result.errors[prefix + name] for name, true in TRUTH.items()
    )


def test_staged_needs_no_start_values(driven):
    free = (*(f"friction.{name}" for name in TRUTH), "m")
    nonsense = sprung(jms.LuGre(1.0, 1.0, 1.0, 1.0, 1.0, 1.0), m=50.0)
    result = jms.fit(nonsense, driven, free, q0=[0.0], initializer=Staged(), limits={"m": (0.0, None)})
    assert result.diagnostics.ending == "converged"
    assert near_truth(result, "friction.")
    assert result.values["m"] == pytest.approx(1.0, abs=4.5 * result.errors["m"])
    assert result.rmse == pytest.approx(NOISE, rel=0.1)


def test_the_best_of_many_starts_is_the_truth_where_one_start_is_lost(moved):
    wrong = jms.LuGre(**WRONG)
    result = jms.fit_law(wrong, moved, tuple(TRUTH), initializer=MultiStart(48, steps=24))
    assert near_truth(result)
    assert len(result.diagnostics.starts) == 48
    assert list(result.diagnostics.starts) == sorted(result.diagnostics.starts)
    assert result.diagnostics.starts[-1] > 2 * result.diagnostics.starts[0]  # others were not as lucky


def test_starts_cover_the_box_and_begin_with_the_given_one(moved):
    search = jms.fit_law(jms.LuGre(**TRUTH), moved, tuple(TRUTH), max_steps=1).search
    assert search is not None
    problem = search.problem
    drawn = MultiStart(64, spread=10.0).starts(problem, problem.x0)
    np.testing.assert_array_equal(drawn[0], problem.x0)
    sigma0 = np.log10(TRUTH["sigma0"] * np.exp(drawn[:, 0]))
    assert 3.0 <= sigma0.min() < 3.2
    assert 4.8 < sigma0.max() <= 5.0
    again = MultiStart(64, spread=10.0).starts(problem, problem.x0)
    np.testing.assert_array_equal(drawn, again)


def test_a_width_that_comes_down_leads_to_the_fit_with_the_small_one(driven):
    law, narrowing = jms.Regularized(jms.Coulomb(0.4), 1e-3), Continuation("friction.width")
    result = jms.fit(sprung(law, 1.3), driven, ("m", "friction.Fc"), q0=[0.0], qd0=[0.0], initializer=narrowing)
    assert float(result.model.effects[1].law.width) == pytest.approx(1e-3)  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    alone = jms.fit(
        replace_numbers(sprung(law), {k: jnp.asarray(x) for k, x in result.values.items()}),
        driven,
        ("m", "friction.Fc"),
        q0=[0.0],
        qd0=[0.0],
    )
    assert result.rmse == pytest.approx(alone.rmse, rel=1e-3)


def test_intervals_hold_the_truth_as_often_as_promised(moved):
    result = jms.fit_law(jms.LuGre(**WRONG), moved, tuple(TRUTH), initializer=Staged())
    covered = coverage(result, 60, initializer=Staged())
    assert covered.converged >= 58
    # Of 60 draws with 95 % each, fewer than 51 come in one of 2000 cases.
    assert all(share >= 51 / 60 for share in covered.shares.values())
    narrow = coverage(result, 60, initializer=Staged(), level=0.5)
    assert all(0.25 < share < 0.75 for share in narrow.shares.values())


def test_steps_on_a_few_of_many_records_come_near(moved):
    rng, truth = np.random.default_rng(5), jms.LuGre(**TRUTH)
    force = jax.jit(lambda x: law_force(truth, jnp.asarray(moved.t), x))
    records = []
    for i in range(12):
        x = moved.inputs["x"] * (0.6 + 0.1 * i)
        noisy = np.asarray(force(jnp.asarray(x))) + 0.01 * rng.standard_normal(x.size)
        records.append(jms.Record(moved.t, noisy, {"x": x}, name=f"run {i}", noise=0.01))
    start = jms.LuGre(2e4, 40.0, 2.0, 1.5, 2.0, 0.02)
    steps = Stochastic(optax.adam(0.05), batch=3, steps=120)
    near = jms.fit_law(start, records, ("sigma0", "Fc"), initializer=steps, max_steps=1)
    for name in near.values:
        assert near.values[name] == pytest.approx(TRUTH[name], rel=0.2)
    assert near.rmse < 0.5 * jms.fit_law(start, records, ("sigma0", "Fc"), max_steps=1).rmse
    with pytest.raises(ValueError, match="draws 20 runs at a time, but there are 12"):
        jms.fit_law(start, records, ("Fc",), initializer=Stochastic(optax.sgd(0.1), batch=20))


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: MultiStart(0), "MultiStart count must be a positive integer"),
        (lambda: MultiStart(spread=1.0), "MultiStart spread must be one finite number > 1"),
        (lambda: Continuation("friction.width", factor=0.5), "Continuation factor must be one finite number > 1"),
        (lambda: Stochastic(0.05), "must be one of optax"),
    ],
)
@pytest.mark.quick
def test_numbers_out_of_range_are_refused(make, text):
    with pytest.raises(ValueError, match=text):
        make()


@pytest.mark.skipif(
    not (DATA / "presliding").exists(), reason="the measured presliding record is not beside the repository"
)
def test_stiffness_of_measured_loops_agrees_between_halves_of_the_record():
    t, normal, x, force = np.loadtxt(DATA / "presliding" / "hysteresis.csv", delimiter=",", skiprows=1).T
    law = jms.ElastoPlastic(sigma0=2e4, sigma1=0.0, sigma2=0.0, Fc=0.45, Fs=0.45, vs=1e-3, Fba=0.2)
    half, intervals = len(t) // 2, []
    for part in (slice(0, half), slice(half, 2 * half)):
        record = jms.Record(t[part], force[part], {"x": x[part], "normal": normal[part]})
        intervals.append(jms.fit_law(law, record, ("sigma0", "Fc", "Fba")).estimate.intervals()["sigma0"])
    (low, high), (low_2, high_2) = intervals
    assert max(low, low_2) < min(high, high_2)
    assert high - low < 0.03 * low
