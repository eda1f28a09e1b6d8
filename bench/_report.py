"""How every bench ends: its tables on the terminal, its result as JSON, its figures, targets met or not."""

import json
import math
import operator
from pathlib import Path
from typing import Any

import matplotlib as mpl
from _options import Options
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from jaxmodsim._core.provenance import describe_machine

mpl.use("Agg")

# What benches write: the results of one are no change to the next.
_WRITTEN = ("bench/results", "README.md", "docs")
_COMPARISONS = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}


def new_result(name: str, options: Options, *packages: str) -> dict[str, Any]:
    """What every result begins with; `packages` are those whose versions matter."""
    machine = describe_machine("jax", "jaxlib", *packages, "jaxmodsim", beside=_WRITTEN)
    return {"name": name, "smoke": options.smoke, "tuned": options.tuned, "machine": machine}


def write_result(content: dict[str, Any], options: Options) -> None:
    """Print the tables of a result, and write `NAME.json`."""
    for table in content["tables"]:
        print(table["caption"], *(" | ".join(row) for row in [table["columns"], *table["rows"]]), sep="\n")
    path = options.out / f"{content['name']}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n")
    print(f"written: {path}")


def write_figure(figure: Figure, path: Path, dpi: int = 150) -> None:
    """Write a figure, and close it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)
    plt.close(figure)
    print(f"written: {path}")


def target_rows(found: list[tuple[str, str, float]]) -> list[list[str]]:
    """Rows of a table of targets.

    **Arguments:**

    - `found`: label, target such as `>= 8` (empty where there is none), and what was measured (NaN if it was not).
    """
    return [[label, target, _plain(value), verdict(target, value)] for label, target, value in found]


def verdict(target: str, value: float) -> str:
    """Whether a target is met; nothing where there is none."""
    if not target:
        return ""
    if math.isnan(value):
        return "not measured"
    comparison, limit = target.split()
    return "yes" if _COMPARISONS[comparison](value, float(limit)) else "no"


def _plain(value: float) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:,.3g}" if abs(value) < 1e4 else f"{value:,.0f}"


def show(row: dict[str, Any] | None, unit: float = 1.0) -> str:
    """Median of what `measure` found, in units of `1/unit` seconds."""
    if row is None:
        return "-"
    return "failed" if "failed" in row else f"{row['median_s'] * unit:.3g}"
