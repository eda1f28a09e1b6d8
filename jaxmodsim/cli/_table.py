"""Tables of a TOML file, read into pydantic models; a mistake is one sentence with the table, the key and the value."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from .._core.arguments import did_you_mean, nearest

# Types of values; errors call them by the text beside them.
Number = Annotated[float, "a finite number"]
Whole = Annotated[int, Field(gt=0), "a whole number > 0"]
Seed = Annotated[int, Field(ge=0), "a whole number >= 0"]
Text = Annotated[str, "text"]
Switch = Annotated[bool, "true or false"]
Numbers = Annotated[list[float], Field(min_length=1), "a list of numbers"]
Values = Annotated[float | Annotated[list[float], Field(min_length=1)], "a number or a list of numbers"]
Table = Annotated[dict[str, object], "a table"]


class AbstractTable(BaseModel):
    """What a table may hold: keys that are fields, values of their types as they are, no others."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=AbstractTable)


def read_table(model: type[Model], content: Mapping[str, object], where: str) -> Model:
    """A table as a model.

    - `where`: the table as errors call it, such as `sweep.toml [over.k]`.

    **Raises:**

    - `ValueError` for an unknown key, a missing one, and a value of another kind.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{where}: {_sentence(model, content, str(first['loc'][0]), first['type'])}") from None


def _sentence(model: type[AbstractTable], content: Mapping[str, object], key: str, kind: str) -> str:
    fields = {field.alias or name: field for name, field in model.model_fields.items()}
    if key not in fields:
        return f"there is no key {key!r}; there may be {', '.join(fields)}.{did_you_mean(key, fields)}"
    words = _kind_of(fields[key].rebuild_annotation())
    if kind == "missing":
        misspelt = nearest(key, [name for name in content if name not in fields])
        return f"{key} is missing; it must be {words}." + (f" {misspelt!r} is there instead." if misspelt else "")
    value = content[key]
    hint = did_you_mean(value, words.replace(",", "").split()) if isinstance(value, str) else ""
    return f"{key} must be {words}, but {value!r} was given.{hint}"


def _kind_of(annotation: Any) -> str:
    """What a type of values is called."""
    if get_origin(annotation) is Annotated:
        return next(text for text in annotation.__metadata__ if isinstance(text, str))
    if get_origin(annotation) is Literal:
        return f"one of {', '.join(get_args(annotation))}"
    return " or ".join(filter(None, map(_kind_of, get_args(annotation))))


def inner(where: str, key: str) -> str:
    """What errors call a table inside the table `where`."""
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
        raise ValueError(f"{path.name} is no TOML: {error}. Names with dots or brackets stand in quotes.") from error
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text in UTF-8"
        raise ValueError(f"{path} cannot be read: {reason}.") from error
