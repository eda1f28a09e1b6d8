"""One law in three formulations: smooth and bristle friction approach exact Coulomb friction, and at what cost.

A mass on a spring with Coulomb friction, let go at rest, passes two reversals and sticks for good. `Regularized` comes
near it as its width goes to zero, `LuGre` as its bristle becomes stiff (with `sigma1 = 2 sqrt(m sigma0)`). Two errors
against the exact run, which itself is held against the closed form:

- of the motion, the largest |q - q_exact| at equispaced times until the exact run has come to rest. Order 1 in the
  width. Order 1/2 in `1/sigma0`: a reversal takes the bristle a time of that order;
- of the place of rest, |q - q_exact| at the end. Order 1 in both: under its load the mass creeps on at a speed of the
  order of the width, or leans on its bristle by a distance of the order of `Fc/sigma0`.

Errors are those of the formulation: runs at rtol 1e-11. Times are those of warm runs at rtol 1e-6.

    python bench/d1_formulations.py [--smoke] [--out DIR]
"""

import itertools
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from _measure import machine_line, measure
from _options import begin
from _report import new_result, write_figure, write_result
from matplotlib import pyplot as plt

import jaxmodsim as jms
from jaxmodsim.problems import braked_spring, braked_spring_motion, braked_spring_rest

M, K, COULOMB, X0, T1 = 1.0, 100.0, 1.5, 0.1, 2.0
TIMES = np.linspace(0.0, T1, 401)
WIDTHS = tuple(10.0**-k for k in range(2, 7))
STIFFNESSES = tuple(10.0**k for k in range(2, 9))
ERRORS = {"motion": "error of the motion", "rest": "error of the place of rest"}


def main() -> None:
    """Measure, and write `formulations.json` and `.png`."""
    options = begin("One law in three formulations.")
    exact = _positions(jms.Coulomb(COULOMB))
    closed = np.asarray(braked_spring_motion(TIMES, x0=X0, m=M, k=K, Fc=COULOMB)[0])
    disagreement = float(np.max(np.abs(exact - closed)))
    count = 2 if options.smoke else None
    points = {
        "Regularized": [_point(width, regularized(width), exact) for width in WIDTHS[:count]],
        "LuGre": [_point(sigma0, bristle(sigma0), exact) for sigma0 in STIFFNESSES[:count]],
    }
    calls = {"exact": _call(jms.Coulomb(COULOMB))}
    calls |= {
        f"Regularized {row['parameter']:g}": _call(regularized(row["parameter"])) for row in points["Regularized"]
    }
    calls |= {f"LuGre {row['parameter']:g}": _call(bristle(row["parameter"])) for row in points["LuGre"]}
    times = measure(calls, 1 if options.smoke else 20)
    for name, rows in points.items():
        _add_orders(rows)
        for row in rows:
            row |= times[f"{name} {row['parameter']:g}"]
    content = new_result("formulations", options, "diffrax") | {
        "problem": {"m": M, "k": K, "Fc": COULOMB, "x0": X0, "t1": T1},
        "exact": times["exact"] | {"error": disagreement, "steps": _steps(jms.Coulomb(COULOMB))},
        "points": points,
    }
    caption = (
        f"Mass of {M:g} kg on a spring of {K:g} N/m with {COULOMB:g} N of Coulomb friction, let go at {X0:g} m,"
        f" {T1:g} s; exact: against the closed form, the others against exact. Errors at rtol 1e-11, orders from row to"
        f" row, steps and times at rtol 1e-6. {machine_line(content['machine'])}"
    )
    content["tables"] = [_table(content) | {"caption": caption}]
    write_result(content, options)
    draw(content, options.out / "formulations.png")


def regularized(width: float) -> jms.Regularized:
    """The law made smooth."""
    return jms.Regularized(jms.Coulomb(COULOMB), width)


def bristle(sigma0: float) -> jms.LuGre:
    """The law on a critically damped bristle, without stiction and viscous part; `vs` is without effect."""
    return jms.LuGre(sigma0=sigma0, sigma1=2.0 * math.sqrt(M * sigma0), sigma2=0.0, Fc=COULOMB, Fs=COULOMB, vs=0.1)


