"""New records: bands that hold what they promise, what varies between records, and what is refused."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.text import Text

import jaxmodsim as jms
from jaxmodsim import plot
from jaxmodsim.identify import agreement, evaluate_on, law_force, predict, prediction_error, replay
from jaxmodsim.identify.selection._agreement import _between, _covariance_between, covariances
from jaxmodsim.problems.braked_spring import driven_spring

T = np.arange(0.0, 4.0, 5e-3)
NOISE = 0.05


def law(Fc: float = 1.0) -> jms.Regularized:
    return jms.Regularized(jms.Stribeck(Fc=Fc, Fs=1.6 * Fc, vs=0.02, Fv=2.0), 1e-3)


def day(name: str, seed: int, level: float = 1.0) -> jms.Record:
    """A measured friction force under a motion in both directions."""
    x = 0.05 * np.sin(2 * np.pi * 0.6 * T + 0.3 * seed) + 0.02 * np.sin(2 * np.pi * 1.7 * T)
    force = np.asarray(law_force(law(level), jnp.asarray(T), jnp.asarray(x)))
    return jms.Record(T, force + NOISE * np.random.default_rng(seed).standard_normal(T.size), {"x": x}, name)


def fitted(*days: jms.Record) -> jms.FitResult:
    return jms.fit_law(law(0.8), days, ("Fc", "Fs", "vs", "Fv"))


def test_bands_hold_where_the_level_changes_and_only_if_it_may():
    result, seen = fitted(day("first", 0)), np.random.default_rng(5).uniform(-0.08, 0.08, 12)
    others = [day(f"day {i}", i + 1, 1.0 + change) for i, change in enumerate(seen)]
    # Of 12 levels all lie within 8 %, the band for normal levels reaches 1.64 x 5.7 % = 9.3 %.
    assert np.mean([predict(result, other).shares["measured"] for other in others]) > 0.85
    assert np.mean([predict(result, other, variation=0.0).shares["measured"] for other in others]) < 0.8
    same = [predict(result, day("same", 40 + i), variation=0.0).shares["measured"] for i in range(5)]
    assert np.mean(same) == pytest.approx(0.9, abs=0.02)  # two standard errors of 4 000 samples are 0.01


def test_the_deviation_of_a_changing_level_is_half_the_difference_of_two_runs():
    result, other = fitted(day("first", 0)), day("other", 1)
    found = predict(result, other)
    # A step of sqrt(3) standard deviations, 0.04 sqrt(2) of both levels, in the model alone.
    step, values = np.sqrt(3.0) * 0.04 * np.sqrt(2.0), result.values
    ends = []
    for side in (1.0, -1.0):
        levels = {name: values[name] * (1 + side * step) for name in ("Fc", "Fs")}
        changed = jms.Regularized(jms.Stribeck(**levels, vs=values["vs"], Fv=values["Fv"]), 1e-3)
        ends.append(np.asarray(law_force(changed, jnp.asarray(T), jnp.asarray(other.inputs["x"]))))
    expected = np.abs(ends[0] - ends[1]) / (2 * np.sqrt(3.0))
    # The coordinates of the fit are logarithms of Fc: 1 % at a step of 10 %.
    assert found.between["measured"] == pytest.approx(expected, rel=0.01, abs=1e-6)
    assert found.model["measured"] == pytest.approx(NOISE, rel=0.08)
    total = prediction_error(result)["measured"]
    assert total.total**2 == pytest.approx(total.model**2 + total.parameters**2 + total.between**2)
    assert total.unchanged**2 == pytest.approx(total.model**2 + total.parameters**2)
    assert total.between == pytest.approx(np.sqrt(np.mean(expected**2)), rel=0.1)  # of the first day's motion
    assert "4 % from record to record (assumed)" in str(found)


def test_records_that_differ_widen_the_band_and_those_that_agree_make_it_narrower():
    alike, unlike = (fitted(day("first", 0), day("second", 1, level)) for level in (1.0, 1.3))
    other = day("other", 2, 1.15)
    widths = [
        np.mean(predict(result, other, agreement=each).between["measured"])
        for result, each in ((alike, agreement(alike)), (unlike, agreement(unlike)))
    ]
    one = np.mean(predict(fitted(day("first", 0)), other).between["measured"])
    assert widths[0] < one < widths[1]
    assert "as these 2 records show" in str(predict(unlike, other, agreement=agreement(unlike)))


def test_what_varies_is_told_from_what_errs():
    found = agreement(fitted(*(day(f"day {i}", i, level) for i, level in enumerate((0.9, 1.0, 1.1, 1.05, 0.95)))))
    name = found.names.index("Fc")
    assert found.common[name] == pytest.approx(1.0, abs=0.05)
    low, high = found.between_interval[name]
    # The standard deviation of these five levels is 0.079.
    assert low < 0.079 < high
    assert found.between[name] == pytest.approx(0.079, rel=0.2)
    assert np.sqrt(found.covariance[name, name]) == pytest.approx(0.079, rel=0.25)
    assert "Fc" in found.differing
    rows = {name: (between, low, high) for name, _, _, between, low, high, _ in found.rows()}
    assert rows["Fv"][1] == 0.0  # the viscous part did not change
    assert "between" in str(found)


def test_variances_between_records_have_closed_forms_where_errors_are_the_same():
    x, error = np.array([1.0, 1.4, 0.9, 1.2]), 0.05
    square = float(np.sum((x - x.mean()) ** 2))
    for target in (3.0, 9.35, 0.216):
        assert _between(x, np.full(4, error**2), target) == pytest.approx(square / target - error**2)
    assert _between(x, np.full(4, 10.0), 3.0) == 0.0
    rng = np.random.default_rng(0)
    values = rng.multivariate_normal([0, 0], [[4.0, 1.0], [1.0, 1.0]], 4000)
    noisy = values + rng.multivariate_normal([0, 0], [[1.0, -0.9], [-0.9, 1.0]], 4000)
    own = np.broadcast_to([[1.0, -0.9], [-0.9, 1.0]], (4000, 2, 2))
    found = _covariance_between(noisy, own, np.array([True, True]))
    assert found == pytest.approx(np.array([[4.0, 1.0], [1.0, 1.0]]), abs=0.3)
    assert not _covariance_between(noisy, own, np.array([False, False])).any()


def spring(Fc: float) -> jms.Scene:
    return driven_spring(jms.Regularized(jms.Coulomb(Fc), 1e-2), m=2.0, k=30.0)


def driven(Fc: float, seed: int, name: str, samples: int = 600) -> jms.Record:
    t, rng = 5e-3 * np.arange(samples), np.random.default_rng(seed)
    u = 6.0 * np.sin(2 * np.pi * 0.7 * t + rng.uniform(0, 6)) + 3.0 * np.sin(2 * np.pi * 1.1 * t)
    zero = jnp.zeros(1)
    q = np.asarray(replay(spring(Fc), jnp.asarray(t), {"u": jnp.asarray(u)}, zero, zero))
    return jms.Record(t, {"x": q + 1e-5 * rng.standard_normal(samples)}, {"u": u}, name)


@pytest.fixture(scope="module")
def axis() -> jms.FitResult:
    return jms.fit(spring(0.8), driven(1.0, 0, "first"), ("m", "friction.Fc"), q0=[0.0], observe={"x": "q[0]"})


def test_a_scene_on_another_day_and_its_figure(axis):
    other = predict(axis, driven(1.05, 1, "other"))
    assert other.shares["x"] > 0.85
    assert predict(axis, driven(1.05, 1, "other"), variation=0.0).shares["x"] < 0.7
    assert other.score.rmse == evaluate_on(axis, driven(1.05, 1, "other")).rmse
    assert not other.counts[:20].any()  # 20 samples of so little noise show the start
    assert other.counts[20:].all()
    assert "from its first 20 samples" in str(other)
    # A start that is given does not follow the parameters, and all samples count.
    given = predict(axis, driven(1.05, 1, "other"), q0=[0.0], qd0=[0.0])
    assert given.counts.all()
    assert given.between["x"][0] == 0.0
    labels = [text.get_text() for text in plot.score_figure(other).axes[0].findobj(Text)]
    assert any(f"contains {100 * other.shares['x']:.0f} %" in label for label in labels)
    alone = [text.get_text() for text in plot.score_figure(other.score).axes[0].findobj(Text)]
    assert not any("contains" in label for label in alone)


def test_a_record_that_starts_in_motion_is_as_uncertain_as_its_first_samples_and_not_as_the_model():
    drive = jms.AppliedForce(lambda t, q, qd, p: jnp.reshape(p["u"], (1,)))
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2, {"m": 1.5, "u": 0.0}, (drive,))
    t, noise, rate = 5e-3 * np.arange(600), 1e-5, 2 * np.pi * 0.7

    def pulled(seed: int, speed: float) -> jms.Record:
        """A free mass of 2 kg, pulled by a sine, and moved by millimetres by what the model does not know."""
        unknown = 5e-3 * (1 - np.cos(t))
        q = speed * t + 3.0 * (t / rate - np.sin(rate * t) / rate**2) + unknown
        x = q + noise * np.random.default_rng(seed).standard_normal(t.size)
        return jms.Record(t, {"x": x}, {"u": 6.0 * np.sin(rate * t)}, f"of {speed} m/s", linear=("u",))

    result = jms.fit(scene, pulled(0, 0.0), ("m",), q0=[0.0], qd0=[0.0], observe={"x": "q[0]"})
    found = predict(result, pulled(1, 0.3))
    assert found.model["x"][0] > 50 * noise
    first = ~found.counts
    by_m = 3.0 * (t / rate - np.sin(rate * t) / rate**2) / 2.0
    by_m -= np.polyval(np.polyfit(t[first], by_m[first], 1), t)
    far = t - np.mean(t[first])
    start = noise * np.sqrt(1 / np.sum(first) + far**2 / np.sum(far[first] ** 2))
    by_m *= np.sqrt(covariances(result, 0.0, None)[0][0, 0])
    assert found.parameters["x"][found.counts] == pytest.approx(np.hypot(start, by_m)[found.counts], rel=0.3)


def test_short_records_show_their_start_by_half_of_them(axis):
    short = evaluate_on(axis, driven(1.0, 1, "short", 8))
    assert np.isfinite(short.rmse["x"])
    with pytest.raises(ValueError, match=r"tiny has 5 samples, too few .* 6 are needed"):
        evaluate_on(axis, driven(1.0, 1, "tiny", 5))
    candidate = jms.identify.Candidate(spring(0.8), ("m", "friction.Fc"))
    with pytest.raises(ValueError, match=r"first\[0\] has 4 samples"):
        jms.identify.compare({"coulomb": candidate}, driven(1.0, 0, "first", 16), observe={"x": "q[0]"})


def test_wrong_questions_are_refused(axis, tmp_path):
    other = driven(1.0, 1, "other")
    for level in (0.0, 1.0, float("nan")):
        with pytest.raises(ValueError, match="level must lie between 0 and 1"):
            predict(axis, other, level=level)
    for variation in (-0.1, float("inf")):
        with pytest.raises(ValueError, match="variation must be finite and >= 0"):
            predict(axis, other, variation=variation)
    two = fitted(day("first", 0), day("second", 1))
    with pytest.raises(ValueError, match=r"The agreement is of Fc.*take agreement\(result\)"):
        prediction_error(axis, agreement=agreement(two))
    axis.save(tmp_path / "axis.npz")
    with pytest.raises(ValueError, match="fit again"):
        predict(jms.FitResult.load(tmp_path / "axis.npz"), other)
    with pytest.raises(ValueError, match="fit again"):
        prediction_error(dataclasses.replace(axis, search=None))
