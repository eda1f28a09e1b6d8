"""The result of `work_precision`: rows, a table, a file."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._core.readable import Table
from .._core.system import extra, written_whole

if TYPE_CHECKING:
    import pandas as pd

_KIND, _VERSION = "jaxmodsim work precision", 4
# Titles of columns that are not the name of the field.
_TITLES = {
    "dt": "dt [s]", "numerical": "numerical error", "model": "model error", "events": "event error [s]",
    "gradient": "gradient error",
}  # fmt: skip


@dataclass(frozen=True)
class Timing:
    """Times of a call [s]: compilation, then median and quartiles of warm calls.

    `compile` is the time of the first call of the method in excess of a warm one. It is small if the process has
    compiled the same program before.
    """

    compile: float
    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Row:
    """One method at one setting. Fields that do not apply are None.

    - `method`: its name.
    - `rtol` or `dt`: the relative tolerance, or the fixed step [s].
    - `dtype`: floating type of the run.
    - `failed`: the reason of a failure, or "".
    - `error`: largest error of the observable over the saved times, relative to its scale. Its part `numerical` is the
      distance from the reference of the same formulation, and `model` the distance between both references.
    - `events`: largest error of the time of an event [s], if the sequence of modes is that of the reference.
    - `gradient`: largest relative error of a derivative of the last value of the observable.
    - `steps`, `rejected`: number of all steps, and of rejected steps.
    - `evaluations`: of the vector field in all steps, including Jacobians; None for methods that iterate.
    - `times`: a `Timing` for each of the costs: `run`, `vmap` (for each run of the batch), `forward`, `reverse`.
    - `warnings`: sentences on missing entries.
    """

    method: str
    rtol: float | None
    dt: float | None
    dtype: str
    failed: str = ""
    error: float | None = None
    numerical: float | None = None
    model: float | None = None
    events: float | None = None
    gradient: float | None = None
    steps: int | None = None
    rejected: int | None = None
    evaluations: int | None = None
    times: dict[str, Timing] | None = None
    warnings: tuple[str, ...] = ()

    @property
    def setting(self) -> str:
        """Tolerance or step as text."""
        return f"rtol = {self.rtol:.0e}" if self.dt is None else f"dt = {self.dt:.3g} s"

    def time(self, cost: str = "run") -> float:
        """Median time [s] of a cost; NaN if it was not measured."""
        timing = (self.times or {}).get(cost)
        return float("nan") if timing is None else timing.median


@dataclass(frozen=True)
class WorkPrecision:
    """Errors and costs, method by method. It prints as a table; `jaxmodsim.plot.work_precision_figure` draws it.

    - `problem`: name of the problem. `observable`, `unit`, `when`: the observable, its unit and times. `scale`: the
      magnitude to which errors are relative, in that unit.
    - `reference`: the methods of the references. `disagreement`: of the references, relative to the scale; smaller
      errors are not resolved. `events_disagreement` [s], `gradient_disagreement`: likewise.
    - `costs`: the timed calls; `batch`: number of runs of the vmap.
    - `rows`: a `Row` for each method and setting, including failures.
    - `machine`: processor, versions, date, commit.

    **Example:**

    ```python
    scene = jms.problems.braked_spring.scene(m=1.0, k=1.0)
    methods = {"Tsit5": jms.Method(diffrax.Tsit5())}
    study = jms.work_precision(scene, [1.0], [0.0], 10.0, methods=methods, tolerances=(1e-4, 1e-6), rounds=1)
    print(study.cheapest(1e-5).method, study.cheapest(1e-5).rtol)
    ```

    ```text
    Tsit5 1e-06
    ```
    """

    problem: str
    observable: str
    unit: str
    when: str
    scale: float
    reference: str
    disagreement: float
    events_disagreement: float
    gradient_disagreement: float
    costs: tuple[str, ...]
    batch: int
    rows: tuple[Row, ...]
    machine: dict[str, object]

    def cheapest(self, error: float, *, cost: str = "run") -> Row:
        """The fastest row up to an error.

        **Arguments:**

        - `error`: largest error, relative to the scale, > 0.
        - `cost`: one of `costs`.

        **Raises:**

        - `ValueError` if all rows have a larger error (the text names the best), if the cost was not measured, or if
          the error is below the disagreement of the references.
        """
        if cost not in self.costs:
            raise ValueError(
                f"cost must be one that the study has measured ({', '.join(self.costs)}), but is {cost!r}."
            )
        done = [row for row in self.rows if row.error is not None]
        if not done:
            raise ValueError("Every method failed: " + "; ".join(f"{row.method}: {row.failed}" for row in self.rows))
        if not error >= self.disagreement:
            raise ValueError(
                f"error must be at least {self.disagreement:.1e}, by which the references disagree, but is {error:.1e}."
            )
        enough = [row for row in done if row.error is not None and row.error <= error]
        if not enough:
            best = min(done, key=lambda row: row.error if row.error is not None else float("inf"))
            raise ValueError(
                f"No row has an error of {error:.1e} or less: the best is {best.error:.1e}, of {best.method} at"
                f" {best.setting}. Ask for tighter tolerances or shorter steps."
            )
        return min(enough, key=lambda row: row.time(cost))

    def table(self) -> "pd.DataFrame":
        """The rows as a pandas `DataFrame`.

        **Raises:**

        - `ImportError` if pandas is not installed.
        """
        return extra("pandas", "table", "cli").DataFrame([_columns(row, self.costs) for row in self.rows])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a JSON file, atomically; `load_work_precision` reads it.

        **Raises:**

        - `OSError` if the file cannot be written.
        """
        body = asdict(self)
        head = {"kind": _KIND, "format": _VERSION, "sha256": _digest(body)}
        text = json.dumps(head | body, indent=1, allow_nan=False)
        with written_whole(path) as file:
            file.write(text.encode() + b"\n")

    def __str__(self) -> str:
        """A table with the problem, failures, warnings and reference."""
        heads = ["method", "setting", "error", "numerical", "model", "events [s]", "gradient", "steps", "evaluations"]
        heads += [f"{cost} [ms]" for cost in self.costs] + ["compile [s]"]
        floors = {"error": self.disagreement, "numerical": self.disagreement, "model": self.disagreement}
        floors |= {"events [s]": self.events_disagreement, "gradient": self.gradient_disagreement}
        cells = [[_cell(row, head, floors, self.costs) for head in heads] for row in self.rows if not row.failed]
        kept = [i for i, _ in enumerate(heads) if any(line[i] for line in cells)]
        unit = f" {self.unit}" if self.unit else ""
        return Table(
            f"{self.problem}: {self.observable} {self.when}, errors relative to {self.scale:.4g}{unit}",
            tuple(heads[i] for i in kept),
            [tuple(line[i] for i in kept) for line in cells],
            (
                *(f"failed: {row.method} at {row.setting}: {row.failed}" for row in self.rows if row.failed),
                *(f"{row.method} at {row.setting}: {warning}" for row in self.rows for warning in row.warnings),
                f"Reference: {self.reference}, which agree to {self.disagreement:.1e}.",
            ),
        ).text()


