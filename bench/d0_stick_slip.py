"""A minute of stick and slip, 122 events: one run, gradient, many runs, compilation, side by side in one process.

The belt oscillator at rtol 1e-6, by `simulate`, by legs of plain diffrax that each end in a terminating event, by
scipy's `solve_ivp` with terminal events, and by jaxonomy. Errors are those of the position at the end against the
closed form, the largest over 17 sets of parameters; as solvers err differently at one tolerance, each is also timed at
the loosest one of a ladder that makes its error no larger than that of `simulate` at 1e-6. Times are medians of
interleaved repetitions, compilation apart. jaxonomy pins a JAX of its own: it is measured in an environment of its
own, with and without the XLA option of `tune_cpu`, and its times are scaled by those of a common NumPy workload:

    python -m venv DIR && DIR/bin/pip install jaxonomy
    python bench/d0_stick_slip.py --jaxonomy DIR/bin/python

    python bench/d0_stick_slip.py [--smoke] [--no-tune] [--jaxonomy PYTHON] [--out DIR]
"""

import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from _elsewhere import ask
from _ladder import loosest
from _measure import machine_line, measure, scaled
from _options import begin
from _report import new_result, write_figure, write_result
from _stick_slip import (
    ATOL,
    NOMINAL,
    PARAMETERS,
    T1,
    belt_oscillator,
    events_until,
    exact_cycle,
    exact_end,
    lagrangian,
    legs_in_python,
    legs_scanned,
    legs_unrolled,
    our_call,
    our_end,
    parameter_sets,
    scipy_end,
)
from matplotlib import pyplot as plt

import jaxmodsim as jms
from jaxmodsim.scene import State, vector_field

RTOL = 1e-6
LADDER = tuple(10.0**-k for k in range(4, 10))
PERIOD_LADDER = tuple(10.0**-k for k in range(3, 12))
# Of the legs that are written out one after the other.
SHORT = 5.0
CYCLES = 68
OURS, WHOLE, SCANNED, LOOPED = "jaxmodsim in `jax.jit`", "jaxmodsim, whole call", "legs in `lax.scan`", "legs in Python"
SCIPY = ("RK45", "DOP853", "LSODA")
TUNED, SHIPPED = "jaxonomy, XLA option set", "jaxonomy as shipped"


def main() -> None:
    """Measure, and write `stick_slip.json` and `stick_slip_work_precision.png`."""
    options = begin("A minute of stick and slip, measured side by side.", may_leave_untuned=True, with_jaxonomy=True)
    smoke, name = options.smoke, "stick_slip" if options.tuned else "stick_slip_untuned"
    content = new_result(name, options, "diffrax", "optimistix", "scipy", "numpy") | {
        "problem": {"parameters": PARAMETERS, "values": NOMINAL.tolist(), "t1": T1, "events": events_until(T1)},
        "atol_over_rtol": ATOL,
        "compile": _compile_times(smoke),
        "primitives": _primitives(),
    }
    runs = _runners()
    content["ladder"] = _ladder(runs, smoke)
    content["one_run"] = _one_run(runs, content["ladder"], 1 if smoke else 25)
    content["gradient"] = _gradients(smoke)
    content["many_runs"] = _many_runs(4 if smoke else 1024, 1 if smoke else 5)
    content["period"] = _periods(smoke)
    content["jaxonomy"] = {"missing": "a smoke run"} if smoke else _jaxonomy(options.jaxonomy)
    content["tables"] = [_main_table(content), _compile_table(content), _target_table(content)]
    write_result(content, options)
    if options.tuned:
        draw(content, options.out / "stick_slip_work_precision.png")


def _sets() -> np.ndarray:
    """The nominal parameters and 16 others."""
    return np.vstack([NOMINAL, parameter_sets(16)])


# One run: what each peer offers as `run(p, rtol)`, the position at the end.


def _runners() -> dict[str, Callable[[Any, float], float]]:
    ours, scanned = jax.jit(our_end), jax.jit(partial(legs_scanned, cycles=CYCLES))
    looped = legs_in_python()
    runs: dict[str, Callable[[Any, float], float]] = {
        OURS: lambda p, rtol: float(ours(p, rtol)),
        SCANNED: lambda p, rtol: float(scanned(p, rtol)),
        LOOPED: looped,
    }
    return runs | {f"scipy {method}": partial(scipy_end, method=method) for method in SCIPY}


