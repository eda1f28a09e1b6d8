"""Indices over ranges of parameters against closed forms."""

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


def test_ishigami() -> None:
    """Sobol' indices of the Ishigami function (a = 7, b = 0.1), and the intervals that hold them."""
    found = global_sensitivity(ishigami, None, {name: (-np.pi, np.pi) for name in "abc"}, count=1024)
    exact = {"S1": np.array([0.3139, 0.4424, 0.0]), "ST": np.array([0.5576, 0.4424, 0.2437])}
    indices, errors, runs = found.indices["value"]
    for name, values in exact.items():
        np.testing.assert_allclose(indices[name], values, atol=0.02)
        assert np.all(np.abs(indices[name] - values) < errors[name])
        assert np.all(errors[name] < 0.1)
    assert runs == 1024 * 5
    assert found.motions == {}
    assert not found.warnings
    again = global_sensitivity(ishigami, None, {name: (-np.pi, np.pi) for name in "abc"}, count=1024)
    np.testing.assert_array_equal(again.indices["value"].errors["S1"], errors["S1"])


def test_ranges_are_distributions() -> None:
    """The variance of 2 a - 3 b over a uniform, b logarithmic, is shared by 4 var a and 9 var b."""
    low, high = 0.1, 2.0
    ranges = {"a": scipy.stats.norm(1.0, 0.5), "b": (low, high, "log"), "c": (0.0, 1.0)}
    found = global_sensitivity(linear, None, ranges, count=512)
    log = np.log(high / low)
    mean, square = (high - low) / log, (high**2 - low**2) / (2 * log)
    parts = np.array([4 * 0.25, 9 * (square - mean**2), 0.0])
    np.testing.assert_allclose(found.indices["value"].values["S1"], parts / parts.sum(), atol=0.02)


