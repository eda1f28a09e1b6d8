"""Errors in functions of the user that JAX cannot trace: which function, which line, and the mend."""

import linecache
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType

import jax
import numpy as np

# Functions from these folders are not the user's.
_LIBRARIES = (*(str(Path(module.__file__ or "").parent) for module in (jax, np)), str(Path(__file__).parents[1]))
_FOREIGN = ("equinox", "diffrax", "jaxtyping", "beartype")

# Parts of the errors of an index by name into a list, a tuple, an array of JAX or a number.
_NOT_BY_NAME = (
    "indices must be integers or slices, not str",
    "does not support string indexing",
    "object is not subscriptable",
)

# Parts of the errors of arithmetic with a list or a mapping.
_NO_OPERAND = ("unsupported operand type(s)", "requires ndarray or scalar arguments", "can't multiply sequence by")

# The most special first.
_MENDS = (
    (
        jax.errors.TracerArrayConversionError,
        "numpy cannot compute with it: use the functions of jax.numpy, as jnp.cos for np.cos.",
    ),
    (
        jax.errors.TracerBoolConversionError,
        "`if`, `and`, `or` and `not` cannot ask for it: use jnp.where(condition, a, b), and &, | and ~.",
    ),
    (jax.errors.TracerIntegerConversionError, "it cannot be an index of Python: use jnp.take or an array of jnp."),
    (jax.errors.NonConcreteBooleanIndexError, "it cannot choose how many entries there are: use jnp.where."),
    (
        jax.errors.ConcretizationTypeError,
        "math, float() and int() cannot compute with it: use the functions of jax.numpy, as jnp.cos for math.cos.",
    ),
)


def explain(error: Exception, name: str, arguments: Iterable[str]) -> str | None:
    """What the user reads in place of an error that tracing a function of theirs has raised; None for other errors.

    **Arguments:**

    - `error`: what was raised.
    - `name`: of the function, for messages.
    - `arguments`: names of what it is called with.
    """
    where = _last_line_of_the_user(error.__traceback__)
    for kind, mend in _MENDS:
        if isinstance(error, kind):
            return f"{_sentence(name)} computes with a value that is known only while it runs{where}: {mend}"
    if isinstance(error, KeyError) and where:
        return (
            f"{_sentence(name)} asks for {error.args[0]!r}, which there is not{where}: give it in the scene's params."
        )
    if isinstance(error, TypeError) and where and any(each in str(error) for each in _NOT_BY_NAME):
        return (
            f"{_sentence(name)} reads params by name, but params, or the entry it reads from, is no mapping{where}:"
            ' give params={"m": 2.0}, or read entries of a list by their position.'
        )
    if isinstance(error, TypeError) and where and any(each in str(error) for each in _NO_OPERAND):
        return (
            f"{_sentence(name)} cannot compute with a list or a mapping{where} ({error}): read its entries, or give an"
            " array in the scene's params."
        )
    if isinstance(error, TypeError) and "positional argument" in str(error):
        return f"{_sentence(name)} is called with ({', '.join(arguments)}), but: {error}."
    return None


def _sentence(name: str) -> str:
    return f"T{name[1:]}" if name.startswith("the ") else name


def _last_line_of_the_user(traceback: TracebackType | None) -> str:
    """The innermost line outside of libraries, in words; empty where there is none."""
    said = ""
    while traceback is not None:
        file = traceback.tb_frame.f_code.co_filename
        if not file.startswith(_LIBRARIES) and not any(f"/{each}/" in file for each in _FOREIGN):
            line = linecache.getline(file, traceback.tb_lineno).strip()
            said = f", at {file}:{traceback.tb_lineno}" + (f" (`{line}`)" if line else "")
        traceback = traceback.tb_next
    return said
