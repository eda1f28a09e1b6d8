"""The variables of a result: their dimensions, sizes and attributes."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..scene import quantity_of
from ._observe import Derivative, Observable
from ._request import Request

# Of runs that have not been run.
NOT_RUN = -1


@dataclass(frozen=True)
class Variable:
    """A variable over all runs.

    - `dims`, `shape`: of what one run gives, behind those of the sweep.
    """

    name: str
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype
    fill: float | int
    attrs: Mapping[str, object]


@dataclass(frozen=True)
class ResultLayout:
    """What a result holds.

    - `dims`, `shape`: of the sweep.
    - `coordinates`: dimensions, values and attributes by name.
    - `variables`: the last one, `result`, is written last, and says what has been run.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    coordinates: dict[str, tuple[tuple[str, ...], np.ndarray, Mapping[str, object]]]
    variables: tuple[Variable, ...]


def layout(request: Request) -> ResultLayout:
    """Lay out the result of a sweep."""
    dims = tuple(axis.name for axis in request.grid.axes)
    coordinates: dict[str, tuple[tuple[str, ...], np.ndarray, Mapping[str, object]]] = {}
    for axis in request.grid.axes:
        for name, values in axis.values.items():
            inner = tuple(f"{name}_{i}" for i in range(values.ndim - 1))
            unit = request.units.get(name, "")
            coordinates[name] = ((axis.name, *inner), values, {"units": unit} if unit else {})
    ts = request.fixed[1].get("ts") if request.fixed else None
    if ts is not None:
        coordinates["time"] = (("time",), np.asarray(ts), {"units": "s"})
    variables = []
    for what in request.observe:
        shape = request.shapes.values[what.name]
        inner = [f"{what.name}_{i}" for i in range(len(shape.shape))]
        first = 0
        if isinstance(what.of, Derivative) and not isinstance(what.of.wrt, str):
            inner[0], first = f"{what.name}_wrt", 1
            coordinates[inner[0]] = ((inner[0],), np.asarray(what.of.wrt), {})
        if ts is not None and shape.shape[first : first + 1] == np.shape(ts):
            inner[first] = "time"
        attrs = {"units": what.unit} if what.unit else _named_attrs(request, what.of)
        variables.append(Variable(what.name, tuple(inner), shape.shape, np.dtype(shape.dtype), np.nan, attrs))
    sentences = list(request.shapes.messages)
    codes = {"long_name": "how the run ended", "flag_values": [*range(len(sentences))], "flag_meanings": sentences}
    for name, attrs in (("num_steps", {"long_name": "number of steps of the run"}), ("result", codes)):
        variables.append(Variable(name, (), (), np.dtype(np.int32), NOT_RUN, attrs))
    for variable in variables:
        if variable.name in dims or variable.name in coordinates:
            raise ValueError(f"{variable.name!r} names both what is observed and what is swept: rename the former.")
    return ResultLayout(dims, tuple(request.grid.shape), coordinates, tuple(variables))


def _named_attrs(request: Request, of: Observable | Derivative) -> dict[str, object]:
    """Name and unit of what is observed by name, where the scene names its coordinates."""
    scene = request.fixed[0] if request.fixed else None
    if scene is None or not scene.coordinates or not isinstance(of, str):
        return {}
    name, unit = quantity_of(scene, of)
    return {"long_name": name, "units": unit}