def test_morris_of_a_linear_function() -> None:
    """Elementary effects are the slopes over the ranges, each time."""
    found = global_sensitivity(
        linear, None, {"a": (0.0, 1.0), "b": (0.0, 2.0), "c": (1.0, 9.0)}, method="morris", count=9
    )
    indices, errors, runs = found.indices["value"]
    np.testing.assert_allclose(indices["mu"], [2.0, -6.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(indices["mu_star"], [2.0, 6.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(indices["sigma"], 0.0, atol=1e-12)
    np.testing.assert_allclose(errors["mu_star"], 0.0, atol=1e-12)
    assert runs == 9 * 4


def test_morris_as_salib_has_it() -> None:
    from SALib.analyze import morris

    found = global_sensitivity(ishigami, None, {name: (-np.pi, np.pi) for name in "abc"}, method="morris", count=40)
    points = np.stack([np.asarray(found.runs[name]) for name in "abc"], axis=1) / (2 * np.pi) + 0.5
    problem = {"num_vars": 3, "names": list("abc"), "bounds": [[0.0, 1.0]] * 3}
    known = morris.analyze(problem, points, np.asarray(found.runs["value"]), seed=1, num_resamples=1000)
    for name in ("mu", "mu_star", "sigma"):
        np.testing.assert_allclose(found.indices["value"].values[name], np.asarray(known[name]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.indices["value"].errors["mu_star"], known["mu_star_conf"], rtol=0.1, atol=1e-12)


def test_the_kind_of_motion_is_an_observable() -> None:
    """Of a function with a leap, a alone decides on which side of it a run lies."""

    def leaping(a: Any, b: Any, c: Any) -> Any:
        return {"y": jnp.where(a > 0.6, 100.0 + b, c), "kind": 1.0 * (a > 0.6)}

    found = global_sensitivity(leaping, None, CUBE, count=256)
    np.testing.assert_allclose(found.indices["y"].values["ST"], [1.0, 0.0, 0.0], atol=0.01)
    np.testing.assert_allclose(found.indices["kind"].values["S1"], [1.0, 0.0, 0.0], atol=0.02)


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
    assert f"{found.failed} runs failed; {found.dropped} runs of their blocks" in found.warnings[0]
    name, expected = ("S1", np.array([4.0, 9.0, 0.0]) / 13.0) if method == "sobol" else ("mu_star", [2.0, 3.0, 0.0])
    np.testing.assert_allclose(found.indices["value"].values[name], expected, atol=0.1 if method == "sobol" else 1e-9)


def test_too_many_failures_are_refused() -> None:
    def failing(a: Any) -> Any:
        return jnp.where(a > 0.8, jnp.nan, a)

    with pytest.raises(ValueError, match=r"% of the design, more than 20 %: \d+ x The function gave NaN"):
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
    assert set(belt.motions) == {"slips for good", "stick-slip cycle"}
    np.testing.assert_allclose(belt.motions["stick-slip cycle"], sticks.mean(), rtol=1e-12)
    period = np.asarray(belt.runs["events"])
    np.testing.assert_array_equal(np.isfinite(period), sticks)
    exact = problems.belt_oscillator.cycle(m=1.0, k=k, belt=v, Fc=5.0, Fs=8.0)
    np.testing.assert_allclose(period[sticks], np.asarray(exact.period)[sticks], rtol=1e-4)
    index = "S1" if belt.method == "sobol" else "mu_star"
    assert np.isnan(belt.indices["events"].values[index]).all()
    assert any(f"events is NaN in {(~sticks).sum()} of" in warning for warning in belt.warnings)
    assert "steady is the same in all runs." in belt.warnings
    assert belt.warnings[0].startswith("2 KINDS OF MOTION")


def test_table_and_figure(belt: GlobalSensitivity) -> None:
    table, text = belt.table(), str(belt)
    index = "S1" if belt.method == "sobol" else "mu_star"
    row = table[(table.observable == "period") & (table.parameter == "k")]
    assert row[index].item() == belt.indices["period"].values[index][1]
    assert row[f"{index}_conf"].item() == belt.indices["period"].errors[index][1]
    assert len(table) == 2 * 3
    assert ("period [s] (" in text) == (belt.method == "morris")
    assert "events" in text
    assert ": no indices" in text
    assert "2 KINDS OF MOTION" in text
    figure = plot.indices_figure(belt)
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    assert titles == ["period", "events", "steady"]
    widths = [bar.get_width() for bar in figure.axes[0].patches if isinstance(bar, Rectangle)]
    assert belt.indices["period"].values[index][1] in widths


def test_one_kind_of_motion() -> None:
    """Where all runs stick, the effects of the belt are those of the closed form."""
    found = of_belts("morris", 8, belt=(0.06, 0.12), k=(114.0, 120.0))
    assert found.motions == {"stick-slip cycle": 1.0}
    assert found.warnings == ("steady is the same in all runs.",)
    numbers = {"m": 1.0, "k": 117.0, "Fc": 5.0, "Fs": 8.0}
    exact = [problems.belt_oscillator.cycle(belt=0.06 + 0.06 * x / 3, **numbers).period for x in range(4)]
    chords = sorted(float((exact[i] - exact[i + 2]) * 1.5) for i in (0, 1))
    assert 0.9 * chords[0] < found.indices["events"].values["mu_star"][0] < 1.1 * chords[1]
    assert len(plot.indices_figure(found).axes) == 3


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"method": "fast"}, "'sobol' or 'morris'"),
        ({"count": 100}, "use 64 or 128"),
        ({"method": "morris", "count": 3}, "integer >= 8"),
        ({"confidence": 1.0}, "between 0 and 1"),
        ({"ranges": {"a": (1.0, 0.0)}}, "range of 'a'"),
        (
            {"ranges": {"a": scipy.stats.norm(0.0, 1.0), "b": (0.0, 1.0), "c": (0.0, 1.0)}, "method": "morris"},
            "bounded",
        ),
    ],
)
def test_garbage_is_refused(more: dict[str, Any], text: str) -> None:
    given = {"ranges": CUBE, "count": 16} | more
    with pytest.raises(ValueError, match=text):
        global_sensitivity(linear, None, given.pop("ranges"), **given)


def test_what_is_no_number_is_refused() -> None:
    with pytest.raises(ValueError, match="one number for each run, but 'value' also has the dimensions"):
        global_sensitivity(lambda m: jnp.stack([m, m]), None, {"m": (1.0, 3.0)}, count=2)
