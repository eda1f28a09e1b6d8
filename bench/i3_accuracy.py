"""`simulate(..., accuracy=...)` on every named problem: what was asked, estimated and met, and at what cost.

The observable of each problem, at eleven times. The true error is that against a run by a method that was not chosen,
at a relative tolerance of 1e-12, and at the end against the closed form, where there is one.

    python bench/i3_accuracy.py [--smoke] [--out DIR]
"""

import time
from typing import Any

import diffrax as dfx
import numpy as np
from _measure import machine_line
from _options import begin
from _report import new_result, write_result

import jaxmodsim as jms
from jaxmodsim.problems import NamedProblem, named_problems
from jaxmodsim.simulation import Accuracy, named_series

ASKED = (1e-3, 1e-5, 1e-8)
SMOKE = ("braked_spring", "double_pendulum")
TIMES = 11


def main() -> None:
    """Measure, and write `accuracy.json`."""
    options = begin("An accuracy that is asked for, estimated and met, problem by problem.")
    points: list[dict[str, Any]] = []
    for name, make in named_problems().items():
        if not options.smoke or name in SMOKE:
            points += _points(make(), ASKED[:1] if options.smoke else ASKED)
    content = new_result("accuracy", options, "diffrax", "numpy")
    content["points"] = points
    caption = (
        "Errors relative to the largest magnitude over the run. Ten times better and worse: steps as predicted, in"
        f" those made. {machine_line(content['machine'])}"
    )
    content["tables"] = [_table(points) | {"caption": caption}]
    write_result(content, options)


def _points(case: NamedProblem, asked: tuple[float, ...]) -> list[dict[str, Any]]:
    settings: dict[str, Any] = {"ts": np.linspace(0.0, case.t1, TIMES), "max_steps": case.max_steps}
    points: list[dict[str, Any]] = []
    references: dict[str, jms.Trajectory] = {}
    for accuracy in asked:
        point: dict[str, Any] = {"problem": case.name, "asked": accuracy}
        began = time.perf_counter()
        try:
            run = jms.simulate(
                case.scene, case.q0, case.qd0, case.t1, accuracy=accuracy, observable=case.observable, **settings
            )
        except jms.SimulationError as error:  # an accuracy that is not met is a result
            points.append(point | {"failed": str(error)})
            continue
        point["search_s"] = time.perf_counter() - began
        found = run.accuracy
        assert found is not None
        other = _other(case, found)
        name = type(other).__name__
        if name not in references:
            references[name] = jms.simulate(
                case.scene, case.q0, case.qd0, case.t1, solver=other, rtol=1e-12, atol=1e-15, throw=False, **settings
            )
        point |= {
            "solver": type(found.solver).__name__,
            "rtol": found.rtol,
            "steps": found.num_steps,
            "runs": len(found.tried),
            "estimate": found.estimate,
            "error": _error(case, run, references[name]),
            "better": found.tenfold.better,
            "worse": found.tenfold.worse,
        }
        points.append(point)
        print(point, flush=True)
    return points


def _other(case: NamedProblem, found: Accuracy) -> dfx.AbstractSolver:
    """A method that was not chosen."""
    if any(effect.stiff for effect in case.scene.effects):
        return dfx.Kvaerno5()
    return jms.Rodas5P() if isinstance(found.solver, dfx.Dopri8) and len(case.q0) == 1 else dfx.Dopri8()


def _error(case: NamedProblem, run: jms.Trajectory, reference: jms.Trajectory) -> float | None:
    """Largest error of the observable, against the reference where that reached the end, and the closed form."""
    one, other = (np.asarray(named_series(each, case.observable)) for each in (run, reference))
    errors = [float(np.max(np.abs(one - other)))] if bool(reference.result.ok) else []
    errors += [] if case.exact is None else [abs(float(one[-1]) - case.exact)]
    return max(errors) / max(float(np.max(np.abs(one))), 1e-6) if errors else None


def _table(points: list[dict[str, Any]]) -> dict[str, Any]:
    columns = ["problem", "asked", "estimated", "true", "solver", "rtol", "steps", "ten times better", "worse"]
    rows = []
    for p in points:
        if "failed" in p:
            rows.append([p["problem"], f"{p['asked']:.0e}", "not reached", *[""] * 6])
            continue
        true = "-" if p["error"] is None else f"{p['error']:.1e}"
        rows.append(
            [
                *(p["problem"], f"{p['asked']:.0e}", f"{p['estimate']:.1e}", true, p["solver"], f"{p['rtol']:.0e}"),
                *(str(p["steps"]), f"{p['better']:.2f}", f"{p['worse']:.2f}"),
            ]
        )
    return {"columns": columns, "rows": rows}


if __name__ == "__main__":
    main()
