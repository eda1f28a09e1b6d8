"""`jaxmodsim sweep`: many runs, as a SPEC says, into a store."""

import logging
import signal
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .._core.progress import progress_line
from .._core.speed import tune_cpu
from ..plot import map2d
from ..sweeps import SweepPlan, SweepProgress, SweepProgressText, plan_sweep, sweep
from ._options import Interrupted, SweepRequest
from ._output import frame_of, say, show_paths, show_table, write
from ._spec import SweepSpec, read_sweep_spec
from ._toml import MODEL

if TYPE_CHECKING:
    import xarray as xr


def run_sweep(request: SweepRequest) -> None:
    """Run the sweep of the SPEC, print a summary, and draw the figure.

    **Raises:**

    - `ValueError` as `read_sweep_spec` and `sweep`, and for options that exclude each other.
    - `Interrupted` after Ctrl-C, with the number of runs that are stored.
    """
    if request.out is None and not request.dry_run:
        raise ValueError("--out STORE is missing: the folder of the results, or --dry-run for none.")
    if request.workers is not None and request.scheduler is not None:
        raise ValueError("--workers and --scheduler exclude each other: the runs go to one cluster.")
    if request.figure is not None and (request.figure.is_dir() or request.figure.suffix.lower() != ".png"):
        raise ValueError(f"--figure must be a file that ends in .png, but it is {request.figure}.")
    try:
        _run(request, read_sweep_spec(request.spec))
    except ImportError as error:  # of the extra
        raise ValueError(str(error)) from error
    except Exception as error:  # the functions of a file may raise anything
        file = getattr(sys.modules.get(MODEL), "__file__", None)
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        if file is None or not frames:
            raise
        line = f"{Path(file).name}, line {frames[-1].lineno}"
        raise ValueError(f"{line}: {type(error).__name__}: {error}") from error


def _run(request: SweepRequest, spec: SweepSpec) -> None:
    arguments: dict[str, Any] = {"chunk": request.chunk, **spec.run}
    plan = plan_sweep(spec.system, spec.over, spec.observe, **arguments)
    drawn = next(iter(plan.variables))
    if request.figure is not None:
        _check_figure(spec, plan, drawn)
    if request.dry_run or request.out is None:
        _show_plan(plan)
        return
    reports: list[SweepProgress] = []
    started = time.perf_counter()
    with _executor(request) as executor:
        try:
            with progress_line("sweep") as show:
                words = SweepProgressText()

                def report(now: SweepProgress) -> None:
                    reports.append(now)
                    show(words(now))

                options = {"out": request.out, "executor": executor, "progress": report, **arguments}
                results = sweep(spec.system, spec.over, spec.observe, **options)
        except KeyboardInterrupt:
            if not reports:
                raise
            raise Interrupted(
                f"interrupted; {reports[-1].done:,} of {reports[-1].total:,} runs are stored in {request.out}, and the"
                " same command resumes the sweep"
            ) from None
    _show_summary(results, reports, time.perf_counter() - started, request.out)
    if request.figure is not None:
        figure = map2d(results, drawn, title=request.spec.stem)
        show_paths(write(request.figure.parent, {request.figure.name: figure}))


def _check_figure(spec: SweepSpec, plan: SweepPlan, name: str) -> None:
    """Refuse a figure that cannot be drawn before the runs."""
    dims, _ = plan.variables[name]
    if len(dims) != 2 or len(plan.dims) != 2:
        raise ValueError(f"--figure needs a first variable over two dimensions, but {name!r} has {', '.join(dims)}.")
    for dim, swept in plan.swept.items():
        entry = spec.over[dim]
        values = np.asarray(entry[swept[0]] if isinstance(entry, dict) else entry, float)
        steps = np.diff(values, axis=0)
        if values.ndim > 1 or values.size < 2 or not ((steps > 0).all() or (steps < 0).all()):
            raise ValueError(
                f"--figure needs two or more values along each dimension that rise or fall, but {swept[0]!r} has"
                f" {np.array2string(values, threshold=4, edgeitems=2, precision=4)}."
            )


@contextmanager
def _executor(request: SweepRequest) -> Iterator[object]:
    """A local or remote cluster; None for the threads of this process."""
    if request.workers is None and request.scheduler is None:
        yield None
        return
    import cloudpickle
    from dask.distributed import Client, LocalCluster

    if MODEL in sys.modules:  # workers cannot import the file
        cloudpickle.register_pickle_by_value(sys.modules[MODEL])
    if request.scheduler is not None:
        try:
            client = Client(request.scheduler, timeout="10s")
        except (OSError, ValueError) as error:
            raise ValueError(f"--scheduler {request.scheduler} does not answer: {error}") from error
        with client:
            yield client
        return
    # Ctrl-C reaches every process of the terminal: the workers ignore it, and this process ends them.
    options: dict[str, Any] = {"threads_per_worker": 1, "dashboard_address": None, "silence_logs": logging.ERROR}
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        cluster = LocalCluster(n_workers=request.workers, **options)
    finally:
        signal.signal(signal.SIGINT, before)
    with cluster, Client(cluster) as client:
        client.run(tune_cpu)  # as in this process
        yield client


def _show_plan(plan: SweepPlan) -> None:
    dims = [(name, size, ", ".join(plan.swept[name])) for name, size in plan.dims.items()]
    show_table(frame_of(dims, "dimension", "values", "numbers that change"), "Dimensions")
    variables = [(name, " x ".join(dims), unit or "-") for name, (dims, unit) in plan.variables.items()]
    show_table(frame_of(variables, "variable", "over", "unit"), "Results")
    say(f"{plan.runs:,} runs, in {plan.chunks:,} chunks of up to {plan.runs_per_chunk:,}; nothing was run.")


def _show_summary(results: "xr.Dataset", reports: list[SweepProgress], seconds: float, out: Path) -> None:
    codes, counts = np.unique(np.asarray(results["result"]), return_counts=True)
    sentences = results["result"].attrs["flag_meanings"]
    rows = [(f"{n:,}", sentences[code]) for code, n in zip(codes, counts, strict=True)]
    first, last = reports[0], reports[-1]
    show_table(frame_of(rows, "runs", "ending"), f"{last.total:,} runs")
    if first.done:
        say(f"{first.done:,} of {first.total:,} runs were already stored.")
    if computed := last.done - first.done:
        say(f"{computed:,} runs in {seconds:.1f} s with compilation, {computed / seconds:,.0f}/s.")
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    say(f"{out.resolve()}: {size / 1e6:,.3g} MB; open it with xarray.open_zarr.")
