"""One evaluation of the accelerations of a chain of n links: alone, in a loop, and 1024 at once.

From the Lagrangian by `jaxmodsim`, by the closed form written in JAX, by sympy and by MuJoCo, side by side in one
process; the errors show that all of them solve the same equations. A single evaluation takes less time than calling it
does, so each is measured three ways:

- called alone: from Python, one state;
- in a loop: dependent evaluations, each followed by a step of Euler, in one `lax.fori_loop`, or one call of `mj_step`;
- many: 1024 states in one call by `jax.vmap`, by NumPy over arrays, by MuJoCo's `rollout` over all cores (a single
  step of Euler each) or a loop of Python; and by `jax.vmap` in a loop, which calls nothing.

Times are the shortest of interleaved repetitions, compilation apart: what disturbs them can only add to them.

    python bench/e0_accelerations.py [--smoke] [--out DIR]
"""

import math
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _chain import JAX, STEP, Accelerations, Engine, Symbolic, arrays, scene, states
from _measure import machine_line, measure, scaled
from _options import begin
from _report import new_result, write_figure, write_result
from matplotlib import pyplot as plt

import jaxmodsim as jms

SIZES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
MANY = 1024
OURS, HAND, SYMPY, MUJOCO = "jaxmodsim", "JAX by hand", "sympy", "MuJoCo"
# Written out in scalars, larger chains take minutes to compile.
LARGEST_WRITTEN_OUT = 12
# A derivation by sympy that takes longer [s] is the last one.
PATIENCE = 15.0
ALONE, LOOP, BATCH, BATCH_LOOP, PYTHON = "alone", "loop", "many", "many in a loop", "many, loop of Python"
LABELS = {ALONE: "called alone", LOOP: "in a loop", BATCH: f"{MANY} at once"}


def main() -> None:
    """Measure, and write `accelerations.json` and `.png`."""
    options = begin("Accelerations of a chain of n links, measured side by side.")
    points: dict[str, dict[str, Any]] = {}
    patience = 0.0 if options.smoke else PATIENCE
    for n in (1, 2) if options.smoke else SIZES:
        points[str(n)] = point = _point(n, options.smoke, patience)
        if point["derived_s"] is None or point["derived_s"] > patience:
            patience = -1.0
        print(
            f"n = {n}: {', '.join(f'{name} {_ns(found, LOOP)}' for name, found in point['times'].items())} ns in a loop"
        )
    content = new_result("accelerations", options, "mujoco", "sympy", "numpy") | {
        "euler_step_s": STEP,
        "points": points,
        "exponents": _exponents(points),
    }
    content["tables"] = [_main_table(content), _other_table(content), _compile_table(content), _target_table(content)]
    write_result(content, options)
    draw(content, options.out / "accelerations.png")


# One size of chain: everybody's calls, their compilation, and their errors.