def _ladder(runs: dict[str, Callable[[Any, float], float]], smoke: bool) -> dict[str, list[dict[str, Any]]]:
    """Largest error of the position at the end over the sets, at each tolerance."""
    sets = _sets()[:2] if smoke else _sets()
    exact = np.asarray(jax.vmap(exact_end)(jnp.asarray(sets)))
    ladder = {}
    for name, run in runs.items():
        ladder[name] = [
            {"rtol": rtol, "error": _largest([run(p, rtol) for p in sets], exact)}
            for rtol in ((RTOL,) if smoke else LADDER)
        ]
    return ladder


def _largest(ends: Any, exact: np.ndarray) -> float:
    return float(np.max(np.abs(np.asarray(ends) - exact)))


def _choose(rows: list[dict[str, Any]], goal: float) -> dict[str, Any] | None:
    """The loosest tolerance at which the error is no larger than the goal (but for 5 %)."""
    return loosest(rows, "error", 1.05 * goal)


def _at(rows: list[dict[str, Any]], rtol: float) -> dict[str, Any]:
    return next(row for row in rows if row["rtol"] == rtol)


def _one_run(runs: dict[str, Any], ladder: dict[str, Any], rounds: int) -> dict[str, Any]:
    """A warm run at rtol 1e-6, and at the tolerance that makes its error that of ours."""
    goal = _at(ladder[OURS], RTOL)["error"]
    p = jnp.asarray(NOMINAL)
    calls: dict[str, Callable[[], Any]] = {f"{WHOLE} {RTOL:g}": our_call(RTOL)}
    for name, run in runs.items():
        chosen = _choose(ladder[name], goal)
        for rtol in {RTOL, chosen["rtol"] if chosen else RTOL}:
            given = p if name in (OURS, SCANNED) else NOMINAL
            calls[f"{name} {rtol:g}"] = partial(run, given, rtol)
    return {"goal": goal, "times": measure(calls, rounds)}


# Derivatives, batches, compilation.


def _gradients(smoke: bool) -> dict[str, Any]:
    """Reverse gradient of the end position by the five parameters; not in a smoke run, for its compilation."""
    p, exact = jnp.asarray(NOMINAL), np.asarray(jax.grad(exact_end)(jnp.asarray(NOMINAL)))
    functions = {} if smoke else {OURS: our_end, SCANNED: partial(legs_scanned, cycles=CYCLES)}
    compiled = {name: jax.jit(jax.grad(function)) for name, function in functions.items()}
    report = measure({name: partial(_wait, function, p) for name, function in compiled.items()}, 25)
    for name, row in report.items():
        row["derivative"] = np.asarray(compiled[name](p)).tolist()
        row["largest_relative_error"] = _relative(row["derivative"], exact)
    return {"exact": exact.tolist(), "measured": report}


def _relative(values: Any, exact: np.ndarray) -> float:
    return float(np.max(np.abs(np.asarray(values) / exact - 1.0)))


def _wait(function: Any, *given: Any) -> Any:
    return jax.block_until_ready(function(*given))


def _many_runs(count: int, rounds: int) -> dict[str, Any]:
    """One `jax.vmap` over sets of parameters within 3 %, per run, and the largest error."""
    sets = jnp.asarray(parameter_sets(count))
    exact = np.asarray(jax.vmap(exact_end)(sets))
    functions = {OURS: our_end} if rounds == 1 else {OURS: our_end, SCANNED: partial(legs_scanned, cycles=CYCLES)}
    compiled = {name: jax.jit(jax.vmap(function)) for name, function in functions.items()}
    report = measure({name: partial(_wait, function, sets) for name, function in compiled.items()}, rounds)
    found = {}
    for name, row in report.items():
        found[name] = scaled(row, count) | {"largest_error": _largest(compiled[name](sets), exact)}
    return found


def _compile_times(smoke: bool) -> dict[str, Any]:
    """Time to trace, lower and compile, from cleared caches: the shortest of three turns, of gradients one.

    The legs that are written out end after 5 s, ours after 5 s, 60 s and 600 s, with ten times the events each.
    """
    legs = events_until(SHORT) + 1
    runs: dict[str, Callable[[Any], Any]] = {
        f"{OURS}, 60 s": lambda p: our_end(p, RTOL, T1),
        f"{OURS}, 600 s": lambda p: our_end(p, RTOL, 10 * T1),
        f"legs written out, {legs - 1} events": lambda p: legs_unrolled(p, RTOL, SHORT, legs=legs),
        SCANNED: lambda p: legs_scanned(p, RTOL, T1, cycles=CYCLES),
    }
    runs |= {f"{name}: gradient": jax.grad(run) for name, run in runs.items()}
    if smoke:
        runs = {SCANNED: runs[SCANNED]}
    times: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(1 if smoke else 3):
        for name, run in runs.items():
            if turn == 0 or not name.endswith("gradient"):
                times[name].append(_compile_time(run))
    found = {name: {"minimum_s": min(taken), "all_s": taken} for name, taken in times.items()}
    ends = {f"{OURS}, 60 s": T1, f"{OURS}, 600 s": 10 * T1, f"legs written out, {legs - 1} events": SHORT}
    for name in set(ends) & set(found):
        found[name]["events"] = events_until(ends[name])
    return found


