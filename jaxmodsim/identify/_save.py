"""Results of fits in files: a zip of one JSON text and plain arrays, which `numpy.load` opens; nothing is pickled."""

import io
import json
import math
import os
import zipfile
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from .._core.files import written_whole
from ._causes import Cause
from ._record import Record

_KIND, _VERSION, _TEXT = "jaxmodsim fit result", 1, "result.json"
# Fields of a result that are not kept: functions, and what depends on them.
_LEFT_OUT = ("model", "found")


def write_fields(path: str | os.PathLike[str], fields: Mapping[str, Any]) -> None:
    """Write the fields of a result, whole or not at all."""
    arrays: dict[str, np.ndarray] = {}
    body = {name: _packed(x, name, arrays) for name, x in fields.items() if name not in _LEFT_OUT}
    head = {"kind": _KIND, "format": _VERSION, "jaxmodsim": metadata.version("jaxmodsim")}
    text = json.dumps({**head, "fields": body}, indent=1, allow_nan=False)
    with written_whole(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(_TEXT, text)
        for name, array in arrays.items():
            archive.writestr(f"{name}.npy", _bytes(array))


def read_fields(path: str | os.PathLike[str], names: tuple[str, ...]) -> dict[str, Any]:
    """The fields of a result by name, all but those that files do not keep.

    **Raises:**

    - `ValueError` for a file that is damaged or something else.
    - `OSError` if there is none.
    """
    content = io.BytesIO(Path(path).read_bytes())
    try:
        with zipfile.ZipFile(content) as archive:
            if _TEXT not in archive.namelist():
                raise ValueError(f"it holds no {_TEXT}")
            text = json.loads(archive.read(_TEXT))
            arrays = {
                name.removesuffix(".npy"): np.lib.format.read_array(io.BytesIO(archive.read(name)), allow_pickle=False)
                for name in archive.namelist()
                if name.endswith(".npy")
            }
    except Exception as error:  # whatever the bytes of a damaged file lead the reader into
        raise ValueError(f"{path} is no result that FitResult.save wrote, or it is damaged: {error}") from error
    if not isinstance(text, dict) or text.get("kind") != _KIND:
        raise ValueError(f"{path} is no result of a fit: it does not say {_KIND!r}.")
    if text.get("format") != _VERSION:
        raise ValueError(
            f"{path} has the format {text.get('format')!r}, written by jaxmodsim {text.get('jaxmodsim')}, but this"
            f" version reads format {_VERSION}."
        )
    wanted = [name for name in names if name not in _LEFT_OUT]
    body = text.get("fields")
    if not isinstance(body, dict) or set(body) != set(wanted):
        lacks = sorted(set(wanted) - set(body or {}))
        raise ValueError(f"{path} is damaged: it lacks {', '.join(lacks) or 'nothing, but holds more than it should'}.")
    try:
        return {name: _unpacked(body[name], arrays) for name in wanted}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{path} is damaged: {error!r}") from error


def _bytes(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def _packed(x: Any, name: str, arrays: dict[str, np.ndarray]) -> Any:
    """As JSON knows it; arrays aside, numbers that JSON does not know as words."""
    if isinstance(x, Record):
        parts = {
            "t": x.t, "channels": x.channels, "inputs": x.inputs, "name": x.name, "linear": tuple(sorted(x.linear)),
            "noise": x.noise, "slips": x.slips,
        }  # fmt: skip
        return {"record": _packed(parts, name, arrays)}
    if isinstance(x, Cause):
        return {"cause": [x.sentence, list(x.about)]}
    if isinstance(x, Mapping):
        return {"dict": {k: _packed(each, f"{name}/{k}", arrays) for k, each in x.items()}}
    if isinstance(x, tuple):
        return {"tuple": [_packed(each, f"{name}/{i}", arrays) for i, each in enumerate(x)]}
    if isinstance(x, np.ndarray):
        arrays[name] = x
        return {"array": name}
    if isinstance(x, float) and not math.isfinite(x):
        return {"float": str(x)}
    if isinstance(x, np.generic) or not (x is None or isinstance(x, str | bool | int | float)):
        raise TypeError(f"{name} is a {type(x).__name__}, which no file of a result has room for.")
    return x


def _unpacked(x: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if not isinstance(x, dict):
        return x
    ((kind, inside),) = x.items()
    if kind == "record":
        parts = _unpacked(inside, arrays)
        return Record(
            parts["t"], parts["channels"], parts["inputs"], parts["name"], linear=parts["linear"],
            noise=parts["noise"] or None, slips=parts["slips"],
        )  # fmt: skip
    if kind == "cause":
        return Cause(inside[0], tuple(inside[1]))
    if kind == "dict":
        return {k: _unpacked(each, arrays) for k, each in inside.items()}
    if kind == "tuple":
        return tuple(_unpacked(each, arrays) for each in inside)
    if kind == "array":
        return arrays[inside]
    if kind == "float":
        return float(inside)
    raise KeyError(kind)
