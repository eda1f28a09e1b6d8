"""LuGre's law of 1995, pulled through a spring for 20 s: stick for seconds, slip in bristles that settle within 1e-5 s.

A box of 1 kg behind a spring of 2 N/m whose end moves at 0.1 m/s. Errors are the largest over 4001 equispaced times, of
the friction force [N] and relative to the largest force and velocity. Two questions:

- error of the force against steps, beside the figures published for this law (T. N. Do, A. A. Ferri, O. A. Bauchau,
  "Efficient simulation of a dynamic system with LuGre friction", Journal of Computational and Nonlinear Dynamics
  2:281, 2007), whose reference is RK4 with steps of 10 us;
- time of a run at the loosest tolerance, on a ladder of half decades alike for all, that keeps both relative errors
  within 1e-6: solvers side by side in one process, medians of interleaved repetitions, compilation apart.

    python bench/i1_pulled_spring.py [--smoke] [--out DIR]
"""

import math
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _ladder import half_decades, loosest
from _lugre import CVODES, OURS, PULLED, SUNDAE, Peer, error_ladder, errors_of, peers, reference_solution, rk4_states
from _measure import machine_line, measure
from _options import begin
from _report import new_result, show, target_rows, write_figure, write_result
from matplotlib import pyplot as plt

GOAL = 1e-6
LADDER = half_decades(-3, -12)
# Solver, tolerance or step, steps, largest error of the force [N]. 28 290 steps of 1 ms are 28.3 s.
PUBLISHED = (
    ("ode45", "rtol 1e-8", 147_600, 1.68e-4),
    ("RK4", "h 1e-3 s", 28_290, 3.98e-4),
    ("Radau-IIA", "h 1e-2 s", 2_830, 9.3e-2),
    ("Radau-IIA", "adapted", 1_216, 0.49),
)
# Steps of RK4 [s]: the published one, one that is stable, and that of their reference.
RK4_STEPS = (1e-3, 5e-5, 1e-5)
SHOWN = (-4.0, -5.0, -6.0, -7.0, -8.0, -9.0)


def main() -> None:
    """Measure, and write `pulled_spring.json` and `.png`."""
    options = begin("LuGre's law of 1995, pulled through a spring.")
    smoke = options.smoke
    content = new_result("pulled_spring", options, "diffrax", "casadi", "scikit-sundae", "scipy", "numpy")
    reference, agreement = reference_solution(PULLED)
    solvers = peers(PULLED, (OURS, CVODES, SUNDAE) if smoke else ())
    ladder = {peer.name: climb(peer, reference, LADDER) for peer in solvers}
    picks = {name: loosest(rows, "worst", GOAL) for name, rows in ladder.items()}
    calls = {peer.name: peer.once(row["rtol"]) for peer in solvers if (row := picks[peer.name])}
    ours = next(peer for peer in solvers if peer.name == OURS)
    if ours.velocity is not None and (row := picks[OURS]):
        calls[f"{OURS}, jitted"] = _jitted(ours.velocity, row["rtol"])
    own = {row["rtol"]: ours.once(row["rtol"]) for row in ladder[OURS]}
    times = measure(calls | {f"{OURS} {rtol:g}": call for rtol, call in own.items()}, 1 if smoke else 25, limit_s=10.0)
    exact = np.column_stack([reference, PULLED.friction(reference)])
    content |= {
        "goal": GOAL,
        "atol_over_rtol": PULLED.atol,
        "reference_disagreement": agreement,
        "ladder": ladder,
        "chosen": picks,
        "times": times,
        "rk4": [
            {"h": h, "steps": round(PULLED.t1 / h), **errors_of(rk4_states(PULLED, h), exact, PULLED)}
            for h in RK4_STEPS
        ],
        "published": [dict(zip(("solver", "setting", "steps", "F_newtons"), row, strict=True)) for row in PUBLISHED],
    }
    content["tables"] = [_error_table(content), _time_table(content), _target_table(content)]
    write_result(content, options)
    draw(content, reference, options.out / "pulled_spring.png")


def climb(peer: Peer, reference: np.ndarray, tolerances: tuple[float, ...]) -> list[dict[str, Any]]:
    """Errors at each tolerance until the goal is reached; ours to the end of the ladder."""
    rows: list[dict[str, Any]] = []
    for rtol in tolerances:
        rows += error_ladder(peer, reference, (rtol,), PULLED)
        rows[-1]["worst"] = max(rows[-1].get("v_run", math.inf), rows[-1].get("F_run", math.inf))
        if rows[-1]["worst"] <= GOAL and peer.name != OURS:
            break
    print(f"{peer.name}: {rows[-1]}")
    return rows


def _jitted(velocity: Any, rtol: float) -> Any:
    p, run = jnp.asarray(PULLED.nominal), jax.jit(partial(_end, velocity, rtol))
    return lambda: run(p).block_until_ready()


def _end(velocity: Any, rtol: float, p: Any) -> Any:
    return velocity(p, rtol)


