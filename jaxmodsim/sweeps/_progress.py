"""How far a sweep has come."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from .._core.progress import minutes


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


class SweepWords:
    """A report in words, with the pace since the first one and the time that is left at that pace."""

    def __init__(self) -> None:
        self._before: int | None = None
        self._began = 0.0

    def __call__(self, now: SweepProgress) -> str:
        """The words."""
        if self._before is None:  # what was there already says nothing of the pace
            self._before, self._began = now.done, time.perf_counter()
        count = f"{now.done:,} of {now.total:,} runs"
        if now.done == now.total or now.done > self._before:
            pace = (now.done - self._before) / max(time.perf_counter() - self._began, 1e-3)
            left = f", {pace:,.0f}/s, {minutes((now.total - now.done) / pace)} left" if now.done < now.total else ""
            return f"{count}, {now.failed:,} failed{left}"
        return "compiling" if now.done == 0 else f"compiling, {count} are there"
