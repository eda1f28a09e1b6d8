"""The LuGre testbench: one run, 1024 runs, Jacobian and gradient, measured side by side in one process.

Every solver gets the loosest tolerance at which its velocity stays within 1e-6 of the reference, relative to the
largest velocity, over 101 equispaced times of the run ("over the run", dense output included); and, as a second
choice, at which the end velocity alone does ("at the end"). Timed is a run that returns the end state. Times are
medians of interleaved repetitions, compilation apart.

    python bench/a0_lugre_testbench.py [--smoke] [--no-tune] [--out DIR]
"""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from _lugre import (
    ATOL,
    NOMINAL,
    PARAMETERS,
    Peer,
    diffrax_run,
    error_ladder,
    parameter_sets,
    peers,
    reference_solution,
)
from _measure import describe_machine, machine_line, measure, scaled, write_json
from _options import begin

import jaxmodsim as jms

GOAL = 1e-6
LADDER = tuple(10.0**-k for k in range(3, 11))
CHOICES = {"over the run": "v_run", "at the end": "v_end"}


def main() -> None:
    """Measure, and write `lugre_testbench.json`."""
    options = begin("The LuGre testbench, measured side by side.", may_leave_untuned=True)
    smoke = options.smoke
    name = "lugre_testbench" if options.tuned else "lugre_testbench_untuned"
    solvers = peers()
    reference, agreement = reference_solution()
    ladder = {peer.name: error_ladder(peer, reference, LADDER[:5] if smoke else LADDER) for peer in solvers}
    chosen = {label: {peer: _choose(rows, key) for peer, rows in ladder.items()} for label, key in CHOICES.items()}
    for label, picks in chosen.items():
        print(label, {peer: row and row["rtol"] for peer, row in picks.items()})
    content: dict[str, Any] = {
        "name": name,
        "smoke": smoke,
        "machine": describe_machine("jax", "jaxlib", "diffrax", "casadi", "scipy", "numpy", "jaxmodsim"),
        "tuned": options.tuned,
        "goal": GOAL,
        "atol_over_rtol": ATOL,
        "reference_disagreement": agreement,
        "ladder": ladder,
        "chosen": chosen,
        "one_run": {label: _one_run(solvers, picks, 2 if smoke else 60) for label, picks in chosen.items()},
        "many_runs": _many_runs(solvers, chosen["over the run"], 8 if smoke else 1024, 1 if smoke else 7),
        "derivatives": _derivatives(solvers, chosen["over the run"], 2 if smoke else 40),
    }
    content["tables"] = [_main_table(content), _target_table(content)]
    for table in content["tables"]:
        print(table["caption"], *(" | ".join(row) for row in [table["columns"], *table["rows"]]), sep="\n")
    write_json(options.out / f"{name}.json", content)


def _choose(rows: list[dict[str, Any]], key: str) -> dict[str, Any] | None:
    """The loosest tolerance that reaches the goal; None where none does."""
    return next((row for row in rows if row.get(key, np.inf) <= GOAL), None)


def _one_run(solvers: list[Peer], picks: dict[str, Any], rounds: int) -> dict[str, Any]:
    """One warm call that returns the end state, as a user makes it, overhead of Python included."""
    able = [peer for peer in solvers if picks[peer.name]]
    calls = {peer.name: peer.once(picks[peer.name]["rtol"]) for peer in able}
    report = measure(calls, rounds)
    for peer in solvers:
        if not picks[peer.name]:
            report[peer.name] = {"failed": f"no tolerance of the ladder reaches {GOAL:g}"}
    return report


