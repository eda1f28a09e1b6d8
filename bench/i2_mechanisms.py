"""Runs of mechanisms and of a measured axis with their derivatives: spherical pendulum, chains of links, EMPS record.

What the other benches leave out: `e0` measures single evaluations of chains, `e1` runs of the spherical pendulum of a
hundred times that length, `g0` fits. Here each is run once, and differentiated by all numbers named, forward (`jacfwd`)
and in reverse (`grad`); times are medians of interleaved calls of jitted functions, and derivatives count in runs. The
runs are also made by plain diffrax, with the accelerations written by hand and the same solver and tolerance.

- spherical pendulum, 1000 periods, end angle by (R, g), by Dopri8 at 1e-9;
- chains of 2 and 3 links, 10 s, end angle of the last by all masses and lengths, by Tsit5 at 1e-6;
- the EMPS record, 24 841 samples, open-loop mean square error by mass, offset and two friction numbers, with one step
  of `identify` for each sample; against the same simulation by hand in numba. The record lies beside the repository.

    python bench/i2_mechanisms.py [--smoke] [--record FILE] [--out DIR]
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _chain import numbers
from _measure import machine_line, measure
from _options import begin
from _report import new_result, show, write_result
from e1_long_runs import PHI0, SPIN0, Closed, G
from g0_fit_cost import DRIVE_GAIN, RECORD, numba_axis

import jaxmodsim as jms
from jaxmodsim.identify import AXIS_MODELS, axis_scene, replay, rough_axis
from jaxmodsim.problems import (
    n_link_pendulum,
    n_link_pendulum_acceleration,
    spherical_pendulum,
    spherical_pendulum_acceleration,
)
from jaxmodsim.scene import replace_numbers, scene_numbers

MAX_STEPS = 1_000_000
HAND = "by hand"
End = Callable[..., Any]


def main() -> None:
    """Measure, and write `mechanisms.json`."""
    options = begin("Runs of mechanisms with their derivatives.", record=RECORD)
    smoke = options.smoke
    tasks = {f"spherical pendulum, {'20' if smoke else '1000'} periods": spherical(20 if smoke else 1000)}
    for n in (2,) if smoke else (2, 3):
        tasks[f"chain of {n} links, 10 s"] = chain(n)
    if options.record.exists():
        tasks["EMPS record"] = axis(options.record, smoke)
    else:
        print(f"without the measured axis: there is no record at {options.record}")
    calls, values = {}, {}
    for name, task in tasks.items():
        calls |= {f"{name}: {kind}": call for kind, call in task.items()}
    report = measure(calls, 1 if smoke else 15, limit_s=15.0)
    for label, row in report.items():
        if "failed" not in row:
            values[label] = np.asarray(calls[label]()).tolist()
    content = new_result("mechanisms", options, "diffrax", "numba", "numpy") | {"measured": report, "values": values}
    content["tables"] = [_table(content, list(tasks))]
    write_result(content, options)


def derivatives(run: End, given: Any, forward: End) -> dict[str, Callable[[], Any]]:
    """A run and its derivatives, each jitted and called alike.

    **Arguments:**

    - `run`: function of the numbers `given`, a vector; `forward`: the same for forward mode.
    """
    functions = {"run": run, "forward": jax.jacfwd(forward), "reverse": jax.grad(run)}
    return {kind: _call(jax.jit(function), given) for kind, function in functions.items()}


def _call(function: End, given: Any) -> Callable[[], Any]:
    return lambda: jax.block_until_ready(function(given))


def _ends(scene_of: Callable[[Any], jms.Scene], q0: Any, qd0: Any, t1: float, **how: Any) -> tuple[End, End]:
    """The last coordinate at the end as a function of numbers, for reverse and for forward mode."""

    def end(p: Any, adjoint: Any = None) -> Any:
        return jms.simulate(scene_of(p), q0, qd0, t1, max_steps=MAX_STEPS, adjoint=adjoint, **how).q[-1, -1]

    return end, lambda p: end(p, dfx.ForwardMode())


def _by_hand(acceleration: End, q0: Any, qd0: Any, t1: float, *, rtol: float, atol: float, solver: Any) -> End:
    """The same by plain diffrax."""

    def field(t: Any, y: Any, p: Any) -> Any:
        del t
        return y[1], acceleration(y[0], y[1], p)

    def end(p: Any) -> Any:
        solved = dfx.diffeqsolve(
            dfx.ODETerm(field), solver, 0.0, t1, None, (jnp.asarray(q0), jnp.asarray(qd0)), args=p,
            stepsize_controller=dfx.PIDController(rtol=rtol, atol=atol), max_steps=MAX_STEPS,
        )  # fmt: skip
        assert solved.ys is not None
        return solved.ys[0][-1, -1]

    return end


def spherical(periods: int) -> dict[str, Callable[[], Any]]:
    """The spherical pendulum."""
    p, t1 = jnp.array([1.0, G]), periods * Closed().period
    start, how = ([PHI0, 0.0], [0.0, SPIN0]), {"solver": dfx.Dopri8(), "rtol": 1e-9, "atol": 1e-12}
    run, forward = _ends(lambda p: spherical_pendulum(m=1.0, R=p[0], g=p[1]), *start, t1, **how)
    hand = _by_hand(lambda q, qd, p: spherical_pendulum_acceleration(q, qd, R=p[0], g=p[1]), *start, t1, **how)
    return derivatives(run, p, forward) | {HAND: _call(jax.jit(hand), p)}


def chain(n: int) -> dict[str, Callable[[], Any]]:
    """A chain of n links."""
    given = numbers(n)
    p = jnp.concatenate([jnp.asarray(given["m"]), jnp.asarray(given["l"])])
    start, how = (np.full(n, 1.0), np.zeros(n)), {"solver": dfx.Tsit5(), "rtol": 1e-6, "atol": 1e-9}

    def named(p: Any) -> dict[str, Any]:
        return {"m": p[:n], "l": p[n:], "g": given["g"]}

    def scene(p: Any) -> jms.Scene:
        base = n_link_pendulum(n, **given)
        return eqx.tree_at(lambda s: (s.params["m"], s.params["l"]), base, (p[:n], p[n:]))

    run, forward = _ends(scene, *start, 10.0, **how)
    hand = _by_hand(lambda q, qd, p: n_link_pendulum_acceleration(q, qd, **named(p)), *start, 10.0, **how)
    return derivatives(run, p, forward) | {HAND: _call(jax.jit(hand), p)}


def axis(path: Path, smoke: bool) -> dict[str, Callable[[], Any]]:
    """The measured axis, simulated as `fit` does."""
    t, q, _, u = np.loadtxt(path, delimiter=",", skiprows=1).T[:, : 2000 if smoke else None]
    force = DRIVE_GAIN * u
    rough = rough_axis(jms.Record(t, q, {"u": force}, name="EMPS"))
    model = AXIS_MODELS["coulomb"]
    width = float(axis_scene(model, rough).effects[1].law.width)  # pyright: ignore[reportAttributeAccessIssue]
    times, inputs, measured = jnp.asarray(t), {"u": jnp.asarray(force)}, jnp.asarray(q)
    base = axis_scene(model, rough)

    def error(p: Any) -> Any:
        scene = replace_numbers(base, dict(zip(model.free, p, strict=True)))
        moved = replay(scene, times, inputs, measured[:1], jnp.zeros(1))
        return jnp.mean((moved - measured) ** 2)

    by_numba = numba_axis(width)
    start = [float(scene_numbers(base)[name]) for name in model.free]
    hand = lambda: float(np.mean((by_numba(t, force, q[0], *start) - q) ** 2))  # noqa: E731
    return derivatives(error, jnp.asarray(start), error) | {f"{HAND}, numba": hand}


def _table(content: dict[str, Any], tasks: list[str]) -> dict[str, Any]:
    measured, rows = content["measured"], []
    for name in tasks:
        run = measured[f"{name}: run"]
        hand = next(row for label, row in measured.items() if label.startswith(f"{name}: {HAND}"))
        cells = [show(run, 1e3), show(hand, 1e3)]
        for kind in ("forward", "reverse"):
            row = measured[f"{name}: {kind}"]
            ratio = f"{row['median_s'] / run['median_s']:.3g}" if "median_s" in row and "median_s" in run else "-"
            cells += [show(row, 1e3), ratio]
        count = len(content["values"].get(f"{name}: forward", []))
        rows.append([name, *cells[:2], str(count), *cells[2:]])
    caption = (
        "Runs and derivatives by the numbers of each mechanism, medians of interleaved calls of jitted functions. By"
        " hand: plain diffrax with the closed form and the same solver and tolerance; the record by numba, step by step"
        f" the same. With `jaxmodsim.tune_cpu()`. {machine_line(content['machine'])}"
    )
    columns = ["run", "run [ms]", "by hand [ms]", "numbers", "forward Jacobian [ms]", "in runs"]
    return {"columns": [*columns, "reverse gradient [ms]", "in runs"], "rows": rows, "caption": caption}


if __name__ == "__main__":
    main()