def _cell(row: Row, head: str, floors: dict[str, float], costs: Sequence[str]) -> str:
    if head in ("method", "setting"):
        return str(getattr(row, head))
    name = head.split(" ")[0]
    if name == "compile":
        return f"{sum(timing.compile for timing in (row.times or {}).values()):.1f}"
    if name in ("steps", "evaluations"):
        return str(getattr(row, name) or "")
    for cost in costs:
        if head == f"{cost} [ms]":
            return f"{1e3 * row.time(cost):.3g}"
    value = getattr(row, name)
    if value is None:
        return ""
    if value == 0.0 and name == "model":
        return "0"
    return f"<{floors[head]:.0e}" if value < floors[head] else f"{value:.1e}"


def _columns(row: Row, costs: Sequence[str]) -> dict[str, object]:
    """The columns of a row, the last of which is `failed`."""
    others = ("failed", "times", "warnings")
    columns = {_TITLES.get(name, name): x for name, x in vars(row).items() if name not in others}
    for cost in costs:
        timing = (row.times or {}).get(cost)
        columns |= {f"{cost} {each.name} [s]": getattr(timing, each.name, None) for each in fields(Timing)}
    return {**columns, "failed": row.failed}


def _digest(body: dict[str, object]) -> str:
    """Checksum that reveals changed numbers."""
    return hashlib.sha256(json.dumps(body).encode()).hexdigest()


def load_work_precision(path: str | os.PathLike[str]) -> WorkPrecision:
    """Read a file of `WorkPrecision.save`.

    **Returns:**

    The `WorkPrecision` that was saved.

    **Raises:**

    - `ValueError` for a damaged file, or one of another kind.
    - `OSError` if it cannot be read.
    """
    try:
        body = json.loads(Path(path).read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged or not a JSON file: {error}") from error
    if not isinstance(body, dict) or body.pop("kind", None) != _KIND:
        raise ValueError(f"{path} was not written by WorkPrecision.save: its kind is not {_KIND!r}.")
    version = body.pop("format", None)
    if version != _VERSION:
        raise ValueError(f"{path} has the format {version!r}, but this version reads format {_VERSION}.")
    if body.pop("sha256", None) != _digest(body):
        raise ValueError(f"{path} is damaged or was edited: its checksum is wrong.")
    try:
        rows = tuple(_row(row) for row in body.pop("rows"))
        return WorkPrecision(**{**body, "costs": tuple(body["costs"]), "rows": rows})
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error!r}") from error


def _row(row: dict[str, Any]) -> Row:
    times = row["times"]
    timings = None if times is None else {cost: Timing(**timing) for cost, timing in times.items()}
    return Row(**{**row, "times": timings, "warnings": tuple(row["warnings"])})
