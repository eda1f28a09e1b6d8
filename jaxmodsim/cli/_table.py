"""Tables of a TOML file, with keys that are checked."""

import math
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .._core.suggest import did_you_mean, nearest


@dataclass(frozen=True)
class Kind:
    """What a value must be, in words and as a test."""

    words: str
    fits: Callable[[Any], bool]


def _is_number(x: Any) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x)


NUMBER = Kind("a finite number", _is_number)
WHOLE = Kind("a whole number > 0", lambda x: isinstance(x, int) and not isinstance(x, bool) and x > 0)
SEED = Kind("a whole number >= 0", lambda x: isinstance(x, int) and not isinstance(x, bool) and x >= 0)
TEXT = Kind("text", lambda x: isinstance(x, str))
SWITCH = Kind("true or false", lambda x: isinstance(x, bool))
NUMBERS = Kind("a list of numbers", lambda x: isinstance(x, list) and bool(x) and all(map(_is_number, x)))
VALUES = Kind("a number or a list of numbers", lambda x: _is_number(x) or NUMBERS.fits(x))
LIST = Kind("a list", lambda x: isinstance(x, list))
TABLE = Kind("a table", lambda x: isinstance(x, dict))


def one_of(words: Iterable[str]) -> Kind:
    """One of these words."""
    known = tuple(words)
    return Kind(f"one of {', '.join(known)}", lambda x: isinstance(x, str) and x in known)


class Table:
    """A table whose keys are taken one by one; what nobody takes is refused.

    - `where`: the table as errors call it, such as `sweep.toml [over.k]`.
    - `keys`: the keys that are there.
    """

    def __init__(self, where: str, content: dict[str, Any]) -> None:
        """Nothing is taken yet."""
        self.where, self._content, self._taken = where, content, list[str]()

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys that are there."""
        return tuple(self._content)

    def refusal(self, text: str) -> ValueError:
        """An error in this table."""
        return ValueError(f"{self.where}: {text}")

    def take(self, key: str, *kinds: Kind, needed: bool = False) -> Any:
        """The value of a key, of one of these kinds; None where it is not there.

        **Raises:**

        - `ValueError` if it is of another kind, or missing though `needed`.
        """
        self._taken.append(key)
        words = " or ".join(kind.words for kind in kinds)
        if key not in self._content:
            if needed:
                left = [name for name in self._content if name not in self._taken]
                misspelt = nearest(key, left)
                hint = f" {misspelt!r} is there instead." if misspelt else ""
                raise self.refusal(f"{key} is missing; it must be {words}.{hint}")
            return None
        value = self._content[key]
        if not any(kind.fits(value) for kind in kinds):
            hint = did_you_mean(value, words.replace(",", "").split()) if isinstance(value, str) else ""
            raise self.refusal(f"{key} must be {words}, but {value!r} was given.{hint}")
        return value

    def table(self, key: str, *, needed: bool = False) -> "Table | None":
        """The table of a key; None where it is not there."""
        content = self.take(key, TABLE, needed=needed)
        return None if content is None else self.inner(key, content)

    def inner(self, key: str, content: dict[str, Any]) -> "Table":
        """A table inside this one."""
        head, _, inside = self.where.partition(" [")
        name = f'"{key}"' if not key.replace("_", "").replace("-", "").isalnum() else key
        return Table(f"{head} [{inside[:-1]}.{name}]" if inside else f"{head} [{name}]", content)

    def close(self) -> None:
        """Refuse keys that nobody has taken.

        **Raises:**

        - `ValueError` that names one, and the keys that there may be.
        """
        known = tuple(dict.fromkeys(self._taken))
        for key in self._content:
            if key not in known:
                allowed = f"; there may be {', '.join(known)}." if known else "."
                raise self.refusal(f"there is no key {key!r}{allowed}{did_you_mean(key, known)}")


def read_table(path: Path) -> Table:
    """A TOML file.

    **Raises:**

    - `ValueError` if it cannot be read.
    """
    try:
        content = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text in UTF-8"
        raise ValueError(f"{path} cannot be read: {reason}.") from error
    try:
        return Table(path.name, tomllib.loads(content))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path.name} is no TOML: {error}. Names with dots or brackets stand in quotes.") from error
