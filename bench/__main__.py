"""The benches as one suite: each in a process of its own, one after the other, then the tables of the documentation.

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
    """A run of one bench: how it ended, and after how long; None before."""

    name: str
    code: int | None = None
    seconds: float = 0.0


@app.command()
def main(
    names: Annotated[
        list[str] | None, typer.Argument(help="Benches by name or its beginning, such as lugre; all without.")
    ] = None,
    show: Annotated[bool, typer.Option("--list", help="Say what there is, and run nothing.")] = False,
    smoke: Annotated[
        bool, typer.Option("--smoke", help="Small configurations that show that everything runs; nothing is kept.")
    ] = False,
    jobs: Annotated[int, typer.Option(min=1, help="Benches at a time; more than one only with --smoke.")] = 1,
    out: Annotated[
        Path | None, typer.Option(help="Folder of results and figures; by default they are recorded for the pages.")
    ] = None,
) -> None:
    """Run the benches one after the other, and render the tables of the documentation.

    The result of a bench is recorded when it has ended well, on a clean commit alone; Ctrl-C leaves those of the
    finished ones.
    """
    for name in names or []:
        if not any(each.startswith(name) for each in REPORTS):
            raise typer.BadParameter(f"no bench is called {name!r}; there are {', '.join(REPORTS)}")
    runs = [Run(name) for name in REPORTS if not names or name.startswith(tuple(names))]
    if show:
        for run in runs:
            print(f"{run.name:<24} {REPORTS[run.name].says}")
        return
    if jobs > 1 and not smoke:
        raise typer.BadParameter("benches that run at the same time disturb each other: --jobs needs --smoke")
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
    """Run them, `jobs` at a time; whether Ctrl-C came in between."""
    started: list[subprocess.Popen[bytes]] = []

    def one(run: Run) -> None:
        with tempfile.TemporaryDirectory() as scratch, tempfile.TemporaryFile() as log:
            command = [sys.executable, "-m", "bench.one", run.name, scratch, *(["--smoke"] if smoke else [])]
            quiet = {"stdout": log, "stderr": subprocess.STDOUT} if jobs > 1 else {}
            began = time.perf_counter()
            # Of Ctrl-C this process hears first, and hands it on.
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
    """Put result and figures in their places."""
    result = scratch / f"{name}.json"
    if out is not None:
        shutil.copytree(scratch, out, dirs_exist_ok=True)
    elif result.exists() and not smoke:
        if not json.loads(result.read_text())["provenance"]["clean"]:
            print(f"{name} is not recorded, as there are uncommitted changes: commit them, and run it again.")
            return
        shutil.copy(result, RESULTS)
        for figure in scratch.glob("*.png"):
            shutil.copy(figure, FIGURES)


if __name__ == "__main__":
    app(prog_name="python -m bench")
