"""What the commands write: all of it at the end, each file whole or not at all."""

import json
import math
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import pandas as pd
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from .._core.system import jsonable
from ..identify import FitResult, InputDesign
from ..plot import Figure

# What a file may hold; a mapping becomes JSON.
Content: TypeAlias = Figure | pd.DataFrame | Mapping[str, object] | str | FitResult | InputDesign

# Off a terminal (a file, a pipe) there is no width to keep to.
console = Console() if sys.stdout.isatty() else Console(width=140)


def write(out: Path, files: Mapping[str, Content]) -> list[Path]:
    """Write figures as PNG, tables and designed inputs as CSV, dicts as JSON, text, and fits as `FitResult.load` reads.

    Into the folder `out`; returns the paths.

    Each file is written under another name first and then renamed, so none is ever half there.
    """
    out.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, content in files.items():
        path, part = out / name, out / f".{name}.part"
        try:
            if isinstance(content, Figure):
                content.savefig(part, format="png", dpi=130)
            elif isinstance(content, pd.DataFrame):
                content.to_csv(part, index=False)
            elif isinstance(content, FitResult):
                content.save(part)
            elif isinstance(content, InputDesign):
                content.to_csv(part)
            elif isinstance(content, str):
                part.write_text(content, encoding="utf-8")
            else:
                part.write_text(json.dumps(jsonable(content), indent=2, allow_nan=False) + "\n")
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
        paths.append(path)
    return paths


def show_table(frame: pd.DataFrame, title: str) -> None:
    """Print a table."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for column in frame.columns:
        words = not pd.api.types.is_numeric_dtype(frame[column])
        table.add_column(escape(str(column)), justify="left" if words else "right", overflow="fold")
    for row in frame.itertuples(index=False):
        table.add_row(*(escape(cell(value)) for value in row))
    console.print(table)


def cell(value: object) -> str:
    """A value as tables show it: five digits, a dash for NaN."""
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.5g}"
    return str(value)


def say(text: str) -> None:
    """Print text as it is."""
    console.print(text, soft_wrap=True, highlight=False, markup=False)


def show_paths(paths: list[Path]) -> None:
    """Print where everything is."""
    console.print("Wrote:")
    for path in paths:
        say(f"  {path.resolve()}")
