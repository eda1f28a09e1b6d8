"""Arguments and options of the commands with their help: imported at once, so nothing heavy in here."""

import inspect
from collections.abc import Callable, Iterable
from dataclasses import MISSING, Field, dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from typer.models import OptionInfo

Options = TypeVar("Options")


class Interrupted(Exception):
    """Ctrl-C, after which the results computed so far were written; the text says so."""


def command_of(record: type[Options]) -> Callable[[Callable[[Options], None]], Callable[..., None]]:
    """Make a command of a function of one options record: each field of the dataclass is an argument or an option."""

    def command_for(function: Callable[[Options], None]) -> Callable[..., None]:
        def command(**options: Any) -> None:
            function(record(**options))

        parameters = []
        # Its own first, as --help lists them.
        every = fields(record)  # pyright: ignore[reportArgumentType] # a dataclass
        for each in sorted(every, key=lambda each: each.name not in record.__annotations__):
            default, kind = _default_of(each), inspect.Parameter.KEYWORD_ONLY
            default = inspect.Parameter.empty if default is MISSING else default
            parameters.append(inspect.Parameter(each.name, kind, default=default, annotation=each.type))
        command.__signature__ = inspect.Signature(parameters)  # pyright: ignore[reportFunctionMemberAccess]
        command.__name__, command.__doc__ = function.__name__, function.__doc__
        return command

    return command_for


def _default_of(option: Field[Any]) -> Any:
    return option.default if option.default_factory is MISSING else option.default_factory()


def _option(panel: str | None, text: str, metavar: str | None = None) -> OptionInfo:
    return typer.Option(help=text, metavar=metavar, rich_help_panel=panel)


Out = Annotated[Path, typer.Option(help="Folder for figures, tables and JSON; created if missing.")]
SpecFile = Annotated[Path, typer.Argument(help="TOML file of the tables described above.", metavar="SPEC")]

# Panels of `jaxmodsim fit --help`.
_COLUMNS, _MODEL, _VALIDATION, _SEARCH, _NEXT = "Columns", "Model", "Validation", "Search", "The next record"
_SERVO = "Servo"


