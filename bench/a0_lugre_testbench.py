"""The LuGre testbench: one run, 1024 runs, Jacobian and gradient, measured side by side in one process.

Every solver gets the loosest tolerance, on a ladder of half decades, at which its velocity stays within 1e-6 of the
reference, relative to the largest velocity, over 101 equispaced times of the run ("over the run", dense output
included); and, as a second choice, at which the end velocity alone does ("at the end"). Timed is a run that returns the
end state: of ours a whole call of `simulate`, Python's part included, of diffrax a call of a jitted function. Times are
medians of interleaved repetitions, compilation apart. Derivatives count in plain runs: those of the function that they
differentiate, jitted and called alike, measured in turns with them.

    python bench/a0_lugre_testbench.py [--smoke] [--no-tune] [--jaxonomy PYTHON] [--out DIR]
"""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from _elsewhere import ask
from _ladder import half_decades, loosest
from _lugre import (
    CVODES,
    GROUPS,
    KVAERNO5,
    LOOP,
    OURS,
    PARAMETERS,
    TESTBENCH,
    VMAP,
    Peer,
    diffrax_run,
    error_ladder,
    parameter_sets,
    peers,
    reference_solution,
)
from _measure import machine_line, measure, scaled
from _options import begin
from _report import new_result, show, target_rows, write_result

import jaxmodsim as jms

GOAL = 1e-6
LADDER = half_decades(-3, -10)
CHOICES = {"over the run": "v_run", "at the end": "v_end"}
# Of derivatives; Kvaerno5 is the stiff solver that diffrax recommends.
DIFFERENTIATED = (OURS, KVAERNO5)
ABSENT = {
    "MuJoCo": "its friction is a soft limit on a constraint force (frictionloss); it has no bristle, so its motion is"
    " that of another law, at any tolerance",
}


def main() -> None:
    """Measure, and write `lugre_testbench.json`."""
    options = begin("The LuGre testbench, measured side by side.", may_leave_untuned=True, with_jaxonomy=True)
    smoke = options.smoke
    name = "lugre_testbench" if options.tuned else "lugre_testbench_untuned"
    content = new_result(name, options, "diffrax", "casadi", "scikit-sundae", "scipy", "numpy")
    solvers = peers(only=(OURS, KVAERNO5, CVODES) if smoke else ())
    reference, agreement = reference_solution()
    ladder = {peer.name: error_ladder(peer, reference, LADDER[:9] if smoke else LADDER) for peer in solvers}
    chosen = {
        label: {peer: loosest(rows, key, GOAL) for peer, rows in ladder.items()} for label, key in CHOICES.items()
    }
    for label, picks in chosen.items():
        print(label, {peer: row and row["rtol"] for peer, row in picks.items()})
    content |= {
        "goal": GOAL,
        "atol_over_rtol": TESTBENCH.atol,
        "reference_disagreement": agreement,
        "ladder": ladder,
        "chosen": chosen,
        "not_measured": ABSENT,
        "jaxonomy": {"missing": "a smoke run"}
        if smoke
        else _jaxonomy(options.jaxonomy, options.tuned, float(reference[-1, 1])),
        "one_run": {label: _one_run(solvers, picks, 2 if smoke else 60) for label, picks in chosen.items()},
        "many_runs": _many_runs(solvers, chosen["over the run"], 128 if smoke else 1024, 1 if smoke else 7),
        "derivatives": _derivatives(solvers, chosen["over the run"], 2 if smoke else 40),
    }
    content["tables"] = [_main_table(content), _many_table(content), _target_table(content)]
    write_result(content, options)


def _one_run(solvers: list[Peer], picks: dict[str, Any], rounds: int) -> dict[str, Any]:
    """One warm call that returns the end state, as a user makes it, overhead of Python included."""
    able = [peer for peer in solvers if picks[peer.name]]
    calls = {peer.name: peer.once(picks[peer.name]["rtol"]) for peer in able}
    report = measure(calls, rounds, limit_s=10.0)
    for peer in solvers:
        if not picks[peer.name]:
            report[peer.name] = {"failed": f"no tolerance of the ladder reaches {GOAL:g}"}
    return report


