"""`sweep`: a scene, or any function, run for many numbers; its plan and its progress."""

import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from .._core.arguments import as_whole
from .._core.progress import minutes, reported
from .._core.system import commit, extra
from ..scene import Scene
from ._compute import GROUP, Task, Work, in_threads, run_on_executor, runs_per_call
from ._grid import Blocks, blocks, grid
from ._predict import predict_steps
from ._request import Request, request_of
from ._results import Results, describe, layout, package_versions, provenance, solver_of

if TYPE_CHECKING:
    import xarray as xr

# Largest number of runs in a block: short runs of it take a fraction of a second.
_RUNS = 16384
# Least number of blocks of a sweep, if each has a group of runs or more.
_BLOCKS = 16
# Largest size of the results of a block [bytes].
_ROOM = 64_000_000
# Largest number of runs in a block on an accelerator, which computes all of them together.
_RUNS_ON_ACCELERATOR = 1 << 18


@dataclass(frozen=True)
class SweepProgress:
    """The progress of a sweep.

    - `done`, `total`: numbers of runs; runs that were already stored count as done.
    - `failed`: number of runs, of those done, that ended early. `reason`: what most of them ended with.
    """

    done: int
    total: int
    failed: int
    reason: str = ""


Progress: TypeAlias = Callable[[SweepProgress], None]


class SweepProgressText:
    """Converts reports of progress to text, with the pace since the first chunk and the time left at that pace."""

    _stored: int | None = None
    _first: tuple[int, float] | None = None

    def __call__(self, now: SweepProgress) -> str:
        """The text."""
        self._stored = now.done if self._stored is None else self._stored
        count, ended = f"{now.done:,} of {now.total:,} runs", now.done == now.total
        words = f"{count}{' already stored' if now.done == self._stored else ''}, {now.failed:,} failed"
        if ended:
            return f"{words}, most with: {now.reason}" if now.reason else words
        if now.done == self._stored:
            return f"{count} already stored, compiling" if now.done else "compiling"
        runs, began = self._first = self._first or (now.done, time.perf_counter())
        if now.done == runs:  # the time of the first chunk is that of compilation, too
            return words
        pace = (now.done - runs) / max(time.perf_counter() - began, 1e-3)
        return f"{words}, {pace:,.{0 if pace >= 10 else 1}f}/s, {minutes((now.total - now.done) / pace)} left"


@dataclass(frozen=True)
class SweepPlan:
    """The plan of a sweep.

    - `dims`: number of points along each dimension.
    - `swept`: the numbers that change along each dimension.
    - `runs`: number of runs; `chunks`: number of chunks, of up to `runs_per_chunk` runs each.
    - `variables`: dimensions and unit of each variable of the result; unit "" if unknown.
    """

    dims: dict[str, int]
    swept: dict[str, tuple[str, ...]]
    runs: int
    chunks: int
    runs_per_chunk: int
    variables: dict[str, tuple[tuple[str, ...], str]]