def _run(law: Any, rtol: float, ts: Any = None) -> jms.Trajectory:
    scene = braked_spring(law, m=M, k=K)
    return jms.simulate(scene, [X0], [0.0], T1, ts=ts, rtol=rtol, atol=1e-3 * rtol, max_steps=1_000_000)


def _positions(law: Any) -> np.ndarray:
    return np.asarray(_run(law, 1e-11, TIMES).q[:, 0])


def _steps(law: Any) -> int:
    return int(_run(law, 1e-6).stats["num_steps"])


def _point(parameter: float, law: Any, exact: np.ndarray) -> dict[str, Any]:
    error = np.abs(_positions(law) - exact)
    moves = float(braked_spring_rest(x0=X0, m=M, k=K, Fc=COULOMB).t) >= TIMES
    return {"parameter": parameter, "motion": float(error[moves].max()), "rest": float(error[-1]), "steps": _steps(law)}


def _call(law: Any) -> Any:
    scene = braked_spring(law, m=M, k=K)
    return partial(_end, scene)


def _end(scene: jms.Scene) -> float:
    return float(jms.simulate(scene, [X0], [0.0], T1, rtol=1e-6, atol=1e-9, max_steps=1_000_000).q[-1, 0])


def _add_orders(rows: list[dict[str, Any]]) -> None:
    """Observed orders from one row to the next."""
    for before, row in itertools.pairwise(rows):
        factor = abs(math.log(row["parameter"] / before["parameter"]))
        for error in ERRORS:
            row[f"order_{error}"] = math.log(before[error] / row[error]) / factor


def _table(content: dict[str, Any]) -> dict[str, Any]:
    found = content["exact"]
    rows = [["exact", "-", f"{found['error']:.1e}", "-", "-", "-", str(found["steps"]), _ms(found)]]
    units = {"Regularized": "width {:.0e} m/s", "LuGre": "sigma0 {:.0e} N/m"}
    for name, points in content["points"].items():
        for row in points:
            cells = [cell for error in ERRORS for cell in (f"{row[error]:.1e}", _order(row.get(f"order_{error}")))]
            rows.append([name, units[name].format(row["parameter"]), *cells, str(row["steps"]), _ms(row)])
    columns = ["formulation", "parameter", "error of the motion [m]", "order", "error at rest [m]", "order", "steps"]
    return {"columns": [*columns, "run [ms]"], "rows": rows}


def _order(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _ms(row: dict[str, Any]) -> str:
    return "failed" if "failed" in row else f"{1e3 * row['median_s']:.3g}"


def draw(content: dict[str, Any], path: Path) -> None:
    """Errors against the width and against the stiffness, with the lines of their orders."""
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 4.0), sharey=True, layout="constrained")
    labels = {"Regularized": "width [m/s]", "LuGre": "bristle stiffness sigma0 [N/m]"}
    for panel, (name, rows) in zip(axes, content["points"].items(), strict=True):
        x = np.array([row["parameter"] for row in rows])
        for marker, (error, label) in zip("os", ERRORS.items(), strict=True):
            y = np.array([row[error] for row in rows])
            order = rows[-1].get(f"order_{error}", float("nan"))
            panel.loglog(x, y, marker, ms=5.0, color=f"C{'os'.index(marker)}", label=f"{label}, order {order:.2f}")
            slope = (1.0 if name == "Regularized" else -1.0) * round(2.0 * order) / 2.0
            panel.loglog(x, y[-1] * (x / x[-1]) ** slope, ":", color=f"C{'os'.index(marker)}")
        panel.set_xlabel(labels[name])
        panel.set_title(name)
        panel.grid(which="major", alpha=0.25)
        panel.legend()
    axes[0].invert_xaxis()
    axes[0].set_ylabel("distance from the exact run [m]")
    write_figure(figure, path)


if __name__ == "__main__":
    main()
