"""A mechanism in motion."""

import base64
import io
import itertools
import json
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, final

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.patches import Polygon
from PIL import Image
from scipy.interpolate import CubicHermiteSpline

from .._core.arguments import as_float, as_whole
from .._core.position import as_position_fn
from ..simulation import Trajectory
from ._style import BLUE, GREY, Figure, with_unit

_MOST_FRAMES = 5000
_PAGE = """<div id="FILM">
<img alt="film" style="max-width: 100%; background: 0 0/100% url(data:image/webp;base64,BACK)"><br>
<button type="button">Play</button> <input type="range" min="0" value="0" aria-label="time" style="width: 60%"></div>
<script>
(() => {
  const [picture, button, time] = document.getElementById("FILM").querySelectorAll("img, button, input");
  const frames = FRAMES;
  let timer;
  const show = () => (picture.src = "data:image/webp;base64," + frames[time.value]);
  const step = () => { time.value = (Number(time.value) + 1) % frames.length; show(); };
  time.max = frames.length - 1;
  time.oninput = show;
  button.onclick = () => {
    if (timer) timer = clearInterval(timer);
    else timer = setInterval(step, 1000 / FPS);
    button.textContent = timer ? "Pause" : "Play";
  };
  show();
})();
</script>
"""


@final
class Animation:
    """Frames of a mechanism, drawn on demand; a notebook shows them with a button and a slider."""

    def __init__(
        self,
        t: np.ndarray,
        chains: list[np.ndarray],
        signals: dict[str, tuple[np.ndarray, np.ndarray]],
        fps: int,
    ) -> None:
        """Places `[frames, points, 2 or 3]` of each chain at the times `t`; times and values of signals by label."""
        self._t, self._chains, self._signals, self._fps = t, chains, signals, fps

    def save(self, path: str | Path) -> None:
        """Write a file: an image that moves (`.gif`, `.webp`), or an HTML page with a button and a slider.

        **Raises:**

        - `ValueError` for another ending.
        """
        path = Path(path)
        if path.suffix in (".gif", ".webp"):
            first, *rest = self._frames()
            first.save(path, save_all=True, append_images=rest, duration=round(1000 / self._fps), loop=0, lossless=True)
        elif path.suffix == ".html":
            path.write_text(self._repr_html_(), encoding="utf-8")
        else:
            raise ValueError(
                f"An animation goes into a file that ends in .gif, .webp or .html, but {str(path)!r} was given."
            )

    def _repr_html_(self) -> str:
        images = (np.asarray(frame.convert("RGBA")) for frame in self._frames())
        # The first image lies behind all: of the others, only the pixels that differ from it are opaque.
        first = next(images)
        changed = (np.where((image != first).any(axis=2, keepdims=True), image, 0) for image in images)
        back, *frames = [_as_webp(image) for image in itertools.chain((first, np.zeros_like(first)), changed)]
        name = f"film-{zlib.crc32(''.join(frames).encode()):x}"
        page = _PAGE.replace("FILM", name).replace("FPS", str(self._fps)).replace("BACK", back)
        return page.replace("FRAMES", json.dumps(frames))

    def _frames(self) -> Iterator[Image.Image]:
        """Images with a palette of 64 colours. All that stands still is drawn once."""
        figure, scene = self._figure()
        canvas = FigureCanvasAgg(figure)
        lines = [self._line(scene, chain) for chain in self._chains]
        panels = figure.axes[1:]
        passed = [panel.plot([], [], color=BLUE, lw=1.6)[0] for panel in panels]
        ends = [panel.plot([], [], color=BLUE, marker="o", ms=5)[0] for panel in panels]
        title = scene.set_title(f"t = {self._t[0]:.2f} s")
        moving: list[Any] = [*reversed(lines), *passed, *ends, title]
        for artist in moving:
            artist.set_animated(True)
        canvas.draw()
        background = canvas.copy_from_bbox(figure.bbox)

        def frame(i: int) -> Image.Image:
            for line, places in zip(lines, self._chains, strict=True):
                if isinstance(line, Polygon):
                    line.set_xy(places[i])
                else:
                    (line.set_data_3d if places.shape[2] == 3 else line.set_data)(*places[i].T)
            for before, end, (t, x) in zip(passed, ends, self._signals.values(), strict=True):
                now = np.interp(self._t[i], t, x)
                before.set_data([*t[t < self._t[i]], self._t[i]], [*x[t < self._t[i]], now])
                end.set_data([self._t[i]], [now])
            title.set_text(f"t = {self._t[i]:.2f} s")
            canvas.restore_region(background)
            for artist in moving:
                artist.axes.draw_artist(artist)
            return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")

        palette = frame(len(self._t) - 1).quantize(64)
        for i in range(len(self._t)):
            yield frame(i).quantize(palette=palette, dither=Image.Dither.NONE)

    def _figure(self) -> tuple[Figure, Any]:
        """The figure without what moves, and the axes of the mechanism, which come first."""
        space = self._chains[0].shape[2] == 3
        points = np.concatenate([x.reshape(-1, x.shape[2]) for x in self._chains])
        low, high = points.min(axis=0), points.max(axis=0)
        margin = 0.05 * max(float((high - low).max()), 1e-9)
        low, high = low - margin, high + margin
        width, height = (5.0, 5.0) if space else 0.9 + 5.0 * (high - low) / float((high - low).max())
        rows = len(self._signals)
        size = (width + 4.0, max(height, 2.8 * rows)) if rows else (width, height)
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.add_gridspec(max(rows, 1), 2 if rows else 1, width_ratios=(width, 4.0) if rows else None)
        axis: Any = figure.add_subplot(grid[:, 0], projection="3d" if space else None)
        axis.set_aspect("equal")
        limits = dict(zip(("xlim", "ylim", "zlim"), zip(low, high, strict=True), strict=False))
        axis.set(**limits, **{name.replace("lim", "label"): "[m]" for name in limits})
        for path in np.swapaxes(self._chains[0], 0, 1):
            axis.plot(*path.T, color=GREY, lw=0.6)
        for row, (label, (t, x)) in enumerate(self._signals.items()):
            panel = figure.add_subplot(grid[row, 1])
            panel.plot(t, x, color=GREY, lw=0.6)
            panel.set(xlabel="time [s]" if row + 1 == rows else "", ylabel=label, xlim=(self._t[0], self._t[-1]))
        return figure, axis

    def _line(self, axis: Any, chain: np.ndarray) -> Any:
        """A chain as it is drawn: filled if closed, grey if it never moves, with its points if it is the first."""
        _, points, dimensions = chain.shape
        if dimensions == 2 and points > 3 and (chain[:, 0] == chain[:, -1]).all():
            return axis.add_patch(Polygon(chain[0], facecolor="#9ecae9", edgecolor=BLUE, lw=2.0))
        marker = {"marker": "o", "ms": 4} if chain is self._chains[0] else {}
        colour = BLUE if np.ptp(chain, axis=0).max() > 0 else GREY
        return axis.plot(*([],) * dimensions, color=colour, lw=2.0, **marker)[0]


