"""The suite of benches: each runs in its own process, one after the other, then the tables of the pages are rendered.

python -m bench [NAME ...] [--list] [--smoke [--jobs N]] [--out DIR]
"""

import concurrent.futures as cf
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(ROOT))

from bench.tables import REPORTS  # noqa: E402

RESULTS, FIGURES = HERE / "results", ROOT / "docs" / "figures"
INTERRUPTED = 130
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@dataclass
class Run:
    """A run of one bench: its exit code, None before the end, and its duration [s]."""

    name: str
    code: int | None = None
    seconds: float = 0.0


@app.command()
def main(
    names: Annotated[
        list[str] | None, typer.Argument(help="Names of benches, or their beginnings, such as lugre; by default all.")
    ] = None,
    show: Annotated[bool, typer.Option("--list", help="List the benches, and run none.")] = False,
    smoke: Annotated[bool, typer.Option("--smoke", help="Run small configurations, and record nothing.")] = False,
    jobs: Annotated[int, typer.Option(min=1, help="Number of benches at a time; more than one needs --smoke.")] = 1,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of results and figures; by default they go to bench/results and the pages."),
    ] = None,
) -> None:
    """Run the benches one after the other, and render the tables of the documentation.

    A result is recorded if the bench succeeds on a clean commit. After Ctrl-C the results of finished benches stay.
    """
    for name in names or []:
        if not any(each.startswith(name) for each in REPORTS):
            raise typer.BadParameter(f"no bench begins with {name!r}; there are: {', '.join(REPORTS)}")
    runs = [Run(name) for name in REPORTS if not names or name.startswith(tuple(names))]
    if show:
        for run in runs:
            print(f"{run.name:<24} {REPORTS[run.name].says}")
        return
    if jobs > 1 and not smoke:
        raise typer.BadParameter("--jobs needs --smoke, because simultaneous benches disturb each other")
    interrupted = _run_all(runs, jobs, smoke, out)
    for run in runs:
        ended = "not finished" if run.code is None else f"exit code {run.code}, {run.seconds:.0f} s"
        print(f"{run.name:<24} {ended}")
    if interrupted:
        raise typer.Exit(INTERRUPTED)
    code = 1 if any(run.code for run in runs) else 0
    if not smoke and out is None:
        code = max(code, subprocess.run([sys.executable, str(HERE / "render.py")], check=False).returncode)
    raise typer.Exit(code)


def _run_all(runs: list[Run], jobs: int, smoke: bool, out: Path | None) -> bool:
    """Run benches, `jobs` at a time; returns whether Ctrl-C interrupted them."""
    started: list[subprocess.Popen[bytes]] = []

    def one(run: Run) -> None:
        with tempfile.TemporaryDirectory() as scratch, tempfile.TemporaryFile() as log:
            command = [sys.executable, "-m", "bench.one", run.name, scratch, *(["--smoke"] if smoke else [])]
            quiet = {"stdout": log, "stderr": subprocess.STDOUT} if jobs > 1 else {}
            began = time.perf_counter()
            # Ctrl-C reaches this process alone, which then ends the others.
            started.append(process := subprocess.Popen(command, start_new_session=True, cwd=ROOT, **quiet))  # pyright: ignore
            code = process.wait()
            if stopped:
                return
            run.code, run.seconds = code, time.perf_counter() - began
            log.seek(0)
            said = log.read().decode(errors="replace")
            print(f"=== {run.name}: exit code {code}, {run.seconds:.0f} s\n{said}", flush=True)
            if code == 0:
                _keep(run.name, Path(scratch), smoke, out)

    stopped: list[bool] = []
    with cf.ThreadPoolExecutor(jobs) as pool:
        futures = [pool.submit(one, run) for run in runs]
        try:
            for future in futures:
                future.result()
        except KeyboardInterrupt:
            stopped.append(True)
            pool.shutdown(wait=False, cancel_futures=True)
            for process in started:
                if process.poll() is None:
                    process.send_signal(signal.SIGTERM)
    return bool(stopped)


def _keep(name: str, scratch: Path, smoke: bool, out: Path | None) -> None:
    """Copy result and figures to their folders."""
    result = scratch / f"{name}.json"
    if out is not None:
        shutil.copytree(scratch, out, dirs_exist_ok=True)
    elif result.exists() and not smoke:
        if not json.loads(result.read_text())["provenance"]["clean"]:
            print(f"{name} is not recorded because of uncommitted changes: commit them, and run it again.")
            return
        shutil.copy(result, RESULTS)
        for figure in scratch.glob("*.png"):
            shutil.copy(figure, FIGURES)


if __name__ == "__main__":
    app(prog_name="python -m bench")
