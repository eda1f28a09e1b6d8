"""Tests that take long are listed in `tests/deep.txt` and get the marker `deep`.

A line names a test, a function with all its parameters, or a file. To measure anew:

```sh
PROCESSOR_TIMES=build/times python -m pytest -n 2 -m ""     # seconds and names, a file for each process
```
"""

import os
from pathlib import Path

import pytest

LIST = Path(__file__).parents[1] / "deep.txt"


def listed() -> set[str]:
    """The lines of the list without comments."""
    return {line for line in LIST.read_text().splitlines() if line and not line.startswith("#")}


def is_listed(nodeid: str, deep: set[str]) -> bool:
    """Whether the list names this test, its function or its file."""
    return not deep.isdisjoint((nodeid, nodeid.split("[")[0], nodeid.split("::")[0]))


class ProcessorTimes:
    """Write what each test took, with the processes that it started."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.out = folder / f"{os.environ.get('PYTEST_XDIST_WORKER', 'main')}.tsv"

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item):
        before = os.times()
        try:
            return (yield)
        finally:
            seconds = sum(os.times()[:4]) - sum(before[:4])
            with self.out.open("a") as file:
                file.write(f"{seconds:.2f}\t{item.nodeid}\n")
