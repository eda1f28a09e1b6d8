"""Maps of sweeps: axes, colours, runs that failed; and the boundary of stick-slip against runs and its closed form."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

import jaxmodsim as jms
from jaxmodsim.plot import map2d
from jaxmodsim.problems import belt_oscillator

K, V = np.geomspace(10.0, 1000.0, 5), np.linspace(0.1, 0.4, 4)
NUMBERS = {"m": 1.3, "c": 1.7, "Fc": 4.0, "Fs": 7.0}


def dataset(**changes: Any) -> xr.Dataset:
    """Over k (geometric) and v (even): amplitude, a class, a count, and something over time; three runs are bad."""
    amplitude = np.arange(20.0).reshape(5, 4) / 7.0
    result = np.zeros((5, 4), int)
    result[0, 0], result[0, 1], result[4, 3] = 1, 1, -1
    amplitude[result != 0] = np.nan
    kind = np.where(result != 0, np.nan, np.broadcast_to(V > 0.25, (5, 4)))
    values = {
        "amplitude": (("k", "v"), amplitude, {"units": "m"}),
        "kind": (("k", "v"), kind),
        "count": (("k", "v"), kind + 2.0),
        "x": (("k", "v", "time"), np.zeros((5, 4, 3))),
        "mean": (("k",), np.zeros(5)),
        "result": (
            ("k", "v"),
            result,
            {"flag_values": [0, 1], "flag_meanings": ["It went well.", "The limit was met: raise it."]},
        ),
    }
    coordinates = {
        "k": ("k", K, {"units": "N/m", "long_name": "stiffness"}),
        "v": ("v", V, {"units": "m/s"}),
        "load": ("v", 2.0 * V),
        "time": np.arange(3.0),
    }
    return xr.Dataset(values | changes, coordinates)


def legend(figure: Figure) -> dict[str, Any]:
    """Labels of the legend with the colour of each."""
    (found,) = figure.legends
    pairs = zip(found.get_texts(), found.legend_handles, strict=True)
    return {text.get_text(): handle for text, handle in pairs}


def colour_at(figure: Figure, row: int, column: int) -> tuple[float, ...]:
    """Colour of a cell: that of the topmost mesh that has one there."""
    figure.draw_without_rendering()
    colour = (0.0, 0.0, 0.0, 0.0)
    meshes: list[Any] = list(figure.axes[0].collections)
    for mesh in meshes:
        mesh.update_scalarmappable()
        shape = np.shape(mesh.get_array())
        found = np.asarray(mesh.get_facecolor()).reshape(*shape, 4)[row, column]
        colour = tuple(found) if found[3] > 0 else colour
    return colour


def test_axes_have_names_units_scales_and_edges() -> None:
    figure = map2d(dataset(), "amplitude", title="a title")
    axes, bar = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("v [m/s]", "stiffness [N/m]")
    assert (axes.get_xscale(), axes.get_yscale()) == ("linear", "log")
    assert (bar.get_ylabel(), axes.get_title()) == ("amplitude [m]", "a title")
    np.testing.assert_allclose(axes.get_xlim(), (0.05, 0.45))
    np.testing.assert_allclose(axes.get_ylim(), (10.0 / 10**0.25, 1000.0 * 10**0.25))
    mesh: Any = axes.collections[0]
    # Half way between the values: in their logarithms on the logarithmic axis.
    np.testing.assert_allclose(mesh.get_coordinates()[1:-1, 0, 1], np.sqrt(K[1:] * K[:-1]))
    np.testing.assert_allclose(mesh.get_coordinates()[0, 1:-1, 0], 0.5 * (V[1:] + V[:-1]))
    np.testing.assert_array_equal(np.ma.getmaskarray(mesh.get_array()), dataset()["result"] != 0)


def test_axes_can_be_chosen_and_can_fall() -> None:
    axes = map2d(dataset(), "amplitude", x="k", y="load").axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("stiffness [N/m]", "load")
    other = map2d(dataset().isel(k=slice(None, None, -1)), "amplitude", y="load").axes[0]
    assert (other.get_xlim(), other.get_ylim()) == (axes.get_xlim(), axes.get_ylim())
    turned = map2d(dataset().rename(k="place").assign_coords(place=("place", [1, 2, 5, 10, 20])), "amplitude", y="v")
    assert (turned.axes[0].get_xlabel(), turned.axes[0].get_xscale()) == ("place", "log")
    bare = map2d(dataset().drop_vars("k"), "amplitude").axes[0]
    np.testing.assert_allclose(bare.get_ylim(), (-0.5, 4.5))


def test_runs_without_a_number_are_counted_by_reason() -> None:
    entries = legend(map2d(dataset(), "amplitude"))
    assert list(entries) == ["2 of 20 failed: The limit was met", "1 of 20 not run"]
    figure = map2d(dataset(), "amplitude")
    failed, unrun = (tuple(handle.get_facecolor()) for handle in entries.values())
    assert colour_at(figure, 0, 0) == colour_at(figure, 0, 1) == failed
    assert colour_at(figure, 4, 3) == unrun
    assert colour_at(figure, 2, 2) not in (failed, unrun)
    strange = dataset()
    strange["amplitude"][1, 2] = np.inf
    assert "1 of 20 failed: not a number" in legend(map2d(strange, "amplitude"))
    assert not map2d(dataset().drop_vars("result").fillna(0.0), "amplitude").legends


def test_classes_have_a_legend_instead_of_a_bar() -> None:
    names = {0: "slides", 1: "sticks", 2: "flies"}
    figure = map2d(dataset(), "kind", classes=names)
    assert len(figure.axes) == 1
    entries = legend(figure)
    assert list(entries)[:2] == ["slides", "sticks"]
    assert len(entries) == 4
    assert colour_at(figure, 2, 0) == tuple(entries["slides"].get_facecolor())
    assert colour_at(figure, 2, 3) == tuple(entries["sticks"].get_facecolor())
    flagged = dataset()
    flagged["kind"].attrs.update(flag_values=[0, 1], flag_meanings=["no", "yes"])
    assert list(legend(map2d(flagged, "kind")))[:2] == ["no", "yes"]
    counted = map2d(dataset(), "count")
    assert list(legend(counted))[:2] == ["2", "3"]
    assert counted.legends[0].get_title().get_text() == "count"


def test_map_of_result_codes() -> None:
    entries = legend(map2d(dataset(), "result"))
    assert list(entries) == ["It went well.", "The limit was met: raise it.", "1 of 20 not run"]


def test_curves_are_overlaid_and_large_maps_are_images() -> None:
    figure = map2d(dataset(), "kind", boundary={"exact": (V, 100.0 * V), "rough": (V, 50.0 * V)})
    exact, rough = figure.axes[0].get_lines()
    np.testing.assert_array_equal(exact.get_ydata(), 100.0 * V)
    assert exact.get_linestyle() != rough.get_linestyle()
    assert to_rgba(legend(figure)["exact"].get_color()) == to_rgba(exact.get_color())
    assert not figure.axes[0].collections[0].get_rasterized()
    large = xr.Dataset({"a": (("u", "w"), np.random.default_rng(0).normal(size=(60, 60)))})
    assert map2d(large, "a").axes[0].collections[0].get_rasterized()


def each_mistake() -> Iterator[tuple[str, Any, dict[str, Any], str]]:
    yield "name", dataset(), {"name": "ampltude"}, "no variable 'ampltude'.*Did you mean 'amplitude'"
    yield "no dataset", {"a": 1}, {"name": "a"}, "needs a Dataset"
    yield "three", dataset(), {"name": "x"}, r"has 3: k, v, time.*dataset.isel\({'time': -1}\)"
    yield "the third", dataset(), {"name": "x", "x": "time"}, r"isel\({'v': -1}\)"
    yield "one", dataset(), {"name": "mean"}, "two dimensions, but 'mean' has 1: k"
    yield "axis", dataset(), {"name": "kind", "x": "velocity"}, "no axis 'velocity'; there are: k, v, load"
    yield "twice", dataset(), {"name": "kind", "x": "v", "y": "load"}, "both lie along the dimension 'v'"
    shuffled = dataset().isel(k=[0, 2, 1, 3, 4])
    yield "order", shuffled, {"name": "kind"}, r"axis 'k' must be monotonic.*sortby\('k'\)"
    yield "text", dataset().assign_coords(k=list("abcde")), {"name": "kind"}, "axis 'k' needs numbers"
    yield "single", dataset().isel(k=[0]), {"name": "kind"}, "axis 'k' has a single value"
    yield "classes", dataset(), {"name": "kind", "classes": {0: "slides"}}, "the value 1, but only 0"


@pytest.mark.parametrize(
    ("given", "arguments", "text"), [x[1:] for x in each_mistake()], ids=[x[0] for x in each_mistake()]
)
def test_mistakes_raise_errors_that_name_the_cause(given: Any, arguments: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        map2d(given, **arguments)


@pytest.mark.parametrize("zeta", [0.003, 0.1, 0.5, 0.9])
def test_onset_speed_is_where_the_free_oscillation_just_reaches_the_belt_velocity(zeta: float) -> None:
    """The free swing itself, on a fine grid of time: its velocity past the first minimum, over that of the belt."""
    numbers = NUMBERS | {"c": 2.0 * zeta * np.sqrt(1.3 * 60.0)}
    w, u = np.sqrt(60.0 / 1.3), np.sqrt(1.0 - zeta**2)
    s = np.linspace(np.pi / 2, 2.0 * np.pi, 200001) / u
    limit = float(belt_oscillator.onset_speed(k=60.0, **numbers))
    for belt, again in ((limit * (1.0 - 1e-6), True), (limit * (1.0 + 1e-6), False)):
        deceleration = (numbers["Fs"] - numbers["Fc"]) / (1.3 * w)
        velocity = np.exp(-zeta * s) * (belt * np.cos(u * s) + (zeta * belt - deceleration) / u * np.sin(u * s))
        assert (velocity.max() > belt) == again
    slope = jax.grad(lambda k: belt_oscillator.onset_speed(k=k, **numbers))(60.0)
    ahead, behind = (float(belt_oscillator.onset_speed(k=60.0 + h, **numbers)) for h in (1e-3, -1e-3))
    np.testing.assert_allclose(slope, (ahead - behind) / 2e-3, rtol=1e-7)


def test_onset_speed_at_the_limits_of_damping() -> None:
    """Small damping has a formula, critical damping no stick-slip; arrays broadcast, float32 is kept."""
    k = np.array([1e2, 1e6])
    small = belt_oscillator.onset_speed(k=k, **(NUMBERS | {"c": 1e-4}))
    zeta = 1e-4 / (2.0 * np.sqrt(1.3 * k))
    np.testing.assert_allclose(small, 3.0 / np.sqrt(4.0 * np.pi * zeta * k * 1.3), rtol=1e-4)
    critical = 2.0 * np.sqrt(1.3 * 100.0)
    found = belt_oscillator.onset_speed(
        k=100.0, **(NUMBERS | {"c": np.array([0.999 * critical, critical, 10.0 * critical])})
    )
    assert 0.0 < found[0] < 1e-20
    np.testing.assert_array_equal(found[1:], 0.0)
    single = {name: np.float32(x) for name, x in NUMBERS.items()}
    low = belt_oscillator.onset_speed(k=np.float32(100.0), **single)
    assert low.dtype == jnp.float32
    np.testing.assert_allclose(low, belt_oscillator.onset_speed(k=100.0, **NUMBERS), rtol=1e-5)


def first_slip(k: Any, belt: Any) -> jms.Trajectory:
    law = jms.Coulomb(NUMBERS["Fc"], NUMBERS["Fs"])
    scene = belt_oscillator.scene(law, m=NUMBERS["m"], k=k, belt=belt, c=NUMBERS["c"])
    radian = jnp.sqrt(NUMBERS["m"] / k)
    begins = (NUMBERS["Fs"] - NUMBERS["c"] * belt) / k - 0.1 * radian * belt
    return jms.simulate(scene, jnp.stack([begins]), jnp.stack([belt]), 8.0 * radian, throw=False)


def test_runs_stick_again_on_one_side_of_the_boundary() -> None:
    k, belt = np.geomspace(5.0, 5e3, 12), np.geomspace(0.05, 0.5, 10)
    runs = jms.sweep(first_slip, {"belt": belt, "k": k}, {"changes": lambda run: run.stats["num_events"]})
    limit = np.asarray(belt_oscillator.onset_speed(k=k, **NUMBERS))
    away = np.abs(belt[:, None] / limit - 1.0) > 1e-3
    assert (runs["result"] == 0).all()
    assert away.mean() > 0.9
    again = runs["changes"].values >= 2
    assert (runs["changes"].values[~again] == 1).all()
    assert 20 < again.sum() < 100
    np.testing.assert_array_equal(again[away], (belt[:, None] < limit)[away])
