"""A mechanism in motion."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, final

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.artist import Artist
from scipy.interpolate import CubicHermiteSpline

from .._core.arguments import as_float, as_whole
from .._core.position import as_position_fn
from ..simulation import Trajectory
from ._style import BLUE, GREY, Figure

_MOST_FRAMES = 5000
_BUTTONS = {
    "minus": "&minus;",
    "fast-backward": "|&#9664;",
    "step-backward": "&lsaquo;",
    "play fa-flip-horizontal": "&#9664;",
    "pause": "||",
    "play": "&#9654;",
    "step-forward": "&rsaquo;",
    "fast-forward": "&#9654;|",
    "plus": "+",
}


@final
class Animation:
    """Frames of a mechanism, drawn when they are asked for; a notebook shows them, with buttons."""

    def __init__(self, t: np.ndarray, chains: list[np.ndarray], fps: int) -> None:
        """Of places `[frames, points, 2 or 3]` for each chain, at the times `t`."""
        self._t, self._chains, self._fps = t, chains, fps

    def save(self, path: str | Path) -> None:
        """Write a file, by its ending a GIF (with pillow) or an HTML page with buttons.

        **Raises:**

        - `ValueError` for another ending.
        """
        path = Path(path)
        if path.suffix == ".gif":
            self._drawn().save(path, writer=PillowWriter(fps=self._fps))
        elif path.suffix == ".html":
            path.write_text(self._repr_html_(), encoding="utf-8")
        else:
            raise ValueError(f"An animation goes into a file that ends in .gif or .html, but {str(path)!r} was given.")

    def _repr_html_(self) -> str:
        page = self._drawn().to_jshtml(fps=self._fps)
        # The symbols on its buttons would come from the network.
        page = re.sub(r"<link rel=\"stylesheet\"[^>]*>", "", page)
        return re.sub(r'<i class="fa fa-([^"]+)"></i>', lambda match: _BUTTONS[match[1]], page)

    def _drawn(self) -> FuncAnimation:
        space = self._chains[0].shape[2] == 3
        points = np.concatenate([x.reshape(-1, x.shape[2]) for x in self._chains])
        low, high = points.min(axis=0), points.max(axis=0)
        margin = 0.05 * max(float((high - low).max()), 1e-9)
        low, high = low - margin, high + margin
        width, height = (5.0, 5.0) if space else 0.9 + 5.0 * (high - low) / float((high - low).max())
        figure = Figure(figsize=(width, height), layout="constrained")
        axis: Any = figure.add_subplot(projection="3d" if space else None)
        axis.set_aspect("equal")
        limits = dict(zip(("xlim", "ylim", "zlim"), zip(low, high, strict=True), strict=False))
        axis.set(**limits, **{name.replace("lim", "label"): "[m]" for name in limits})
        for path in np.swapaxes(self._chains[0], 0, 1):
            axis.plot(*path.T, color=GREY, lw=0.6)
        nothing = ([],) * len(low)
        lines = [axis.plot(*nothing, color=BLUE, lw=2.0, marker="o", ms=4)[0] for _ in self._chains]
        title = axis.set_title(f"t = {self._t[0]:.2f} s")
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # the layout of the first frame serves all, and takes longer than they do

        def draw(i: int) -> list[Artist]:
            for line, places in zip(lines, self._chains, strict=True):
                (line.set_data_3d if space else line.set_data)(*places[i].T)
            title.set_text(f"t = {self._t[i]:.2f} s")
            return [*lines, title]

        return FuncAnimation(figure, draw, frames=len(self._t), init_func=lambda: [*lines, title])


def animate(
    trajectory: Trajectory,
    points: Callable[..., ArrayLike | tuple[ArrayLike, ...]],
    *,
    fps: int = 25,
    speed: float = 1.0,
) -> Animation:
    """A mechanism in motion: points of it, joined by lines.

    ```python
    def links(q, p):  # of a pendulum, q the angle from straight down: pivot and bob [m]
        return jnp.array([[0.0, 0.0], [p["l"] * jnp.sin(q[0]), -p["l"] * jnp.cos(q[0])]])


    jaxmodsim.plot.animate(run, links).save("pendulum.gif")
    ```

    Between the times that a run was kept at, the coordinates are cubics with its velocities.

    **Arguments:**

    - `trajectory`: the run, kept at some times `ts`.
    - `points`: `points(q)` or `points(q, params)` returns places [m], shape `[points, 2]` with y upwards, or
      `[points, 3]` with z upwards; a tuple of such arrays for several lines. Of points in space that all have one y, x
      and z are drawn. The paths of the points of the first line stand behind.
    - `fps`: frames a second of the film. `speed`: seconds of the run in a second of the film, such as 0.1 for slow
      motion.

    **Returns:**

    An `Animation`, which a notebook shows, with `save("name.gif")` and `save("name.html")`.

    **Raises:**

    - `ValueError` for places of another shape or that are not finite, for a run that holds one time alone, and for more
      than 5000 frames.
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
    return Animation(t, chains, fps)


def _places(
    trajectory: Trajectory, points: Callable[..., Any], t: Float[Array, " frames"], q: Float[Array, "frames dof"]
) -> list[Array]:
    fn, scene = as_position_fn(points, name="points"), trajectory.scene

    def places(t: Array, q: Array) -> list[Array]:
        value = fn.place(q, scene.bind_time(t).params) if fn.with_params else fn.place(q)
        return [jnp.asarray(x) for x in (value if isinstance(value, tuple) else (value,))]

    return jtu.tree_leaves(jax.vmap(places)(t, q))