def _compile_time(function: Callable[[Any], Any]) -> float:
    jax.clear_caches()
    given = jnp.asarray(NOMINAL)
    start = time.perf_counter()
    # A function of its own, which nothing has seen.
    jax.jit(lambda p: function(p)).lower(given).compile()
    return time.perf_counter() - start


def _primitives() -> dict[str, Any]:
    """Primitives of the field of the oscillator without friction, against the equations by hand."""
    scene = eqx.tree_at(lambda s: s.effects, belt_oscillator(jnp.asarray(NOMINAL)), ())
    t, y = jnp.asarray(0.3), State(jnp.asarray([0.01]), jnp.asarray([0.2]), {})

    def by_hand(t: Any, q: Any, qd: Any, p: Any) -> Any:
        """d/dt dL/dqd = dL/dq, solved for the acceleration."""

        def momentum(t: Any, q: Any, qd: Any) -> Any:
            by_q, by_qd = jax.grad(lagrangian, argnums=(1, 2))(t, q, qd, p)
            return by_qd, by_q

        _, push, by_q = jax.linearize(momentum, t, q, qd, has_aux=True)
        still, rest = jnp.zeros_like(t), jnp.zeros_like(q)
        mass = push(still, rest, jnp.ones_like(qd))[None]
        return qd, (by_q - push(jnp.ones_like(t), qd, rest)) / mass[0]

    ours = _count(jax.make_jaxpr(lambda t, y, s: vector_field(t, y, s))(t, y, scene).jaxpr)
    hand = _count(jax.make_jaxpr(by_hand)(t, y.q, y.qd, scene.params).jaxpr)
    with_law = belt_oscillator(jnp.asarray(NOMINAL))
    mode = jnp.zeros(1)
    full = _count(jax.make_jaxpr(lambda t, y, s: vector_field(t, y, s, mode))(t, y, with_law).jaxpr)
    return {
        "ours": sum(ours.values()),
        "by_hand": sum(hand.values()),
        "same": ours == hand,
        "with_coulomb": sum(full.values()),
    }


def _count(jaxpr: Any) -> Counter[str]:
    """Primitives, with those inside of called functions and without the calls themselves."""
    total: Counter[str] = Counter()
    for equation in jaxpr.eqns:
        inner = [x.jaxpr for x in equation.params.values() if isinstance(x, jax.extend.core.ClosedJaxpr)]
        if inner:
            total += sum((_count(x) for x in inner), Counter())
        else:
            total[equation.primitive.name] += 1
    return total


# The period of the limit cycle against the tolerance.


def _periods(smoke: bool) -> list[dict[str, Any]]:
    """Error of the mean period between the first and the last break-away, and the time of a run."""
    exact, scene, ladder = float(exact_cycle(NOMINAL)["period"]), belt_oscillator(NOMINAL), PERIOD_LADDER
    rows, calls = [], {}
    for rtol in ladder[:2] if smoke else ladder:
        run = jms.simulate(scene, [0.0], [NOMINAL[4]], T1, rtol=rtol, atol=ATOL * rtol)
        times = np.asarray(run.events.t)[np.asarray(run.events.before) == 0]
        times = times[np.isfinite(times)]
        period = (times[-1] - times[0]) / (times.size - 1)
        steps = int(run.stats["num_steps"])
        rows.append({"rtol": rtol, "period": period, "error": abs(period / exact - 1.0), "steps": steps})
        calls[f"{rtol:g}"] = our_call(rtol)
    for row, found in zip(rows, measure(calls, 1 if smoke else 20).values(), strict=True):
        row |= found
    return rows


