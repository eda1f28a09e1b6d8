"""Indices over ranges of parameters against closed forms, over all runs and within each kind of motion."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from matplotlib.patches import Rectangle

import jaxmodsim as jms
from jaxmodsim import metrics, plot, problems
from jaxmodsim.sweeps import GlobalSensitivity, global_sensitivity

CUBE = {name: (0.0, 1.0) for name in "abc"}


def ishigami(a: Any, b: Any, c: Any) -> Any:
    return jnp.sin(a) + 7.0 * jnp.sin(b) ** 2 + 0.1 * c**4 * jnp.sin(a)


def linear(a: Any, b: Any, c: Any) -> Any:
    return 2.0 * a - 3.0 * b + 0.0 * c


def leaping(a: Any, b: Any, c: Any) -> Any:
    """Two kinds of motion: b alone matters in one, c alone in the other, a alone decides which it is."""
    fast = a > 0.6
    return {"y": jnp.where(fast, 100.0 + b, c), "kind": 1.0 * fast}


def test_ishigami() -> None:
    """Sobol' indices of the Ishigami function (a = 7, b = 0.1), and the intervals that hold them."""
    found = global_sensitivity(ishigami, None, {name: (-np.pi, np.pi) for name in "abc"}, count=1024)
    exact = {"S1": np.array([0.3139, 0.4424, 0.0]), "ST": np.array([0.5576, 0.4424, 0.2437])}
    indices, errors, samples = found.overall["value"]
    for name, values in exact.items():
        np.testing.assert_allclose(indices[name], values, atol=0.02)
        assert np.all(np.abs(indices[name] - values) < errors[name])
        assert np.all(errors[name] < 0.1)
    np.testing.assert_array_equal(samples, 1024 * 5)
    assert found.shares == {}
    assert not found.remarks
    again = global_sensitivity(ishigami, None, {name: (-np.pi, np.pi) for name in "abc"}, count=1024)
    np.testing.assert_array_equal(again.overall["value"].errors["S1"], errors["S1"])


def test_ranges_are_distributions() -> None:
    """The variance of 2 a - 3 b over a uniform, b logarithmic, is shared by 4 var a and 9 var b."""
    low, high = 0.1, 2.0
    ranges = {"a": scipy.stats.norm(1.0, 0.5), "b": (low, high, "log"), "c": (0.0, 1.0)}
    found = global_sensitivity(linear, None, ranges, count=512)
    log = np.log(high / low)
    mean, square = (high - low) / log, (high**2 - low**2) / (2 * log)
    parts = np.array([4 * 0.25, 9 * (square - mean**2), 0.0])
    np.testing.assert_allclose(found.overall["value"].indices["S1"], parts / parts.sum(), atol=0.02)


