"""Output of the commands: text and tables on the terminal, and files that are written whole or not at all."""

import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import pandas as pd

from .._core.readable import Table
from .._core.system import jsonable, written_whole
from ..identify import FitResult, InputDesign
from ..plot import Figure

# Content of a file; a mapping becomes JSON.
Content: TypeAlias = Figure | pd.DataFrame | Mapping[str, object] | str | FitResult | InputDesign


def write(out: Path, files: Mapping[str, Content]) -> list[Path]:
    """Write files by name into the folder `out`, and return their paths.

    Figures become PNG, tables and designed inputs CSV, mappings JSON, and fits the format that `FitResult.load` reads.
    """
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / name for name in files]
    for path, content in zip(paths, files.values(), strict=True):
        if isinstance(content, FitResult):
            content.save(path)
        elif isinstance(content, InputDesign):
            content.to_csv(path)
        else:
            with written_whole(path) as file:
                if isinstance(content, Figure):
                    content.savefig(file, format="png", dpi=130)
                elif isinstance(content, pd.DataFrame):
                    content.to_csv(file, index=False)
                elif isinstance(content, str):
                    file.write(content.encode())
                else:
                    file.write((json.dumps(jsonable(content), indent=2, allow_nan=False) + "\n").encode())
    return paths


def frame_of(rows: Sequence[Sequence[object]], *columns: str) -> pd.DataFrame:
    """A table of these rows."""
    return pd.DataFrame(list(rows), columns=pd.Index(columns))


def say(text: str) -> None:
    """Print a text."""
    sys.stdout.write(f"{text}\n")


def show_table(frame: pd.DataFrame, title: str) -> None:
    """Print a table: five digits, a dash for NaN."""

    def cell(value: object) -> str:
        if isinstance(value, float):
            return "-" if math.isnan(value) else f"{value:.5g}"
        return str(value)

    rows = [tuple(map(cell, row)) for row in frame.itertuples(index=False)]
    say(Table(f"\n{title}", tuple(map(str, frame.columns)), rows).text())


def show_paths(paths: list[Path]) -> None:
    """Print the paths of the files that were written."""
    say("\n".join(["Wrote:", *(f"  {path.resolve()}" for path in paths)]))
