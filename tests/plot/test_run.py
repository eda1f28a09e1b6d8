"""Runs as figures, films and tables: names, units, stick, and what a notebook gets to see."""

import base64
import io
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from IPython.core.formatters import DisplayFormatter
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from jaxmodsim import Friction, LuGre, Scene, Trajectory, Viscous, plot, problems, simulate
from jaxmodsim.problems import belt_oscillator

TS = np.linspace(0.0, 2.0, 41)


@pytest.fixture(scope="module")
def belt() -> Trajectory:
    return simulate(belt_oscillator.scene(), [0.0], [0.1], 2.0, ts=TS)


def two_masses(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, p
    return 0.5 * jnp.sum(qd**2) - jnp.cos(q[1]) * q[0] ** 2


@pytest.fixture(scope="module")
def mixed() -> Trajectory:
    """Two units, a vector of friction, and one that has no events."""
    law = LuGre(sigma0=100.0, sigma1=1.0, sigma2=0.1, Fc=0.1, Fs=0.1, vs=0.1)
    effects = (
        Friction(law, along=lambda q: jnp.stack([q[0], 0.1 * q[1]]), name="table"),
        Friction(Viscous(0.3), along=lambda q: q[1], name="joint"),
        Friction(Viscous(0.3), along=lambda q: 2.0 * q[1], name="gear"),
    )
    scene = Scene(two_masses, effects=effects, coordinates=("x [m]", "phi [rad]"))
    return simulate(scene, [0.3, 0.1], [0.0, 0.0], 2.0, ts=TS)


def test_tables_have_names_and_units(belt: Trajectory, mixed: Trajectory) -> None:
    table, dataset = belt.to_dataframe(), belt.to_xarray()
    assert list(table.columns) == ["x", "x_dot", "friction", "friction_mode"] == list(dataset.data_vars)
    assert table.attrs["units"] == {"time": "s", "x": "m", "x_dot": "m/s", "friction": "N", "friction_mode": "1"}
    assert dataset["x_dot"].attrs["units"] == "m/s"
    assert (table.index.name, dataset["x"].dims) == ("time", ("time",))
    np.testing.assert_array_equal(table["x"], belt.q[:, 0])
    np.testing.assert_array_equal(dataset["friction"], belt.forces["friction"])
    np.testing.assert_array_equal(dataset["time"], TS)
    units = mixed.to_dataframe().attrs["units"]
    assert (units["table[0]"], units["joint"], units["gear"]) == ("N", "N m", "N or N m")
    nameless = simulate(Scene(two_masses), [0.3, 0.1], [0.0, 0.0], 2.0, ts=TS).to_dataframe()
    assert list(nameless.columns) == ["q[0]", "q[1]", "qd[0]", "qd[1]"]
    with pytest.raises(ValueError, match="A table of a run needs numbers"):
        jax.jit(lambda run: run.to_dataframe().size)(belt)


def test_a_run_that_ended_early_has_the_rows_it_reached() -> None:
    run = simulate(belt_oscillator.scene(), [0.0], [0.1], 2.0, ts=TS, max_steps=12, throw=False)
    assert 0 < len(run.to_dataframe()) < len(TS)
    assert np.isfinite(run.to_dataframe()).all(axis=None)


def test_figure_of_a_run(belt: Trajectory, mixed: Trajectory) -> None:
    figure = plot.run(belt)
    assert [axis.get_ylabel() for axis in figure.axes] == ["x [m]", "x_dot [m/s]", "friction [N]"]
    assert figure.axes[-1].get_xlabel() == "time [s]"
    assert [axis.get_title(loc="left") for axis in figure.axes] == ["a", "b", "c"]
    # It sticks to the belt until k x = Fs, and in slip for the time that the closed form says.
    numbers = belt_oscillator.PARAMS
    breaks = numbers["Fs"] / numbers["k"] / numbers["belt"]
    slip = float(belt_oscillator.cycle(**numbers).slip)
    shaded = [patch.get_x() for axis in figure.axes for patch in axis.patches if isinstance(patch, Rectangle)]
    assert len(shaded) == 3 * 2
    np.testing.assert_allclose(sorted(set(np.round(shaded, 6))), [0.0, breaks + slip], atol=1e-5)
    panels = plot.run(mixed).axes
    assert [axis.get_ylabel() for axis in panels] == [
        "x [m]", "phi [rad]", "x_dot [m/s]", "phi_dot [rad/s]", "[N]", "joint [N m]", "gear [N or N m]",
    ]  # fmt: skip
    assert [line.get_label() for line in panels[4].lines[:2]] == ["table[0]", "table[1]"]


def test_what_cannot_be_drawn_says_why(belt: Trajectory) -> None:
    end = simulate(belt_oscillator.scene(), [0.0], [0.1], 0.5)
    with pytest.raises(ValueError, match=r"this one has 1: pass the times, as in simulate\(\.\.\., ts="):
        plot.run(end)
    with pytest.raises(ValueError, match="needs one run that was kept at two times or more"):
        plot.animate(end, lambda q: jnp.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"shape \[points, 2\] or \[points, 3\].*one has the shape \(2,\)"):
        plot.animate(belt, lambda q: jnp.zeros(2))
    with pytest.raises(ValueError, match="finite places"):
        plot.animate(belt, lambda q: jnp.full((1, 2), jnp.nan))
    with pytest.raises(ValueError, match="has no signal 'torque': its signals are x, x_dot, friction, friction_mode"):
        plot.animate(belt, lambda q: jnp.zeros((1, 2)), signals=("torque",))
    with pytest.raises(ValueError, match="more than 5000: pass a larger speed"):
        plot.animate(belt, lambda q: jnp.zeros((1, 2)), speed=1e-3)
    with pytest.raises(ValueError, match=r"ends in \.gif, \.webp or \.html, but 'film\.avi' was given"):
        plot.animate(belt, lambda q: jnp.zeros((1, 2))).save("film.avi")


def test_films(belt: Trajectory, tmp_path: Path) -> None:
    def block(q: Any, p: Any) -> Any:
        del p
        return jnp.stack([jnp.zeros(2), jnp.stack([q[0], 0.0 * q[0]])]), jnp.array([[0.0, 1.0]])

    film = plot.animate(belt, block, signals=("friction", "x"), fps=4, speed=0.5)
    film.save(tmp_path / "film.gif")
    film.save(tmp_path / "film.webp")
    film.save(str(tmp_path / "film.html"))
    for name in ("film.gif", "film.webp"):
        with Image.open(tmp_path / name) as image:
            assert getattr(image, "n_frames", 0) == 2 * 2 * 4 + 1
    html = (tmp_path / "film.html").read_text()
    frames = json.loads(re.findall(r"const frames = (.+);", html)[0])
    assert len(frames) == 17
    assert html.count("<button") == 1
    assert "https:" not in html
    # The page composes what the image file shows.
    back = re.findall(r"url\(data:image/webp;base64,(.+?)\)", html)[0]
    shown = [Image.open(io.BytesIO(base64.b64decode(data))).convert("RGBA") for data in (back, *frames)]
    with Image.open(tmp_path / "film.webp") as image:
        for i in (0, 8, 16):
            image.seek(i)
            composed = Image.alpha_composite(shown[0], shown[1 + i])
            np.testing.assert_array_equal(np.asarray(composed), np.asarray(image.convert("RGBA")))
    in_space = plot.animate(belt, lambda q: jnp.stack([jnp.stack([q[0], q[0] ** 2, 1.0 - q[0]])]), fps=1)
    in_space.save(tmp_path / "space.gif")
    with Image.open(tmp_path / "space.gif") as image:
        assert image.size == (500, 500)


def test_a_film_of_five_seconds_is_small(belt: Trajectory) -> None:
    film = plot.animate(belt, lambda q: jnp.stack([jnp.zeros(2), q[0] * jnp.ones(2)]), signals=("x",), speed=0.4)
    assert len(film._repr_html_()) < 1_000_000


def test_a_notebook_shows_figures_and_films(belt: Trajectory) -> None:
    figure = plot.run(belt)
    assert isinstance(figure, Figure)
    shown, _ = DisplayFormatter().format(figure)
    assert shown["image/png"][:4] == b"\x89PNG"
    shown, _ = DisplayFormatter().format(plot.animate(belt, lambda q: jnp.zeros((1, 2)), fps=1))
    assert "data:image/webp" in shown["text/html"]


def test_no_figure_needs_pyplot() -> None:
    shown = "plot.Figure()._repr_png_()[:4]"
    code = f"import sys; from jaxmodsim import plot; print({shown}, 'matplotlib.pyplot' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == r"b'\x89PNG' False" + "\n"
    files = Path(plot.__file__ or "").parent.glob("*.py")
    assert [file.name for file in files if "matplotlib.figure" in file.read_text()] == ["_style.py"]


def test_places_of_a_mechanism_may_need_its_numbers() -> None:
    run = simulate(problems.four_bar.scene(), *problems.four_bar.state(0.7, 8.0), 0.2, ts=jnp.linspace(0.0, 0.2, 5))
    film = plot.animate(run, lambda q, p: jnp.stack([p["a"] * jnp.stack([jnp.cos(q[0]), 0.0, jnp.sin(q[0])])]), fps=20)
    assert "data:image/webp" in film._repr_html_()
