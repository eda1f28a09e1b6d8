"""Figures of the pages, drawn from results when they are recorded."""

from collections.abc import Callable
from pathlib import Path

from cycler import cycler
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from bench.layout import OURS, Recorded
from bench.tables import HAND

# Okabe and Ito, Color universal design, 2008: told apart without red and green.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a8a8a", "#e69f00", "#56b4e9", "#000000")


def save(figure: Figure, path: Path, dpi: int = 150) -> None:
    """Write a figure, and close it."""
    figure.savefig(path, dpi=dpi)
    plt.close(figure)


def accelerations(r: Recorded) -> Figure:
    """Time over the number of links, one panel for each way to measure."""
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 4.3), sharey=True, layout="constrained")
    sizes = r.all_of("loop", "case")
    for panel, way in zip(axes, ("loop", "many"), strict=True):
        for marker, name in zip("osD", (OURS, HAND, "MuJoCo"), strict=True):
            times = [1e9 * r.number(way, peer=name, case=n, key="minimum") for n in sizes]
            panel.loglog([int(n) for n in sizes], times, marker + "-", ms=4.5, label=name)
        panel.set(xlabel="number of links n [1]", title="in a loop" if way == "loop" else "1024 at once")
        panel.set_xticks([int(n) for n in sizes], sizes)
        panel.minorticks_off()
        panel.grid(which="major", alpha=0.25)
        panel.set_title("a" if way == "loop" else "b", loc="left", fontweight="bold")
    axes[0].set_ylabel("time of one evaluation of the accelerations [ns]")
    axes[0].legend()
    return figure


def lugre_work_precision(r: Recorded) -> Figure:
    """Work-precision diagram: the lower left is the better place."""
    figure, axes = plt.subplots(figsize=(7.0, 4.6), layout="constrained")
    for marker, peer in zip("osD^v<>PX*", r.all_of("run", "peer"), strict=False):
        ladder = r.all_of("run", "at", peer=peer)
        axes.loglog(
            [r.number("error of v", peer=peer, at=rtol) for rtol in ladder],
            [1e3 * r.number("run", peer=peer, at=rtol) for rtol in ladder], marker=marker, ms=4.5, label=peer,
        )  # fmt: skip
    axes.set_xlabel("largest error of the velocity over the run, relative to its maximum [1]")
    axes.set_ylabel("time of one run, warm [ms]")
    axes.set_title("LuGre test bench, 10 s: one point for each relative tolerance")
    axes.grid(which="both", alpha=0.25)
    axes.legend()
    return figure


def long_runs(r: Recorded) -> Figure:
    """Errors of the energy and of the angle over periods, one line for each solver."""
    figure, axes = plt.subplots(1, 2, figsize=(13.0, 5.0), layout="constrained")
    titles = {
        "error of energy": "Energy: no drift with Gauss (solid), linear with the others",
        "error of phi": "Angle: linear in time with Gauss, quadratic with the others",
    }
    units = {row["quantity"]: row["unit"] for row in r.rows}
    for letter, panel, (quantity, title) in zip("ab", axes, titles.items(), strict=True):
        for peer in r.all_of(quantity, "peer"):
            ends = r.all_of(quantity, "at", peer=peer)
            values = [r.number(quantity, case="spherical pendulum", peer=peer, at=end) for end in ends]
            panel.loglog(ends, values, "-" if peer.startswith("Gauss") else "--", label=peer)
        panel.set(xlabel="time [periods]", ylabel=f"{quantity}, largest in a period [{units[quantity]}]")
        panel.set_title(f"$\\bf{{{letter}}}$  {title}", loc="left")
        panel.grid(which="major", alpha=0.25)
    axes[1].legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


FIGURES: dict[str, Callable[[Recorded], Figure]] = {
    each.__name__: each for each in (accelerations, lugre_work_precision, long_runs)
}


def write(found: Recorded, folder: Path) -> None:
    """Draw a result, where it has a figure."""
    if found.name in FIGURES:
        with plt.rc_context({"axes.prop_cycle": cycler(color=_COLOURS)}):
            save(FIGURES[found.name](found), folder / f"{found.name}.png")