def sweep(
    system: Scene | Callable[..., object],
    over: Mapping[str, object],
    observe: Mapping[str, object] | Sequence[str] | str | None = None,
    *,
    q0: ArrayLike | list[float] | None = None,
    qd0: ArrayLike | list[float] | None = None,
    t1: ArrayLike | None = None,
    out: str | PathLike[str] | None = None,
    executor: object = None,
    devices: Sequence[object] | None = None,
    chunk: int | None = None,
    progress: bool | Progress = False,
    **options: object,
) -> "xr.Dataset":
    """Run a scene, or any function, for many numbers, on all cores, in bounded memory.

    Runs are computed in small groups that fit the cache, in one thread per core. For more than 1024 runs, a trial of a
    few predicts the number of steps of the others, which are sorted by it. A run with many more steps than its
    neighbours leaves its group, and is computed again with other slow runs. The results equal those of single calls of
    `simulate` up to rounding.

    **Arguments:**

    - `system`: a `Scene`; or a function that is called with the numbers of a run by name and returns real numbers, a
      dictionary of them, or a run (`simulate(..., throw=False)`) to observe. Functions must be traceable by JAX, and
      are compared by identity: define them once.
    - `over`: the numbers that change. A name with an array of values is a dimension; all combinations of the dimensions
      are run. A name with a mapping (or table) of several names to arrays of the same length is one dimension along
      which they change together, as in `{"sample": jaxmodsim.sweeps.latin_hypercube(...)}`. Names are those of the
      numbers of the scene (`jaxmodsim.scene.scene_numbers`, with `[i]` for an entry of an array), and `q0`, `qd0`,
      `q0[i]`, `qd0[i]`, `t0`, `t1`, `rtol`, `atol`, `dt`, `dtmax`. Values of an array have the shape `[n, ...]`.
    - `observe`: the observables by name. Each is a function of the `Trajectory` that returns real numbers, a name
      (`q[0]`, `qd[0]`, or an effect for its force), which is evaluated at `ts`, or at the end without `ts`, a
      `jaxmodsim.sweeps.Derivative`, or one of these with its unit, as in `(function, "s")`. Or a list of names.
    - `q0`, `qd0`, `t1`: as for `simulate`; omitted if they are in `over`.
    - `out`: folder of a Zarr store, to which results are written chunk by chunk. A call that finds results of the same
      sweep resumes it. Without `out`, results are kept in memory.
    - `executor`: a `dask.distributed.Client` or a `concurrent.futures.Executor`, which computes the chunks; by default
      threads of this process.
    - `devices`: JAX devices that share the chunks; by default all devices of this process.
    - `chunk`: largest number of runs that are computed, sent and written together; by default up to 16384, fewer for
      large results.
    - `progress`: True for a line of text, or a function that is called with a `jaxmodsim.sweeps.SweepProgress` after
      each chunk.
    - `options`: further arguments of `simulate`, such as `ts`, but not `throw` and `adjoint`.

    **Returns:**

    An `xarray.Dataset` over the dimensions of the sweep (and `time`): the observables, NaN for runs that failed;
    `result`, the code of each run (0 for success; the attribute `flag_meanings` has the sentences; -1 for runs that
    were not computed); `num_steps`; and, as attributes, everything that determines the results. With `out`, values are
    read on access. Ctrl-C ends a sweep in memory with its results so far; with `out` it raises, and the next call
    resumes.

    **Raises:**

    - `ValueError` for wrong names, shapes, types or ranges, before anything runs; and if `out` holds the results of
      another scene, other numbers, code or versions.
    - `ImportError` without the extra `sweep`.

    **Example:**

    ```python
    scene = jms.problems.braked_spring.scene()
    runs = jms.sweep(scene, {"k": np.linspace(2.0, 3.0, 3)}, {"x": "q[0]"}, q0=[1.0], qd0=[0.0], t1=2.0)
    print(runs["x"].sel(k=2.5).values.round(4), runs["x"].dims)
    ```

    ```text
    -0.933 ('k',)
    ```
    """
    with reported(progress, "sweep", SweepProgressText()) as report:
        for library in ("xarray", "zarr"):  # a missing one is better reported before the runs
            extra(library)
        request = request_of(system, grid(over), observe, {"q0": q0, "qd0": qd0, "t1": t1, **options})
        chosen: list[Any] = list(devices) if devices is not None else jax.local_devices()
        runs = _runs_per_block(request, chosen[0].platform, chunk)
        cut = blocks(request.grid.shape, runs)
        group = GROUP if chosen[0].platform == "cpu" else runs
        work = Work(request.run, request.fixed, None, group, jnp.result_type(float) == jnp.float64)
        attrs = {
            "system": describe(request),
            "solver": solver_of(request),
            "made_by": f"jaxmodsim {package_versions()['jaxmodsim']}",
            "commit": commit(),
        }
        path = None if out is None else Path(out)
        results = Results(path, layout(request), cut, attrs, provenance(request, work, cut.extent))
        try:
            _run(request, work, cut, results, executor, chosen, report)
        except KeyboardInterrupt:
            if out is not None:
                raise KeyboardInterrupt(f"Interrupted; call sweep again with out={str(out)!r} to resume.") from None
            warnings.warn("sweep was interrupted: runs that were not computed have the result -1.", stacklevel=2)
        return results.dataset()


