"""Options of the command line with their help: imported at once, so nothing heavy in here."""

from pathlib import Path
from typing import Annotated

import typer


class Interrupted(Exception):
    """Ctrl-C, after which what had been computed was written; the text says so."""


Out = Annotated[Path, typer.Option(help="Folder for figures, tables and JSON; made if it is not there.")]

# Panels of `jaxmodsim fit --help`.
_COLUMNS, _MODEL, _JUDGED, _SEARCH, _NEXT = "Columns", "Model", "Judging it", "Search", "The next record"

Records = Annotated[
    list[Path],
    typer.Argument(
        help="Records, fitted together: .csv with a header line, .parquet, .mat; of loggers .mf4, .tdms, .mcap, .bag."
    ),
]
Time = Annotated[str, typer.Option(help="Column of time.", rich_help_panel=_COLUMNS)]
Position = Annotated[
    str, typer.Option(help="Column of measured position or angle; or of velocity.", rich_help_panel=_COLUMNS)
]
Force = Annotated[
    str, typer.Option(help="Column of the applied force or torque, or drive signal.", rich_help_panel=_COLUMNS)
]
Units = Annotated[
    list[str] | None,
    typer.Option(
        help="What the columns time, position and force are in, as in time=ms,position=deg,force=12.5; by default"
        r" what their names say, `phi \[deg]` or `phi_deg`, or SI. A number is SI units per unit of the column. An"
        " angle or a torque makes the axis a rotary one.",
        metavar="COLUMN=UNIT,...",
        rich_help_panel=_COLUMNS,
    ),
]
Drop = Annotated[
    list[str] | None,
    typer.Option(
        help="Samples to leave out: nan, those without a finite value; repeated, those at the time of the one before.",
        metavar="nan,repeated",
        rich_help_panel=_COLUMNS,
    ),
]
Laws = Annotated[
    str,
    typer.Option(
        help="Friction of the axis: coulomb, asymmetric, stribeck, lugre. Several, with commas between, or `all` are"
        " judged by what was held back, and the simplest that is as good as the best is taken.",
        metavar="A,B,...|all",
        rich_help_panel=_MODEL,
    ),
]
Free = Annotated[
    list[str] | None,
    typer.Option(
        help="Parameters to fit, names with commas between, repeatable; by default those of the law, to which +NAME"
        r" adds one. Also q0 and qd0, to report where records start, and delay.u of the force \[s].",
        metavar="NAME,...|+NAME",
        rich_help_panel=_MODEL,
    ),
]
Start = Annotated[
    list[str] | None,
    typer.Option(
        help="Start value in SI units; by default estimated from the longest record. Repeatable.",
        metavar="NAME=VALUE",
        rich_help_panel=_MODEL,
    ),
]
Fix = Annotated[
    list[str] | None,
    typer.Option(
        help="Value in SI units that is not fitted. Repeatable.", metavar="NAME=VALUE", rich_help_panel=_MODEL
    ),
]
Limit = Annotated[
    list[str] | None,
    typer.Option(
        help="Limits of a parameter in SI units; either side may be left out: m=80:, vs=:0.1. Repeatable.",
        metavar="NAME=LOW:HIGH",
        rich_help_panel=_MODEL,
    ),
]
HeldOut = Annotated[
    list[Path] | None,
    typer.Option(
        help="Record to judge by; nothing but its start is fitted to it. Repeatable.", rich_help_panel=_JUDGED
    ),
]
Folds = Annotated[
    int | None,
    typer.Option(
        help="Judge by cross-validation instead: cut each record into so many parts, and hold back one after the"
        " other. Several laws without --held-out are judged so with 4.",
        rich_help_panel=_JUDGED,
    ),
]
Loss = Annotated[
    str,
    typer.Option(help="squares; huber or cauchy, where there are outliers.", rich_help_panel=_SEARCH),
]
Begin = Annotated[
    str,
    typer.Option(
        help="Where the search begins: rough, by regression of the force on the smoothed motion; staged, by the"
        " balance of forces with the law itself, and by reversals.",
        rich_help_panel=_SEARCH,
    ),
]
Starts = Annotated[
    int,
    typer.Option(help="Searches from so many starts around it, of which the best is taken.", rich_help_panel=_SEARCH),
]
MaxSteps = Annotated[
    int,
    typer.Option(help="Limit of iterations of a search, up to which it goes on by itself.", rich_help_panel=_SEARCH),
]
Substeps = Annotated[
    int | None,
    typer.Option(
        help="Integration steps between two samples; by default as many as it takes until they no longer show.",
        rich_help_panel=_SEARCH,
    ),
]
Report = Annotated[
    Path | None, typer.Option(help="Folder for report.html: all of it in one file, to attach to a report.")
]
NextInput = Annotated[
    Path | None,
    typer.Option(
        "--next",
        help="CSV file for the motion and force of the next record that would tell most, from the middle of"
        " the travel that was recorded.",
        rich_help_panel=_NEXT,
    ),
]
MaxForce = Annotated[
    float | None, typer.Option(help="Its largest force [N]; by default the records'.", rich_help_panel=_NEXT)
]
MaxSpeed = Annotated[
    float | None, typer.Option(help=r"Its largest speed \[m/s]; by default the records'.", rich_help_panel=_NEXT)
]
MaxTravel = Annotated[
    float | None,
    typer.Option(
        help=r"Its largest distance from the start to either side \[m]; by default half the records' travel.",
        rich_help_panel=_NEXT,
    ),
]
Duration = Annotated[
    float | None,
    typer.Option(help=r"Its duration \[s]; by default that of the longest record.", rich_help_panel=_NEXT),
]

Spec = Annotated[Path, typer.Argument(help="TOML file that says what to run; see above.")]
Store = Annotated[
    Path | None,
    typer.Option(help="Folder of the Zarr store; made if it is not there, gone on with if it is.", metavar="STORE"),
]
FigureFile = Annotated[
    Path | None, typer.Option(help="Map of the first variable, where there are two dimensions.", metavar="PNG")
]
Chunk = Annotated[int | None, typer.Option(help="Largest number of runs that are computed and written as one.", min=1)]
Workers = Annotated[
    int | None,
    typer.Option(help="Processes of a local Dask cluster; by default threads of this process.", min=1),
]
Scheduler = Annotated[
    str | None, typer.Option(help="Address of the scheduler of a Dask cluster that is there.", metavar="ADDRESS")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what would be run, and run nothing.")]
