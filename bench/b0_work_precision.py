"""Work against precision on the LuGre testbench: time of one run and its error, tolerance by tolerance.

python bench/b0_work_precision.py [--smoke] [--no-tune] [--out DIR]
"""

from pathlib import Path
from typing import Any

from _ladder import half_decades
from _lugre import TESTBENCH, error_ladder, peers, reference_solution
from _measure import machine_line, measure
from _options import begin
from _report import new_result, write_figure, write_result
from matplotlib import pyplot as plt

LADDER = half_decades(-3, -10)


def main() -> None:
    """Measure, and write `lugre_work_precision.json` and `.png`."""
    options = begin("Work against precision on the LuGre testbench.", may_leave_untuned=True)
    name = "lugre_work_precision" if options.tuned else "lugre_work_precision_untuned"
    solvers, (reference, agreement) = peers(), reference_solution()
    points = {peer.name: error_ladder(peer, reference, LADDER[:2] if options.smoke else LADDER) for peer in solvers}
    calls = {
        f"{peer.name} {row['rtol']:.0e}": peer.once(row["rtol"])
        for peer in solvers
        for row in points[peer.name]
        if "failed" not in row
    }
    times = measure(calls, 1 if options.smoke else 20, limit_s=3.0)
    for peer, rows in points.items():
        for row in rows:
            row |= times.get(f"{peer} {row['rtol']:.0e}", {})
    content = new_result(name, options, "diffrax", "casadi", "scikit-sundae", "scipy", "numpy") | {
        "atol_over_rtol": TESTBENCH.atol,
        "reference_disagreement": agreement,
        "points": points,
    }
    content["tables"] = [_table(content)]
    write_result(content, options)
    draw(content, options.out / f"{name}.png")


def _table(content: dict[str, Any]) -> dict[str, Any]:
    def cell(row: dict[str, Any]) -> str:
        return "failed" if "failed" in row else f"{1e3 * row['median_s']:.2f} ms, {row['v_run']:.0e}"

    points = content["points"]
    rows = [[f"{same[0]['rtol']:.0e}", *(cell(row) for row in same)] for same in zip(*points.values(), strict=True)]
    caption = (
        "Time of one run [ms] and largest error of the velocity over the run, relative to the largest velocity."
        f" {machine_line(content['machine'])}"
    )
    return {"columns": ["rtol", *points], "rows": rows, "caption": caption}


def draw(content: dict[str, Any], path: Path) -> None:
    """Work-precision diagram: the lower left is the better place."""
    figure, axes = plt.subplots(figsize=(7.0, 4.6), layout="constrained")
    for marker, (peer, rows) in zip("osD^v<>PX*", content["points"].items(), strict=False):
        kept = [row for row in rows if "failed" not in row]
        axes.loglog(
            [row["v_run"] for row in kept], [1e3 * row["median_s"] for row in kept], marker=marker, ms=4.5, label=peer
        )
    axes.set_xlabel("largest error of the velocity over the run, relative to its maximum [1]")
    axes.set_ylabel("time of one run, warm [ms]")
    axes.set_title("LuGre testbench, 10 s: one point for each relative tolerance")
    axes.grid(which="both", alpha=0.25)
    axes.legend()
    write_figure(figure, path)


if __name__ == "__main__":
    main()