def _many_runs(solvers: list[Peer], picks: dict[str, Any], count: int, rounds: int) -> dict[str, Any]:
    """All runs of a batch with different parameters: one `jax.vmap`, or a plain loop (over fewer sets)."""
    sets = parameter_sets(count)
    calls, sizes, ends = {}, {}, {}
    for peer in solvers:
        if picks[peer.name]:
            sizes[peer.name] = min(count, 64) if peer.serial else count
            calls[peer.name] = peer.many(picks[peer.name]["rtol"], sets[: sizes[peer.name]])
    tight = peers_by_name(solvers)["CVODES (CasADi)"].many(1e-11, sets[: min(count, 64)])()
    report = {name: scaled(row, sizes[name]) for name, row in measure(calls, rounds, limit_s=20.0).items()}
    for name, call in calls.items():
        if "failed" not in report[name]:
            ends[name] = np.asarray(call())[: len(tight)]
            report[name]["largest_relative_error_of_v_end"] = float(np.max(np.abs(ends[name] / tight - 1.0)))
    return report


def peers_by_name(solvers: list[Peer]) -> dict[str, Peer]:
    """Solvers by name."""
    return {peer.name: peer for peer in solvers}


def _derivatives(solvers: list[Peer], picks: dict[str, Any], rounds: int) -> dict[str, Any]:
    """End velocity and its derivatives by the six parameters, all jitted alike as functions of those six numbers.

    The tolerance is that of the velocity, which says nothing on the error of its derivatives: this is recorded, both
    relative to each derivative by itself (those by `sigma0` and `sigma1` are next to nothing) and, with derivatives by
    the logarithms of the parameters (`sigma1`: per N s/m), relative to the largest of them.
    """
    p, exact = jnp.asarray(NOMINAL), finite_differences()
    calls, values = {}, {}
    for name in ("jaxmodsim", "diffrax Kvaerno5"):
        velocity, rtol = peers_by_name(solvers)[name].velocity, picks[name] and picks[name]["rtol"]
        if velocity is None or rtol is None:
            continue
        functions = {
            "run": _bind(velocity, rtol, None),
            "jacobian": jax.jacfwd(_bind(velocity, rtol, dfx.ForwardMode())),
            "gradient": jax.grad(_bind(velocity, rtol, None)),
        }
        for kind, function in functions.items():
            calls[f"{name}: {kind}"] = _waiting(jax.jit(function), p)
    report = measure(calls, rounds)
    for label, row in report.items():
        if "failed" in row or label.endswith("run"):
            continue
        values[label] = np.asarray(calls[label]())
        run = report[label.split(":")[0] + ": run"]["median_s"]
        row |= {"derivative": values[label].tolist(), "times_a_run": row["median_s"] / run}
        error = np.abs(values[label] - exact)
        scale = np.where(NOMINAL == 0.0, 1.0, NOMINAL)
        row["largest_relative_error"] = float(np.max(error / np.abs(exact)))
        row["error_in_the_largest"] = float(np.max(error * scale) / np.max(np.abs(exact) * scale))
    return {"parameters": PARAMETERS, "finite_differences": exact.tolist(), "measured": report}


def _bind(velocity: Any, rtol: float, adjoint: Any) -> Any:
    return lambda p: velocity(p, rtol, adjoint)


def _waiting(function: Any, p: Any) -> Any:
    return lambda: function(p).block_until_ready()


def finite_differences() -> np.ndarray:
    """Derivatives of the end velocity by the six parameters, by central differences of order 4.

    Runs at a tolerance of 1e-13 of the field written by hand, which admits the negative `sigma1` that the difference
    about zero needs. With a step of 0.2 % (`sigma1`: 0.02 N s/m) the error of truncation is some 1e-9 and that of
    rounding some 1e-7 of the derivatives.
    """
    steps = 2e-3 * np.where(NOMINAL == 0.0, 10.0, NOMINAL)
    run = jax.jit(lambda p: diffrax_run(p, 1e-13, jms.Rodas5P()).ys[1][-1])

    def difference(i: int) -> float:
        moved = [NOMINAL + k * steps[i] * np.eye(6)[i] for k in (-2, -1, 1, 2)]
        a, b, c, d = (float(run(jnp.asarray(p))) for p in moved)
        return (a - 8.0 * b + 8.0 * c - d) / (12.0 * steps[i])

    return np.array([difference(i) for i in range(6)])


