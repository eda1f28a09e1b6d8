"""Maps of a sweep over two dimensions."""

import textwrap
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from .._core.arguments import did_you_mean
from ._style import BLUE, GREEN, RED, Figure, plain_ticks, with_unit

if TYPE_CHECKING:
    import xarray as xr

_CLASSES = ("#cfdceb", BLUE, "#e3a73f", GREEN, "#8c6bb1", "#5ab4ac", "#b15928", "#666666")
# Integers without names have a legend entry each, up to this number.
_FEW = len(_CLASSES)
# Colours of failed runs by reason, the most frequent first; of runs that were not computed.
_FAILED, _NOT_RUN = ("#1a1a1a", "#6b4a2b", "#8a8a8a"), "#f6f1dc"
_CURVES = ("-", "--", ":", "-.")
# A map with more cells is rasterized in vector graphics.
_CELLS = 2500

# Codes beside those of `result`: a run that was not computed, and a completed run whose value is no number.
_UNRUN, _NAN = -1, -2

# Curves over a map: label to x and y.
Curves: TypeAlias = Mapping[str, tuple[object, object]]


@dataclass(frozen=True)
class _Side:
    """An axis of a map.

    - `label`: its name and unit; `edges`: of the cells, one more than the number of cells; `log`: logarithmic or not.
    """

    label: str
    edges: np.ndarray
    log: bool

    @property
    def limits(self) -> tuple[float, float]:
        """The smallest and the largest value."""
        return float(self.edges.min()), float(self.edges.max())


def map2d(
    dataset: "xr.Dataset",
    name: str,
    *,
    x: str | None = None,
    y: str | None = None,
    title: str = "",
    classes: Mapping[int, str] | None = None,
    boundary: Curves | None = None,
) -> Figure:
    """Draw a variable of a sweep over two dimensions.

    An axis is logarithmic if the logarithms of its values are more evenly spaced than the values. Failed runs and runs
    that were not computed have their own colours; the legend counts them and gives the reasons.

    **Arguments:**

    - `dataset`: from `jaxmodsim.sweep`.
    - `name`: the variable, with two dimensions; its attribute `units` labels the colour bar. A legend replaces the bar
      if the values have names, from `classes` or the attributes `flag_values` and `flag_meanings`, or are at most eight
      different integers.
    - `x`, `y`: a dimension, or a coordinate that varies along one, for each axis. The default for `x` is the last
      dimension, as in xarray. The attribute `units` of a coordinate goes to its label.
    - `title`: above the map.
    - `classes`: a name for each value of the variable.
    - `boundary`: curves over the map: label to x and y, of the shape `[points]` each.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.

    **Raises:**

    - `ValueError` for unknown names, a number of dimensions other than two, axis values that are not monotonic, not
      numbers, or fewer than two, and values without a name in `classes`.
    """
    values, across, up = _read(dataset, name, x, y)
    cells = np.asarray(values, float)
    codes = _codes(dataset, values)
    shown = (codes == 0) & np.isfinite(cells)
    figure = Figure(figsize=(7.6, 5.6), layout="constrained")
    axes = figure.subplots()
    axes.set(xscale="log" if across.log else "linear", yscale="log" if up.log else "linear")
    names = _names(values, cells[shown], classes)
    label = with_unit(str(values.attrs.get("long_name", name)), str(values.attrs.get("units", "")))
    if names is not None:
        entries = _draw_classes(axes, across, up, np.where(shown, cells, np.nan), names)
    else:
        entries = []
        mesh = _draw(axes, across, up, np.where(shown, cells, np.nan), cmap="viridis")
        if shown.any():
            figure.colorbar(mesh, ax=axes, label=label)
    sentences = _flags(dataset["result"]) if "result" in dataset.data_vars else {}
    entries += _draw_failures(axes, across, up, np.where(shown, 0, np.where(codes == 0, _NAN, codes)), sentences)
    entries += _draw_curves(axes, boundary or {})
    axes.set(xlabel=across.label, xlim=across.limits, ylabel=up.label, ylim=up.limits)
    plain_ticks(axes.xaxis, axes.yaxis)
    axes.set_title(title, fontsize=11)
    if entries:
        # Bare numbers need the name of the variable as a title; names of classes do not.
        bare = names is not None and list(names.values()) == [f"{value:g}" for value in names]
        head = label if bare else None
        figure.legend(handles=entries, loc="outside lower center", ncols=2, fontsize=9, title=head)
    return figure


