"""The format of all results: rows of case, peer, quantity, value and unit, with their provenance."""

import json
import math
import subprocess
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxmodsim._core.system import describe_machine
from jaxmodsim.analysis._timing import measure

# Paths that benches write, whose changes do not make a commit unclean.
WRITTEN = ("bench/results", "README.md", "docs")
OURS = "jaxmodsim"

Call = Callable[[], Any]
Value = float | str | None


@dataclass
class Result:
    """The result of a bench.

    - `name`: of the bench.
    - `packages`: packages whose versions are recorded, besides JAX.
    - `settings`: numbers in captions.
    - `rows`: dictionaries with `case`, `peer`, `quantity`, `at` (a setting such as a tolerance), `value` and `unit`;
      those of times also with `quartiles`, `minimum`, `repetitions` and `first`, the time of the first call, which
      compiles. The value of a peer that failed is a text that begins with "failed".
    - `not_run`: peers that cannot be imported, with the reasons.
    """

    name: str
    packages: tuple[str, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)
    not_run: dict[str, str] = field(default_factory=dict)

    def add(
        self, quantity: str, value: Value, unit: str = "1", *, case: str = "", peer: str = OURS, at: Any = ""
    ) -> None:
        """Add a row; nothing for a value that is None."""
        if value is not None:
            found = value if isinstance(value, str) or math.isfinite(value) else str(value)
            self.rows.append(_row(case or self.name, peer, quantity, at) | {"value": found, "unit": unit})

    def add_time(
        self, quantity: str, found: Mapping[str, Any], *, case: str = "", peer: str = OURS, at: Any = ""
    ) -> None:
        """Add the times of one call, from `timed`."""
        row = _row(case or self.name, peer, quantity, at)
        if "failed" in found:
            self.rows.append(row | {"value": f"failed: {found['failed']}", "unit": "s"})
            return
        row |= {"value": found["median_s"], "unit": "s", "quartiles": found["quartiles_s"]}
        row |= {name: found[f"{name}_s"] for name in ("minimum", "first")}
        self.rows.append(row | {"repetitions": found["repetitions"]})

    def write(self, folder: Path, *, smoke: bool) -> None:
        """Write `NAME.json` with a line for each row."""
        machine = describe_machine("jax", "jaxlib", *self.packages, "jaxmodsim", beside=WRITTEN)
        machine["clean"] = bool(machine["commit"]) and not machine.pop("uncommitted_changes")
        head = {"name": self.name, "smoke": smoke, "provenance": machine}
        head |= {"settings": self.settings, "not_run": self.not_run}
        folder.mkdir(parents=True, exist_ok=True)
        lines = ",\n".join("  " + json.dumps(row) for row in self.rows)
        text = json.dumps(head, indent=1)[:-2] + f',\n "rows": [\n{lines}\n ]\n}}\n'
        (folder / f"{self.name}.json").write_text(text)


def _row(case: str, peer: str, quantity: str, at: Any) -> dict[str, Any]:
    return {"case": case, "peer": peer, "quantity": quantity, "at": at}


def timed(calls: Mapping[Any, Call], rounds: int, *, per: Mapping[Any, int] | int = 1, limit_s: float = 30.0) -> Any:
    """Times of calls in turns, by `measure`, with the same keys, divided by the number of runs in a call, `per`."""
    report = measure(dict(calls), rounds, limit_s)  # pyright: ignore[reportArgumentType] - any key will do
    for key, found in report.items():
        count = per if isinstance(per, int) else per[key]
        if "failed" not in found:
            found |= {name: found[name] / count for name in ("median_s", "minimum_s")}
            found["quartiles_s"] = [x / count for x in found["quartiles_s"]]
    return report


def command(*arguments: str) -> None:
    """Run `jaxmodsim` with these arguments in a process of its own, compilation included."""
    whole = [sys.executable, "-c", "from jaxmodsim.cli import main; main()", *arguments]
    subprocess.run(whole, check=True, capture_output=True)


def importable(result: Result, makers: Mapping[str, Callable[[], Any]]) -> dict[str, Any]:
    """The peers by name; a peer that cannot import its package is recorded and left out."""
    made = {}
    for name, make in makers.items():
        try:
            made[name] = make()
        except ImportError as error:
            result.not_run[name] = str(error)
            warnings.warn(f"{name} is not run: {error}", stacklevel=2)
    return made
