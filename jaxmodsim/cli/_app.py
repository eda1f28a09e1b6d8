"""The commands. Everything heavy is imported inside them, so that --help and usage errors come at once."""

import sys
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    name="jaxmodsim",
    help="Differentiable mechanics with friction: test benches, fits to measured records.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

Out = Annotated[Path, typer.Option(help="Folder for figures, tables and JSON; made if it is not there.")]


def run() -> None:
    """Run the command line; an error that a user can mend is one sentence on stderr and exit code 2."""
    try:
        app()
    except (ValueError, OSError, RuntimeError) as error:
        sys.stderr.write(f"jaxmodsim: {error}\n")
        sys.exit(2)
    except SystemExit as ending:
        if ending.code == 130:  # what typer makes of Ctrl-C
            sys.stderr.write("jaxmodsim: interrupted; nothing was written\n")
        raise


def _start() -> None:
    """An application may set what a library must not: double precision, and XLA's treatment of small loops."""
    import jax

    from jaxmodsim import tune_cpu

    tune_cpu()
    jax.config.update("jax_enable_x64", True)


@app.command()
def demo(out: Out = Path("jaxmodsim-demo")) -> None:
    """The test bench, and a LuGre fit to a synthetic record whose truth is known."""
    _start()
    from ._demo import run_demo

    run_demo(out)


@app.command("testbench")
def bench_models(
    laws: Annotated[
        bool, typer.Option("--laws", help="Every friction law in the standard experiments, instead of the box.")
    ] = False,
    out: Out = Path("jaxmodsim-testbench"),
) -> None:
    """A box under a rising force with one friction model after the other: figures, a table, a LuGre sweep.

    With --laws instead what each friction law does in the standard experiments (characteristic, presliding, break-away,
    lag, stick-slip, creep, passivity); exit code 1 if one fails where it should not.
    """
    _start()
    if laws:
        from ._behaviour import report_behaviour

        if not report_behaviour(out):
            raise typer.Exit(1)
        return
    from ._report import report_testbench

    report_testbench(out)


@app.command()
def fit(
    record: Annotated[Path, typer.Argument(help="CSV file with a header line.")],
    time: Annotated[str, typer.Option(help="Column of time [s].")] = "t",
    position: Annotated[str, typer.Option(help="Column of measured position [m].")] = "q",
    force: Annotated[str, typer.Option(help="Column of the applied force or drive signal.")] = "u",
    force_gain: Annotated[float, typer.Option(help="Newtons per unit of the force column.")] = 1.0,
    model: Annotated[str, typer.Option(help="coulomb, asymmetric, stribeck or lugre.")] = "coulomb",
    start: Annotated[
        list[str] | None, typer.Option(help="Start value, NAME=VALUE; by default estimated from the record.")
    ] = None,
    fix: Annotated[list[str] | None, typer.Option(help="Value that is not fitted, NAME=VALUE.")] = None,
    substeps: Annotated[int, typer.Option(help="Integration steps between two samples.")] = 1,
    out: Out = Path("jaxmodsim-fit"),
) -> None:
    """Fit mass, offset and friction of one axis to a record of position and applied force, by open-loop simulation."""
    _start()
    from ._fit import AxisColumns, run_fit

    run_fit(record, AxisColumns(time, position, force, force_gain), model, start or [], fix or [], substeps, out)