def _as_webp(pixels: np.ndarray) -> str:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="webp", lossless=True, method=2)
    return base64.b64encode(file.getvalue()).decode()


def animate(
    trajectory: Trajectory,
    points: Callable[..., ArrayLike | tuple[ArrayLike, ...]],
    *,
    signals: Sequence[str] = (),
    fps: int = 25,
    speed: float = 1.0,
) -> Animation:
    """A mechanism in motion: points of it, joined by lines, with signals of the run drawn beside it.

    Between the times that a run was kept at, the coordinates are cubics with its velocities.

    **Arguments:**

    - `trajectory`: the run, kept at some times `ts`.
    - `points`: `points(q)` or `points(q, params)` returns places [m], shape `[points, 2]` with y upwards, or
      `[points, 3]` with z upwards; a tuple of such arrays for several lines. Of points in space that all have one y, x
      and z are drawn. The points of the first line are marked, with their paths behind it; closed lines
      in the plane are filled, and lines that never move are grey.
    - `signals`: columns of `run.to_dataframe()`, such as the name of a friction element for its force.
    - `fps`: frames a second of the film. `speed`: seconds of the run in a second of the film, such as 0.1 for slow
      motion.

    **Returns:**

    An `Animation`, which a notebook shows; `save(path)` writes a `.gif`, a `.webp` or an `.html`.

    **Raises:**

    - `ValueError` for places of another shape or that are not finite, a signal that the run does not have, a run
      that holds one time alone, and more than 5000 frames.

    **Example:**

    ```python
    def spring(q, p):  # from the wall to the mass [m]
        return jnp.array([[-1.0, 0.0], [q[0], 0.0]])

    scene = jms.problems.braked_spring.scene()
    run = jms.simulate(scene, [0.5], [0.0], 1.0, ts=jnp.linspace(0.0, 1.0, 11))
    jms.plot.animate(run, spring, fps=5).save("spring.gif")
    ```
    """
    fps, speed = as_whole(fps, name="fps"), as_float(speed, name="speed", lower=0.0)
    kept, first = np.unique(trajectory.t[np.isfinite(trajectory.t)], return_index=True)
    if trajectory.t.ndim != 1 or len(kept) < 2:
        raise ValueError(
            "A film needs one run that was kept at two times or more: pass them, as in simulate(...,"
            " ts=jnp.linspace(t0, t1, 1001))."
        )
    count = int((kept[-1] - kept[0]) * fps / speed) + 1
    if count > _MOST_FRAMES:
        raise ValueError(f"A film of {count} frames has more than {_MOST_FRAMES}: pass a larger speed or a lower fps.")
    t = kept[0] + np.arange(count) * speed / fps
    q = CubicHermiteSpline(kept, np.asarray(trajectory.q)[first], np.asarray(trajectory.qd)[first])(t)
    chains = [np.asarray(x) for x in _places(trajectory, points, jnp.asarray(t), jnp.asarray(q))]
    for places in chains:
        if places.ndim != 3 or places.shape[2] not in (2, 3) or places.shape[2] != chains[0].shape[2]:
            raise ValueError(
                "points must return places of the shape [points, 2] or [points, 3], or a tuple of them that are all in"
                f" the plane or all in space, but one has the shape {places.shape[1:]}."
            )
        if not np.isfinite(places).all():
            raise ValueError("points must return finite places, but some along the run are not.")
    if chains[0].shape[2] == 3 and np.ptp(np.concatenate([x[..., 1].ravel() for x in chains])) == 0:
        chains = [x[..., [0, 2]] for x in chains]
    table = trajectory.columns
    if unknown := [name for name in signals if name not in table.values]:
        raise ValueError(f"The run has no signal {unknown[0]!r}: its signals are {', '.join(table.values)}.")
    beside = {with_unit(name, table.units[name]): (table.time, table.values[name]) for name in signals}
    return Animation(t, chains, beside, fps)


def _places(
    trajectory: Trajectory, points: Callable[..., Any], t: Float[Array, " frames"], q: Float[Array, "frames dof"]
) -> list[Array]:
    fn, scene = as_position_fn(points, name="points"), trajectory.scene

    def places(t: Array, q: Array) -> list[Array]:
        value = fn.place(q, scene.bind_time(t).params) if fn.with_params else fn.place(q)
        return [jnp.asarray(x) for x in (value if isinstance(value, tuple) else (value,))]

    return jtu.tree_leaves(jax.vmap(places)(t, q))