def draw(content: dict[str, Any], path: Path) -> None:
    """Two panels over the tolerance: error of the period, time of a run."""
    rows = content["period"]
    rtol = [row["rtol"] for row in rows]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.8), layout="constrained")
    left.loglog(rtol, [row["error"] for row in rows], "o-", ms=4.5, label="measured")
    left.loglog(rtol, rtol, ":", color="0.5", label="error = rtol")
    left.set_ylabel("relative error of the period [1]")
    left.legend()
    right.loglog(rtol, [1e3 * row["median_s"] for row in rows], "s-", ms=4.5)
    right.set_ylabel("time of one run of 60 s, warm [ms]")
    for axes in (left, right):
        axes.set_xlabel("relative tolerance [1]")
        axes.invert_xaxis()
        axes.grid(which="major", alpha=0.3)
    figure.suptitle("Belt oscillator: period of the stick-slip cycle against the tolerance")
    write_figure(figure, path)


# jaxonomy, in its own environment.


def _jaxonomy(interpreter: str | None) -> dict[str, Any]:
    """What its script measured, with times scaled to this environment; or why it is missing."""
    if interpreter is None:
        return {"missing": "no environment of it was given (--jaxonomy)"}
    sets = _sets()
    exact, slopes = np.asarray(jax.vmap(exact_end)(jnp.asarray(sets))), np.asarray(jax.grad(exact_end)(NOMINAL))
    task = {"nominal": NOMINAL.tolist(), "sets": sets.tolist(), "ladder": LADDER, "rtol": RTOL}
    task |= {"t1": T1, "atol": ATOL, "max_events": events_until(T1) + 32, "rounds": 25}
    found: dict[str, Any] = {}
    for label, tuned in ((SHIPPED, False), (TUNED, True)):
        found[label] = row = ask(interpreter, "_jaxonomy_stick_slip.py", task, tuned=tuned)
        if "missing" in row:
            return row
        row["ladder"] = [{"rtol": rtol, "error": _largest(ends, exact)} for rtol, ends in row.pop("ends")]
        row["largest_relative_error"] = _relative(row["gradient"], slopes)
    return found


# Tables.


def _ms(row: dict[str, Any] | None) -> str:
    if row is None:
        return "-"
    return "failed" if "failed" in row else f"{1e3 * row['median_s']:.3g}"


def _caption(content: dict[str, Any]) -> str:
    setting = "with `jaxmodsim.tune_cpu()`" if content["tuned"] else "without `jaxmodsim.tune_cpu()`"
    return f"all in one process, {setting}. {machine_line(content['machine'])}"


def _main_table(content: dict[str, Any]) -> dict[str, Any]:
    one, goal, rows = content["one_run"]["times"], content["one_run"]["goal"], []
    for name, ladder in content["ladder"].items():
        gradient, many = content["gradient"]["measured"].get(name), content["many_runs"].get(name)
        rows.append(_row(name, ladder, goal, partial(_timed, one, name), gradient, many))
        if name == OURS:
            row = one[f"{WHOLE} {RTOL:g}"]
            rows.append([WHOLE, rows[0][1], _ms(row), f"{RTOL:.0e}", _ms(row), "-", "-", "-"])
    peers = content["jaxonomy"]
    for label in (SHIPPED, TUNED):
        if label not in peers:
            continue
        found = peers[label]
        gradient = found["times"]["gradient"] | {"largest_relative_error": found["largest_relative_error"]}
        rows.append(_row(label, found["ladder"], goal, partial(_timed, found["times"], "run"), gradient, None))
    caption = (
        f"Belt oscillator, {T1:g} s and {content['problem']['events']} events; error of the position at the end (it"
        f" moves by 0.06 m) and of the gradient by {', '.join(PARAMETERS)}, against the closed form; medians,"
        f" {_caption(content)}"
    )
    if "missing" in peers:
        rows.append(["jaxonomy", *["-"] * 7])
        caption += f" jaxonomy is missing: {peers['missing']}."
    else:
        versions = peers[SHIPPED]["versions"]
        caption += f" jaxonomy {versions['jaxonomy']} with jax {versions['jax']} in an environment of its own."
    columns = ["program", "error at rtol 1e-6 [m]", "run at rtol 1e-6 [ms]", "rtol for our error", "run at it [ms]"]
    count = content["many_runs"][OURS].get("runs_per_call", 0)
    columns += ["reverse gradient [ms]", "its relative error", f"{count} runs, per run [ms]"]
    return {"caption": caption, "columns": columns, "rows": rows}


def _timed(times: dict[str, Any], name: str, rtol: float) -> dict[str, Any] | None:
    return times.get(f"{name} {rtol:g}")