def _many_runs(solvers: list[Peer], picks: dict[str, Any], count: int, rounds: int) -> dict[str, dict[str, Any]]:
    """All runs of a batch with different parameters, in every way each peer has; a loop over fewer sets.

    The error is that of the end velocity of the first 64, against `simulate` at 1e-11.
    """
    sets, calls, sizes = parameter_sets(count), {}, {}
    few = min(count, 64)
    for peer in solvers:
        for way, many in peer.many.items() if picks[peer.name] else ():
            size = few if way == LOOP else count
            label = f"{peer.name}: {way}"
            calls[label], sizes[label] = many(picks[peer.name]["rtol"], sets[:size]), size
    tight = next(peer for peer in solvers if peer.name == OURS).many[VMAP](1e-11, sets[:few])()
    report = {label: scaled(row, sizes[label]) for label, row in measure(calls, rounds, limit_s=20.0).items()}
    found: dict[str, dict[str, Any]] = {}
    for label, row in report.items():
        name, way = label.split(": ")
        if "failed" not in row:
            row["largest_relative_error_of_v_end"] = float(
                np.max(np.abs(np.asarray(calls[label]())[:few] / tight - 1.0))
            )
        found.setdefault(name, {})[way] = row
    return found


def _derivatives(solvers: list[Peer], picks: dict[str, Any], rounds: int) -> dict[str, Any]:
    """End velocity and its derivatives by the six parameters, all jitted alike as functions of those six numbers.

    The tolerance is that of the velocity, which says nothing on the error of its derivatives: this is recorded, both
    relative to each derivative by itself (those by `sigma0` and `sigma1` are next to nothing) and, with derivatives by
    the logarithms of the parameters (`sigma1`: per N s/m), relative to the largest of them.
    """
    nominal = TESTBENCH.nominal
    p, exact = jnp.asarray(nominal), finite_differences()
    calls, values = {}, {}
    for peer in solvers:
        if peer.name not in DIFFERENTIATED or peer.velocity is None or picks[peer.name] is None:
            continue
        rtol = picks[peer.name]["rtol"]
        functions = {
            "run": _bind(peer.velocity, rtol, None),
            "jacobian": jax.jacfwd(_bind(peer.velocity, rtol, dfx.ForwardMode())),
            "gradient": jax.grad(_bind(peer.velocity, rtol, None)),
        }
        for kind, function in functions.items():
            calls[f"{peer.name}: {kind}"] = _waiting(jax.jit(function), p)
    report = measure(calls, rounds)
    for label, row in report.items():
        if "failed" in row or label.endswith("run"):
            continue
        values[label] = np.asarray(calls[label]())
        run = report[label.split(":")[0] + ": run"]["median_s"]
        row |= {"derivative": values[label].tolist(), "times_a_run": row["median_s"] / run}
        error = np.abs(values[label] - exact)
        scale = np.where(nominal == 0.0, 1.0, nominal)
        row["largest_relative_error"] = float(np.max(error / np.abs(exact)))
        row["error_in_the_largest"] = float(np.max(error * scale) / np.max(np.abs(exact) * scale))
    return {"parameters": PARAMETERS, "finite_differences": exact.tolist(), "measured": report}


def _jaxonomy(interpreter: str | None, tuned: bool, v_end: float) -> dict[str, Any]:
    """Its two solvers at the loosest tolerance that keeps the end velocity, as its results are recorded at steps."""
    if interpreter is None:
        return {"missing": "no environment of it was given (--jaxonomy)"}
    task = {"parameters": PARAMETERS, "nominal": list(TESTBENCH.numbers), "mass": TESTBENCH.mass, "t1": TESTBENCH.t1}
    task |= {"ladder": LADDER, "atol": TESTBENCH.atol, "goal": GOAL, "v_end": v_end, "rounds": 25}
    return ask(interpreter, "_jaxonomy_lugre.py", task, tuned=tuned)


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
    nominal = TESTBENCH.nominal
    steps = 2e-3 * np.where(nominal == 0.0, 10.0, nominal)
    run = jax.jit(lambda p: diffrax_run(TESTBENCH, p, 1e-13, jms.Rodas5P()).ys[1][-1])

    def difference(i: int) -> float:
        moved = [nominal + k * steps[i] * np.eye(6)[i] for k in (-2, -1, 1, 2)]
        a, b, c, d = (float(run(jnp.asarray(p))) for p in moved)
        return (a - 8.0 * b + 8.0 * c - d) / (12.0 * steps[i])

    return np.array([difference(i) for i in range(6)])


def _caption(content: dict[str, Any]) -> str:
    setting = "with `jaxmodsim.tune_cpu()`" if content["tuned"] else "without `jaxmodsim.tune_cpu()`"
    return f"all in one process, {setting}. {machine_line(content['machine'])}"


