"""Fixed steps whatever the stiffness: bristles that the step resolves, and bristles that it is far too long for.

The test bench's box on a LuGre bristle of growing stiffness, critically damped, pulled for four seconds with steps that
somebody else has chosen. Against an adaptive run at a tight tolerance: the error of the last velocity by

- `ImplicitFriction`: implicit in friction, order 1;
- `Rodas5P(pivot=True)` with a fixed step: order 5, linearly implicit;
- explicit Euler.

A run whose velocity exceeds 100 m/s, or that ended with an error, counts as diverged: the box reaches 1.4 m/s. Times
per step are those of warm runs with steps of 1 ms, compilation apart.

    python bench/f2_fixed_step.py [--smoke] [--out DIR]
"""

from functools import partial
from typing import Any

import diffrax as dfx
import numpy as np
from _measure import machine_line, measure
from _options import begin
from _report import new_result, write_result

import jaxmodsim as jms
from jaxmodsim.problems import box_lugre, ramped_box

M, T1 = 2.0, 4.0
STIFFNESSES = tuple(10.0**k for k in range(1, 10))
STEPS = (1e-1, 1e-2, 1e-3, 1e-4)
SOLVERS = {"ImplicitFriction": jms.ImplicitFriction(), "Rodas5P": jms.Rodas5P(pivot=True), "Euler": dfx.Euler()}
# Velocity [m/s] beyond which a run has diverged.
DIVERGED = 100.0
TIMED_STEP, TIMED = 1e-3, (1e3, 1e6, 1e9)


def main() -> None:
    """Measure, and write `fixed_step.json`."""
    options = begin("Fixed steps whatever the stiffness.")
    stiffnesses, steps = (STIFFNESSES[::4], STEPS[:2]) if options.smoke else (STIFFNESSES, STEPS)
    points = [_point(sigma0, steps) for sigma0 in stiffnesses]
    calls = {
        f"{name} {sigma0:g}": partial(_end, _scene(sigma0), solver)
        for name, solver in SOLVERS.items()
        for sigma0 in (TIMED[:1] if options.smoke else TIMED)
        if name != "Euler" or sigma0 == TIMED[0]
    }
    times = measure(calls, 1 if options.smoke else 20)
    count = round(T1 / TIMED_STEP)
    content = new_result("fixed_step", options, "diffrax") | {
        "problem": {"m": M, "t1": T1, "sigma1": "2 sqrt(m sigma0)"},
        "points": points,
        "times": {"step": TIMED_STEP, "steps": count, "runs": times},
    }
    machine = machine_line(content["machine"])
    errors = _table(points, steps) | {
        "caption": f"Box of {M:g} kg on a LuGre bristle with critical damping, pulled by 1 N/s for {T1:g} s: error of"
        f" the last velocity [m/s] by stiffness and step. {machine}",
    }
    costs = {
        "columns": ["run", "time per step [us]"],
        "rows": [[name, _microseconds(row, count)] for name, row in times.items()],
        "caption": f"Time per step with steps of 1 ms, by stiffness [N/m]: medians of warm runs. {machine}",
    }
    content["tables"] = [errors, costs]
    write_result(content, options)


def _scene(sigma0: float) -> jms.Scene:
    return ramped_box(box_lugre(sigma0=sigma0, sigma1=2.0 * (M * sigma0) ** 0.5), m=M)


def _end(scene: jms.Scene, solver: Any, dt: float = TIMED_STEP) -> float:
    run = jms.simulate(scene, [0.0], [0.0], T1, dt=dt, solver=solver, max_steps=1_000_000, throw=False)
    return float(run.qd[-1, 0]) if bool(run.result.ok) else float("nan")


def _point(sigma0: float, steps: tuple[float, ...]) -> dict[str, Any]:
    scene = _scene(sigma0)
    tight = jms.simulate(scene, [0.0], [0.0], T1, rtol=1e-9, atol=1e-12, max_steps=1_000_000).qd[-1, 0]
    point: dict[str, Any] = {"sigma0": sigma0, "v": float(tight)}
    for name, solver in SOLVERS.items():
        ends = [_end(scene, solver, dt) for dt in steps]
        point[name] = [abs(v - float(tight)) if abs(v) < DIVERGED else None for v in ends]
    return point


def _table(points: list[dict[str, Any]], steps: tuple[float, ...]) -> dict[str, Any]:
    columns = ["sigma0 [N/m]", *(f"{name}, {dt:g} s" for name in SOLVERS for dt in steps)]
    rows = [[f"{row['sigma0']:.0e}", *(_error(x) for name in SOLVERS for x in row[name])] for row in points]
    return {"columns": columns, "rows": rows}


def _error(value: float | None) -> str:
    return "diverged" if value is None or not np.isfinite(value) else f"{value:.1e}"


def _microseconds(row: dict[str, Any], steps: int) -> str:
    return "failed" if "failed" in row else f"{1e6 * row['median_s'] / steps:.2f}"


if __name__ == "__main__":
    main()