def _row(name: str, ladder: Any, goal: float, timed: Any, gradient: Any, many: Any) -> list[str]:
    chosen = _choose(ladder, goal)
    return [
        name,
        f"{_at(ladder, RTOL)['error']:.1e}",
        _ms(timed(RTOL)),
        f"{chosen['rtol']:.0e}" if chosen else "-",
        _ms(timed(chosen["rtol"])) if chosen else "-",
        _ms(gradient),
        f"{gradient['largest_relative_error']:.1e}" if gradient and "largest_relative_error" in gradient else "-",
        _ms(many),
    ]


def _compile_table(content: dict[str, Any]) -> dict[str, Any]:
    found = content["compile"]
    rows = [
        [name, str(row.get("events", "-")), f"{row['minimum_s']:.2f}", _seconds(found.get(f"{name}: gradient"))]
        for name, row in found.items()
        if not name.endswith("gradient")
    ]
    columns = ["program", "events", "compilation of a run [s]", "of its reverse gradient [s]"]
    return {
        "caption": f"Time to trace and compile, shortest of three, {_caption(content)}",
        "columns": columns,
        "rows": rows,
    }


def _seconds(row: dict[str, Any] | None) -> str:
    return "-" if row is None else f"{row['minimum_s']:.2f}"


def _target_table(content: dict[str, Any]) -> dict[str, Any]:
    times, ladder, goal = content["one_run"]["times"], content["ladder"], content["one_run"]["goal"]
    compile_s = {name: row["minimum_s"] for name, row in content["compile"].items()}
    picks = [(f"scipy {method}", _choose(ladder[f"scipy {method}"], goal)) for method in SCIPY]
    scipy = [times[f"{name} {row['rtol']:g}"]["median_s"] for name, row in picks if row]
    written = f"legs written out, {events_until(SHORT)} events"
    long, short = f"{OURS}, 600 s", f"{OURS}, 60 s"

    def run(name: str) -> float:
        return times[f"{name} {RTOL:g}"].get("median_s", np.nan)

    def compiling(name: str, other: str) -> float:
        return compile_s.get(name, np.nan) / compile_s.get(other, np.nan)

    many = content["many_runs"][OURS].get("median_s", np.nan)
    found: list[tuple[str, str, float, float | None]] = [
        ("scipy RK45, against a whole call", ">= 200", run("scipy RK45") / run(WHOLE), 200.0),
        ("fastest method of scipy at our error", ">= 200", min(scipy, default=np.nan) / run(WHOLE), 200.0),
        ("legs in Python, against a whole call", ">= 1", run(LOOPED) / run(WHOLE), 1.0),
        ("legs in `lax.scan`", ">= 1", run(SCANNED) / run(OURS), 1.0),
        (f"compilation of {written}", ">= 3", compiling(written, short), 3.0),
        ("the same of the gradients", "", compiling(f"{written}: gradient", f"{short}: gradient"), None),
        ("one run alone, to one of many", ">= 15", run(OURS) / many, 15.0),
    ]
    for label in (SHIPPED, TUNED):
        one, gradient = _against_jaxonomy(content, label, run(OURS))
        found += [(f"{label}: run", ">= 2", one, 2.0), (f"{label}: gradient", ">= 4", gradient, 4.0)]
    rows = [[name, target, _ratio(x), "" if least is None else _verdict(x, least)] for name, target, x, least in found]
    longer = compiling(long, short)
    verdict = "not measured" if np.isnan(longer) else "yes" if abs(longer - 1.0) <= 0.1 else "no"
    rows.append(["compilation, ten times the events", "0.9 to 1.1", _ratio(longer), verdict])
    primitives = content["primitives"]
    counts = f"{primitives['ours']} and {primitives['by_hand']}"
    rows.append(["primitives without friction, and by hand", "equal", counts, "yes" if primitives["same"] else "no"])
    columns = ["time of the other, in ours", "target", "measured", "met"]
    return {"caption": f"Targets on stick-slip, {_caption(content)}", "columns": columns, "rows": rows}


def _against_jaxonomy(content: dict[str, Any], label: str, alone: float) -> tuple[float, float]:
    found = content["jaxonomy"].get(label)
    if found is None:
        return np.nan, np.nan
    ours = content["gradient"]["measured"][OURS]["median_s"]
    row = found["times"][f"run {RTOL:g}"]
    return row.get("median_s", np.nan) / alone, found["times"]["gradient"].get("median_s", np.nan) / ours


def _ratio(x: float) -> str:
    return "-" if np.isnan(x) else f"{x:.3g}"


def _verdict(x: float, least: float) -> str:
    if np.isnan(x):
        return "not measured"
    return "yes" if x >= least else "no"


if __name__ == "__main__":
    main()
