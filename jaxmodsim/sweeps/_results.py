"""Where results go: into memory, or chunk by chunk into a Zarr store that a later call goes on with."""

import abc
import contextlib
import importlib
import json
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .._core.system import extra
from ._compute import Computed
from ._grid import Blocks
from ._layout import NOT_RUN, ResultLayout, Variable
from ._provenance import differences

if TYPE_CHECKING:
    import xarray as xr

# The attribute of a store that says what it holds.
_ATTRIBUTE = "provenance"
# How zarr names a file that it has begun to write.
_PARTIAL = "*.partial"


class AbstractResults(abc.ABC):
    """Takes the results of blocks in any order."""

    @abc.abstractmethod
    def done(self, block: int) -> np.ndarray | None:
        """Codes of the runs of a block that is there already; None where it is not."""

    @abc.abstractmethod
    def write(self, block: int, computed: Computed) -> None:
        """Keep the results of a block."""

    @abc.abstractmethod
    def dataset(self) -> "xr.Dataset":
        """All results."""


class Memory(AbstractResults):
    """Results in the memory of this process."""

    def __init__(
        self, layout: ResultLayout, blocks: Blocks, attrs: Mapping[str, object], provenance: dict[str, object]
    ) -> None:
        """Make room for all of them."""
        self._layout, self._blocks = layout, blocks
        self._attrs = {**attrs, _ATTRIBUTE: json.dumps(provenance)}
        self._arrays = {x.name: np.full((*layout.shape, *x.shape), x.fill, x.dtype) for x in layout.variables}

    def done(self, block: int) -> np.ndarray | None:
        """Nothing is there."""
        del block

    def write(self, block: int, computed: Computed) -> None:
        """Copy the results into their place."""
        place = self._blocks.place(block)
        for name, x in parts(self._layout, self._blocks, block, computed):
            self._arrays[name][place] = x

    def dataset(self) -> "xr.Dataset":
        """All results."""
        return extra("xarray").Dataset(
            {x.name: ((*self._layout.dims, *x.dims), self._arrays[x.name], x.attrs) for x in self._layout.variables},
            self._layout.coordinates,
            self._attrs,
        )


class Store(AbstractResults):
    """Results in a Zarr store, one chunk for each block and variable, each written whole or not at all.

    The chunk of `result` is written last, and says that the block is there.

    **Raises:**

    - `ValueError` if the folder holds something else, or results of another sweep.
    - `OSError` if it cannot be written.
    """

    def __init__(
        self,
        path: Path,
        layout: ResultLayout,
        blocks: Blocks,
        attrs: Mapping[str, object],
        provenance: dict[str, object],
    ) -> None:
        """Make the store, or go on with the one that is there."""
        self._path, self._layout, self._blocks = path, layout, blocks
        provenance = json.loads(json.dumps(provenance))
        if path.exists():
            _check_same(path, provenance)
            for left in path.rglob(_PARTIAL):
                left.unlink(missing_ok=True)
        else:
            _create(path, layout, blocks, {**attrs, _ATTRIBUTE: json.dumps(provenance)})
        self._group = extra("zarr").open_group(path, mode="r+")

    def done(self, block: int) -> np.ndarray | None:
        """Codes of a block whose last chunk is there."""
        try:
            codes = np.asarray(self._group["result"][self._blocks.place(block)])
        except (ValueError, RuntimeError) as error:
            raise ValueError(
                f"{self._path} is damaged: chunk {block} of result cannot be read ({error}). Remove its file, and it is"
                " run again."
            ) from error
        return None if (codes == NOT_RUN).any() else codes

    def write(self, block: int, computed: Computed) -> None:
        """Write one chunk of each variable."""
        place = self._blocks.place(block)
        for name, x in parts(self._layout, self._blocks, block, computed):
            self._group[name][place] = x

    def dataset(self) -> "xr.Dataset":
        """All results, read when they are asked for."""
        stored = extra("xarray").open_zarr(self._path, consolidated=False, chunks=None)
        return stored[[x.name for x in self._layout.variables]]  # a store keeps no order


def parts(layout: ResultLayout, blocks: Blocks, block: int, computed: Computed) -> Iterator[tuple[str, np.ndarray]]:
    """Results of a block by variable, in the shape of the block, `result` last."""
    shape = tuple(place.stop - place.start for place in blocks.place(block))
    for variable in layout.variables:
        x = computed.values.get(variable.name)
        if x is None:
            x = computed.code if variable.name == "result" else computed.num_steps
        yield variable.name, x.reshape(*shape, *variable.shape)


def _check_same(path: Path, provenance: dict[str, object]) -> None:
    """Refuse to go on with what is something else."""
    try:
        then = json.loads(extra("zarr").open_group(path, mode="r").attrs[_ATTRIBUTE])
    except (KeyError, ValueError, OSError, TypeError) as error:
        raise ValueError(
            f"{path} exists and is no store of a sweep ({type(error).__name__}): name another one, or remove it."
        ) from error
    changes = differences(then, provenance)
    if changes:
        raise ValueError(
            f"{path} holds the results of another sweep: {'; '.join(changes)}. Name another store, or remove this one."
        )


def _create(path: Path, layout: ResultLayout, blocks: Blocks, attrs: Mapping[str, object]) -> None:
    """Make an empty store, which appears whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        group = extra("zarr").open_group(scratch, mode="w", zarr_format=3)
        group.attrs.update(attrs)
        for name, (dims, values, about) in layout.coordinates.items():
            # Text of fixed length is no settled part of the format, text of any length is.
            dtype = "string" if values.dtype.kind == "U" else values.dtype
            array = group.create_array(
                name, shape=values.shape, dtype=dtype, dimension_names=dims, attributes=about, compressors=_codecs()
            )
            array[...] = values.astype(object) if dtype == "string" else values
        for x in layout.variables:
            _create_variable(group, x, layout, blocks)
        os.rename(scratch, path)
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(scratch)


def _create_variable(group: Any, x: Variable, layout: ResultLayout, blocks: Blocks) -> None:
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


def _codecs() -> tuple[object, ...]:
    """How chunks are packed: with a checksum behind, as a damaged one could hold other numbers."""
    codecs = importlib.import_module("zarr.codecs")
    return codecs.ZstdCodec(), codecs.Crc32cCodec()