def _point(n: int, smoke: bool, patience: float) -> dict[str, Any]:
    many, single, batches = (8, 20, 2) if smoke else (MANY, max(200, 4000 // n), max(2, 32 // n))
    q, qd = states(n, many)
    exact = np.asarray(jax.vmap(arrays, (0, 0, None))(jnp.asarray(q), jnp.asarray(qd), scene(n)))
    calls: dict[str, Callable[[], Any]] = {}
    counts = {ALONE: 1, LOOP: single, BATCH: many, BATCH_LOOP: many * batches, PYTHON: many}
    compiled, errors = {}, {}
    for name, fn in JAX.items():
        if "scalars" not in name or n <= LARGEST_WRITTEN_OUT:
            own, compiled[name], found = _jax_calls(fn, n, q, qd, single, batches)
            calls |= {f"{name}: {mode}": call for mode, call in own.items()}
            errors[name] = _error(found, exact)
    derived = None
    if patience >= 0.0:
        symbolic = Symbolic(n)
        derived = symbolic.derived_s
        calls[f"{SYMPY}: {ALONE}"] = partial(symbolic.alone, q[0], qd[0])
        calls[f"{SYMPY}: {BATCH}"] = partial(symbolic.many, q, qd)
        errors[SYMPY] = _error(symbolic.many(q, qd), exact)
    engine = Engine(n, os.cpu_count() or 1)
    engine.place(q[0], qd[0])
    engine.forward()
    errors[MUJOCO] = _error(engine.accelerations()[None], exact[:1])
    rows, own_q, own_qd = engine.rows(q, qd), np.diff(q, axis=1, prepend=0.0), np.diff(qd, axis=1, prepend=0.0)
    calls[f"{MUJOCO}: {ALONE}"] = engine.forward
    calls[f"{MUJOCO}: {LOOP}"] = partial(_placed_steps, engine, q[0], qd[0], single)
    calls[f"{MUJOCO}: {BATCH}"] = partial(engine.once_each, rows)
    calls[f"{MUJOCO}: {PYTHON}"] = partial(engine.one_by_one, own_q, own_qd)
    times: dict[str, dict[str, Any]] = {}
    for label, found in measure(calls, 1 if smoke else 12, 10.0).items():
        name, mode = label.split(": ")
        times.setdefault(name, {})[mode] = scaled(found, counts[mode])
    times[HAND] = {
        mode: min((times[name][mode] for name in JAX if name != OURS and name in times), key=_shortest)
        for mode in (ALONE, LOOP, BATCH, BATCH_LOOP)
    }
    engine.pool.close()
    return {"times": times, "compile_s": compiled, "derived_s": derived, "relative_error": errors}


def _shortest(found: dict[str, Any]) -> float:
    return found.get("minimum_s", math.inf)


def _placed_steps(engine: Engine, q: np.ndarray, qd: np.ndarray, count: int) -> None:
    engine.place(q, qd)
    engine.steps(count)


def _error(found: Any, exact: np.ndarray) -> float:
    """Largest difference of an acceleration, relative to the largest acceleration there."""
    return float(np.max(np.abs(np.asarray(found) - exact) / np.abs(exact).max(axis=1, keepdims=True)))


def _jax_calls(
    fn: Accelerations, n: int, q: np.ndarray, qd: np.ndarray, single: int, batches: int
) -> tuple[dict[str, Callable[[], Any]], dict[str, float], Any]:
    """Compiled calls by kind, seconds to trace and compile each, and the accelerations at the many states."""
    chain, many = scene(n), jax.vmap(fn, (0, 0, None))
    one = jnp.asarray(q[0]), jnp.asarray(qd[0])
    all_of_them = jnp.asarray(q), jnp.asarray(qd)
    programs = {
        ALONE: (fn, one),
        LOOP: (partial(_euler, fn, single), one),
        BATCH: (many, all_of_them),
        BATCH_LOOP: (partial(_euler, many, batches), all_of_them),
    }
    calls, seconds, results = {}, {}, {}
    for mode, (program, state) in programs.items():
        start = time.perf_counter()
        compiled = jax.jit(program).lower(*state, chain).compile()
        seconds[mode] = time.perf_counter() - start
        calls[mode] = partial(_wait, compiled, *state, chain)
        results[mode] = calls[mode]()
    return calls, seconds, results[BATCH]


def _wait(call: Callable[..., Any], *args: Any) -> Any:
    return jax.block_until_ready(call(*args))


def _euler(fn: Accelerations, count: int, q: Any, qd: Any, chain: jms.Scene) -> Any:
    """`count` evaluations, each at the state the last one led to."""

    def step(_: Any, state: Any) -> Any:
        q, qd = state
        return q + STEP * qd, qd + STEP * fn(q, qd, chain)

    return jax.lax.fori_loop(0, count, step, (q, qd))


# Tables.


def _exponents(points: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Slope of log time over log n where nobody writes anything out any more."""
    found: dict[str, dict[str, float]] = {}
    sizes = [n for n in points if int(n) >= min(16, max(map(int, points)) // 2)]
    for name in (OURS, HAND, MUJOCO):
        found[name] = {}
        for mode in (LOOP, BATCH):
            y = [_shortest(points[n]["times"][name].get(mode, {})) for n in sizes]
            found[name][mode] = float(np.polyfit(np.log([int(n) for n in sizes]), np.log(y), 1)[0])
    return found


def _ns(found: dict[str, Any], mode: str) -> str:
    seconds = _shortest(found.get(mode, {}))
    return "-" if math.isinf(seconds) else f"{1e9 * seconds:.3g}"


def _ratio(point: dict[str, Any], mode: str, peer: str = HAND) -> float:
    """Time of ours in the peer's."""
    return _shortest(point["times"][OURS][mode]) / _shortest(point["times"][peer][mode])


def _fastest_mujoco(point: dict[str, Any]) -> float:
    found = point["times"][MUJOCO]
    return min(_shortest(found[mode]) for mode in (LOOP, BATCH, PYTHON))


def _main_table(content: dict[str, Any]) -> dict[str, Any]:
    columns = ["n", "jaxmodsim, loop [ns]", "by hand, loop [ns]", "ratio", "jaxmodsim, many [ns]", "by hand, many [ns]"]
    columns += ["ratio", "ratio in a loop", "MuJoCo, loop [ns]", "MuJoCo, many [ns]", "sympy, many [ns]"]
    rows = []
    for n, point in content["points"].items():
        times = point["times"]
        cells = [_ns(times[OURS], LOOP), _ns(times[HAND], LOOP), f"{_ratio(point, LOOP):.2f}"]
        cells += [_ns(times[OURS], BATCH), _ns(times[HAND], BATCH), f"{_ratio(point, BATCH):.2f}"]
        cells += [f"{_ratio(point, BATCH_LOOP):.2f}", _ns(times[MUJOCO], LOOP), _ns(times[MUJOCO], BATCH)]
        rows.append([n, *cells, _ns(times.get(SYMPY, {}), BATCH)])
    slopes = content["exponents"]
    rows.append(["exponent", *(_slope(slopes, name, LOOP) for name in (OURS, HAND)), "-"])
    rows[-1] += [*(_slope(slopes, name, BATCH) for name in (OURS, HAND)), "-", "-"]
    rows[-1] += [_slope(slopes, MUJOCO, LOOP), _slope(slopes, MUJOCO, BATCH), "-"]
    return {"columns": columns, "rows": rows, "caption": _caption(content, "Accelerations of a chain, per evaluation")}


def _slope(slopes: dict[str, Any], name: str, mode: str) -> str:
    return f"{slopes[name][mode]:.1f}"


def _caption(content: dict[str, Any], what: str) -> str:
    return (
        f"{what}: shortest of interleaved repetitions, all in one process, with `jaxmodsim.tune_cpu()`. By hand: the"
        " faster of arrays and scalars. Loop: dependent evaluations with a step of Euler. Many: 1024 states in one"
        f" call; MuJoCo's over all cores. Exponents of n from n = 16 on. {machine_line(content['machine'])}"
    )


def _other_table(content: dict[str, Any]) -> dict[str, Any]:
    rows = []
    for n, point in content["points"].items():
        times = point["times"]
        alone = [_ns(times.get(name, {}), ALONE) for name in (OURS, HAND, SYMPY, MUJOCO)]
        others = [_ns(times.get(name, {}), BATCH_LOOP) for name in (OURS, HAND)]
        worst = max(point["relative_error"].values())
        rows.append([n, *alone, *others, _ns(times[MUJOCO], PYTHON), f"{worst:.0e}"])
    columns = [
        "n",
        "jaxmodsim, called [ns]",
        "by hand [ns]",
        "sympy [ns]",
        "MuJoCo [ns]",
        "jaxmodsim, many in a loop [ns]",
    ]
    columns += ["by hand [ns]", "MuJoCo, loop of Python [ns]", "largest disagreement"]
    return {"columns": columns, "rows": rows, "caption": _caption(content, "The same called from Python one by one")}


def _compile_table(content: dict[str, Any]) -> dict[str, Any]:
    rows = []
    for n, point in content["points"].items():
        found = point["compile_s"]
        cells = [f"{found[name][mode]:.2f}" if name in found else "-" for mode in (LOOP, BATCH) for name in JAX]
        rows.append([n, *cells, "-" if point["derived_s"] is None else f"{point['derived_s']:.1f}"])
    columns = ["n", *(f"{name}, {mode} [s]" for mode in (LOOP, BATCH) for name in JAX), "sympy, to derive [s]"]
    return {
        "columns": columns,
        "rows": rows,
        "caption": f"Time to trace and compile. {machine_line(content['machine'])}",
    }


def _target_table(content: dict[str, Any]) -> dict[str, Any]:
    rows = []
    for n, point in content["points"].items():
        if int(n) <= 3:
            for mode, what in ((LOOP, "in a loop"), (BATCH, f"{MANY} at once"), (BATCH_LOOP, f"{MANY}, in a loop")):
                ratio = _ratio(point, mode)
                rows.append([f"time by hand, n = {n}, {what}", "<= 1.3", f"{ratio:.2f}", _met(ratio <= 1.3)])
    for n, point in content["points"].items():
        if int(n) <= 6:
            ratio = _shortest(point["times"][OURS][BATCH]) / _fastest_mujoco(point)
            rows.append([f"time of MuJoCo, n = {n}, {MANY} at once", "< 1", f"{ratio:.3f}", _met(ratio < 1.0)])
    caption = f"Targets: time of jaxmodsim in that of its peers. {machine_line(content['machine'])}"
    return {"columns": ["jaxmodsim in the", "target", "measured", "met"], "rows": rows, "caption": caption}


def _met(fulfilled: bool) -> str:
    return "yes" if fulfilled else "no"


def draw(content: dict[str, Any], path: Path) -> None:
    """Time over the number of links, one panel for each way to measure."""
    figure, axes = plt.subplots(1, 3, figsize=(12.0, 4.3), sharey=True, layout="constrained")
    for panel, (mode, label) in zip(axes, LABELS.items(), strict=True):
        for i, (marker, name) in enumerate(zip("osD^", (OURS, HAND, SYMPY, MUJOCO), strict=True)):
            known = {int(n): _shortest(p["times"].get(name, {}).get(mode, {})) for n, p in content["points"].items()}
            known = {n: 1e9 * y for n, y in known.items() if not math.isinf(y)}
            panel.loglog(list(known), list(known.values()), marker + "-", ms=4.5, color=f"C{i}", label=name)
        panel.set_xlabel("number of links n [1]")
        panel.set_title(label)
        panel.set_xticks([int(n) for n in content["points"]], list(content["points"]))
        panel.minorticks_off()
        panel.grid(which="major", alpha=0.25)
    axes[0].set_ylabel("time of one evaluation of the accelerations [ns]")
    axes[0].legend()
    write_figure(figure, path)


if __name__ == "__main__":
    main()
