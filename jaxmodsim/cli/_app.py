"""The commands. Everything heavy is imported inside them, so that --help and usage errors come at once."""

import logging
import sys
from pathlib import Path
from typing import Annotated

import typer

from ._options import (
    FitRequest,
    Interrupted,
    Out,
    PredictRequest,
    SpecFile,
    SweepRequest,
    check_axis,
    check_exists,
    check_outputs,
    command_of,
)

app = typer.Typer(
    name="jaxmodsim",
    help="Differentiable mechanics with friction: test benches, fits to measured records, sweeps.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def run() -> None:
    """Run the command line; an error that a user can fix is one sentence on stderr and exit code 2."""
    try:
        app()
    except (ValueError, OSError, RuntimeError) as error:
        sys.stderr.write(f"jaxmodsim: {error}\n")
        sys.exit(2)
    except Interrupted as ending:
        sys.stderr.write(f"jaxmodsim: {ending}\n")
        sys.exit(130)
    except SystemExit as ending:
        if ending.code == 130:  # from typer, on Ctrl-C
            sys.stderr.write("jaxmodsim: interrupted; nothing was written\n")
        raise


def _start(*files: Path) -> None:
    """Set what an application may set and a library must not: double precision, XLA's flags, a compilation cache.

    **Raises:**

    - `ValueError` if one of `files` is missing, before anything slow.
    """
    for path in files:
        check_exists(path)
    import jax

    from .._core.speed import tune_cpu
    from ._cache import use_cache

    tune_cpu()
    logging.getLogger("jaxmodsim").setLevel(logging.ERROR)  # long computations show a progress line
    jax.config.update("jax_enable_x64", True)
    use_cache()


@app.command()
def demo(out: Out = Path("jaxmodsim-demo")) -> None:
    """Run the test bench, and fit LuGre to a synthetic record with known parameters."""
    _start()
    from ._demo import run_demo

    run_demo(out)


@app.command("testbench")
def bench_models(out: Out = Path("jaxmodsim-testbench")) -> None:
    """Run a box under a rising force with each friction model: figures, a table, a LuGre sweep."""
    _start()
    from ._demo import report_testbench

    report_testbench(out)


@app.command()
@command_of(FitRequest)
def fit(request: FitRequest) -> None:
    """Fit mass, offset and friction of one axis to records of position and applied force, by open-loop simulation.

    With --axis servo: motor and gear friction of a position servo, from command and supply.

    Ctrl-C ends the search; its result so far is written, and the exit code is 130.
    """
    check_axis(request)
    tables = [request.out / name for name in ("fit.csv", "ranking.csv")] + ([request.next] if request.next else [])
    check_outputs(tables, [*request.records, *request.held_out])
    _start(*request.records, *request.held_out)
    if request.axis == "servo":
        from ._servo import run_servo_fit

        run_servo_fit(request)
        return
    from ._fit import run_fit

    run_fit(request)


@app.command()
@command_of(PredictRequest)
def predict(request: PredictRequest) -> None:
    """Predict the angle of a fitted servo for new commands, with a band for 90 % of the samples.

    Writes for each RECORD a CSV of t, q, lower and upper, a JSON summary and a figure.
    """
    names = [f"{path.stem}{ending}" for path in request.records for ending in (".csv", ".json")]
    check_outputs([request.out / name for name in names], [request.fit, *request.records])
    _start(request.fit, *request.records)
    from ._servo import run_servo_prediction

    run_servo_prediction(request)


@app.command()
@command_of(SweepRequest)
def sweep(request: SweepRequest) -> None:
    r"""Run a scene over ranges of its numbers into a Zarr store, as a SPEC says. The same command resumes a sweep.

    SPEC is a TOML file of four tables; names with dots or brackets need quotes.

    \[scene] is problem = "belt_oscillator" (any of jaxmodsim.problems) with its
    numbers, and a table law with kind = "LuGre" and its numbers. Or it is
    file = "model.py" and object = "scene", a Scene or a function of that file.
    The file is executed: use only files that you trust.

    \[run] has q0, qd0, t1; ts, a list or {start, stop, count}; t0, rtol, atol,
    dt, dtmax, max_steps, max_events, stick_on_chatter, project.

    \[over] has an entry for each dimension; all combinations are run. It is
    a list; {from, to, count, spacing = "linear" or "log"}; a table of lists
    that change together; or {latin_hypercube = {m = \[1, 2],
    k = \[10, 1e4, "log"]}, count, seed}, or the same with sobol.

    \[observe] has an entry for each result: "q\[0]", "qd\[0]", or the name
    of an effect for its force; or {of = "qd\[0]", take = "max", unit = "m/s"},
    where take is end, max, min, mean, rms or ptp (the largest minus the smallest
    value) of the saved times, or peak, the largest magnitude at any time.
    """
    _start(request.spec)
    from ._sweep import run_sweep

    run_sweep(request)


@app.command()
def orbit(spec: SpecFile, out: Out = Path("jaxmodsim-orbit")) -> None:
    r"""Find a periodic orbit, as a SPEC says: its period, extent, stability and modes.

    SPEC is a TOML file; \[scene] as for jaxmodsim sweep.

    \[orbit] has q0 and qd0, the state from which a simulation settles for
    settle seconds. A forced orbit has period, in seconds, or frequency, the
    name of the number that is the angular frequency of the force. Without
    both, the period is computed. Also rtol, atol.
    """
    _start(spec)
    from ._orbits import run_orbit

    run_orbit(spec, out)


@app.command()
def branch(spec: SpecFile, out: Out = Path("jaxmodsim-branch")) -> None:
    r"""Continue a periodic orbit in a parameter, through folds, and locate bifurcations. The same command resumes it.

    SPEC is that of jaxmodsim orbit with one more table: \[branch] has parameter,
    the name of the number, from and to; step, the longest step as a fraction of
    that range; max_orbits; start = "Hopf" for orbits from the first Hopf point
    of the equilibria, which are continued from q0.
    """
    _start(spec)
    from ._orbits import run_branch

    run_branch(spec, out)


@app.command()
def export(
    spec: SpecFile,
    model: Annotated[Path, typer.Argument(help="File NAME.fmu; NAME is the name of the model.", metavar="MODEL.fmu")],
) -> None:
    r"""Write a scene as an FMU of FMI 3.0, for model exchange and co-simulation, as a SPEC says.

    SPEC is a TOML file; \[scene] as for jaxmodsim sweep.

    \[export] has q0 and qd0, the start values; inputs, a list of names of
    numbers that are inputs; t1, the end of the default experiment; rtol, atol;
    platforms, a list such as \["x86_64-linux"], by default all that the
    compilers here support.
    """
    _start(spec)
    from ..export import fmu
    from ._output import show_paths
    from ._spec import read_export_spec

    scene, options = read_export_spec(spec)
    model.parent.mkdir(parents=True, exist_ok=True)
    show_paths([fmu(scene, path=model, **options)])


@app.command()
def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Delete them.")] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Run a scene in two processes and test that the second compiles less.")
    ] = False,
) -> None:
    """Report the compiled programs that commands keep on disk: folder, number and size.

    A command that runs again compiles nothing. JAX_COMPILATION_CACHE_DIR names another folder,
    JAX_ENABLE_COMPILATION_CACHE=false disables the cache. The exit code is 1 if --check finds that the second process
    used no program of the first.
    """
    from ._cache import check_cache, report_cache

    if clear or not check:
        report_cache(clear)
    if check and not check_cache():
        raise typer.Exit(1)
