"""The commands. Everything heavy is imported inside them, so that --help and usage errors come at once."""

import logging
import sys
from pathlib import Path
from typing import Annotated

import typer

from . import _options
from ._options import Interrupted, Out

app = typer.Typer(
    name="jaxmodsim",
    help="Differentiable mechanics with friction: test benches, fits to measured records, sweeps.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def run() -> None:
    """Run the command line; an error that a user can mend is one sentence on stderr and exit code 2."""
    try:
        app()
    except (ValueError, OSError, RuntimeError) as error:
        sys.stderr.write(f"jaxmodsim: {error}\n")
        sys.exit(2)
    except Interrupted as ending:
        sys.stderr.write(f"jaxmodsim: {ending}\n")
        sys.exit(130)
    except SystemExit as ending:
        if ending.code == 130:  # what typer makes of Ctrl-C
            sys.stderr.write("jaxmodsim: interrupted; nothing was written\n")
        raise


def _start() -> None:
    """An application may set what a library must not: double precision, XLA's treatment of small loops, a cache."""
    import jax

    from .._core.speed import tune_cpu
    from ._cache import use_cache

    tune_cpu()
    logging.getLogger("jaxmodsim").setLevel(logging.ERROR)  # what takes time shows its progress
    jax.config.update("jax_enable_x64", True)
    use_cache()


@app.command()
def demo(out: Out = Path("jaxmodsim-demo")) -> None:
    """The test bench, and a LuGre fit to a synthetic record whose truth is known."""
    _start()
    from ._demo import run_demo

    run_demo(out)


@app.command("testbench")
def bench_models(out: Out = Path("jaxmodsim-testbench")) -> None:
    """A box under a rising force with one friction model after the other: figures, a table, a LuGre sweep."""
    _start()
    from ._report import report_testbench

    report_testbench(out)


@app.command()
def fit(
    record: _options.Records,
    time: _options.Time = "t",
    position: _options.Position = "q",
    force: _options.Force = "u",
    units: _options.Units = None,
    drop: _options.Drop = None,
    laws: _options.Laws = "coulomb",
    free: _options.Free = None,
    start: _options.Start = None,
    fix: _options.Fix = None,
    limit: _options.Limit = None,
    held_out: _options.HeldOut = None,
    folds: _options.Folds = None,
    loss: _options.Loss = "squares",
    begin: _options.Begin = "rough",
    starts: _options.Starts = 1,
    max_steps: _options.MaxSteps = 400,
    substeps: _options.Substeps = None,
    out: Out = Path("jaxmodsim-fit"),
    report: _options.Report = None,
    next_input: _options.NextInput = None,
    max_force: _options.MaxForce = None,
    max_speed: _options.MaxSpeed = None,
    max_travel: _options.MaxTravel = None,
    duration: _options.Duration = None,
) -> None:
    """Fit mass, offset and friction of one axis to records of position and applied force, by open-loop simulation.

    Ctrl-C ends the search; what it has found by then is written, and the exit code is 130.
    """
    _start()
    from ._fit import run_fit
    from ._plan import FitRequest

    run_fit(
        FitRequest(
            record, (time, position, force), units or [], drop or [], laws, free or [], start or [], fix or [],
            limit or [], held_out or [], folds, loss, begin, starts, max_steps, substeps, out, report, next_input,
            max_force, max_speed, max_travel, duration,
        )
    )  # fmt: skip


@app.command()
def sweep(
    spec: _options.Spec,
    out: _options.Store = None,
    figure: _options.FigureFile = None,
    chunk: _options.Chunk = None,
    workers: _options.Workers = None,
    scheduler: _options.Scheduler = None,
    dry_run: _options.DryRun = False,
) -> None:
    r"""Run a scene for many numbers, as a SPEC says, into a Zarr store; the same command goes on where one ended.

    SPEC is a TOML file of four tables; names with dots or brackets stand in
    quotes.

    \[scene] is problem = "belt_oscillator" (any of jaxmodsim.problems) with its
    numbers, and a table law with kind = "LuGre" and its numbers. Or it is
    file = "model.py" and object = "scene", a Scene or a function of that file,
    which is run: use only files that you trust.

    \[run] has q0, qd0, t1; ts, a list or {start, stop, count}; t0, rtol, atol,
    dt, dtmax, max_steps, max_events, stick_on_chatter, project.

    \[over] has an entry for each dimension, all combinations of which are run:
    a list; {from, to, count, spacing = "linear" or "log"}; a table of lists
    that change together; or {latin_hypercube = {m = \[1, 2],
    k = \[10, 1e4, "log"]}, count, seed}, or the same with sobol.

    \[observe] has an entry for each thing to keep: "q\[0]", "qd\[0]", or the name
    of an effect for its force; or {of = "qd\[0]", take = "max", unit = "m/s"},
    where take is end, max, min, mean, rms, peak (the largest magnitude) or ptp
    (from the lowest to the highest).
    """
    _start()
    from ._sweep import SweepRequest, run_sweep

    run_sweep(SweepRequest(spec, out, figure, chunk, workers, scheduler, dry_run))


@app.command()
def orbit(spec: _options.Spec, out: Out = Path("jaxmodsim-orbit")) -> None:
    r"""Find a periodic orbit, as a SPEC says: its period, extent, stability and modes.

    SPEC is a TOML file; \[scene] as for jaxmodsim sweep.

    \[orbit] has q0 and qd0, from where a simulation settles for settle seconds.
    A forced orbit has period, in seconds, or frequency, the name of the number
    that is the angular frequency of the force; without, the period is found.
    Also rtol, atol.
    """
    _start()
    from ._orbits import run_orbit

    run_orbit(spec, out)


@app.command()
def branch(spec: _options.Spec, out: Out = Path("jaxmodsim-branch")) -> None:
    r"""Follow a periodic orbit over a number, through folds, and name where it changes; goes on where one ended.

    SPEC is that of jaxmodsim orbit with one more table: \[branch] has parameter,
    the name of the number, from and to; step, the longest step as a part of
    that; max_orbits; start = "Hopf" for orbits from the first Hopf point of the
    equilibria on, which are followed from q0.
    """
    _start()
    from ._orbits import run_branch

    run_branch(spec, out)


@app.command("bench", context_settings={"ignore_unknown_options": True})
def run_benches(
    arguments: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", help="Benches, such as a0, and options of python -m bench; all without."),
    ] = None,
) -> None:
    """Run the benches of a clone of the repository: what things cost and how near they come, measured side by side.

    They are no part of the installed package: this is `python -m bench` in a clone, and takes its options --list,
    --smoke, --jobs, --out and --jaxonomy.
    """
    from ._bench import run_bench_suite

    raise typer.Exit(run_bench_suite(arguments or []))


@app.command()
def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Delete them.")] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Run a scene in two processes: does the second one compile less?")
    ] = False,
) -> None:
    """Compiled programs that commands keep for the next ones: where, how many, how large.

    A command that runs again compiles nothing. JAX_COMPILATION_CACHE_DIR names another folder,
    JAX_ENABLE_COMPILATION_CACHE=false turns it off. Exit code 1 if --check finds no program of the first process.
    """
    from ._cache import check_cache, report_cache

    if clear or not check:
        report_cache(clear)
    if check and not check_cache():
        raise typer.Exit(1)
