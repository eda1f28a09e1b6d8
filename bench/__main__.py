"""The benches as one suite: each in a process of its own, one after the other, then the tables of the documentation.

python -m bench [NAME ...] [--list] [--smoke [--jobs N]] [--out DIR] [--jaxonomy PYTHON]
"""

import ast
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
# What else a bench is run with, each time as a run of its own.
ALSO: dict[str, tuple[str, ...]] = {"a0_lugre_testbench": ("--no-tune",)}
# Benches that measure jaxonomy.
WITH_JAXONOMY = ("a0_lugre_testbench", "d0_stick_slip", "j0_hard_cases")
INTERRUPTED = 130

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
# Off a terminal (a file, a pipe) there is no width to keep to.
console = Console() if sys.stdout.isatty() else Console(width=140)


@dataclass
class Run:
    """A run of one bench.

    - `path`: of its script.
    - `options`: given to it, besides those of the suite.
    - `process`, `began`, `log`: while it runs; no log where it prints to the terminal.
    - `code`, `seconds`: how it ended, and after how long; None before.
    """

    path: Path
    options: tuple[str, ...] = ()
    process: subprocess.Popen[bytes] | None = None
    began: float = 0.0
    log: IO[bytes] | None = None
    code: int | None = None
    seconds: float | None = None
    out: Path = field(default_factory=Path)

    @property
    def name(self) -> str:
        """File name without its ending, and the options."""
        return " ".join((self.path.stem, *self.options))

    @property
    def says(self) -> str:
        """First sentence of what the bench says of itself."""
        return (ast.get_docstring(ast.parse(self.path.read_text())) or "").split("\n\n")[0].replace("\n", " ")


def every_run() -> list[Run]:
    """All runs of the suite, in their order."""
    found = []
    for path in sorted(HERE.glob("[a-z][0-9]_*.py")):
        found.append(Run(path))
        if path.stem in ALSO:
            found.append(Run(path, ALSO[path.stem]))
    return found


def chosen(names: list[str]) -> list[Run]:
    """The runs of the benches that are named by the beginning of their file names; all without names.

    **Raises:**

    - `typer.BadParameter` for a name that no bench has.
    """
    runs = every_run()
    for name in names:
        if not any(run.path.stem.startswith(name) for run in runs):
            known = ", ".join(dict.fromkeys(run.path.stem for run in runs))
            raise typer.BadParameter(f"no bench is called {name!r}; there are {known}")
    return [run for run in runs if not names or any(run.path.stem.startswith(name) for name in names)]


@app.command()
def main(
    names: Annotated[
        list[str] | None, typer.Argument(help="Benches by file name or its beginning, such as a0; all without.")
    ] = None,
    show: Annotated[bool, typer.Option("--list", help="Say what there is, and run nothing.")] = False,
    smoke: Annotated[
        bool, typer.Option("--smoke", help="Small configurations that show that everything runs; nothing is kept.")
    ] = False,
    jobs: Annotated[int, typer.Option(min=1, help="Benches at a time; more than one only with --smoke.")] = 1,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; by default bench/results, and the pages are rendered.")
    ] = None,
    jaxonomy: Annotated[
        Path | None, typer.Option(help="Python of an environment that has jaxonomy, whose pins are its own.")
    ] = None,
) -> None:
    """Run the benches one after the other, and render the tables of the documentation.

    The results of a bench take their place when it has ended well; Ctrl-C leaves those of the finished ones.
    """
    runs = chosen(names or [])
    if show:
        _list(runs)
        return
    if jobs > 1 and not smoke:
        raise typer.BadParameter("benches that run at the same time disturb each other: --jobs needs --smoke")
    with tempfile.TemporaryDirectory() as scratch:
        given = ["--smoke"] if smoke else []
        target = out or (None if smoke else RESULTS)
        interrupted = _run_all(runs, given, jobs, Path(scratch), target, jaxonomy)
    _summarise(runs)
    if interrupted:
        raise typer.Exit(INTERRUPTED)
    code = 1 if any(run.code for run in runs) else 0
    if target == RESULTS:
        code = max(code, subprocess.run([sys.executable, str(HERE / "render.py")], check=False).returncode)
    raise typer.Exit(code)


def _list(runs: list[Run]) -> None:
    for run in runs:
        console.print(f"{run.name:<32} {run.says}", highlight=False, markup=False, soft_wrap=True)


def _run_all(
    runs: list[Run], given: list[str], jobs: int, scratch: Path, target: Path | None, jaxonomy: Path | None
) -> bool:
    """Run them, `jobs` at a time; whether Ctrl-C came in between."""
    waiting, running = list(runs), []
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                run = waiting.pop(0)
                own = ["--jaxonomy", str(jaxonomy)] if jaxonomy and run.path.stem in WITH_JAXONOMY else []
                _start(run, [*given, *own], scratch, quiet=jobs > 1)
                running.append(run)
            time.sleep(0.05)
            for run in [each for each in running if each.process and each.process.poll() is not None]:
                running.remove(run)
                _finish(run, target)
    except KeyboardInterrupt:
        for run in running:
            _stop(run)
        return True
    return False


def _start(run: Run, given: list[str], scratch: Path, *, quiet: bool) -> None:
    run.out = scratch / run.name.replace(" ", "")
    run.log = tempfile.TemporaryFile() if quiet else None  # noqa: SIM115 - closed when the bench has ended
    if not quiet:
        console.rule(run.name)
    command = [sys.executable, str(run.path), *run.options, *given, "--out", str(run.out)]
    run.began = time.perf_counter()
    run.process = subprocess.Popen(command, stdout=run.log, stderr=subprocess.STDOUT if quiet else None)


def _finish(run: Run, target: Path | None) -> None:
    """Note how it ended, print what it said, and put its results in their place if it ended well."""
    assert run.process is not None
    run.code, run.seconds = run.process.returncode, time.perf_counter() - run.began
    if run.log is not None:
        run.log.seek(0)
        print(f"{run.name} (exit code {run.code}, {run.seconds:.0f} s)")
        print(run.log.read().decode(errors="replace"), flush=True)
        run.log.close()
    if run.code == 0 and target is not None and run.out.is_dir():
        shutil.copytree(run.out, target, dirs_exist_ok=True)


def _stop(run: Run) -> None:
    """End a bench that Ctrl-C may have reached already, or not."""
    assert run.process is not None
    run.process.send_signal(signal.SIGINT)
    try:
        run.process.wait(10.0)
    except subprocess.TimeoutExpired:
        run.process.kill()
        run.process.wait()


def _summarise(runs: list[Run]) -> None:
    table = Table(title="Benches", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("bench")
    table.add_column("exit code", justify="right")
    table.add_column("time [s]", justify="right")
    for run in runs:
        ended = "not finished" if run.code is None else str(run.code)
        table.add_row(run.name, ended, "-" if run.seconds is None else f"{run.seconds:.0f}")
    console.print(table)


if __name__ == "__main__":
    app(prog_name="python -m bench")
