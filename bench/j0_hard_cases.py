"""Hard cases by `jaxmodsim` and by what people would use without it: right, wrong without a word, error, no answer.

diffrax and scipy get the same equations of motion, with `Fc sign(v)` for dry friction, at rtol 1e-6 and atol 1e-9, all
else as they come; MuJoCo those that it can express, at its own step. `jaxmodsim` gets each case as it is defined,
and is held to the tolerance of the case, the others to a hundred times that, and no tighter than 1e-3, MuJoCo than
1e-2. jaxonomy gets four of them, with modes and zero crossings. Where no number is right but an end with a name, any
error is right, whatever it says. Every program runs every case in a process of its own, with 60 s for it, compilation
included. jaxonomy pins a JAX of its own, and so runs in an environment of its own:

    python -m venv DIR && DIR/bin/pip install jaxonomy
    python bench/j0_hard_cases.py [--smoke] [--jaxonomy DIR/bin/python] [--out DIR]
"""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from _hard_elsewhere import METHODS, answer, in_jaxonomy
from _hard_one import (
    COARSE,
    ERROR,
    GENEROUS,
    LEAST,
    NONE,
    PROGRAMS,
    RIGHT,
    WRONG,
    ask,
    asked,
    is_nan,
    judged_elsewhere,
    seconds,
)
from _hard_plain import ATOL, RTOL
from _measure import machine_line
from _options import begin
from _report import new_result, write_figure, write_result
from matplotlib import pyplot as plt
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

from jaxmodsim.validation.hard import HardCase, hard_cases

LIMIT = 60.0
SMOKE_LIMIT = 10.0
SMOKE = ("zero_start", "pole_start", "bouncing_ball")
# Some of each family: all of them by all programs take hours, most of them spent on waiting for no answer.
CASES = (
    *("bristle_stiff", "zero_start", "force_equals_limit", "dip_of_slip", "belt_turns", "shaken_table"),
    *("bouncing_ball", "grazing_ceiling", "pole_start", "painleve_rod"),
    *("units_nanometres", "nan_states", "resting_place"),
)
VERDICTS = (RIGHT, WRONG, ERROR, NONE)
COLOURS = ("#3f8f5b", "#c2452d", "#e0a83a", "#8a8a8a")


def main() -> None:
    """Ask, and write `hard_cases.json` and `hard_cases.png`."""
    options = begin("The hard cases by every program.", smoke="three cases, ten seconds for each", with_jaxonomy=True)
    limit = SMOKE_LIMIT if options.smoke else LIMIT
    cases = {name: case for name, case in hard_cases().items() if name in (SMOKE if options.smoke else CASES)}
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for name, case in cases.items():
        found[name] = {}
        for program in PROGRAMS:
            if asked(case, program):
                found[name][program] = entry = ask(name, program, limit)
                print(f"{name}, {program}: {entry['verdict']}: {entry['says']}", flush=True)
        for program in METHODS if options.jaxonomy else ():
            if in_jaxonomy(case, program):
                found[name][program] = entry = _elsewhere(case, program, options.jaxonomy, limit)
                print(f"{name}, {program}: {entry['verdict']}: {entry['says']}", flush=True)
    content = new_result("hard_cases", options, "diffrax", "scipy", "mujoco", "numpy")
    content["settings"] = {"rtol": RTOL, "atol": ATOL, "limit_s": limit, "generous": GENEROUS}
    content["settings"] |= {"least": LEAST, "least_mujoco": COARSE}
    content["found"] = [entry for row in found.values() for entry in row.values()]
    families = {name: case.family for name, case in cases.items()}
    content["tables"] = [_summary(found, content), _every(found, families)]
    write_result(content, options)
    draw(found, families, options.out / "hard_cases.png")


def _elsewhere(case: HardCase, program: str, interpreter: str, limit: float) -> dict[str, Any]:
    given = answer(case, program, interpreter, limit)
    return {"case": case.name, "program": program, **judged_elsewhere(case, given)} | {
        "versions": given.get("versions", {})
    }


