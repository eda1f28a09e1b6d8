"""How far a sweep has come."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeAlias

from .._core.extra import extra


@dataclass(frozen=True)
class SweepProgress:
    """How far a sweep has come.

    - `done`, `total`: runs; those that were there already count as done.
    - `failed`: of those done, the ones that ended early.
    """

    done: int
    total: int
    failed: int


Progress: TypeAlias = Callable[[SweepProgress], None]


@contextmanager
def reporter(progress: bool | Progress) -> Iterator[Progress]:
    """What is called after each block: a function that was given, a bar, or nothing."""
    if not progress:
        yield _silent
    elif callable(progress):
        yield progress
    else:
        with progress_bar() as report:
            yield report


def _silent(now: SweepProgress) -> None:
    del now


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A bar on the terminal, shown while the context is open; yields what to call with a `SweepProgress`.

    **Raises:**

    - `ImportError` where rich is not installed.
    """
    rich = extra("rich.progress")
    columns = (
        rich.BarColumn(bar_width=16),
        rich.TextColumn("{task.completed:,.0f} of {task.total:,.0f} runs{task.fields[rate]}"),
        rich.TextColumn("{task.fields[failed]:,} failed"),
        rich.TimeElapsedColumn(),
        rich.TextColumn("left"),
        rich.TimeRemainingColumn(),
    )
    with rich.Progress(*columns) as bar:
        task = bar.add_task("sweep", total=1, failed=0, rate="")
        before: list[int] = []

        def report(now: SweepProgress) -> None:
            if not before:  # what was there already says nothing of the rate
                before.append(now.done)
                bar.reset(task, total=now.total, completed=now.done)
            seconds = bar.tasks[0].elapsed or 0.0
            rate = f", {(now.done - before[0]) / seconds:,.0f}/s" if seconds > 0 and now.done > before[0] else ""
            bar.update(task, completed=now.done, total=now.total, failed=now.failed, rate=rate)

        yield report