def _error_table(content: dict[str, Any]) -> dict[str, Any]:
    rows = []
    for row in content["ladder"][OURS]:
        if "failed" not in row and any(math.isclose(row["rtol"], 10.0**k) for k in SHOWN):
            time = show(content["times"].get(f"{OURS} {row['rtol']:g}"), 1e3)
            rows.append([OURS, f"rtol {row['rtol']:.0e}", _whole(row["steps"]), f"{row['F_newtons']:.1e}", time])
    for row in content["rk4"]:
        error = f"{row['F_newtons']:.1e}" if row["F_newtons"] < 1.0 else "diverges"
        rows.append(["RK4, here", f"h {row['h']:g} s", _whole(row["steps"]), error, "-"])
    rows += [[f"{solver}, published", how, _whole(steps), f"{e:.1e}", "-"] for solver, how, steps, e in PUBLISHED]
    caption = (
        f"LuGre friction of 1995 pulled through a spring, {PULLED.t1:g} s: largest error of the friction force, of"
        " which the largest is 1.5 N, against `simulate` at 1e-12. Published: Do, Ferri and Bauchau 2007, against RK4"
        " with steps of 10 us. Their runs are longer (28 290 steps of 1 ms), and must slip more slowly: here RK4 with"
        f" steps of 1 ms diverges. {machine_line(content['machine'])}"
    )
    columns = ["solver", "tolerance or step", "steps", "error of the friction force [N]", "one run [ms]"]
    return {"columns": columns, "rows": rows, "caption": caption}


def _whole(count: int) -> str:
    return f"{count:,}".replace(",", " ")


def _time_table(content: dict[str, Any]) -> dict[str, Any]:
    rows, ours = [], content["times"].get(OURS, {}).get("median_s", math.nan)
    for name, pick in content["chosen"].items():
        if pick is None:
            rows.append([name, *["-"] * 6])
            continue
        errors = [f"{pick['v_run']:.0e}", f"{pick['F_run']:.0e}"]
        taken = content["times"][name]
        ratio = f"{taken['median_s'] / ours:.3g}" if "median_s" in taken else "-"
        rows.append([name, f"{pick['rtol']:.0e}", _whole(pick["steps"]), *errors, show(taken, 1e3), ratio])
        if name == OURS:
            taken = content["times"].get(f"{OURS}, jitted", {"failed": ""})
            ratio = f"{taken['median_s'] / ours:.3g}" if "median_s" in taken else "-"
            rows.append([f"{OURS}, jitted", *rows[-1][1:5], show(taken, 1e3), ratio])
    caption = (
        f"The same to relative errors of at most {content['goal']:g}, of velocity and friction force both, over the"
        " run, medians, all in one process, with `jaxmodsim.tune_cpu()`. Ours: a whole call of `simulate`, or one of a"
        f" jitted function, as those of diffrax are. {machine_line(content['machine'])}"
    )
    columns = ["solver", "rtol", "steps", "error of v", "error of F", "one run [ms]", "in ours"]
    return {"columns": columns, "rows": rows, "caption": caption}


def _target_table(content: dict[str, Any]) -> dict[str, Any]:
    times = {name: row.get("median_s", math.nan) for name, row in content["times"].items()}
    ours, own = times.get(OURS, math.nan), [x for name, x in times.items() if name.startswith("diffrax")]
    found = [
        ("one run against CVODES (CasADi)", ">= 3", times.get(CVODES, math.nan) / ours),
        ("the same, ours jitted", "", times.get(CVODES, math.nan) / times.get(f"{OURS}, jitted", math.nan)),
        ("one run against CVODE (scikit-sundae)", ">= 3", times.get(SUNDAE, math.nan) / ours),
        ("one run against the fastest of diffrax", "", min(own, default=math.nan) / ours),
    ]
    caption = f"Targets on the pulled spring, by the times above. {machine_line(content['machine'])}"
    return {"columns": ["ratio", "target", "measured", "met"], "rows": target_rows(found), "caption": caption}


def draw(content: dict[str, Any], reference: np.ndarray, path: Path) -> None:
    """The motion, and error against steps beside what was published."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 4.2), layout="constrained")
    left.plot(PULLED.times, PULLED.friction(reference), color="C0", lw=1.4)
    left.set_xlabel("time [s]")
    left.set_ylabel("friction force [N]", color="C0")
    place = left.twinx()
    place.plot(PULLED.times, reference[:, 0], color="C1", lw=1.4)
    place.set_ylabel("position of the box [m]", color="C1")
    left.set_title("The motion", loc="left")
    rows = [row for row in content["ladder"][OURS] if "failed" not in row]
    right.loglog([row["steps"] for row in rows], [row["F_newtons"] for row in rows], "o-", ms=4.5, label=OURS)
    stable = [row for row in content["rk4"] if row["F_newtons"] < 1.0]
    right.loglog(
        [row["steps"] for row in stable], [row["F_newtons"] for row in stable], "s-", color="C2", label="RK4, here"
    )
    for i, (solver, how, steps, error) in enumerate(PUBLISHED):
        right.loglog(steps, error, "x", color="C3", ms=7, label="published, 2007" if i == 0 else None)
        right.annotate(f"{solver}, {how}", (steps, error), xytext=(6, 4), textcoords="offset points", fontsize=8)
    # Below, errors are against a finer run of the same solver, which nothing else confirms.
    confirmed = content["rk4"][-1]["F_newtons"]
    right.axhline(confirmed, color="0.5", lw=1.0, ls=":")
    right.annotate(
        "RK4 confirms the reference to here", (3e3, confirmed), xytext=(0, 4), textcoords="offset points",
        fontsize=8, color="0.4",
    )  # fmt: skip
    right.set_xlim(min(row["steps"] for row in rows) / 1.5, 4e6)
    right.set_xlabel("steps [1]")
    right.set_ylabel("largest error of the friction force [N]")
    right.set_title("Error against steps", loc="left")
    right.grid(which="major", alpha=0.25)
    right.legend(loc="lower right", fontsize=9)
    write_figure(figure, path)


if __name__ == "__main__":
    main()