def _programs(found: dict[str, dict[str, dict[str, Any]]]) -> list[str]:
    """Those that were asked anything."""
    return [program for program in (*PROGRAMS, *METHODS) if any(program in row for row in found.values())]


def _summary(found: dict[str, dict[str, dict[str, Any]]], content: dict[str, Any]) -> dict[str, Any]:
    rows = []
    for program in _programs(found):
        counts = Counter(row[program]["verdict"] for row in found.values() if program in row)
        rows.append([program, str(counts.total()), *(str(counts[verdict]) for verdict in VERDICTS)])
    limit = content["settings"]["limit_s"]
    versions = {entry["versions"]["jaxonomy"] for entry in content["found"] if entry.get("versions")}
    other = f"jaxonomy {versions.pop()} in an environment of its own" if versions else "jaxonomy was not there"
    caption = (
        f"How many of {len(found)} hard cases each program was asked, and what came of them. diffrax and scipy:"
        f" `Fc sign(v)` for dry friction, rtol {RTOL:g}, atol {ATOL:g}; Kvaerno5 where rates are high; MuJoCo what it"
        " can express."
        f" Admissible is for `jaxmodsim` the tolerance of the case, for the others {GENEROUS:g} times that and at"
        f" least {LEAST:g}, and {COARSE:g} for MuJoCo, whose step is fixed. Where a case has no answer, an error is"
        f" right, whatever it says. No answer: in {limit:g} s, compilation included; {other}."
        f" {machine_line(content['machine'])}"
    )
    return {"columns": ["program", "cases", *VERDICTS], "rows": rows, "caption": caption}


def _every(found: dict[str, dict[str, dict[str, Any]]], families: dict[str, str]) -> dict[str, Any]:
    rows = []
    for name, row in found.items():
        words = [_word(row.get(program)) for program in _programs(found)]
        rows.append([f"{families[name]}: `{name}`", *words, seconds(row.get(PROGRAMS[0]))])
    caption = "Case by case; the last column is the time of a second run of `jaxmodsim`, where there is one."
    return {"columns": ["case", *_programs(found), "second run [ms]"], "rows": rows, "caption": caption}


def _word(entry: dict[str, Any] | None) -> str:
    if entry is None:
        return "-"
    return f"{entry['verdict']} (NaN)" if is_nan(entry) else entry["verdict"]


def draw(found: dict[str, dict[str, dict[str, Any]]], families: dict[str, str], path: Path) -> None:
    """Cases over programs, coloured by verdict; white where a program was not asked."""
    programs = _programs(found)
    grid = np.full((len(found), len(programs)), np.nan)
    for i, row in enumerate(found.values()):
        for program, entry in row.items():
            grid[i, programs.index(program)] = VERDICTS.index(entry["verdict"])
    figure, axes = plt.subplots(figsize=(8.5, 1.5 + 0.19 * len(found)), layout="constrained")
    axes.pcolormesh(grid, cmap=ListedColormap(COLOURS), vmin=-0.5, vmax=len(COLOURS) - 0.5, edgecolors="w", linewidth=1)
    axes.invert_yaxis()
    axes.xaxis.tick_top()
    axes.set_xticks(np.arange(len(programs)) + 0.5, programs, rotation=30, ha="left")
    axes.set_yticks(np.arange(len(found)) + 0.5, found, fontsize=7)
    axes.tick_params(length=0)
    names = list(families.values())
    for i in range(1, len(names)):
        if names[i] != names[i - 1]:
            axes.axhline(i, color="k", lw=0.8)
    figure.legend(
        handles=[Patch(color=colour, label=word) for colour, word in zip(COLOURS, VERDICTS, strict=True)],
        loc="outside lower center",
        ncols=len(VERDICTS),
    )
    write_figure(figure, path)


if __name__ == "__main__":
    main()