def test_morris_of_a_linear_function() -> None:
    """Elementary effects are the slopes over the ranges, each time."""
    found = global_sensitivity(
        linear, None, {"a": (0.0, 1.0), "b": (0.0, 2.0), "c": (1.0, 9.0)}, method="morris", count=9
    )
    indices, errors, samples = found.overall["value"]
    np.testing.assert_allclose(indices["mu"], [2.0, -6.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(indices["mu_star"], [2.0, 6.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(indices["sigma"], 0.0, atol=1e-12)
    np.testing.assert_allclose(errors["mu_star"], 0.0, atol=1e-12)
    np.testing.assert_array_equal(samples, 9)
    assert found.crossings is None


def test_morris_as_salib_has_it() -> None:
    from SALib.analyze import morris

    found = global_sensitivity(ishigami, None, {name: (-np.pi, np.pi) for name in "abc"}, method="morris", count=40)
    points = np.stack([np.asarray(found.runs[name]) for name in "abc"], axis=1) / (2 * np.pi) + 0.5
    problem = {"num_vars": 3, "names": list("abc"), "bounds": [[0.0, 1.0]] * 3}
    known = morris.analyze(problem, points, np.asarray(found.runs["value"]), seed=1, num_resamples=1000)
    for name in ("mu", "mu_star", "sigma"):
        np.testing.assert_allclose(found.overall["value"].indices[name], np.asarray(known[name]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.overall["value"].errors["mu_star"], known["mu_star_conf"], rtol=0.1, atol=1e-12)


def test_sobol_of_two_kinds_of_motion() -> None:
    """Over all runs only a seems to matter; within the kinds it does not at all."""
    found = global_sensitivity(leaping, None, CUBE, by="kind", count=256)
    np.testing.assert_allclose(found.overall["y"].indices["ST"], [1.0, 0.0, 0.0], atol=0.01)
    assert list(found.shares) == ["kind = 0", "kind = 1"]
    np.testing.assert_allclose(list(found.shares.values()), [0.6, 0.4], atol=0.01)
    assert list(found.membership) == ["kind = 0"]
    np.testing.assert_allclose(found.membership["kind = 0"].indices["S1"], [1.0, 0.0, 0.0], atol=0.02)
    for kind, expected in (("kind = 0", [0.0, 0.0, 1.0]), ("kind = 1", [0.0, 1.0, 0.0])):
        indices, errors, samples = found.within[kind]["y"]
        np.testing.assert_allclose(indices["S1"], expected, atol=0.1)
        assert np.all(np.abs(indices["S1"] - expected) <= errors["S1"])
        # Of the two independent points of each block.
        np.testing.assert_allclose(samples, 512 * found.shares[kind], atol=6)
    assert "MORE THAN ONE KIND" in found.remarks[0]


def test_morris_of_two_kinds_of_motion() -> None:
    """Effects between points of one kind are exact, and all steps that cross are steps of a."""
    found = global_sensitivity(leaping, None, CUBE, by="kind", method="morris", count=40)
    assert found.crossings is not None
    assert found.crossings[0] > 0.9
    np.testing.assert_array_equal(found.crossings[1:], 0.0)
    assert found.overall["y"].indices["mu_star"][0] > 90.0
    for kind, expected in (("kind = 0", [0.0, 1.0]), ("kind = 1", [1.0, 0.0])):
        indices, _, samples = found.within[kind]["y"]
        np.testing.assert_allclose(indices["mu_star"][1:], expected, atol=1e-9)
        assert np.all(samples[1:] >= 8)
    # The steps of a, of two thirds of its range, all cross.
    assert np.isnan(found.within["kind = 0"]["y"].indices["mu_star"][0])


@pytest.mark.parametrize(("method", "count"), [("sobol", 256), ("morris", 64)])
def test_runs_that_fail_take_their_blocks_with_them(method: str, count: int) -> None:
    def failing(a: Any, b: Any, c: Any) -> Any:
        return jnp.where(c > 0.97, jnp.nan, linear(a, b, c))

    def seldom(a: Any, b: Any, c: Any) -> Any:
        # Levels of Morris's design are thirds: one corner of the cube.
        return jnp.where((a > 0.97) & (b > 0.97) & (c > 0.97), jnp.nan, linear(a, b, c))

    found = global_sensitivity(failing if method == "sobol" else seldom, None, CUBE, method=method, count=count)
    block = 5 if method == "sobol" else 4
    bad = np.asarray(found.runs["result"]).reshape(-1, block) != 0
    assert found.failed == bad.sum() > 0
    assert found.dropped == block * bad.any(axis=1).sum()
    assert f"{found.failed} runs failed; with them {found.dropped}" in found.remarks[0]
    name, expected = ("S1", np.array([4.0, 9.0, 0.0]) / 13.0) if method == "sobol" else ("mu_star", [2.0, 3.0, 0.0])
    np.testing.assert_allclose(found.overall["value"].indices[name], expected, atol=0.1 if method == "sobol" else 1e-9)


def test_too_many_failures_are_refused() -> None:
    def failing(a: Any) -> Any:
        return jnp.where(a > 0.8, jnp.nan, a)

    with pytest.raises(ValueError, match=r"% of the design is lost, more than 20 %: \d+ x The function gave NaN"):
        global_sensitivity(failing, None, {"a": (0.0, 1.0)}, count=64)


def steady(run: jms.Trajectory) -> Any:
    return 0.0 * run.q[-1, 0]


OBSERVE = {"period": metrics.period("q[0]"), "events": (metrics.period(), "s"), "steady": steady}


def of_belts(method: str, count: int, **ranges: tuple[float, float]) -> GlobalSensitivity:
    """A mass let go beside the middle Fc/k of its swing, on belts slow and fast."""
    named = {"friction.belt_velocity": ranges["belt"], "k": ranges["k"]}
    options: dict[str, Any] = {"t1": 10.0, "ts": jnp.linspace(0.0, 10.0, 401), "max_events": 64}
    scene = problems.belt_oscillator.scene()
    return global_sensitivity(scene, OBSERVE, named, method=method, count=count, q0=[0.06], qd0=[0.0], **options)


@pytest.fixture(scope="module", params=["sobol", "morris"])
def belt(request: pytest.FixtureRequest) -> GlobalSensitivity:
    return of_belts(request.param, 256 if request.param == "sobol" else 40, belt=(0.03, 0.2), k=(80.0, 120.0))


def test_belts_that_stick_and_that_do_not(belt: GlobalSensitivity) -> None:
    """It sticks where its swing reaches the velocity of the belt: |q0 - Fc/k| sqrt(k/m) > belt."""
    k, v = (np.asarray(belt.runs[name]) for name in ("k", "friction.belt_velocity"))
    sticks = np.abs(0.06 - 5.0 / k) * np.sqrt(k) > v
    assert set(belt.shares) == {"slips for good", "stick-slip cycle"}
    np.testing.assert_allclose(belt.shares["stick-slip cycle"], sticks.mean(), rtol=1e-12)
    period = np.asarray(belt.runs["events"])
    np.testing.assert_array_equal(np.isfinite(period), sticks)
    exact = problems.belt_oscillator.cycle(m=1.0, k=k, belt=v, Fc=5.0, Fs=8.0)
    np.testing.assert_allclose(period[sticks], np.asarray(exact.period)[sticks], rtol=1e-4)
    assert any("events is not defined" in remark for remark in belt.remarks)
    assert "steady is the same in all runs." in belt.remarks


def test_within_slip_the_stiffness_alone_matters(belt: GlobalSensitivity) -> None:
    index = "S1" if belt.method == "sobol" else "mu_star"
    # Where the mass slips for good it swings freely, with the period 2 pi sqrt(m/k).
    free = belt.within["slips for good"]["period"].indices[index]
    if belt.method == "sobol":
        np.testing.assert_allclose(free[1], 1.0, atol=0.02)
        assert belt.overall["period"].indices["S1"][1] < 0.2
        # Which it is they decide together.
        together = belt.membership["slips for good"].indices
        assert np.all(together["ST"] - together["S1"] > 0.2)
    else:
        np.testing.assert_allclose(free[0], 0.0, atol=1e-4)
        # Steps are two thirds of the range, from either end.
        chords = [abs(2 * np.pi * (x**-0.5 - (x + 80 / 3) ** -0.5)) * 1.5 for x in (80.0, 280 / 3)]
        assert min(chords) - 1e-4 < free[1] < max(chords) + 1e-4
        assert belt.crossings is not None
        assert np.all(belt.crossings > 0.1)
    assert np.isnan(belt.overall["events"].indices[index]).all()
    assert belt.within["stick-slip cycle"]["events"].indices[index][0] > 0.5


def test_table_and_figure(belt: GlobalSensitivity) -> None:
    table, text = belt.table(), str(belt)
    index = "S1" if belt.method == "sobol" else "mu_star"
    row = table[(table.observable == "period") & (table.runs == "within 'slips for good'") & (table.parameter == "k")]
    assert row[index].item() == belt.within["slips for good"]["period"].indices[index][1]
    assert row[f"{index}_conf"].item() == belt.within["slips for good"]["period"].errors[index][1]
    assert len(table) == 2 * len(belt.groups())
    assert ("period [s], all runs" in text) == (belt.method == "morris")
    assert "events" in text
    assert "all runs (0 " in text
    assert "MORE THAN ONE KIND OF MOTION (2)" in text
    figure = plot.indices_figure(belt)
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    assert titles == ["which parameters decide the kind of motion", "period", "events", "steady"]
    widths = [bar.get_width() for bar in figure.axes[1].patches if isinstance(bar, Rectangle)]
    assert belt.within["slips for good"]["period"].indices[index][1] in widths


def test_one_kind_of_motion() -> None:
    """Where all of them stick there are no classes: effects of the belt are those of the closed form."""
    found = of_belts("morris", 8, belt=(0.06, 0.12), k=(114.0, 120.0))
    assert found.shares == {"stick-slip cycle": 1.0}
    assert not found.membership
    assert found.crossings is None
    assert found.remarks == ("steady is the same in all runs.",)
    numbers = {"m": 1.0, "k": 117.0, "Fc": 5.0, "Fs": 8.0}
    exact = [problems.belt_oscillator.cycle(belt=0.06 + 0.06 * x / 3, **numbers).period for x in range(4)]
    chords = sorted(float((exact[i] - exact[i + 2]) * 1.5) for i in (0, 1))
    assert 0.9 * chords[0] < found.overall["events"].indices["mu_star"][0] < 1.1 * chords[1]
    assert len(plot.indices_figure(found).axes) == 3


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"method": "fast"}, "'sobol' or 'morris'"),
        ({"count": 100}, "take 64 or 128"),
        ({"method": "morris", "count": 3}, "at least 8"),
        ({"confidence": 1.0}, "between 0 and 1"),
        ({"ranges": {"a": (1.0, 0.0)}}, "range of 'a'"),
        ({"ranges": {"a": scipy.stats.norm(0.0, 1.0), "b": (0.0, 1.0), "c": (0.0, 1.0)}, "method": "morris"}, "ends"),
        ({"by": "motion"}, "the function returns: value"),
        ({"by": "value"}, "name a quantity"),
    ],
)
def test_garbage_is_refused(more: dict[str, Any], text: str) -> None:
    given = {"ranges": CUBE, "count": 16} | more
    with pytest.raises(ValueError, match=text):
        global_sensitivity(linear, None, given.pop("ranges"), **given)


def test_what_is_no_number_is_refused() -> None:
    scene, ranges = problems.ramped_box.scene(jms.Viscous(0.1)), {"m": (1.0, 3.0)}
    with pytest.raises(ValueError, match="observed is: v"):
        global_sensitivity(scene, {"v": "qd[0]"}, ranges, by="kind", q0=[0.0], qd0=[0.0], t1=0.1)
    with pytest.raises(ValueError, match="one number of each run, but 'value' has the dimensions"):
        global_sensitivity(lambda m: jnp.stack([m, m]), None, ranges, count=2)