def _read(dataset: "xr.Dataset", name: str, x: str | None, y: str | None) -> "tuple[xr.DataArray, _Side, _Side]":
    """The variable with its dimensions in the order (y, x), and both axes."""
    if not hasattr(dataset, "data_vars"):
        raise ValueError(f"map2d needs a Dataset as sweep returns it, but a {type(dataset).__name__} was given.")
    _check_known("variable", name, dataset.data_vars)
    values = dataset[name]
    right, upwards = (None if given is None else _dimension(dataset, values, given) for given in (x, y))
    if right is not None and right == upwards:
        raise ValueError(f"x={x!r} and y={y!r} both lie along the dimension {right!r}.")
    left = [dim for dim in values.dims if dim not in (right, upwards)]
    if upwards is None and left:
        upwards = left.pop(0)
    if right is None and left:
        right = left.pop(0)
    if left or right is None or upwards is None:
        have = f"{name!r} has {len(values.dims)}: {', '.join(map(str, values.dims)) or 'none'}"
        mend = f" Select one index of the others first: dataset.isel({dict.fromkeys(left, -1)})." if left else ""
        raise ValueError(f"map2d needs a variable with two dimensions, but {have}.{mend}")
    across, up = _side(dataset, right, x), _side(dataset, upwards, y)
    return values.transpose(upwards, right), across, up


def _check_known(kind: str, name: object, known: Iterable[object]) -> None:
    known = [str(each) for each in known]
    if name not in known:
        hint = did_you_mean(str(name), known)
        raise ValueError(f"There is no {kind} {name!r}; there are: {', '.join(known)}.{hint}")


def _dimension(dataset: "xr.Dataset", values: "xr.DataArray", given: str) -> Hashable:
    """The dimension of an axis name: itself, or the dimension of the coordinate of that name."""
    along = {dim: dim for dim in values.dims}
    along |= {each: c.dims[0] for each, c in dataset.coords.items() if len(c.dims) == 1 and c.dims[0] in values.dims}
    _check_known("axis", given, along)
    return along[given]


def _side(dataset: "xr.Dataset", dim: Hashable, given: str | None) -> _Side:
    """The axis of a dimension: the coordinate of that name, the first that varies along it, or the index."""
    along = [name for name, coordinate in dataset.coords.items() if coordinate.dims == (dim,)]
    name = given if given in along else dim if dim in along or not along else along[0]
    coordinate = dataset[name]
    values = np.asarray(coordinate)
    if values.dtype.kind not in "iuf":
        raise ValueError(f"The axis {name!r} needs numbers, but it has {values[:3].tolist()}.")
    if values.size < 2:
        raise ValueError(f"The axis {name!r} has a single value: a map needs two or more.")
    steps = np.diff(values.astype(float))
    if not ((steps > 0).all() or (steps < 0).all()):
        raise ValueError(
            f"The values of the axis {name!r} must be monotonic: use dataset.sortby({name!r}), or name another"
            " coordinate that varies along it."
        )
    log = bool((values > 0).all()) and values.size > 2 and _spread(np.log(values)) < _spread(values)
    label = with_unit(str(coordinate.attrs.get("long_name", name)), str(coordinate.attrs.get("units", "")))
    return _Side(label, _edges(values, log), log)


def _spread(values: np.ndarray) -> float:
    """Standard deviation of the steps over their mean: zero for equal steps."""
    steps = np.diff(values.astype(float))
    return float(np.std(steps) / abs(np.mean(steps)))


def _edges(values: np.ndarray, log: bool) -> np.ndarray:
    """Edges of cells half way between the values; the outer edges are as far from their value as the inner ones."""
    x = np.log(values) if log else values.astype(float)
    middle = 0.5 * (x[1:] + x[:-1])
    edges = np.concatenate([[2.0 * x[0] - middle[0]], middle, [2.0 * x[-1] - middle[-1]]])
    return np.exp(edges) if log else edges


