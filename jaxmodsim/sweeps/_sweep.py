"""`sweep`: a scene, or any function, run for many numbers."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import prod
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from .._core.arguments import as_whole
from .._core.progress import reported
from .._core.system import commit, extra
from ..scene import Scene
from ._compute import GROUP, Work, runs_per_call
from ._execute import Task, in_threads, run_on_executor
from ._grid import Blocks, blocks, grid
from ._layout import layout
from ._predict import Prediction, predict_steps
from ._progress import Progress, SweepProgress, SweepWords
from ._provenance import describe, package_versions, provenance, solver_of
from ._request import Request, request
from ._results import AbstractResults, Memory, Store

if TYPE_CHECKING:
    import xarray as xr

# Runs of a block: that many take a fraction of a second of short runs, and little room.
_RUNS = 16384
# A sweep is cut into at least so many blocks, as far as each keeps a group of runs.
_BLOCKS = 16
# Room that the results of a block may take [bytes].
_ROOM = 64_000_000
# Runs of a block on an accelerator, which runs all of them as one.
_RUNS_ON_ACCELERATOR = 1 << 18


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

    ```python
    runs = jaxmodsim.sweep(
        scene,
        over={"k": np.linspace(50.0, 200.0, 100), "friction.belt_velocity": np.geomspace(0.01, 1.0, 100)},
        observe={"amplitude": (lambda run: jnp.ptp(run.q[:, 0]), "m"), "x": "q[0]"},
        q0=[0.0], qd0=[0.0], t1=20.0, ts=jnp.linspace(0.0, 20.0, 201),
    )
    runs["amplitude"].sel(k=100.0, method="nearest")
    ```

    Runs are computed in narrow groups that fit the cache, one thread for each core; where a sweep has more than 1024
    of them, a few are run first, to sort the others by the number of steps that they will take. A run that takes many
    more steps than its neighbours leaves them, and is run again among others like it. The numbers are those of single
    calls of `simulate` to rounding.

    **Arguments:**

    - `system`: a `Scene`; or a function that is called with the numbers of a run by name and returns real numbers, a
      dictionary of them, or a run (`simulate(..., throw=False)`) that is then observed. Functions must be traceable by
      JAX, and are compared by identity: define them once.
    - `over`: what changes. A name with an array of values is a dimension; all combinations of the dimensions are run. A
      name with a mapping (or table) of several names to equally long arrays is one dimension along which they change
      together, as in `{"sample": jaxmodsim.sweeps.latin_hypercube(...)}`. Names are those of the numbers of the scene
      (`jaxmodsim.scene.scene_numbers`, `[i]` behind for an entry of an array), and `q0`, `qd0`, `q0[i]`, `qd0[i]`,
      `t0`, `t1`, `rtol`, `atol`, `dt`, `dtmax`. Values of a number that is an array have the shape `[n, ...]`.
    - `observe`: what is kept, by name: a function of the `Trajectory` that returns real numbers, a name (`q[0]`,
      `qd[0]`, or of an effect for its force) that is read at `ts` or, without, at the end, a
      `jaxmodsim.sweeps.Derivative`, or one of these with its unit, as in `(function, "s")`. Or names alone.
    - `q0`, `qd0`, `t1`: as for `simulate`; left out where they are in `over`.
    - `out`: folder of a Zarr store. Results are written there chunk by chunk; a call that finds results of the same
      sweep goes on with them. Without, they are kept in memory.
    - `executor`: a `dask.distributed.Client` or a `concurrent.futures.Executor`, to whose workers chunks are sent; by
      default threads of this process.
    - `devices`: JAX devices to share the chunks among; by default all of this process.
    - `chunk`: largest number of runs that are computed, sent and written as one; by default up to 16384, fewer where
      results are large.
    - `progress`: True for a line of text, or a function that is called with a `jaxmodsim.sweeps.SweepProgress` after
      each chunk.
    - `options`: further arguments of `simulate`, `ts` among them, but not `throw` and `adjoint`.

    **Returns:**

    An `xarray.Dataset`: what is observed over the dimensions of the sweep (and `time`), NaN where a run failed;
    `result`, how each ended (0 where all went well; the sentences are in its attribute `flag_meanings`; -1 where it has
    not been run); `num_steps`; and as attributes all that the numbers follow from. With `out` values are read when they
    are asked for. Ctrl-C ends a sweep in memory with what has been run; with `out` it raises, and the next call goes
    on.

    **Raises:**

    - `ValueError` for wrong names, shapes, types or ranges, before anything runs; and where `out` holds the results of
      another scene, other numbers, code, or versions.
    - `ImportError` where the extra `sweep` is not installed.
    """
    with reported(progress, "sweep", SweepWords()) as report:
        for needed in ("xarray", "zarr"):  # rather now than after the runs
            extra(needed)
        asked = request(system, grid(over), observe, {"q0": q0, "qd0": qd0, "t1": t1, **options})
        places: list[Any] = list(devices) if devices is not None else jax.local_devices()
        runs = runs_per_block(asked, places[0].platform, chunk)
        cut = blocks(asked.grid.shape, runs)
        group = GROUP if places[0].platform == "cpu" else runs
        work = Work(asked.run, asked.fixed, None, group, jnp.result_type(float) == jnp.float64)
        results = _results(asked, work, cut, out)
        try:
            _run(asked, work, cut, results, executor, places, report)
        except KeyboardInterrupt:
            if out is not None:
                raise KeyboardInterrupt(f"Interrupted; call sweep again with out={str(out)!r} to go on.") from None
            warnings.warn("sweep was interrupted: runs that have not been run have the result -1.", stacklevel=2)
        return results.dataset()


