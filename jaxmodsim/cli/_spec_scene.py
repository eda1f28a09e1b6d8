"""The scene of a SPEC: a named problem with numbers, or an object of a Python file."""

import dataclasses
import importlib.util
import inspect
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import create_model

from .. import problems
from .._core.arguments import did_you_mean
from ..friction import AbstractLaw, laws
from ..scene import Scene
from ._table import AbstractTable, Table, Text, Values, Whole, inner, read_table

# Under which the file of a SPEC is known as a module.
MODEL = "jaxmodsim_model"

# The scenes of the modules of `problems`: `scene` by the name of its module, any other by its own.
PROBLEMS: dict[str, Callable[..., Scene]] = {
    module if name == "scene" else name: made
    for module, system in inspect.getmembers(problems, inspect.ismodule)
    for name, made in vars(system).items()
    if inspect.isfunction(made) and inspect.signature(made).return_annotation is Scene
}


class _FileScene(AbstractTable):
    problem: Text | None = None
    file: Text
    object: Text


def read_system(content: dict[str, object], where: str, folder: Path) -> Scene | Callable[..., object]:
    """The scene, or the function, that a table names. A file that it names is run.

    **Arguments:**

    - `content`: with `problem`, its numbers and `law`; or with `file` and `object`.
    - `where`: the table as errors call it.
    - `folder`: that of the SPEC, to which `file` is relative.

    **Raises:**

    - `ValueError` for unknown names and wrong numbers, and where the file cannot be run.
    """
    if ("problem" in content) == ("file" in content):
        both = "both are given" if "problem" in content else "neither is given"
        raise ValueError(f"{where}: either problem or file says what to sweep, but {both}.")
    if "problem" in content:
        return _made(content, where, "problem", PROBLEMS)
    asked = read_table(_FileScene, content, where)
    return _from_file(where, folder / asked.file, asked.object)


def _made(content: dict[str, object], where: str, key: str, makers: Mapping[str, Callable[..., object]]) -> Any:
    """What the constructor that a table names by `key` makes of the numbers and the law of the table."""
    name = content.get(key)
    fields: dict[str, Any] = {key: (Literal[*makers], ...)}
    if not isinstance(name, str) or name not in makers:
        read_table(create_model("Kind", __base__=AbstractTable, **fields), content, where)
    maker = makers[str(name)]
    for field, parameter in inspect.signature(maker).parameters.items():
        needed = parameter.default is inspect.Parameter.empty
        if (callable(parameter.default) and not needed) or field == "laws":
            continue  # functions, and laws of several places: those need a file
        kind: Any = Table if field == "law" else Whole if parameter.annotation is int else Values
        fields[field] = (kind, ...) if needed else (kind | None, None)
    model = create_model("Made", __base__=AbstractTable, **fields)
    given = read_table(model, content, where).model_dump(exclude={key}, exclude_none=True)
    if "law" in given:
        given["law"] = _made(given["law"], inner(where, "law"), "kind", known_laws())
    numbers = {field: np.asarray(x, float) if isinstance(x, float | list) else x for field, x in given.items()}
    try:
        return maker(**numbers)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where}: {error}") from error


def known_laws() -> dict[str, type[AbstractLaw]]:
    """Registered laws that need nothing but numbers and another law, which is what a file can say."""

    def needed(law: type[AbstractLaw]) -> list[dataclasses.Field[object]]:
        return [field for field in dataclasses.fields(law) if field.default is dataclasses.MISSING]

    return {
        name: law
        for name, law in laws().items()
        if all("range" in field.metadata or field.name == "law" for field in needed(law))
    }


def _from_file(where: str, path: Path, name: str) -> Scene | Callable[..., object]:
    """Run a Python file and take an object of it."""
    if not path.is_file():
        raise ValueError(f"{where}: file {str(path)!r} is not there; it is looked for beside the SPEC.")
    spec = importlib.util.spec_from_file_location(MODEL, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{where}: file must be a Python file, whose name ends in .py, but {path.name!r} was given.")
    module = importlib.util.module_from_spec(spec)
    # Some decorators of classes look their module up.
    sys.modules[MODEL] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever the file does
        raise ValueError(f"{where}: running {path.name} failed with {type(error).__name__}: {error}") from error
    objects = {
        key: x
        for key, x in vars(module).items()
        if isinstance(x, Scene) or (callable(x) and getattr(x, "__module__", None) == MODEL)
    }
    if name not in objects:
        there = f"it defines {', '.join(objects)}" if objects else "it defines neither"
        raise ValueError(
            f"{where}: object must be a Scene or a function of {path.name}, but {name!r} was given, and {there}."
            f"{did_you_mean(name, objects)}"
        )
    return objects[name]
