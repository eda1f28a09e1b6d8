"""Figures of the pages, drawn from results when they are recorded."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from cycler import cycler
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from bench.layout import OURS, Recorded
from bench.tables import HAND

# Okabe and Ito, Color universal design, 2008: distinct for colour-blind readers.
BLUE, RED, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#8a8a8a"
_COLOURS = (BLUE, RED, GREEN, "#cc79a7", GREY, "#e69f00", "#56b4e9", "#000000")


def save(figure: Figure, path: Path, dpi: int = 150) -> None:
    """Write and close a figure."""
    figure.savefig(path, dpi=dpi)
    plt.close(figure)


def accelerations(r: Recorded) -> Figure:
    """Plot time over the number of links, with a panel for each method of measurement."""
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
    """Plot a work-precision diagram: lower left is better."""
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


def lugre_testbench(r: Recorded) -> Figure:
    """Plot times of one run, and of one of many, as bars on a logarithmic axis."""
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 3.8), sharey=True, layout="constrained")
    peers = r.all_of("run of many", "peer")[::-1]
    one = [1e3 * r.number("run", peer=peer, at="chosen") for peer in peers]
    ways = {peer: r.all_of("run of many", "at", peer=peer) for peer in peers}
    many = [1e3 * min(r.number("run of many", peer=peer, at=way) for way in ways[peer]) for peer in peers]
    for panel, letter, times, title in zip(axes, "ab", (one, many), ("one run", "one of many runs"), strict=True):
        colours = [BLUE if peer == OURS else GREY for peer in peers]
        bars = panel.barh(peers, times, color=colours)
        panel.bar_label(bars, [f"{time:.2g}" for time in times], padding=3, fontsize=9)
        panel.set(xscale="log", xlabel="time [ms]", title=title, xlim=(0.3 * min(times), 4.0 * max(times)))
        panel.set_title(letter, loc="left", fontweight="bold")
    return figure


def long_runs(r: Recorded) -> Figure:
    """Plot errors of the energy and of the angle over periods, with a line for each solver."""
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


def hard(r: Recorded) -> Figure:
    """Plot errors of hard cases relative to the admissible error."""
    cases = r.all_of("passes", "case")
    rows, least = np.arange(len(cases)), 1e-12  # exact results are drawn at the edge
    figure, axes = plt.subplots(figsize=(8.5, 1.4 + 0.19 * len(cases)), layout="constrained")
    for marker, kind in zip("osDv", r.all_of("error", "at"), strict=False):
        errors = np.array([r.number("error", case=case, at=kind) for case in cases])
        axes.plot(np.maximum(errors, least), rows, marker, ms=5, label=kind, alpha=0.85)
    numbers = r.all_of("error", "case")
    for row, case in zip(rows, cases, strict=True):
        if r.get("passes", case=case) != "yes":
            axes.axhspan(row - 0.5, row + 0.5, color=RED, alpha=0.2, lw=0)
        elif case not in numbers:
            axes.text(least, float(row), " says why there is no answer", va="center", fontsize=9, color=GREY)
    axes.axvline(1.0, color=RED, lw=1.2)
    axes.set(xscale="log", xlabel="error over what is admissible [1]", yticks=rows, xlim=(0.5 * least, 10.0))
    families, names = zip(*(case.split(": ") for case in cases), strict=True)
    axes.set_yticklabels([name.strip("`") for name in names], fontsize=9)
    axes.set_ylim(len(cases) - 0.4, -0.6)
    axes.grid(axis="x", color="#e4e4e4", lw=0.6)
    for row, family in enumerate(families):
        if row == 0 or families[row - 1] != family:
            axes.axhline(row - 0.5, color="black", lw=0.6)
            beside = axes.get_yaxis_transform()
            axes.text(1.01, row - 0.4, family, transform=beside, va="top", fontsize=10, fontweight="bold")
    passed = sum(r.get("passes", case=case) == "yes" for case in cases)
    figure.suptitle(f"Hard cases: {passed} of {len(cases)} pass (line: the limit)", fontsize=12)
    figure.legend(loc="outside lower center", ncols=2, fontsize=10, frameon=False)
    return figure


def hard_steps(r: Recorded) -> Figure:
    """Plot largest stable fixed steps by simulation over those by theory."""
    figure, axes = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
    solvers = r.all_of("step found", "peer")
    steps = {
        kind: {name: [r.number(kind, case=name, peer=each) for each in solvers] for name in r.all_of(kind, "case")}
        for kind in ("step by theory", "step found")
    }
    for marker, (name, predicted) in zip("osDv", steps["step by theory"].items(), strict=False):
        axes.plot(predicted, steps["step found"][name], marker, label=name, ms=7, alpha=0.8)
    every = [step for predicted in steps["step by theory"].values() for step in predicted]
    span = [0.5 * min(every), 2.0 * max(every)]
    axes.plot(span, span, color="#c8c8c8", lw=3, zorder=0, label="equal")
    axes.set(xscale="log", yscale="log", xlabel="largest stable step by theory [s]", ylabel="found by bisection [s]")
    axes.set_title(f"Stability of fixed explicit steps: {', '.join(solvers)}", fontsize=10)
    axes.legend(fontsize=9, frameon=False)
    return figure


# Figures by name, each with its bench.
FIGURES: dict[str, tuple[str, Callable[[Recorded], Figure]]] = {
    **{
        each.__name__: (each.__name__, each)
        for each in (accelerations, lugre_testbench, lugre_work_precision, long_runs)
    },
    **{each.__name__: ("hard_cases", each) for each in (hard, hard_steps)},
}


def write(found: Recorded, folder: Path) -> None:
    """Draw the figures of a result."""
    with plt.rc_context({"axes.prop_cycle": cycler(color=_COLOURS)}):
        for name, (bench, draw) in FIGURES.items():
            if bench == found.name:
                save(draw(found), folder / f"{name}.png")
