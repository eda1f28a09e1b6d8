"""A line that reports progress in a terminal, a notebook or a command."""

import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import ParamSpec

P = ParamSpec("P")

# Interval of updates, which show the elapsed time [s].
_EVERY = 1.0


@contextmanager
def reported(
    progress: bool | Callable[P, None], title: str, text_of: Callable[P, str]
) -> Iterator[Callable[P, None] | None]:
    """The callback of an argument `progress`: a function of the user, one that shows a line, or None.

    **Arguments:**

    - `progress`: a function, True for the line, or False for no report.
    - `title`: start of the line.
    - `text_of`: text of the line from the arguments of the callback.

    **Raises:**

    - `ValueError` for other values of `progress`.
    """
    if callable(progress):
        yield progress
    elif progress is True:
        with progress_line(title) as show:
            yield lambda *args, **kwargs: show(text_of(*args, **kwargs))
    elif progress is False:
        yield None
    else:
        raise ValueError(f"progress must be True, False or a function, but {progress!r} was given.")


@contextmanager
def progress_line(title: str, text: str = "compiling") -> Iterator[Callable[[str], None]]:
    """Show a line on standard output with the elapsed time; yield the function that changes its text.

    In a terminal and in a notebook the line overwrites itself; the last text remains, unless it is the initial text. In
    a file or pipe only the last text appears, on standard error.

    **Arguments:**

    - `title`: start of the line.
    - `text`: initial text.
    """
    line = _StatusLine(title, text)
    thread = threading.Thread(target=line.keep_time, daemon=True)
    if line.rewritten:
        thread.start()
    try:
        yield line.show
    finally:
        line.closed.set()
        if line.rewritten:
            thread.join()
        line.close()


class _StatusLine:
    """A line on a stream."""

    def __init__(self, title: str, text: str) -> None:
        self.title, self.text, self.changed = title, text, False
        self.began, self.written = time.perf_counter(), 0
        self.stream, self.closed, self.lock = sys.stdout, threading.Event(), threading.Lock()
        self.terminal = self.stream.isatty()
        # Notebooks also support carriage returns.
        self.rewritten = self.terminal or type(self.stream).__module__.startswith("ipykernel")
        if not self.rewritten:  # a file or another program receives only the result
            self.stream = sys.stderr

    def show(self, text: str) -> None:
        """Change the text."""
        self.text, self.changed = text, True
        if self.rewritten:
            self.write()

    def keep_time(self) -> None:
        """Update the line until it is closed."""
        self.write()
        while not self.closed.wait(_EVERY):
            self.write()

    def write(self) -> None:
        """Overwrite the line."""
        with self.lock:
            text = self.whole()
            if self.terminal:  # a wrapped line cannot be overwritten
                text = text[: shutil.get_terminal_size().columns - 1]
            self.stream.write(f"\r{text.ljust(self.written)}")
            self.stream.flush()
            self.written = len(text)

    def close(self) -> None:
        """Write the last text, or clear the initial one."""
        if not self.rewritten:
            self.stream.write(f"{self.whole()}\n" if self.changed else "")
        elif self.changed:
            self.write()
            self.stream.write("\n")
        else:
            self.stream.write(f"\r{' ' * self.written}\r")
        self.stream.flush()

    def whole(self) -> str:
        """Title, elapsed time and text."""
        return f"{self.title} {minutes(time.perf_counter() - self.began)}: {self.text}"


def minutes(seconds: float) -> str:
    """A time such as 0:07 or 1:02:03."""
    whole = round(seconds)
    hours = f"{whole // 3600}:{whole // 60 % 60:02d}" if whole >= 3600 else f"{whole // 60}"
    return f"{hours}:{whole % 60:02d}"


def iteration_words(number: int, rmse: float, values: Mapping[str, float] | None = None) -> str:
    """Text for an iteration of a fit: its number, the RMSE and the parameters."""
    numbers = {"RMSE": rmse, **(values or {})}
    return f"iteration {number}: " + ", ".join(f"{name} {value:.4g}" for name, value in numbers.items())


def candidate_words(name: str, fold: int | None, number: int, rmse: float) -> str:
    """Text for an iteration of the fit of one model among several."""
    held = "" if fold is None else f", fold {fold + 1} held out"
    return f"{name}{held}, {iteration_words(number, rmse)}"
