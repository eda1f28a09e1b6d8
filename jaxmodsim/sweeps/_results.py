"""The results of a sweep: variables, provenance, and their storage in memory or in a Zarr store that can be resumed."""

import contextlib
import hashlib
import importlib
import json
import os
import shutil
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.tree_util as jtu
import numpy as np

from .._core.system import extra, versions
from ..scene import quantity_of, scene_numbers
from ..simulation import default_solver
from ._compute import Computed, Work, program
from ._grid import Blocks
from ._request import Request
from ._run import Derivative, Observable

if TYPE_CHECKING:
    import xarray as xr

# Code of runs that are not computed yet.
NOT_RUN = -1
_PACKAGES = ("jaxmodsim", "jax", "jaxlib", "diffrax", "equinox", "numpy")
# Larger arrays are compared by a checksum.
_SHORT = 16
# Attribute of a store with the provenance of its results.
_ATTRIBUTE = "provenance"
# Files that zarr has not finished writing.
_PARTIAL = "*.partial"


@dataclass(frozen=True)
class Variable:
    """A variable over all runs.

    - `dims`, `shape`: dimensions of one run, after those of the sweep.
    """

    name: str
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype
    fill: float | int
    attrs: Mapping[str, object]


@dataclass(frozen=True)
class ResultLayout:
    """The coordinates and variables of a result.

    - `dims`, `shape`: of the sweep.
    - `coordinates`: dimensions, values and attributes by name.
    - `variables`: the last one, `result`, is written last, and marks the runs as computed.
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
    for each in request.observe:
        shape = request.shapes.values[each.name]
        inner = [f"{each.name}_{i}" for i in range(len(shape.shape))]
        first = 0
        if isinstance(each.of, Derivative) and not isinstance(each.of.wrt, str):
            inner[0], first = f"{each.name}_wrt", 1
            coordinates[inner[0]] = ((inner[0],), np.asarray(each.of.wrt), {})
        if ts is not None and shape.shape[first : first + 1] == np.shape(ts):
            inner[first] = "time"
        attrs = {"units": each.unit} if each.unit else _named_attrs(request, each.of)
        variables.append(Variable(each.name, tuple(inner), shape.shape, np.dtype(shape.dtype), np.nan, attrs))
    sentences = list(request.shapes.messages)
    codes = {"long_name": "how the run ended", "flag_values": [*range(len(sentences))], "flag_meanings": sentences}
    for name, attrs in (("num_steps", {"long_name": "number of steps of the run"}), ("result", codes)):
        variables.append(Variable(name, (), (), np.dtype(np.int32), NOT_RUN, attrs))
    for variable in variables:
        if variable.name in dims or variable.name in coordinates:
            raise ValueError(f"{variable.name!r} names both an observable and a swept number: rename the former.")
    return ResultLayout(dims, tuple(request.grid.shape), coordinates, tuple(variables))


def _named_attrs(request: Request, of: Observable | Derivative) -> dict[str, object]:
    """Name and unit of an observable, if the scene names its coordinates."""
    scene = request.fixed[0] if request.fixed else None
    if scene is None or not scene.coordinates or not isinstance(of, str):
        return {}
    name, unit = quantity_of(scene, of)
    return {"long_name": name, "units": unit}


def provenance(request: Request, work: Work, extent: tuple[int, ...]) -> dict[str, object]:
    """Everything that determines the results of a sweep, as values for JSON."""
    scene, arguments = request.fixed or (None, {})
    numbers = {} if scene is None else scene_numbers(scene)
    choices = dict(getattr(work.run, "choices", ()))
    swept = request.grid.values
    return {
        "over": {name: f"{x.shape} {x.dtype} {_digest(x)}" for name, x in swept.items()},
        "numbers": {name: _value(x) for name, x in numbers.items() if name not in swept},
        "arguments": {
            jtu.keystr(path, simple=True, separator="."): _value(x)
            for name, value in sorted(arguments.items())
            if name not in swept
            for path, x in jtu.tree_leaves_with_path({name: value})
        },
        "options": {name: repr(value) for name, value in sorted(choices.items())},
        "program": program(work.run, work.fixed, request.grid.first),
        "versions": package_versions(),
        "backend": jax.default_backend(),
        "chunks": list(extent),
        "runs in a group": work.group,
    }


@cache
def package_versions() -> dict[str, str]:
    """Versions of the packages that determine the results."""
    return versions(*_PACKAGES)


def describe(request: Request) -> str:
    """A description of the swept system."""
    if request.fixed:
        scene = request.fixed[0]
        return f"{_called(scene.lagrangian)}; " + ", ".join(
            f"{name}: {type(getattr(effect, 'law', effect)).__name__}"
            for name, effect in zip(scene.names, scene.effects, strict=True)
        )
    return _called(getattr(request.run, "function", None))


def solver_of(request: Request) -> str:
    """The solver of a scene, explicit or by default; "" for a function."""
    if not request.fixed:
        return ""
    scene, arguments = request.fixed
    solver = dict(getattr(request.run, "choices", ())).get("solver")
    return repr(default_solver(scene, np.size(arguments["q0"]), "dt" in arguments) if solver is None else solver)


def _differences(then: dict[str, object], now: dict[str, object]) -> list[str]:
    """Sentences on the differences between two provenances."""
    texts = []
    for part in [*then, *(name for name in now if name not in then)]:
        old, new = then.get(part), now.get(part)
        if isinstance(old, dict) and isinstance(new, dict):
            for name in [*old, *(name for name in new if name not in old)]:
                if old.get(name) != new.get(name):
                    texts.append(f"{part}: {name} was {old.get(name, 'not there')}, is {new.get(name, 'not there')}")
        elif old != new:
            code = "the code of the scene, the observables, or this library has changed"
            texts.append(code if part == "program" else f"{part} was {old}, is {new}")
    return texts


def _called(function: object) -> str:
    function = getattr(function, "fn", function)  # a scene wraps plain functions
    return str(getattr(function, "__qualname__", type(function).__name__))


def _digest(x: object) -> str:
    return hashlib.sha256(np.ascontiguousarray(x).tobytes()).hexdigest()[:16]


def _value(x: object) -> object:
    x = np.asarray(x)
    return x.tolist() if x.size <= _SHORT else f"{x.shape} {x.dtype} {_digest(x)}"


class Results:
    """Results of blocks, in any order, in a Zarr store or, without a path, in the memory of this process.

    A store has one chunk for each block and variable, each written whole or not at all. The chunk of `result` is
    written last, and marks the block as stored.

    **Raises:**

    - `ValueError` if the folder has other content, or results of another sweep.
    - `OSError` if it cannot be written.
    """

    def __init__(
        self,
        path: Path | None,
        layout: ResultLayout,
        blocks: Blocks,
        attrs: Mapping[str, object],
        provenance: dict[str, object],
    ) -> None:
        """Allocate arrays, create the store, or open it to resume."""
        self._path, self._layout, self._blocks = path, layout, blocks
        self._attrs = {**attrs, _ATTRIBUTE: json.dumps(provenance)}
        if path is None:
            self._arrays = {x.name: np.full((*layout.shape, *x.shape), x.fill, x.dtype) for x in layout.variables}
            return
        if path.exists():
            _check_same(path, json.loads(self._attrs[_ATTRIBUTE]))
            for partial in path.rglob(_PARTIAL):
                partial.unlink(missing_ok=True)
        else:
            _create(path, layout, blocks, self._attrs)
        self._arrays: Any = extra("zarr").open_group(path, mode="r+")

    def done(self, block: int) -> np.ndarray | None:
        """Codes of the runs of a stored block; None for a block that is not computed yet."""
        try:
            codes = np.asarray(self._arrays["result"][self._blocks.place(block)])
        except (ValueError, RuntimeError) as error:
            raise ValueError(
                f"{self._path} is damaged: chunk {block} of result cannot be read ({error}). Remove its file to"
                " compute it again."
            ) from error
        return None if (codes == NOT_RUN).any() else codes

    def write(self, block: int, computed: Computed) -> None:
        """Store the results of a block, `result` last."""
        place = self._blocks.place(block)
        shape = tuple(along.stop - along.start for along in place)
        values = {"num_steps": computed.num_steps, "result": computed.code} | computed.values
        for variable in self._layout.variables:
            self._arrays[variable.name][place] = values[variable.name].reshape(*shape, *variable.shape)

    def dataset(self) -> "xr.Dataset":
        """All results; those of a store are read on access."""
        xarray, layout = extra("xarray"), self._layout
        if self._path is None:
            data = {x.name: ((*layout.dims, *x.dims), self._arrays[x.name], x.attrs) for x in layout.variables}
            return xarray.Dataset(data, layout.coordinates, self._attrs)
        stored = xarray.open_zarr(self._path, consolidated=False, chunks=None)
        # A store has no order of variables, and does not mark coordinates that are no dimension.
        return stored[[x.name for x in layout.variables]].assign_coords(layout.coordinates)


def _check_same(path: Path, provenance: dict[str, object]) -> None:
    """Check that the store holds results of the same sweep."""
    try:
        then = json.loads(extra("zarr").open_group(path, mode="r").attrs[_ATTRIBUTE])
    except (KeyError, ValueError, OSError, TypeError) as error:
        raise ValueError(
            f"{path} exists and is not a store of a sweep ({type(error).__name__}): use another folder, or remove it."
        ) from error
    changes = _differences(then, provenance)
    if changes:
        raise ValueError(
            f"{path} holds the results of another sweep: {'; '.join(changes)}. Use another store, or remove this one."
        )


def _create(path: Path, layout: ResultLayout, blocks: Blocks, attrs: Mapping[str, object]) -> None:
    """Create an empty store, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        group = extra("zarr").open_group(scratch, mode="w", zarr_format=3)
        group.attrs.update(attrs)
        for name, (dims, values, about) in layout.coordinates.items():
            # The format defines text of variable length only.
            dtype = "string" if values.dtype.kind == "U" else values.dtype
            array = group.create_array(
                name, shape=values.shape, dtype=dtype, dimension_names=dims, attributes=about, compressors=_codecs()
            )
            array[...] = values.astype(object) if dtype == "string" else values
        for x in layout.variables:
            group.create_array(
                x.name,
                shape=(*layout.shape, *x.shape),
                chunks=(*blocks.extent, *x.shape),
                dtype=x.dtype,
                fill_value=x.fill,
                dimension_names=(*layout.dims, *x.dims),
                attributes=x.attrs,
                compressors=_codecs(),
            )
        os.rename(scratch, path)
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(scratch)


def _codecs() -> tuple[object, ...]:
    """Compression of chunks, with a checksum that detects damage."""
    codecs = importlib.import_module("zarr.codecs")
    return codecs.ZstdCodec(), codecs.Crc32cCodec()
