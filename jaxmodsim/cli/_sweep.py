"""`jaxmodsim sweep`: many runs by a SPEC, into a store."""

import logging
import signal
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from .._core.progress import progress_line
from .._core.speed import tune_cpu
from ..plot import map2d
from ..sweeps import SweepPlan, SweepProgress, SweepWords, plan_sweep, sweep
from ._options import Interrupted
from ._output import say, show_paths, show_table, write
from ._spec import Spec, read_spec
from ._spec_scene import MODEL

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class SweepRequest:
    """The arguments of `jaxmodsim sweep`, as they were typed; see its --help."""

    spec: Path
    out: Path | None
    figure: Path | None
    chunk: int | None
    workers: int | None
    scheduler: str | None
    dry_run: bool


def run_sweep(request: SweepRequest) -> None:
    """Run what the SPEC says, print how it went, and draw what was asked for.

    **Raises:**

    - `ValueError` as `read_spec` and `sweep` do, and for options that do not go together.
    - `Interrupted` after Ctrl-C, with what is kept.
    """
    _check(request)
    try:
        _run(request, read_spec(request.spec))
    except ImportError as error:  # of the extra
        raise ValueError(str(error)) from error
    except Exception as error:  # whatever the functions of a file do
        line = _line_of_model(error)
        if line is None:
            raise
        raise ValueError(f"{line}: {type(error).__name__}: {error}") from error


def _line_of_model(error: Exception) -> str | None:
    """Where in the file of a SPEC an error comes from; None where it does not."""
    file = getattr(sys.modules.get(MODEL), "__file__", None)
    frames = traceback.extract_tb(error.__traceback__)
    in_model = [frame for frame in frames if frame.filename == file]
    return f"{Path(file).name}, line {in_model[-1].lineno}" if file is not None and in_model else None


def _check(request: SweepRequest) -> None:
    if request.out is None and not request.dry_run:
        raise ValueError("--out STORE is missing: the folder that the results go to, or --dry-run for none.")
    if request.workers is not None and request.scheduler is not None:
        raise ValueError("--workers and --scheduler do not go together: the runs go to one cluster.")
    if request.figure is not None and (request.figure.is_dir() or request.figure.suffix.lower() != ".png"):
        raise ValueError(f"--figure must be a file that ends in .png, but it is {request.figure}.")


def _run(request: SweepRequest, spec: Spec) -> None:
    arguments: dict[str, Any] = {"chunk": request.chunk, **spec.run}
    drawn = ""
    if request.dry_run or request.figure is not None:
        laid = plan_sweep(spec.system, spec.over, spec.observe, **arguments)
        drawn = next(iter(laid.variables))
        if request.figure is not None:
            _check_figure(spec, laid, drawn)
        if request.dry_run:
            _show_plan(laid)
            return
    assert request.out is not None
    seen: list[SweepProgress] = []
    started = time.perf_counter()
    with _executor(request) as executor:
        try:
            with progress_line("sweep") as show:
                words = SweepWords()

                def report(now: SweepProgress) -> None:
                    seen.append(now)
                    show(words(now))

                results = sweep(
                    spec.system,
                    spec.over,
                    spec.observe,
                    out=request.out,
                    executor=executor,
                    progress=report,
                    **arguments,
                )
        except KeyboardInterrupt:
            if not seen:
                raise
            raise Interrupted(
                f"interrupted; {seen[-1].done:,} of {seen[-1].total:,} runs are kept in {request.out}, and the same"
                " command goes on with the others"
            ) from None
    _show_summary(results, seen, time.perf_counter() - started, request.out)
    if request.figure is not None:
        figure = map2d(results, drawn, title=request.spec.stem)
        show_paths(write(request.figure.parent, {request.figure.name: figure}))


def _check_figure(spec: Spec, laid: SweepPlan, name: str) -> None:
    """Refuse what cannot be drawn before hours are spent on it."""
    dims, _ = laid.variables[name]
    if len(dims) != 2 or len(laid.dims) != 2:
        raise ValueError(f"--figure needs a first variable over two dimensions, but {name!r} has {', '.join(dims)}.")
    for dim, swept in laid.swept.items():
        given = spec.over[dim]
        values = np.asarray(given[swept[0]] if isinstance(given, dict) else given, float)
        steps = np.diff(values, axis=0)
        if values.ndim > 1 or values.size < 2 or not ((steps > 0).all() or (steps < 0).all()):
            raise ValueError(
                f"--figure needs two or more values along each dimension that rise or fall, but {swept[0]!r} has"
                f" {np.array2string(values, threshold=4, edgeitems=2, precision=4)}."
            )


@contextmanager
def _executor(request: SweepRequest) -> Iterator[object]:
    """A cluster, here or elsewhere; None for the threads of this process."""
    if request.workers is None and request.scheduler is None:
        yield None
        return
    import cloudpickle
    from dask.distributed import Client, LocalCluster

    if MODEL in sys.modules:  # workers do not have the file
        cloudpickle.register_pickle_by_value(sys.modules[MODEL])
    if request.scheduler is not None:
        try:
            client = Client(request.scheduler, timeout="10s")
        except (OSError, ValueError) as error:
            raise ValueError(f"--scheduler {request.scheduler} does not answer: {error}") from error
        with client:
            yield client
        return
    # Ctrl-C reaches every process of the terminal; it is this one that ends the others, and what ends late is killed.
    options: dict[str, Any] = {"threads_per_worker": 1, "dashboard_address": None, "silence_logs": logging.ERROR}
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        cluster = LocalCluster(n_workers=request.workers, **options)
    finally:
        signal.signal(signal.SIGINT, before)
    with cluster, Client(cluster) as client:
        client.run(tune_cpu)  # as in this process
        yield client


def _show_plan(laid: SweepPlan) -> None:
    dims = [(name, size, ", ".join(laid.swept[name])) for name, size in laid.dims.items()]
    show_table(pd.DataFrame(dims, columns=["dimension", "values", "what changes"]), "What would be swept")
    kept = [(name, " x ".join(dims), unit or "-") for name, (dims, unit) in laid.variables.items()]
    show_table(pd.DataFrame(kept, columns=["variable", "over", "unit"]), "What would be kept")
    say(f"{laid.runs:,} runs, in {laid.chunks:,} chunks of up to {laid.runs_per_chunk:,}; nothing was run.")


def _show_summary(results: "xr.Dataset", seen: list[SweepProgress], seconds: float, out: Path) -> None:
    codes, counts = np.unique(np.asarray(results["result"]), return_counts=True)
    sentences = results["result"].attrs["flag_meanings"]
    rows = [(f"{n:,}", sentences[code]) for code, n in zip(codes, counts, strict=True)]
    show_table(pd.DataFrame(rows, columns=["runs", "how they ended"]), f"{seen[-1].total:,} runs")
    now = seen[-1].done - seen[0].done
    if now:
        before = f", {seen[0].done:,} were there before" if seen[0].done else ""
        say(f"{now:,} run in {seconds:.1f} s with compilation, {now / seconds:,.0f}/s{before}.")
    else:
        say("All were there before.")
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    say(f"{out.resolve()}: {size / 1e6:,.3g} MB; read it by xarray.open_zarr.")
