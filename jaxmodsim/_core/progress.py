"""One line of text that says how far something has come: the same in a terminal, a notebook and a command."""

import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import ParamSpec

P = ParamSpec("P")

# The line is written again after so many seconds, for the time in it.
_EVERY = 1.0


@contextmanager
def reported(
    progress: bool | Callable[P, None], title: str, words: Callable[P, str]
) -> Iterator[Callable[P, None] | None]:
    """What is called as something goes on: a function that was given, one that shows a line, or None.

    **Arguments:**

    - `progress`: what the user gave: a function, True for the line, False for nothing.
    - `title`: begins the line.
    - `words`: text of the line from what a function would be called with.

    **Raises:**

    - `ValueError` if `progress` is something else.
    """
    if callable(progress):
        yield progress
    elif progress is True:
        with progress_line(title) as show:
            yield lambda *given, **named: show(words(*given, **named))
    elif progress is False:
        yield None
    else:
        raise ValueError(f"progress must be True, False or a function, but {progress!r} was given.")


@contextmanager
def progress_line(title: str, text: str = "compiling") -> Iterator[Callable[[str], None]]:
    """A line on standard output with the time since its begin; yields what changes its text.

    In a terminal and in a notebook the line is written over itself; its last text stays, or nothing where there never
    was another than the first. Elsewhere, in a file or pipe, only the last text is written, to standard error.

    **Arguments:**

    - `title`: begins the line.
    - `text`: follows, until there is something to report.
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
    """A line on a stream, and what is written of it."""

    def __init__(self, title: str, text: str) -> None:
        self.title, self.text, self.changed = title, text, False
        self.began, self.written = time.perf_counter(), 0
        self.stream, self.closed, self.lock = sys.stdout, threading.Event(), threading.Lock()
        self.terminal = self.stream.isatty()
        # Notebooks obey a carriage return, too.
        self.rewritten = self.terminal or type(self.stream).__module__.startswith("ipykernel")
        if not self.rewritten:  # where output goes to a file or another program, it is the result alone
            self.stream = sys.stderr

    def show(self, text: str) -> None:
        """Change the text."""
        self.text, self.changed = text, True
        if self.rewritten:
            self.write()

    def keep_time(self) -> None:
        """Write the line again and again, until it is closed."""
        self.write()
        while not self.closed.wait(_EVERY):
            self.write()

    def write(self) -> None:
        """Write the line over itself."""
        with self.lock:
            text = self.whole()
            if self.terminal:  # a line that is broken in two cannot be written over
                text = text[: shutil.get_terminal_size().columns - 1]
            self.stream.write(f"\r{text.ljust(self.written)}")
            self.stream.flush()
            self.written = len(text)

    def close(self) -> None:
        """Leave the last text."""
        if not self.rewritten:
            self.stream.write(f"{self.whole()}\n" if self.changed else "")
        elif self.changed:
            self.write()
            self.stream.write("\n")
        else:
            self.stream.write(f"\r{' ' * self.written}\r")
        self.stream.flush()

    def whole(self) -> str:
        """Title, the time since the begin, text."""
        return f"{self.title} {minutes(time.perf_counter() - self.began)}: {self.text}"


def minutes(seconds: float) -> str:
    """A time as 0:07 or 1:02:03."""
    whole = round(seconds)
    hours = f"{whole // 3600}:{whole // 60 % 60:02d}" if whole >= 3600 else f"{whole // 60}"
    return f"{hours}:{whole % 60:02d}"


def iteration_words(number: int, rmse: float, values: Mapping[str, float] | None = None) -> str:
    """An iteration of a fit: its number, the RMSE, the parameters."""
    numbers = {"RMSE": rmse, **(values or {})}
    return f"iteration {number}: " + ", ".join(f"{name} {value:.4g}" for name, value in numbers.items())


def candidate_words(name: str, fold: int | None, number: int, rmse: float) -> str:
    """An iteration of a fit of one model among several."""
    held = "" if fold is None else f", fold {fold + 1} held back"
    return f"{name}{held}, {iteration_words(number, rmse)}"
