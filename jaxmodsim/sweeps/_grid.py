"""The grid of a sweep: dimensions, the numbers of each run, and blocks of runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any

import numpy as np

# Variables of every result.
RESERVED = ("result", "num_steps", "time")


@dataclass(frozen=True)
class GridAxis:
    """A dimension: its name and the values of the numbers that change along it, with the dimension as first axis."""

    name: str
    values: dict[str, np.ndarray]

    @property
    def size(self) -> int:
        """Number of points along the dimension."""
        return next(iter(self.values.values())).shape[0]


@dataclass(frozen=True)
class Grid:
    """The product of all dimensions. The index of a run counts along the last dimension first."""

    axes: tuple[GridAxis, ...]

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Size of each dimension."""
        return tuple(axis.size for axis in self.axes)

    @property
    def size(self) -> int:
        """Number of runs."""
        return prod(self.shape)

    @property
    def values(self) -> dict[str, np.ndarray]:
        """Values of all numbers, each along its own dimension."""
        return {name: values for axis in self.axes for name, values in axis.values.items()}

    @property
    def first(self) -> dict[str, np.ndarray | np.generic]:
        """The numbers of the first run."""
        return {name: values[0] for name, values in self.values.items()}

    def numbers_at(self, index: np.ndarray) -> dict[str, np.ndarray]:
        """The numbers of the runs with these indices, by name, with the runs as first axis."""
        places = np.unravel_index(index, self.shape)
        return {
            name: values[place]
            for axis, place in zip(self.axes, places, strict=True)
            for name, values in axis.values.items()
        }


def grid(over: object) -> Grid:
    """Convert the argument `over` of a sweep.

    **Raises:**

    - `ValueError` for anything but a mapping of names to numbers; for numbers that are missing, not finite, or of
      unequal length, and for a name that occurs twice.
    """
    if not isinstance(over, Mapping) or not over:
        raise ValueError(
            "over must name the numbers to sweep, as in over={'m': [1.0, 2.0]}, or over={'sample': {'m': [...], 'k':"
            f" [...]}}}} for numbers that change together, but {over!r} was given."
        )
    axes = tuple(_axis(name, values) for name, values in over.items())
    seen: set[str] = set()
    for axis in axes:
        for name in {axis.name, *axis.values}:
            if name in seen:
                raise ValueError(f"over names {name!r} twice.")
            if "/" in name:
                raise ValueError(f"over needs names without a slash, the separator of a store, but has {name!r}.")
            if name in RESERVED:
                raise ValueError(f"over cannot use the name {name!r}, which every result has.")
            seen.add(name)
    return Grid(axes)


def _axis(name: object, entry: Any) -> GridAxis:
    if not isinstance(name, str):
        raise ValueError(f"over must map names to values, but {name!r} is not a name.")
    # A DataFrame is not a Mapping, but has the same interface.
    zipped = isinstance(entry, Mapping) or hasattr(entry, "columns")
    values = {each: _numbers(each, entry[each]) for each in entry} if zipped else {name: _numbers(name, entry)}
    if not values:
        raise ValueError(f"over[{name!r}] is empty: name at least one number that changes along it.")
    lengths = {each: x.shape[0] for each, x in values.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(
            f"Numbers that change together must have the same length, but over[{name!r}] has {lengths}. For all"
            " combinations, use a separate dimension for each."
        )
    return GridAxis(name, values)


def _numbers(name: object, entry: object) -> np.ndarray:
    if not isinstance(name, str):
        raise ValueError(f"over must map names to values, but {name!r} is not a name.")
    try:
        values = np.asarray(entry)
    except ValueError as error:
        raise ValueError(f"{name!r} in over must be an array of numbers: {error}") from error
    if values.dtype.kind not in "iuf":
        raise ValueError(
            f"{name!r} in over must hold real numbers, but {entry!r} was given. Static arguments (solver, max_steps)"
            " cannot be swept: call sweep once for each value, and join the results by xarray.concat."
        )
    if values.ndim == 0 or values.shape[0] == 0:
        raise ValueError(f"{name!r} in over must be a sequence of at least one value, but {entry!r} was given.")
    if not np.isfinite(values).all():
        where = np.argwhere(~np.isfinite(values))[0].tolist()
        raise ValueError(f"{name!r} in over must be finite, but at {where} it is {values[tuple(where)]}.")
    return values


@dataclass(frozen=True)
class Blocks:
    """A grid cut into blocks that are computed and stored together, of shape `extent`; smaller at the upper edges."""

    shape: tuple[int, ...]
    extent: tuple[int, ...]

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Number of blocks along each dimension."""
        return tuple(-(-n // m) for n, m in zip(self.shape, self.extent, strict=True))

    def __len__(self) -> int:
        """Number of blocks."""
        return prod(self.counts)

    def place(self, block: int) -> tuple[slice, ...]:
        """Slices of a block in the grid."""
        where = np.unravel_index(block, self.counts)
        return tuple(
            slice(int(i) * m, min((int(i) + 1) * m, n)) for i, m, n in zip(where, self.extent, self.shape, strict=True)
        )

    def index(self, block: int) -> np.ndarray:
        """Indices of the runs of a block, in the shape of the block."""
        return np.ravel_multi_index(np.ix_(*(np.arange(p.start, p.stop) for p in self.place(block))), self.shape)


def blocks(shape: Sequence[int], runs: int) -> Blocks:
    """Cut a grid into even blocks of at most `runs` runs, across the first dimensions."""
    extent: list[int] = []
    for n in reversed(shape):
        most = max(runs // prod(extent), 1)
        extent.insert(0, -(-n // -(-n // most)))
    return Blocks(tuple(shape), tuple(extent))
