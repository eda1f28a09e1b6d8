"""Columns of files: CSV, Parquet, MATLAB, and those of loggers."""

import io
import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pandas as pd

from ._logs import LOG_READERS

# Columns by name, as the file has them.
Columns: TypeAlias = Mapping[str, object]
# Bytes and lines of a CSV file from which its separators are told.
_LOOKED_AT, _LINES = 2**16, 50
_COMMA_NUMBER = re.compile(r"\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*")
_POINT_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*")


def read_columns(path: Path) -> Columns:
    """Read all columns of a file, as its ending says.

    **Raises:**

    - `ValueError` naming a file that is missing, damaged or of an unknown kind; `OSError` if it cannot be read.
    """
    if path.is_dir() and (path / "metadata.yaml").is_file():
        return _logged(path, ".bag")
    if path.is_dir():
        raise ValueError(f"{path} is a folder; a file is needed.")
    if not path.is_file():
        raise ValueError(f"There is no file {path}.")
    if path.suffix.lower() in LOG_READERS:
        return _logged(path, path.suffix.lower())
    if path.suffix.lower() not in _READERS:
        endings = ", ".join((*_READERS, *LOG_READERS))
        raise ValueError(f"{path.name}: the ending must be one of {endings}, as it says how to read the file.")
    return _READERS[path.suffix.lower()](path)


def _logged(path: Path, ending: str) -> Columns:
    try:
        return LOG_READERS[ending](path)
    except ImportError as error:
        raise ValueError(str(error)) from error
    except Exception as error:  # whatever the bytes of a damaged file lead the reader into
        raise ValueError(f"{path} is damaged or no {ending} file: {_one_line(error)}") from error


def _csv(path: Path) -> Columns:
    raw = path.read_bytes()
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if b"\x00" in raw:
            raise ValueError(f"{path} is no CSV file with a header line: {_one_line(error)}") from error
        text = raw.decode("latin-1")  # in which units have their degrees and micro signs
    separator, decimal = _separators(text[:_LOOKED_AT])
    try:
        frame = pd.read_csv(io.StringIO(text), sep=separator, decimal=decimal, skipinitialspace=True)
    except (ValueError, pd.errors.ParserError) as error:
        raise ValueError(f"{path} is no CSV file with a header line: {_one_line(error)}") from error
    names = [str(name).strip() for name in frame.columns]
    if names and all(_POINT_NUMBER.fullmatch(name) for name in names):
        raise ValueError(
            f"{path} is no CSV file with a header line: the first line holds numbers. Put the names of the columns"
            " above them."
        )
    return {name: frame.iloc[:, i] for i, name in enumerate(names)}


def _separators(text: str) -> tuple[str, str]:
    """Separator of columns, as pandas wants it, and decimal sign: commas in numbers only where they separate nothing.

    The header tells the first, the numbers below it the second.
    """
    header, *lines = text.splitlines()[: _LINES + 1] or [""]
    separator = next((each for each in (";", "\t", ",", "|") if each in header), None)
    if separator is None:
        separator = r"\s+" if len(header.split()) > 1 else ","
    if separator == ",":
        return separator, "."
    cells = [cell.strip('" ') for line in lines for cell in re.split(separator.replace("|", r"\|"), line)]
    comma = any(_COMMA_NUMBER.fullmatch(cell) for cell in cells)
    point = any("." in cell and _POINT_NUMBER.fullmatch(cell) for cell in cells)
    return separator, "," if comma and not point else "."


def _parquet(path: Path) -> Columns:
    try:
        frame = pd.read_parquet(path)
    except ImportError as error:
        raise ValueError("Reading Parquet needs pyarrow: pip install 'jaxmodsim[cli]'.") from error
    except Exception as error:  # whatever the bytes of a damaged file lead the reader into
        raise ValueError(f"{path} is damaged or no Parquet file: {_one_line(error)}") from error
    return {str(name): frame[name] for name in frame.columns}


def _mat(path: Path) -> Columns:
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


_READERS: dict[str, Callable[[Path], Columns]] = {
    ".csv": _csv,
    ".txt": _csv,
    ".parquet": _parquet,
    ".mat": _mat,
}