@dataclass(frozen=True, kw_only=True)
class AbstractServoColumns:
    """Columns of a record of a servo, in `jaxmodsim fit` and `jaxmodsim predict`."""

    goal: Annotated[str, _option(_SERVO, r"Column of the commanded angle \[rad].")] = "q_goal"
    supply: Annotated[str, _option(_SERVO, r"Column of the supply \[V].")] = "volts"
    enable: Annotated[str, _option(_SERVO, "Column that is 0 while the motor is off; without it always on.")] = (
        "torque_enable"
    )
    gain: Annotated[
        str | None,
        _option(
            _SERVO,
            "Gain of the position loop: a number, or a column. The default is the column kp, or the number after kp in"
            " the name of the file.",
            "NUMBER|COLUMN",
        ),
    ] = None
    duty: Annotated[
        str | None,
        _option(
            _SERVO,
            "Simulate from the measured duty in this column, from -885 to 885, and not from the command. A prediction"
            " must do as the fit did.",
            "COLUMN",
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class FitRequest(AbstractServoColumns):
    """Arguments and options of `jaxmodsim fit`, as typed."""

    records: Annotated[
        list[Path],
        typer.Argument(
            help="Records, fitted together: .csv with a header line, .parquet, .mat; logger files .mf4, .tdms, .mcap,"
            " .bag.",
            metavar="RECORD",
        ),
    ]
    time: Annotated[str, _option(_COLUMNS, "Column of time.")] = "t"
    position: Annotated[str, _option(_COLUMNS, "Column of measured position, angle or velocity.")] = "q"
    force: Annotated[str, _option(_COLUMNS, "Column of the applied force or torque, or of a drive signal.")] = "u"
    units: Annotated[
        list[str],
        _option(
            _COLUMNS,
            "Units of the columns time, position and force, as in time=ms,position=deg,force=12.5. The default is the"
            r" unit in the column's name, `phi \[deg]` or `phi_deg`, or else SI. A number is SI units per unit of the"
            " column. An angle or a torque makes the axis rotary.",
            "COLUMN=UNIT,...",
        ),
    ] = field(default_factory=list)
    drop: Annotated[
        list[str],
        _option(
            _COLUMNS,
            "Samples to leave out: nan, those with a value that is not finite; repeated, those with the time of the"
            " sample before.",
            "nan,repeated",
        ),
    ] = field(default_factory=list)
    laws: Annotated[
        str | None,
        _option(
            _MODEL,
            "Friction of the axis: coulomb (the default), asymmetric, stribeck, lugre. Several, separated by commas, or"
            " `all` are compared by held-out error; the simplest law that is as good as the best is taken. A servo has"
            " the laws M1 to M6 and MQ, by default all.",
            "A,B,...|all",
        ),
    ] = None
    free: Annotated[
        list[str],
        _option(
            _MODEL,
            "Parameters to fit, names separated by commas, repeatable. The default is those of the law, to which +NAME"
            r" adds one. Also q0 and qd0, to report the initial states, and delay.u, the delay of the force \[s].",
            "NAME,...|+NAME",
        ),
    ] = field(default_factory=list)
    start: Annotated[
        list[str],
        _option(
            _MODEL,
            "Start value in SI units; the default is estimated from the longest record. Repeatable.",
            "NAME=VALUE",
        ),
    ] = field(default_factory=list)
    fix: Annotated[
        list[str], _option(_MODEL, "Value in SI units of a parameter that is not fitted. Repeatable.", "NAME=VALUE")
    ] = field(default_factory=list)
    limit: Annotated[
        list[str],
        _option(
            _MODEL,
            "Limits of a parameter in SI units; either side may be omitted: m=80:, vs=:0.1. Repeatable.",
            "NAME=LOW:HIGH",
        ),
    ] = field(default_factory=list)
    held_out: Annotated[
        list[Path],
        _option(_VALIDATION, "Record for validation; only its initial state is fitted to it. Repeatable."),
    ] = field(default_factory=list)
    folds: Annotated[
        int | None,
        _option(
            _VALIDATION,
            "Validate by cross-validation instead: cut each record into this many parts and hold out one after the"
            " other. The default for several laws without --held-out is 4.",
        ),
    ] = None
    loss: Annotated[str, _option(_SEARCH, "squares; huber or cauchy for records with outliers.")] = "squares"
    initializer: Annotated[
        str,
        _option(
            _SEARCH,
            "Start of the search: regression of the force on the smoothed motion; staged, from the balance of forces"
            " with the law itself and from reversals.",
        ),
    ] = "regression"
    starts: Annotated[int, _option(_SEARCH, "Number of searches from starts around it; the best one is taken.")] = 1
    max_steps: Annotated[int, _option(_SEARCH, "Largest number of iterations of a search.")] = 400
    substeps: Annotated[
        int | None,
        _option(
            _SEARCH,
            "Integration steps between two samples; by default refined until the step size has no visible effect.",
        ),
    ] = None
    out: Out = Path("jaxmodsim-fit")
    report: Annotated[Path | None, _option(None, "Folder for report.html, a page in one file.")] = None
    next: Annotated[
        Path | None,
        _option(
            _NEXT,
            "CSV file for the motion and force of the most informative next record. It starts in the middle of the"
            " recorded travel.",
        ),
    ] = None
    max_force: Annotated[float | None, _option(_NEXT, "Largest force [N]; default: that of the records.")] = None
    max_speed: Annotated[float | None, _option(_NEXT, r"Largest speed \[m/s]; default: that of the records.")] = None
    max_travel: Annotated[
        float | None,
        _option(_NEXT, r"Largest distance from the start \[m]; default: half the travel of the records."),
    ] = None
    duration: Annotated[float | None, _option(_NEXT, r"Duration \[s]; default: that of the longest record.")] = None
    axis: Annotated[
        str,
        _option(
            _SERVO,
            "driven, an axis under the force of --force; or servo, a position servo that turns a pendulum, from columns"
            " of command and supply. A servo takes the options of this panel, --time, --position, --laws and --out.",
            "driven|servo",
        ),
    ] = "driven"
    pendulum: Annotated[
        str,
        _option(_SERVO, r"Mass \[kg] and distance \[m] of the pendulum from the servo.", "MASS,LENGTH"),
    ] = "0.49,0.1"
    prior: Annotated[
        list[str],
        _option(
            _SERVO,
            "Mean and standard deviation of a parameter, such as those of a data sheet: kt=0.37:0.05. Repeatable.",
            "NAME=MEAN:DEVIATION",
        ),
    ] = field(default_factory=list)


def check_exists(path: Path) -> None:
    """Refuse a path without a file or folder."""
    if not path.exists():
        raise ValueError(f"There is no file {path}.")


def check_outputs(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """Refuse outputs that would replace an input, or one another."""
    taken = dict.fromkeys((path.resolve() for path in inputs), "a file that is read")
    for path in outputs:
        if other := taken.get(path.resolve()):
            raise ValueError(f"{path} would replace {other}: rename one of them, or use another folder for --out.")
        taken[path.resolve()] = "a result of another record"


def check_axis(request: FitRequest) -> None:
    """Refuse an unknown kind of axis, and options of the other kind."""
    if request.axis not in ("driven", "servo"):
        raise ValueError(f"--axis must be driven or servo, but {request.axis!r} was given.")
    for each in fields(request):
        of_both = each.name in ("records", "time", "position", "laws", "out", "axis")
        if of_both or getattr(request, each.name) == _default_of(each):
            continue
        option = each.type.__metadata__[0]  # pyright: ignore[reportAttributeAccessIssue] # an Annotated
        if (option.rich_help_panel == _SERVO) != (request.axis == "servo"):
            raise ValueError(f"--{each.name.replace('_', '-')} does not belong to --axis {request.axis}.")


@dataclass(frozen=True, kw_only=True)
class PredictRequest(AbstractServoColumns):
    """Arguments and options of `jaxmodsim predict`, as typed."""

    fit: Annotated[Path, typer.Argument(help="fit.json of jaxmodsim fit --axis servo.", metavar="FIT")]
    records: Annotated[
        list[Path],
        typer.Argument(help="Records of command and supply; with the angle, its error is reported.", metavar="RECORD"),
    ]
    time: Annotated[str, _option(_COLUMNS, "Column of time.")] = "t"
    position: Annotated[
        str, _option(_COLUMNS, "Column of the measured angle, if any: its first sample is the start.")
    ] = "q"
    q0: Annotated[
        float | None,
        _option(None, r"Angle at rest at the first sample \[rad]; default: that of --position, or of --goal."),
    ] = None
    out: Out = Path("jaxmodsim-predict")


@dataclass(frozen=True, kw_only=True)
class SweepRequest:
    """Arguments and options of `jaxmodsim sweep`, as typed."""

    spec: SpecFile
    out: Annotated[
        Path | None, _option(None, "Folder of the Zarr store; created if missing, resumed if it exists.", "STORE")
    ] = None
    figure: Annotated[
        Path | None, _option(None, "Map of the first variable; needs a sweep over two dimensions.", "PNG")
    ] = None
    chunk: Annotated[
        int | None, typer.Option(help="Largest number of runs that are computed and written together.", min=1)
    ] = None
    workers: Annotated[
        int | None, typer.Option(help="Processes of a local Dask cluster; by default threads of this process.", min=1)
    ] = None
    scheduler: Annotated[str | None, _option(None, "Address of a running Dask scheduler.", "ADDRESS")] = None
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan of the sweep and run nothing.")] = False
