"""Records from files: CSV, Parquet, MATLAB."""

import io
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from .._core.arguments import nearest
from ..identify import Record


@dataclass(frozen=True)
class AxisColumns:
    """Names of the record's columns, and newtons per unit of the force column."""

    time: str
    position: str
    force: str
    force_gain: float


def read_records(paths: Sequence[Path], columns: AxisColumns) -> tuple[Record, ...]:
    """Read several records, named after their files; with their folder before where two files are called the same.

    **Raises:**

    - `ValueError` as `read_record` does, and for a file that is given twice.
    """
    real = [path.resolve() for path in paths]
    for i, path in enumerate(real):
        if path in real[:i]:
            raise ValueError(f"{paths[i]} is given twice.")
    stems = [path.stem for path in real]
    names = [path.stem if stems.count(path.stem) == 1 else f"{path.parent.name}/{path.name}" for path in real]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise ValueError(f"Two files are called {name}: rename one of them.")
    return tuple(read_record(path, columns, name) for path, name in zip(paths, names, strict=True))


def read_record(path: Path, columns: AxisColumns, name: str | None = None) -> Record:
    """Read a record from a `.csv` (or `.txt`), `.parquet` or `.mat` file.

    **Raises:**

    - `ValueError` naming a file that is damaged or of an unknown kind, a missing column and those that are there, a
      column that holds no numbers, NaN, lengths that differ, or times that do not increase; `OSError` if the file
      cannot be read.
    """
    if not np.isfinite(columns.force_gain) or columns.force_gain == 0:
        raise ValueError(f"--force-gain must be finite and not zero, but it is {columns.force_gain}.")
    if path.is_dir():
        raise ValueError(f"{path} is a folder; a file is needed.")
    if not path.is_file():
        raise ValueError(f"There is no file {path}.")
    if path.suffix.lower() not in _READERS:
        raise ValueError(
            f"{path.name}: the ending must be one of {', '.join(_READERS)}, as it says how to read the file."
        )
    table = _READERS[path.suffix.lower()](path)
    wanted = {"time": columns.time, "position": columns.position, "force": columns.force}
    t, q, u = (_column(table, path, option, column) for option, column in wanted.items())
    return Record(t, q, {"u": columns.force_gain * u}, name=name or path.stem)


def _column(table: Mapping[str, object], path: Path, option: str, name: str) -> np.ndarray:
    if name not in table:
        near = nearest(name, table)
        hint = f" Did you mean --{option} {near}?" if near else ""
        raise ValueError(
            f"{path.name} has no column {name!r} (--{option}); it has: {', '.join(table) or 'none'}.{hint}"
        )
    given = pd.Series(table[name])
    if given.empty:
        return np.zeros(0)
    if pd.api.types.is_numeric_dtype(given) and not pd.api.types.is_complex_dtype(given):
        return given.to_numpy(float, na_value=np.nan)
    bad = int(np.argmax(np.isnan(np.asarray(pd.to_numeric(given, errors="coerce"), float))))
    raise ValueError(f"{path.name}: column {name!r} holds {given.iloc[bad]!r} in sample {bad}, which is no number.")


def _csv(path: Path) -> dict[str, object]:
    try:
        frame = pd.read_csv(path)
    except (ValueError, pd.errors.ParserError) as error:
        raise ValueError(f"{path} is no CSV file with a header line: {_one_line(error)}") from error
    return {str(name): frame[name] for name in frame.columns}


def _parquet(path: Path) -> dict[str, object]:
    try:
        frame = pd.read_parquet(path)
    except ImportError as error:
        raise ValueError("Reading Parquet needs pyarrow: pip install 'jaxmodsim[cli]'.") from error
    except Exception as error:  # whatever the bytes of a damaged file lead the reader into
        raise ValueError(f"{path} is damaged or no Parquet file: {_one_line(error)}") from error
    return {str(name): frame[name] for name in frame.columns}


def _mat(path: Path) -> dict[str, object]:
    # In a process of its own: some damaged files end the one that reads them.
    reading = subprocess.run([sys.executable, "-c", _MAT, str(path.resolve())], capture_output=True, check=False)
    if reading.returncode == _HDF5:
        raise ValueError(
            f"{path.name} is a MATLAB 7.3 file (HDF5), which is not read here: save it in MATLAB with"
            f" save('{path.name}', ..., '-v7'), or as CSV or Parquet."
        )
    if reading.returncode != 0:
        last = reading.stderr.decode(errors="replace").strip().splitlines()[-1:]
        why = " ".join(last) if reading.returncode > 0 else "reading it ends the process that reads"
        raise ValueError(f"{path} is damaged or no MATLAB file: {why}")
    with np.load(io.BytesIO(reading.stdout), allow_pickle=False) as arrays:
        # MATLAB knows no vectors: a row or a column of a matrix is one.
        vectors = {name[1:]: np.ravel(x) for name, x in arrays.items() if x.size == max(x.shape, default=0)}
    return {name: x for name, x in vectors.items() if not name.startswith("__")}


# What is neither numbers nor text is left out.
_HDF5 = 3
_MAT = f"""
import sys, numpy, scipy.io
try:
    arrays = scipy.io.loadmat(sys.argv[1])
except NotImplementedError:
    sys.exit({_HDF5})
kept = {{"_" + name: x for name, x in arrays.items() if getattr(getattr(x, "dtype", None), "kind", "O") in "biufcU"}}
numpy.savez(sys.stdout.buffer, **kept)
"""


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


_READERS: dict[str, Callable[[Path], dict[str, object]]] = {
    ".csv": _csv,
    ".txt": _csv,
    ".parquet": _parquet,
    ".mat": _mat,
}