def plan_sweep(
    system: Scene | Callable[..., object],
    over: Mapping[str, object],
    observe: Mapping[str, object] | Sequence[str] | str | None = None,
    *,
    chunk: int | None = None,
    **arguments: object,
) -> SweepPlan:
    """Check the arguments of a sweep as `sweep` does, and return its plan.

    **Arguments:**

    - `system`, `over`, `observe`, `chunk`: as for `sweep`.
    - `arguments`: further arguments of `sweep` for `simulate`.

    **Returns:**

    A `SweepPlan`.

    **Raises:**

    - `ValueError` as `sweep` does, before anything runs.
    """
    request = request_of(system, grid(over), observe, arguments)
    cut = blocks(request.grid.shape, _runs_per_block(request, jax.local_devices()[0].platform, chunk))
    result = layout(request)
    return SweepPlan(
        {axis.name: axis.size for axis in request.grid.axes},
        {axis.name: tuple(axis.values) for axis in request.grid.axes},
        request.grid.size,
        len(cut),
        prod(cut.extent),
        {x.name: ((*result.dims, *x.dims), str(x.attrs.get("units", ""))) for x in result.variables},
    )


def _runs_per_block(request: Request, platform: str, chunk: int | None) -> int:
    """Number of runs in a block.

    **Raises:**

    - `ValueError` if `chunk` is not a positive integer.
    """
    if chunk is not None:
        return as_whole(chunk, name="chunk")
    room = sum(np.prod(x.shape, initial=1.0) * x.dtype.itemsize for x in request.shapes.values.values())
    if platform != "cpu":
        return max(min(_RUNS_ON_ACCELERATOR, int(_ROOM / room)), 1)
    even = -(-request.grid.size // (_BLOCKS * GROUP)) * GROUP
    # A multiple of the runs in a call of compiled code.
    call = runs_per_call(even, GROUP)
    even = -(-even // call) * call
    return max(min(_RUNS, even, int(_ROOM / room)), 1)


def _run(
    request: Request,
    work: Work,
    cut: Blocks,
    results: Results,
    executor: object,
    devices: list[object],
    report: Progress | None,
) -> None:
    """Compute the blocks that are not stored yet."""
    ended: Counter[int] = Counter()  # numbers of runs by their codes

    def tell(codes: Iterable[np.ndarray]) -> None:
        for each in codes:
            ended.update(each.ravel().tolist())
        if report is not None:
            failed = Counter({code: runs for code, runs in ended.items() if code})
            reason = request.shapes.messages[failed.most_common(1)[0][0]] if failed else ""
            report(SweepProgress(ended.total(), request.grid.size, failed.total(), reason))

    stored = {block: results.done(block) for block in range(len(cut))}
    missing = [block for block, codes in stored.items() if codes is None]
    tell(codes for codes in stored.values() if codes is not None)
    if not missing:
        return
    work, prediction = predict_steps(work, request.grid, prod(cut.extent))

    def tasks() -> Iterator[Task]:
        for block in missing:
            index = cut.index(block).ravel()
            numbers = request.grid.numbers_at(index)
            yield block, numbers, np.arange(index.size) if prediction is None else prediction.order(numbers)

    computed = in_threads(work, tasks(), devices) if executor is None else run_on_executor(work, tasks(), executor)
    for block, part in computed:
        results.write(block, part)
        tell([part.code])
