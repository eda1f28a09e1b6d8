"""Tables of a SPEC, read from TOML into pydantic models, and the scene that one of them names.

A mistake is one sentence with the table, the key and the value.
"""

import dataclasses
import importlib.util
import inspect
import sys
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from .. import problems
from .._core.arguments import did_you_mean, nearest
from ..friction import AbstractLaw, laws
from ..scene import Scene

# Types of values; the text beside each is its name in errors.
Number = Annotated[float, "a finite number"]
Whole = Annotated[int, Field(gt=0), "a whole number > 0"]
Seed = Annotated[int, Field(ge=0), "a whole number >= 0"]
Text = Annotated[str, "text"]
Texts = Annotated[list[str], "a list of names"]
Switch = Annotated[bool, "true or false"]
Numbers = Annotated[list[float], Field(min_length=1), "a list of numbers"]
Values = Annotated[float | Annotated[list[float], Field(min_length=1)], "a number or a list of numbers"]
Table = Annotated[dict[str, object], "a table"]


class AbstractTable(BaseModel):
    """The keys of a table and the types of their values; nothing is converted."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=AbstractTable)


def read_table(model: type[Model], content: Mapping[str, object], where: str) -> Model:
    """Read a table into a model.

    - `where`: name of the table in errors, such as `sweep.toml [over.k]`.

    **Raises:**

    - `ValueError` for an unknown key, a missing one, and a value of another type.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{where}: {_sentence(model, content, str(first['loc'][0]), first['type'])}") from None


def _sentence(model: type[AbstractTable], content: Mapping[str, object], key: str, kind: str) -> str:
    fields = {field.alias or name: field for name, field in model.model_fields.items()}
    if key not in fields:
        return f"there is no key {key!r}; the keys are {', '.join(fields)}.{did_you_mean(key, fields)}"
    expected = _type_name(fields[key].rebuild_annotation())
    if kind == "missing":
        misspelt = nearest(key, [name for name in content if name not in fields])
        return f"{key} is missing; it must be {expected}." + (f" {misspelt!r} is there instead." if misspelt else "")
    value = content[key]
    hint = did_you_mean(value, expected.replace(",", "").split()) if isinstance(value, str) else ""
    return f"{key} must be {expected}, but {value!r} was given.{hint}"


def _type_name(annotation: Any) -> str:
    """Name of a type of values."""
    if get_origin(annotation) is Annotated:
        return next(text for text in annotation.__metadata__ if isinstance(text, str))
    if get_origin(annotation) is Literal:
        return f"one of {', '.join(get_args(annotation))}"
    return " or ".join(filter(None, map(_type_name, get_args(annotation))))


def inner(where: str, key: str) -> str:
    """Name in errors of a table inside the table `where`."""
    file, _, inside = where.partition(" [")
    name = key if key.replace("_", "").replace("-", "").isalnum() else f'"{key}"'
    return f"{file} [{inside[:-1]}.{name}]" if inside else f"{file} [{name}]"


def read_toml(path: Path) -> dict[str, object]:
    """The content of a TOML file.

    **Raises:**

    - `ValueError` if it cannot be read.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path.name} is not TOML: {error}. Names with dots or brackets need quotes.") from error
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise ValueError(f"{path} cannot be read: {reason}.") from error


# Name of the module of a SPEC's Python file.
MODEL = "jaxmodsim_model"

# Functions of `problems` that return a scene: `scene` by the name of its module, others by their own.
PROBLEMS: dict[str, Callable[..., Scene]] = {
    module if name == "scene" else name: maker
    for module, system in inspect.getmembers(problems, inspect.ismodule)
    for name, maker in vars(system).items()
    if inspect.isfunction(maker) and inspect.signature(maker).return_annotation is Scene
}


class _FileScene(AbstractTable):
    problem: Text | None = None
    file: Text
    object: Text


def read_system(content: dict[str, object], where: str, folder: Path) -> Scene | Callable[..., object]:
    """The scene or function that a table names. A file that it names is executed.

    **Arguments:**

    - `content`: with `problem`, its numbers and `law`; or with `file` and `object`.
    - `where`: name of the table in errors.
    - `folder`: folder of the SPEC, to which `file` is relative.

    **Raises:**

    - `ValueError` for unknown names, wrong numbers and a file that fails.
    """
    if ("problem" in content) == ("file" in content):
        both = "both are given" if "problem" in content else "neither is given"
        raise ValueError(f"{where}: either problem or file names the system, but {both}.")
    if "problem" in content:
        return _construct(content, where, "problem", PROBLEMS)
    named = read_table(_FileScene, content, where)
    return _from_file(where, folder / named.file, named.object)


def _construct(content: dict[str, object], where: str, key: str, makers: Mapping[str, Callable[..., object]]) -> Any:
    """Call the constructor that a table names by `key` with the numbers and the law of the table."""
    name = content.get(key)
    fields: dict[str, Any] = {key: (Literal[*makers], ...)}
    if not isinstance(name, str) or name not in makers:
        read_table(create_model("Kind", __base__=AbstractTable, **fields), content, where)
    maker = makers[str(name)]
    for field, parameter in inspect.signature(maker).parameters.items():
        needed = parameter.default is inspect.Parameter.empty
        if (callable(parameter.default) and not needed) or field == "laws":
            continue  # functions and several laws need a Python file
        kind: Any = Table if field == "law" else Whole if parameter.annotation is int else Values
        fields[field] = (kind, ...) if needed else (kind | None, None)
    model = create_model("Arguments", __base__=AbstractTable, **fields)
    values = read_table(model, content, where).model_dump(exclude={key}, exclude_none=True)
    if "law" in values:
        values["law"] = _construct(values["law"], inner(where, "law"), "kind", known_laws())
    try:
        return maker(**{name: np.asarray(x, float) if isinstance(x, float | list) else x for name, x in values.items()})
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where}: {error}") from error


def known_laws() -> dict[str, type[AbstractLaw]]:
    """Registered laws whose required arguments are numbers and another law, which a TOML file can state."""

    def needed(law: type[AbstractLaw]) -> list[dataclasses.Field[object]]:
        return [field for field in dataclasses.fields(law) if field.default is dataclasses.MISSING]

    return {
        name: law
        for name, law in laws().items()
        if all("range" in field.metadata or field.name == "law" for field in needed(law))
    }


def _from_file(where: str, path: Path, name: str) -> Scene | Callable[..., object]:
    """Execute a Python file and take an object from it."""
    if not path.is_file():
        raise ValueError(f"{where}: file {str(path)!r} is missing; its path is relative to the SPEC.")
    spec = importlib.util.spec_from_file_location(MODEL, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{where}: file must be a Python file, whose name ends in .py, but {path.name!r} was given.")
    module = importlib.util.module_from_spec(spec)
    # Some class decorators look up the module.
    sys.modules[MODEL] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # the file may raise anything
        raise ValueError(f"{where}: running {path.name} failed with {type(error).__name__}: {error}") from error
    objects = {
        key: x
        for key, x in vars(module).items()
        if isinstance(x, Scene) or (callable(x) and getattr(x, "__module__", None) == MODEL)
    }
    if name not in objects:
        defined = f"it defines {', '.join(objects)}" if objects else "it defines neither"
        raise ValueError(
            f"{where}: object must be a Scene or a function of {path.name}, but {name!r} was given, and {defined}."
            f"{did_you_mean(name, objects)}"
        )
    return objects[name]