def runs_per_block(asked: Request, platform: str, chunk: int | None) -> int:
    """Runs of a block.

    **Raises:**

    - `ValueError` if `chunk` is no positive integer.
    """
    if chunk is not None:
        return as_whole(chunk, name="chunk")
    room = sum(np.prod(x.shape, initial=1.0) * x.dtype.itemsize for x in asked.shapes.values.values())
    if platform != "cpu":
        return max(min(_RUNS_ON_ACCELERATOR, int(_ROOM / room)), 1)
    even = -(-asked.grid.size // (_BLOCKS * GROUP)) * GROUP
    # Whole calls of compiled code, where there are enough runs for that.
    call = runs_per_call(even, GROUP)
    even = -(-even // call) * call
    return max(min(_RUNS, even, int(_ROOM / room)), 1)


def _results(asked: Request, work: Work, cut: Blocks, out: str | PathLike[str] | None) -> AbstractResults:
    laid = layout(asked)
    attrs = {
        "system": describe(asked),
        "solver": solver_of(asked),
        "made_by": f"jaxmodsim {package_versions()['jaxmodsim']}",
        "commit": commit(),
    }
    about = provenance(asked, work, cut.extent)
    return Memory(laid, cut, attrs, about) if out is None else Store(Path(out), laid, cut, attrs, about)


def _run(
    asked: Request,
    work: Work,
    cut: Blocks,
    results: AbstractResults,
    executor: object,
    devices: list[object],
    report: Progress | None,
) -> None:
    """Run the blocks that are not there yet."""
    left, done, failed = [], 0, 0
    for block in range(len(cut)):
        codes = results.done(block)
        if codes is None:
            left.append(block)
        else:
            done, failed = done + codes.size, failed + int((codes != 0).sum())
    if report is not None:
        report(SweepProgress(done, asked.grid.size, failed))
    if not left:
        return
    work, prediction = predict_steps(work, asked.grid, prod(cut.extent))
    tasks = _tasks(asked, cut, left, prediction)
    came = in_threads(work, tasks, devices) if executor is None else run_on_executor(work, tasks, executor)
    for block, computed in came:
        results.write(block, computed)
        done, failed = done + computed.code.size, failed + int((computed.code != 0).sum())
        if report is not None:
            report(SweepProgress(done, asked.grid.size, failed))


def _tasks(asked: Request, cut: Blocks, left: list[int], prediction: Prediction | None) -> Iterator[Task]:
    for block in left:
        index = cut.index(block).ravel()
        numbers = asked.grid.numbers_at(index)
        yield block, numbers, np.arange(index.size) if prediction is None else prediction.order(numbers)