def _time(row: dict[str, Any] | None, unit: float, digits: int = 3) -> str:
    if row is None:
        return "-"
    return "failed" if "failed" in row else f"{row['median_s'] * unit:.{digits}g}"


def _caption(content: dict[str, Any]) -> str:
    setting = "with `jaxmodsim.tune_cpu()`" if content["tuned"] else "without `jaxmodsim.tune_cpu()`"
    return f"all in one process, {setting}. {machine_line(content['machine'])}"


def _main_table(content: dict[str, Any]) -> dict[str, Any]:
    measured = content["derivatives"]["measured"]
    rows = []
    for name in content["ladder"]:
        pick = content["chosen"]["over the run"][name]
        rows.append(
            [
                name,
                f"{pick['rtol']:.0e}" if pick else "-",
                str(pick["steps"]) if pick else "-",
                f"{pick['v_run']:.1e}" if pick else "-",
                _time(content["one_run"]["over the run"][name], 1e3),
                _time(content["one_run"]["at the end"][name], 1e3),
                _time(content["many_runs"].get(name), 1e6)
                + (" (loop)" if name.startswith(("CVODES", "scipy")) else ""),
                _time(measured.get(f"{name}: jacobian"), 1e3),
                _time(measured.get(f"{name}: gradient"), 1e3),
                f"{measured[f'{name}: gradient']['error_in_the_largest']:.1e}"
                if "error_in_the_largest" in measured.get(f"{name}: gradient", {})
                else "-",
            ]
        )
    count = content["many_runs"]["jaxmodsim"].get("runs_per_call", 0)
    columns = ["solver", "rtol", "steps", "error of v", "one run [ms]", "one run, error at the end only [ms]"]
    columns += [f"{count} runs, per run [us]", "Jacobian, 6 parameters [ms]", "reverse gradient [ms]", "its error"]
    caption = f"LuGre testbench at an error of at most {content['goal']:g}, medians, {_caption(content)}"
    return {"caption": caption, "columns": columns, "rows": rows}


def _target_table(content: dict[str, Any]) -> dict[str, Any]:
    one, many, ours = content["one_run"], content["many_runs"], content["derivatives"]["measured"]

    def ratio(report: dict[str, Any], peer: str) -> float:
        return report.get(peer, {}).get("median_s", np.nan) / report["jaxmodsim"].get("median_s", np.nan)

    kvaerno, cvodes = "diffrax Kvaerno5", "CVODES (CasADi)"
    found = [
        ("one run against Kvaerno5", ">= 20", ratio(one["over the run"], kvaerno), 20.0),
        ("one run against Kvaerno5, error at the end only", "", ratio(one["at the end"], kvaerno), None),
        ("one run against CVODES", ">= 3", ratio(one["over the run"], cvodes), 3.0),
        ("one run against CVODES, error at the end only", "", ratio(one["at the end"], cvodes), None),
        ("many runs against Kvaerno5, per run", ">= 100", ratio(many, kvaerno), 100.0),
        ("Jacobian in plain runs", "<= 4", ours["jaxmodsim: jacobian"].get("times_a_run", np.nan), -4.0),
        ("reverse gradient in plain runs", "<= 6", ours["jaxmodsim: gradient"].get("times_a_run", np.nan), -6.0),
    ]
    rows = []
    for label, target, value, limit in found:
        met = "" if limit is None else "yes" if (value >= limit if limit > 0 else value <= -limit) else "no"
        rows.append([label, target, f"{value:.3g}", met])
    return {
        "caption": f"Targets on the LuGre testbench, {_caption(content)}",
        "columns": ["ratio", "target", "measured", "met"],
        "rows": rows,
    }


if __name__ == "__main__":
    main()
