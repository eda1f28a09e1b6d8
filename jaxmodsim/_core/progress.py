"""A line of text that reports progress in a terminal, a notebook or a file."""

import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import ParamSpec

P = ParamSpec("P")

# Seconds between two updates of the time in the line, and between two lines in a file or pipe.
_EVERY, _EVERY_IN_FILE = 1.0, 20.0


@contextmanager
def reported(
    progress: bool | Callable[P, None], title: str, text_of: Callable[P, str]
) -> Iterator[Callable[P, None] | None]:
    """The function to call with reports of progress: the user's own, one that shows a line, or None.

    **Arguments:**

    - `progress`: the user's choice: a function, True for the line, False for nothing.
    - `title`: first part of the line.
    - `text_of`: converts a report to the text of the line.

    **Raises:**

    - `ValueError` for other values of `progress`.
    """
    if callable(progress):
        yield progress
    elif progress is True:
        with progress_line(title) as show:
            yield lambda *report, **named: show(text_of(*report, **named))
    elif progress is False:
        yield None
    else:
        raise ValueError(f"progress must be True, False or a function, but {progress!r} was given.")


@contextmanager
def progress_line(title: str, text: str = "compiling") -> Iterator[Callable[[str], None]]:
    """A line with a title, the elapsed time and a text; yields the function that changes the text.

    In a terminal or a notebook, the line on standard output overwrites itself. Its last text remains, or nothing if the
    text never changed. In a file or pipe, standard error gets a line every 20 s, and the last text.

    **Arguments:**

    - `title`: first part of the line.
    - `text`: text before the first report.
    """
    line = _StatusLine(title, text)
    thread = threading.Thread(target=line.keep_time, daemon=True)
    thread.start()
    try:
        yield line.show
    finally:
        line.closed.set()
        thread.join()
        line.close()


class _StatusLine:
    """The state of a progress line and its stream."""

    def __init__(self, title: str, text: str) -> None:
        self.title, self.text, self.changed = title, text, False
        self.began, self.written = time.perf_counter(), 0
        self.stream, self.closed, self.lock = sys.stdout, threading.Event(), threading.Lock()
        self.terminal = self.stream.isatty()
        # Notebooks support a carriage return, too.
        self.rewritten = self.terminal or type(self.stream).__module__.startswith("ipykernel")
        if not self.rewritten:  # in a file or pipe, standard output holds the result alone
            self.stream = sys.stderr

    def show(self, text: str) -> None:
        """Change the text."""
        self.text, self.changed = text, True
        if self.rewritten:
            self.write()

    def keep_time(self) -> None:
        """Write the line at regular intervals until it is closed."""
        if self.rewritten:
            self.write()
        while not self.closed.wait(_EVERY if self.rewritten else _EVERY_IN_FILE):
            self.write()

    def write(self) -> None:
        """Overwrite the line, or add one to a file."""
        with self.lock:
            text = self.whole()
            if self.terminal:  # a wrapped line cannot be overwritten
                text = text[: shutil.get_terminal_size().columns - 1]
            self.stream.write(f"\r{text.ljust(self.written)}" if self.rewritten else f"{text}\n")
            self.stream.flush()
            self.written = len(text)

    def close(self) -> None:
        """Write the last text, or erase a line that never changed."""
        if self.changed:
            self.write()
        if self.rewritten:
            self.stream.write("\n" if self.changed else f"\r{' ' * self.written}\r")
        self.stream.flush()

    def whole(self) -> str:
        """Title, elapsed time and text."""
        return f"{self.title} {minutes(time.perf_counter() - self.began)}: {self.text}"


def minutes(seconds: float) -> str:
    """A duration as 0:07 or 1:02:03."""
    whole = round(seconds)
    hours = f"{whole // 3600}:{whole // 60 % 60:02d}" if whole >= 3600 else f"{whole // 60}"
    return f"{hours}:{whole % 60:02d}"


def iteration_words(number: int, rmse: float, values: Mapping[str, float] | None = None) -> str:
    """An iteration of a fit: number, RMSE and parameters."""
    numbers = {"RMSE": rmse, **(values or {})}
    return f"iteration {number}: " + ", ".join(f"{name} {value:.4g}" for name, value in numbers.items())


def candidate_words(name: str, fold: int | None, number: int, rmse: float) -> str:
    """An iteration of a fit in a comparison of models."""
    held = "" if fold is None else f", fold {fold + 1} held out"
    return f"{name}{held}, {iteration_words(number, rmse)}"
