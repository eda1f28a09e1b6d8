"""Errors in functions of the user: the function, the line and the remedy, and the last line of a traceback."""

import builtins
import linecache
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import SupportsIndex, final, overload

import jax
import numpy as np

from .compat import after_traceback

# Code in these folders is not the user's.
_LIBRARIES = (*(str(Path(module.__file__ or "").parent) for module in (jax, np)), str(Path(__file__).parents[1]))
_FOREIGN = ("equinox", "diffrax", "jaxtyping", "beartype")

# Parts of the messages for an index by name into a list, a tuple, a JAX array or a number.
_NOT_BY_NAME = (
    "indices must be integers or slices, not str",
    "does not support string indexing",
    "object is not subscriptable",
)

# Parts of the messages for arithmetic with a list or a mapping.
_NO_OPERAND = ("unsupported operand type(s)", "requires ndarray or scalar arguments", "can't multiply sequence by")

# Remedies by type, subclasses first.
_REMEDIES = (
    (
        jax.errors.TracerArrayConversionError,
        "numpy cannot compute with it. Use the functions of jax.numpy, such as jnp.cos for np.cos.",
    ),
    (
        jax.errors.TracerBoolConversionError,
        "`if`, `and`, `or` and `not` cannot evaluate it. Use jnp.where(condition, a, b), and &, | and ~.",
    ),
    (jax.errors.TracerIntegerConversionError, "it cannot be an index in Python. Use jnp.take or an array of jnp."),
    (jax.errors.NonConcreteBooleanIndexError, "it cannot determine the number of entries. Use jnp.where."),
    (
        jax.errors.ConcretizationTypeError,
        "math, float() and int() cannot compute with it. Use the functions of jax.numpy, such as jnp.cos for math.cos.",
    ),
)


def explain(error: Exception, name: str, arguments: Iterable[str]) -> str | None:
    """Message that replaces an error from tracing a function of the user; None if the error is of another kind.

    **Arguments:**

    - `error`: the error.
    - `name`: name of the function in messages.
    - `arguments`: names of its arguments.
    """
    where = _last_line_of_the_user(error.__traceback__)
    for kind, remedy in _REMEDIES:
        if isinstance(error, kind):
            return f"{_sentence(name)} computes with a value that is known only at run time{where}: {remedy}"
    if isinstance(error, KeyError) and where:
        return f"{_sentence(name)} reads {error.args[0]!r}, which is not defined{where}: add it to the scene's params."
    if isinstance(error, TypeError) and where and any(each in str(error) for each in _NOT_BY_NAME):
        return (
            f"{_sentence(name)} reads params by name, but params, or one of its entries, is not a mapping{where}:"
            ' pass params={"m": 2.0}, or read the entries of a list by position.'
        )
    if isinstance(error, TypeError) and where and any(each in str(error) for each in _NO_OPERAND):
        return (
            f"{_sentence(name)} cannot compute with a list or a mapping{where} ({error}): read its entries, or use an"
            " array in the scene's params."
        )
    if isinstance(error, TypeError) and "positional argument" in str(error):
        return f"{_sentence(name)} is called with ({', '.join(arguments)}), but: {error}."
    return None


def _sentence(name: str) -> str:
    return f"T{name[1:]}" if name.startswith("the ") else name


def _last_line_of_the_user(traceback: TracebackType | None) -> str:
    """Text with the innermost line outside of libraries; empty if there is none."""
    text = ""
    while traceback is not None:
        file = traceback.tb_frame.f_code.co_filename
        if not file.startswith(_LIBRARIES) and not any(f"/{each}/" in file for each in _FOREIGN):
            line = linecache.getline(file, traceback.tb_lineno).strip()
            text = f", at {file}:{traceback.tb_lineno}" + (f" (`{line}`)" if line else "")
        traceback = traceback.tb_next
    return text


# Message of the last error inside compiled code, and the callbacks of IPython shells that repeat it.
_LAST: list[str] = [""]
_SHELLS: dict[int, Callable[..., None]] = {}


@final
class LastLines(tuple[str, ...]):
    """Messages for `equinox.branched_error_if`; the one that is raised is repeated after the traceback.

    An error inside `jax.jit` reaches the user within a page of text by XLA, equinox and JAX, which ends with advice on
    tracebacks. Only the printer of the traceback, Python or IPython, can append a line.
    """

    __slots__ = ()

    @overload
    def __getitem__(self, index: SupportsIndex) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[str, ...]: ...
    def __getitem__(self, index: SupportsIndex | slice) -> str | tuple[str, ...]:
        """The message, which equinox reads when it raises the error."""
        message = super().__getitem__(index)
        if isinstance(message, str):
            _repeat_at_exit(message)
        return message


def _repeat_at_exit(message: str) -> None:
    """Repeat the message after the traceback, if the error ends the program or a notebook cell."""
    _LAST[0] = message
    after_traceback(_print)
    shell = getattr(builtins, "get_ipython", lambda: None)()
    if shell is not None and id(shell) not in _SHELLS:
        _SHELLS[id(shell)] = lambda result: _print(result.error_in_exec)
        shell.events.register("post_run_cell", _SHELLS[id(shell)])


def _print(error: BaseException | None) -> None:
    if _LAST[0] and error is not None and _LAST[0] in str(error):
        sys.stderr.write(f"\n{_LAST[0]}\n")
        sys.stderr.flush()
