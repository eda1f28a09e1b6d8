"""What a sweep would run, without running it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import prod

import jax

from ..scene import Scene
from ._grid import blocks, grid
from ._layout import layout
from ._request import request
from ._sweep import runs_per_block


@dataclass(frozen=True)
class SweepPlan:
    """What a sweep would run.

    - `dims`: number of places along each dimension of the sweep.
    - `swept`: the numbers that change along each.
    - `runs`: number of runs; `chunks`: in how many chunks, of up to `runs_per_chunk` runs each.
    - `variables`: dimensions and unit of each variable that would be kept, unit "" where it has none.
    """

    dims: dict[str, int]
    swept: dict[str, tuple[str, ...]]
    runs: int
    chunks: int
    runs_per_chunk: int
    variables: dict[str, tuple[tuple[str, ...], str]]


def plan_sweep(
    system: Scene | Callable[..., object],
    over: Mapping[str, object],
    observe: Mapping[str, object] | Sequence[str] | str | None = None,
    *,
    chunk: int | None = None,
    **arguments: object,
) -> SweepPlan:
    """Check the arguments of a sweep as `sweep` does, and say what it would run.

    **Arguments:**

    - `system`, `over`, `observe`, `chunk`: as for `sweep`.
    - `arguments`: further ones of `sweep` that it passes to `simulate`.

    **Raises:**

    - `ValueError` as `sweep` does, before anything runs.
    """
    asked = request(system, grid(over), observe, arguments)
    cut = blocks(asked.grid.shape, runs_per_block(asked, jax.local_devices()[0].platform, chunk))
    laid = layout(asked)
    return SweepPlan(
        {axis.name: axis.size for axis in asked.grid.axes},
        {axis.name: tuple(axis.values) for axis in asked.grid.axes},
        asked.grid.size,
        len(cut),
        prod(cut.extent),
        {x.name: ((*laid.dims, *x.dims), str(x.attrs.get("units", ""))) for x in laid.variables},
    )