def _main_table(content: dict[str, Any]) -> dict[str, Any]:
    measured = content["derivatives"]["measured"]
    rows = []
    for name in content["ladder"]:
        pick = content["chosen"]["over the run"][name]
        gradient = measured.get(f"{name}: gradient", {})
        rows.append(
            [
                name,
                f"{pick['rtol']:.0e}" if pick else "-",
                str(pick["steps"]) if pick else "-",
                f"{pick['v_run']:.1e}" if pick else "-",
                show(content["one_run"]["over the run"][name], 1e3),
                show(content["one_run"]["at the end"][name], 1e3),
                show(measured.get(f"{name}: run"), 1e3),
                show(measured.get(f"{name}: jacobian"), 1e3),
                show(measured.get(f"{name}: gradient"), 1e3),
                f"{gradient['error_in_the_largest']:.1e}" if "error_in_the_largest" in gradient else "-",
            ]
        )
    other = content["jaxonomy"]
    for label, row in other.get("times", {}).items():
        method, rtol = label.split()
        rows.append([f"jaxonomy {method}", *["-"] * 4, f"{show(row, 1e3)} (rtol {float(rtol):.0e})", *["-"] * 4])
    columns = ["solver", "rtol", "steps", "error of v", "one run [ms]", "one run, error at the end only [ms]"]
    columns += ["plain run, jitted [ms]", "Jacobian, 6 parameters [ms]", "reverse gradient [ms]", "its error"]
    caption = f"LuGre testbench at an error of at most {content['goal']:g}, medians, {_caption(content)}"
    if "missing" in other:
        caption += f" jaxonomy is missing: {other['missing']}."
    else:
        caption += f" jaxonomy {other['versions']['jaxonomy']} with jax {other['versions']['jax']} in an environment of"
        caption += " its own, times scaled by those of the same NumPy work."
    return {"caption": caption, "columns": columns, "rows": rows}


def _many_table(content: dict[str, Any]) -> dict[str, Any]:
    rows = []
    for name, ways in content["many_runs"].items():
        for way, row in ways.items():
            error = row.get("largest_relative_error_of_v_end")
            per_second = "-" if "failed" in row else f"{1.0 / row['median_s']:,.0f}"
            rows.append([name, way, show(row, 1e6), per_second, "-" if error is None else f"{error:.1e}"])
    count = content["many_runs"][OURS][VMAP].get("runs_per_call", 0)
    caption = (
        f"{count} runs of the LuGre testbench with different parameters (in loops 64), error of the end velocity,"
        f" medians, {_caption(content)}"
    )
    columns = ["solver", "way", "per run [us]", "runs per second", "largest relative error"]
    return {"caption": caption, "columns": columns, "rows": rows}


def _target_table(content: dict[str, Any]) -> dict[str, Any]:
    one, many, ours = content["one_run"], content["many_runs"], content["derivatives"]["measured"]
    run = ours.get(f"{OURS}: run", {}).get("median_s", np.nan)

    def time(label: str, peer: str) -> float:
        return one[label].get(peer, {}).get("median_s", np.nan)

    own = [name for name in content["ladder"] if name.startswith("diffrax")]
    fastest = min(own, key=lambda name: np.nan_to_num(time("over the run", name), nan=np.inf))
    whole, diffrax, cvodes = (time("over the run", name) for name in (OURS, fastest, CVODES))
    serial = many[CVODES][LOOP].get("median_s", np.nan)

    def batch(way: str) -> float:
        return serial / many[OURS].get(way, {}).get("median_s", np.nan)

    found = [
        ("one run against CVODES", ">= 8", cvodes / whole),
        ("the same, ours jitted", ">= 8", cvodes / run),
        ("one run against CVODES, error at the end only", "", time("at the end", CVODES) / time("at the end", OURS)),
        (f"one run against the fastest of diffrax ({fastest.split()[-1]})", ">= 20", diffrax / whole),
        ("the same, ours jitted as it is", ">= 20", diffrax / run),
        ("one run against Kvaerno5", "", time("over the run", KVAERNO5) / whole),
        ("many runs by `jax.vmap` against CVODES one by one, per run", ">= 200", batch(VMAP)),
        ("the same by `jax.lax.map`, 64 at a time", ">= 200", batch(GROUPS)),
        ("the same by `jaxmodsim.sweep` on all cores", ">= 200", batch("sweep")),
        ("Jacobian in plain runs", "<= 2.5", ours.get(f"{OURS}: jacobian", {}).get("times_a_run", np.nan)),
        ("reverse gradient in plain runs", "<= 4", ours.get(f"{OURS}: gradient", {}).get("times_a_run", np.nan)),
    ]
    return {
        "caption": "Targets on the LuGre testbench. One run: a whole call of `simulate`, or `jitted`: a call of the"
        " jitted function whose derivatives are measured, which is also the plain run that these count in; of diffrax"
        f" such a call, of CVODES a call of CasADi's integrator; {_caption(content)}",
        "columns": ["ratio", "target", "measured", "met"],
        "rows": target_rows(found),
    }


if __name__ == "__main__":
    main()
