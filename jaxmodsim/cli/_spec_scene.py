"""The scene of a SPEC: a named problem with numbers, or an object of a Python file."""

import dataclasses
import importlib.util
import inspect
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .. import problems
from .._core.suggest import did_you_mean
from ..friction import AbstractLaw, laws
from ..scene import Scene
from ._table import TEXT, VALUES, WHOLE, Table

# Under which the file of a SPEC is known as a module.
MODEL = "jaxmodsim_model"

PROBLEMS: dict[str, Callable[..., Scene]] = {
    name: made
    for name, made in vars(problems).items()
    if inspect.isfunction(made) and inspect.signature(made).return_annotation is Scene
}


def read_system(table: Table, folder: Path) -> Scene | Callable[..., Any]:
    """The scene, or the function, that a table names. A file that it names is run.

    **Arguments:**

    - `table`: with `problem`, its numbers and `law`; or with `file` and `object`.
    - `folder`: that of the SPEC, to which `file` is relative.

    **Raises:**

    - `ValueError` for unknown names and wrong numbers, and where the file cannot be run.
    """
    problem, file = table.take("problem", TEXT), table.take("file", TEXT)
    if (problem is None) == (file is None):
        both = "both are given" if problem else "neither is given"
        raise table.refusal(f"either problem or file says what to sweep, but {both}.")
    if file is not None:
        name = table.take("object", TEXT, needed=True)
        table.close()
        return _from_file(table, folder / file, name)
    _check_known(table, "problem", problem, PROBLEMS)
    return _made(table, PROBLEMS[problem])


def _check_known(table: Table, key: str, name: str, known: Mapping[str, Any]) -> None:
    if name not in known:
        raise table.refusal(
            f"{key} must be one of {', '.join(known)}, but {name!r} was given.{did_you_mean(name, known)}"
        )


def _made(table: Table, maker: Callable[..., Any]) -> Any:
    """What a constructor makes of the numbers and the law of a table."""
    given: dict[str, Any] = {}
    for name, parameter in inspect.signature(maker).parameters.items():
        needed = parameter.default is inspect.Parameter.empty
        if (callable(parameter.default) and not needed) or name == "laws":
            continue  # functions, and laws of several places: those need a file
        if name == "law":
            inner = table.table(name, needed=needed)
            value = None if inner is None else _law(inner)
        elif parameter.annotation is int:
            value = table.take(name, WHOLE, needed=needed)
        else:
            value = table.take(name, VALUES, needed=needed)
            value = None if value is None else np.asarray(value, float)
        if value is not None:
            given[name] = value
    table.close()
    try:
        return maker(**given)
    except (ValueError, TypeError) as error:
        raise table.refusal(str(error)) from error


def _law(table: Table) -> Any:
    kind = table.take("kind", TEXT, needed=True)
    known = known_laws()
    _check_known(table, "kind", kind, known)
    return _made(table, known[kind])


def known_laws() -> dict[str, type[AbstractLaw]]:
    """Registered laws that need nothing but numbers and another law, which is what a file can say."""

    def needed(law: type[AbstractLaw]) -> list[dataclasses.Field[Any]]:
        return [field for field in dataclasses.fields(law) if field.default is dataclasses.MISSING]

    return {
        name: law
        for name, law in laws().items()
        if all("range" in field.metadata or field.name == "law" for field in needed(law))
    }


def _from_file(table: Table, path: Path, name: str) -> Scene | Callable[..., Any]:
    """Run a Python file and take an object of it."""
    if not path.is_file():
        raise table.refusal(f"file {str(path)!r} is not there; it is looked for beside the SPEC.")
    found = importlib.util.spec_from_file_location(MODEL, path)
    if found is None or found.loader is None:
        raise table.refusal(f"file must be a Python file, whose name ends in .py, but {path.name!r} was given.")
    module = importlib.util.module_from_spec(found)
    # Some decorators of classes look their module up.
    sys.modules[MODEL] = module
    try:
        found.loader.exec_module(module)
    except Exception as error:  # whatever the file does
        raise table.refusal(f"running {path.name} failed with {type(error).__name__}: {error}") from error
    objects = {
        key: x
        for key, x in vars(module).items()
        if isinstance(x, Scene) or (callable(x) and getattr(x, "__module__", None) == MODEL)
    }
    if name not in objects:
        there = f"it defines {', '.join(objects)}" if objects else "it defines neither"
        raise table.refusal(
            f"object must be a Scene or a function of {path.name}, but {name!r} was given, and {there}."
            f"{did_you_mean(name, objects)}"
        )
    return objects[name]