def _codes(dataset: "xr.Dataset", values: "xr.DataArray") -> np.ndarray:
    """The result code of each run; in a map of `result` itself only whether the run was computed."""
    result = dataset["result"] if "result" in dataset.data_vars else None
    if result is None or not set(result.dims) <= set(values.dims):
        return np.zeros(values.shape, int)
    codes = np.asarray(result.broadcast_like(values).transpose(*values.dims), int)
    return np.where(codes < 0, codes, 0) if values.name == "result" else codes


def _flags(values: "xr.DataArray") -> dict[int, str]:
    """Names of values, from the attributes of the variable."""
    return dict(zip(values.attrs.get("flag_values", ()), values.attrs.get("flag_meanings", ()), strict=False))


def _names(values: "xr.DataArray", shown: np.ndarray, classes: Mapping[int, str] | None) -> dict[int, str] | None:
    """A name for each class of the variable; None for a variable without classes."""
    distinct = np.unique(shown)
    named = dict(classes) if classes is not None else _flags(values)
    if named:
        nameless = [f"{value:g}" for value in distinct if value not in named]
        if nameless:
            known = ", ".join(f"{value:g}" for value in named)
            raise ValueError(f"{values.name!r} has the value {nameless[0]}, but only {known} have names in classes.")
        return named
    few = 0 < distinct.size <= _FEW and bool((distinct == np.round(distinct)).all())
    return {int(value): f"{value:g}" for value in distinct} if few else None


def _draw(axes: Axes, across: _Side, up: _Side, cells: np.ndarray, **style: Any) -> QuadMesh:
    masked = np.ma.masked_invalid(cells)
    return axes.pcolormesh(across.edges, up.edges, masked, rasterized=cells.size > _CELLS, **style)


def _draw_classes(axes: Axes, across: _Side, up: _Side, cells: np.ndarray, names: dict[int, str]) -> list[Patch]:
    """Draw one colour for each class; returns a legend entry for each class that occurs."""
    colours = [_CLASSES[i % _FEW] for i in range(len(names))]
    entries = []
    place = np.full(cells.shape, np.nan)
    for i, (value, text) in enumerate(names.items()):
        place[cells == value] = i
        if (cells == value).any():
            entries.append(Patch(color=colours[i], label=_folded(text)))
    _draw(axes, across, up, place, cmap=ListedColormap(colours), vmin=-0.5, vmax=len(names) - 0.5)
    return entries


def _draw_failures(
    axes: Axes, across: _Side, up: _Side, codes: np.ndarray, sentences: Mapping[int, str]
) -> list[Patch]:
    """Draw runs without a number, coloured by reason; `codes` are 0 for all others."""
    reasons, counts = np.unique(codes[codes != 0], return_counts=True)
    place, entries = np.full(codes.shape, np.nan), []
    failed = sorted(((n, code) for code, n in zip(reasons, counts, strict=True) if code != _UNRUN), reverse=True)
    for i, (n, code) in enumerate(failed):
        which = min(i, len(_FAILED) - 1)
        place[codes == code] = which
        why = "not a number" if code == _NAN else sentences.get(int(code), f"code {code}").split(": ")[0]
        entries.append(Patch(color=_FAILED[which], label=_folded(f"{n} of {codes.size} failed: {why}")))
    unrun = int((codes == _UNRUN).sum())
    if unrun:
        place[codes == _UNRUN] = len(_FAILED)
        text = f"{unrun} of {codes.size} not run"
        entries.append(Patch(facecolor=_NOT_RUN, edgecolor=_FAILED[-1], lw=0.5, label=text))
    if entries:
        colours = ListedColormap([*_FAILED, _NOT_RUN])
        _draw(axes, across, up, place, cmap=colours, vmin=-0.5, vmax=len(_FAILED) + 0.5)
    return entries


def _draw_curves(axes: Axes, curves: Curves) -> list[Line2D]:
    entries = []
    for i, (label, (x, y)) in enumerate(curves.items()):
        entries += axes.plot(
            np.asanyarray(x), np.asanyarray(y), color=RED, lw=1.8, ls=_CURVES[i % len(_CURVES)], label=_folded(label)
        )
    return entries


def _folded(text: str) -> str:
    """A text folded and shortened for a legend."""
    return textwrap.fill(textwrap.shorten(text, 110, placeholder=" ..."), 56)
