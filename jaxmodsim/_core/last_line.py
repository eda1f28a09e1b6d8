"""The sentence that names the cause of an error, as the last line that a user reads of it."""

import builtins
import sys
from collections.abc import Callable
from typing import SupportsIndex, final, overload

from .compat import after_traceback

# The sentence of the last error inside compiled code, and what shows it in each shell of IPython.
_LAST: list[str] = [""]
_SHELLS: dict[int, Callable[..., None]] = {}


@final
class LastLines(tuple[str, ...]):
    """Messages for `equinox.branched_error_if`, of which the one that is raised is also said after the traceback.

    What is raised inside `jax.jit` reaches the user within a page of text of XLA, equinox and JAX, which ends with
    advice on tracebacks. Only the one who prints the traceback, Python or IPython, can put a line behind it.
    """

    __slots__ = ()

    @overload
    def __getitem__(self, index: SupportsIndex) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[str, ...]: ...
    def __getitem__(self, index: SupportsIndex | slice) -> str | tuple[str, ...]:
        """The message, which equinox reads as it raises it."""
        message = super().__getitem__(index)
        if isinstance(message, str):
            _say_last(message)
        return message


def _say_last(sentence: str) -> None:
    """Say it once more after the traceback, if the error ends the program, or the cell of a notebook."""
    _LAST[0] = sentence
    after_traceback(_say)
    shell = getattr(builtins, "get_ipython", lambda: None)()
    if shell is not None and id(shell) not in _SHELLS:
        _SHELLS[id(shell)] = lambda result: _say(result.error_in_exec)
        shell.events.register("post_run_cell", _SHELLS[id(shell)])


def _say(error: BaseException | None) -> None:
    if _LAST[0] and error is not None and _LAST[0] in str(error):
        sys.stderr.write(f"\n{_LAST[0]}\n")
        sys.stderr.flush()
