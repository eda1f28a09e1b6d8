"""Long runs: energy, momentum and motion over 100 000 periods, and drift off a constraint over 10 000 s.

Three parts:

- a spherical pendulum, regular and away from the poles, over 100 000 periods, by fixed steps of `Gauss` on momenta and
  by adaptive solvers on velocities. Energy counts from the lowest point of the sphere. The angle phi is held against
  its closed form, a Jacobi elliptic function. Errors are the largest over windows of one period; the growth is the
  slope of their logarithm over that of time in the last two of five decades: 0 for errors that stay, 1 for linear
  drift. It is not given for the angle where that is lost, with errors above 0.1 rad;
- a pendulum in Cartesian coordinates on a `Constraint`, 10 000 s, with and without projection and stabilisation;
- observed orders of `Gauss` under forces and on a constraint.

Times are those of one run each, compiled before.

    python bench/e1_long_runs.py [--smoke] [--out DIR]
"""

import itertools
import math
import time
from functools import partial
from pathlib import Path
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from _measure import machine_line
from _options import begin
from _report import new_result, write_figure, write_result
from matplotlib import pyplot as plt
from scipy.special import ellipj, ellipk

import jaxmodsim as jms
from jaxmodsim.problems import spherical_pendulum

G, PHI0, SPIN0 = 9.81, 2.0, 2.0
PERIODS, SECONDS = 100_000, 10_000
# Steps that are powers of two, so that time is without rounding.
DT = 1.0 / 32.0
# A window of somewhat more than one period: as many samples, at ends of steps.
SAMPLES = 36
# Errors of the angle [rad] above which its growth means nothing; its swing is 0.65.
LOST = 0.1
# Let go at this angle from straight down [rad].
ANGLE0 = 1.5
LIMIT = 1_000_000_000

LONG: dict[str, dict[str, Any]] = {
    "Gauss(1)": {"solver": jms.Gauss(1), "dt": DT},
    "Gauss(2)": {"solver": jms.Gauss(2), "dt": DT},
    "Gauss(3)": {"solver": jms.Gauss(3), "dt": DT},
    "Gauss(3), half the step": {"solver": jms.Gauss(3), "dt": DT / 2},
    "Rodas5P, 1e-6": {"solver": jms.Rodas5P(), "rtol": 1e-6, "atol": 1e-9},
    "Tsit5, 1e-6": {"solver": dfx.Tsit5(), "rtol": 1e-6, "atol": 1e-9},
    "Tsit5, 1e-9": {"solver": dfx.Tsit5(), "rtol": 1e-9, "atol": 1e-12},
    "Dopri8, 1e-9": {"solver": dfx.Dopri8(), "rtol": 1e-9, "atol": 1e-12},
    "Dopri8, 1e-12": {"solver": dfx.Dopri8(), "rtol": 1e-12, "atol": 1e-15},
}
# Label, rate of stabilisation [1/s], options of the run.
CONSTRAINED: tuple[tuple[str, float, dict[str, Any]], ...] = (
    ("projected", 0.0, {"rtol": 1e-6}),
    ("projected", 0.0, {"rtol": 1e-9, "atol": 1e-12}),
    ("neither", 0.0, {"rtol": 1e-6, "project": False}),
    ("neither", 0.0, {"rtol": 1e-9, "atol": 1e-12, "project": False}),
    ("stabilise = 10", 10.0, {"rtol": 1e-6, "project": False}),
    ("stabilise = 10", 10.0, {"rtol": 1e-9, "atol": 1e-12, "project": False}),
    ("projected", 0.0, {"solver": jms.Gauss(3), "dt": DT}),
    ("neither", 0.0, {"solver": jms.Gauss(3), "dt": DT, "project": False}),
    ("stabilise = 10", 10.0, {"solver": jms.Gauss(3), "dt": DT, "project": False}),
)
# By the number of stages.
ORDER_STEPS = {1: (1 / 128, 1 / 256, 1 / 512), 2: (1 / 64, 1 / 128, 1 / 256), 3: (1 / 16, 1 / 32, 1 / 64)}
ORDER_T1 = 4.0


def main() -> None:
    """Measure, and write `long_runs.json` and `.png`."""
    options = begin("Long runs: energy, momentum and motion, and constraints.")
    long, constrained, stages, seconds = LONG, CONSTRAINED, (1, 2, 3), SECONDS
    if options.smoke:
        long, constrained = {name: LONG[name] for name in ("Gauss(1)", "Tsit5, 1e-6")}, CONSTRAINED[:1]
        stages, seconds = (1,), 100
    cases = {
        "under forces": (_driven, _driven_reference),
        "on a constraint, projected": (partial(_hung, project=True), _hung_reference),
        "on a constraint, not projected": (partial(_hung, project=False), _hung_reference),
    }
    if options.smoke:
        cases = dict(itertools.islice(cases.items(), 1))
    swing = math.acos(Closed().lower) - PHI0
    content = new_result("long_runs", options, "diffrax", "scipy", "numpy") | {
        "problem": {
            "g": G,
            "phi0": PHI0,
            "spin0": SPIN0,
            "period_s": Closed().period,
            "angle0": ANGLE0,
            "swing": swing,
        },
        "long_runs": long_runs(long, 300 if options.smoke else PERIODS),
        "constraint_drift": constraint_drift(constrained, seconds),
        "seconds": seconds,
        "orders": {name: orders(run, reference(), stages) for name, (run, reference) in cases.items()},
    }
    content["tables"] = [_long_table(content), _constraint_table(content), _order_table(content)]
    if not options.smoke:
        content["tables"].append(_target_table(content))
    write_result(content, options)
    draw(content, options.out / "long_runs.png")


class Closed:
    """Closed form of the spherical pendulum let go at a turning point of phi, unit mass and radius.

    `u = cos(phi)` obeys `u'^2 = 2 g (u - u1)(u - u2)(u - u3)` and moves between u1 and u2, the start.
    """

    def __init__(self) -> None:
        self.upper = math.cos(PHI0)
        self.momentum = math.sin(PHI0) ** 2 * SPIN0
        self.energy = 0.5 * math.sin(PHI0) ** 2 * SPIN0**2 + G * self.upper
        # The cubic without its root u2.
        total = self.energy / G - self.upper
        product = (0.5 * self.momentum**2 - self.energy) / (G * self.upper)
        root = math.sqrt(0.25 * total**2 - product)
        self.lower, beyond = 0.5 * total - root, 0.5 * total + root
        self.modulus = (self.upper - self.lower) / (beyond - self.lower)
        self.rate = math.sqrt(0.5 * G * (beyond - self.lower))
        self.quarter = float(ellipk(self.modulus))
        self.period = 2.0 * self.quarter / self.rate

    def phi(self, t: np.ndarray) -> np.ndarray:
        """The angle at the times t."""
        sn = ellipj(np.mod(self.rate * t, 2.0 * self.quarter) + self.quarter, self.modulus)[0]
        return np.arccos(self.lower + (self.upper - self.lower) * sn**2)


def _windows(periods: int) -> np.ndarray:
    """Times of saving, shape `[windows, SAMPLES]`: windows of a period, spread evenly over the logarithm of time."""
    period = Closed().period
    last = int(periods * period / DT) - SAMPLES
    starts = np.unique(np.geomspace(period / DT, last, 36).astype(int))
    kept = [starts[0]]
    kept += [start for before, start in itertools.pairwise(starts) if start - before >= SAMPLES]
    return DT * (np.array(kept)[:, None] + np.arange(SAMPLES)[None, :])


def _timed(run: Any, ts: np.ndarray) -> tuple[jms.Trajectory, float, float]:
    """A run, its time [s], and that of a short one before it, which compiles."""
    start = time.perf_counter()
    jax.block_until_ready(run(ts * (1.0 / 1024.0)).q)
    compiled = time.perf_counter() - start
    start = time.perf_counter()
    result = run(ts)
    jax.block_until_ready(result.q)
    return result, time.perf_counter() - start, compiled


def _growth(t: np.ndarray, error: np.ndarray, lost: float = math.inf) -> float | None:
    """Slope of log error over log t in the last two decades; None where errors are beyond `lost` in most of them."""
    late = t >= 0.01 * t[-1]
    use = late & (error > 0) & (np.maximum.accumulate(error) < lost)
    return float(np.polyfit(np.log(t[use]), np.log(error[use]), 1)[0]) if 2 * use.sum() > late.sum() else None


def long_runs(runs: dict[str, dict[str, Any]], periods: int) -> list[dict[str, Any]]:
    """The spherical pendulum by each solver."""
    closed, windows = Closed(), _windows(periods)
    scene, times = spherical_pendulum(m=1.0, R=1.0, g=G), windows.ravel()
    rows = []
    for name, keywords in runs.items():
        run = partial(_spherical, scene, keywords)
        result, seconds, compiled = _timed(run, times)
        (phi, _), (phi_rate, theta_rate) = np.asarray(result.q).T, np.asarray(result.qd).T
        momentum = np.sin(phi) ** 2 * theta_rate
        energy = 0.5 * phi_rate**2 + 0.5 * np.sin(phi) ** 2 * theta_rate**2 + G * np.cos(phi)
        errors = {
            "energy": np.abs(energy - closed.energy) / (closed.energy + G),
            "momentum": np.abs(momentum / closed.momentum - 1.0),
            "phi": np.abs(phi - closed.phi(times)),
        }
        row = {"solver": name, "steps": int(result.stats["num_steps"]), "run_s": seconds, "first_s": compiled}
        row["periods"] = (windows[:, -1] / closed.period).tolist()
        row |= {key: keywords[key] for key in ("dt", "rtol") if key in keywords}
        for key, values in errors.items():
            over = values.reshape(windows.shape).max(axis=1)
            row[key] = {
                "windows": over.tolist(),
                "largest": float(over.max()),
                "end": float(over[-1]),
                "growth": _growth(windows[:, -1], over, LOST if key == "phi" else math.inf),
            }
        rows.append(row)
        print(f"{name}: {seconds:.1f} s, energy {row['energy']['largest']:.1e}, phi {row['phi']['end']:.1e}")
    return rows


def _spherical(scene: jms.Scene, keywords: dict[str, Any], ts: np.ndarray) -> jms.Trajectory:
    return jms.simulate(scene, [PHI0, 0.0], [0.0, SPIN0], ts[-1], ts=ts, max_steps=LIMIT, **keywords)


_START = ([math.sin(ANGLE0), -math.cos(ANGLE0)], [0.0, 0.0])


def _place(q: Any) -> Any:
    return jnp.stack([q[0], 0.0 * q[0], q[1]])


def _length(t: Any, q: Any, p: Any) -> Any:
    del t, p
    return q[0] ** 2 + q[1] ** 2 - 1.0


def _on_circle(stabilise: float) -> jms.Scene:
    return jms.Scene(
        jms.point_mass(1.0, _place, gravity=G), constraints=(jms.Constraint(_length, stabilise=stabilise),)
    )


def constraint_drift(runs: tuple[tuple[str, float, dict[str, Any]], ...], seconds: int) -> list[dict[str, Any]]:
    """The Cartesian pendulum by each treatment of its constraint."""
    times = DT * np.unique(np.round(np.geomspace(2.0, seconds, 1500) / DT))
    times = times[len(times) % 10 :]
    depth = G * (1.0 - math.cos(ANGLE0))
    rows = []
    for treatment, stabilise, keywords in runs:
        run = partial(
            _cartesian, _on_circle(stabilise), {"solver": dfx.Tsit5(), "max_steps": LIMIT, "throw": False} | keywords
        )
        result, taken, compiled = _timed(run, times)
        q, qd = np.asarray(result.q), np.asarray(result.qd)
        energy = np.abs((0.5 * np.sum(qd**2, axis=1) + G * (q[:, 1] + 1.0)) / depth - 1.0)
        solver = type(keywords.get("solver", dfx.Tsit5())).__name__ + ("(3)" if "solver" in keywords else "")
        row = {
            "solver": solver,
            "treatment": treatment,
            "steps": int(result.stats["num_steps"]),
            "run_s": taken,
            "first_s": compiled,
            "position": float(np.max(np.abs(np.sum(q**2, axis=1) - 1.0))),
            "velocity": float(np.max(np.abs(np.sum(q * qd, axis=1)))),
            "energy": float(energy.max()),
            "growth": _growth(times[9::10], energy.reshape(-1, 10).max(axis=1)),
            "ok": bool(result.result.ok),
            "message": result.result.message,
        }
        row |= {key: keywords[key] for key in ("dt", "rtol") if key in keywords}
        rows.append(row)
        print(f"{solver}, {treatment}: {taken:.1f} s, position {row['position']:.1e}, energy {row['energy']:.1e}")
    return rows


def _cartesian(scene: jms.Scene, keywords: dict[str, Any], ts: np.ndarray) -> jms.Trajectory:
    return jms.simulate(scene, *_START, ts[-1], ts=ts, **keywords)


def orders(run: Any, reference: np.ndarray, stages: tuple[int, ...]) -> dict[str, dict[str, Any]]:
    """Errors of `Gauss` at the end for each step, and the orders observed from step to step."""
    found = {}
    for count in stages:
        errors = [float(np.max(np.abs(run(solver=jms.Gauss(count), dt=dt) - reference))) for dt in ORDER_STEPS[count]]
        found[str(count)] = {
            "steps": ORDER_STEPS[count],
            "errors": errors,
            "orders": [math.log2(before / after) for before, after in itertools.pairwise(errors)],
        }
    return found


def _push(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del q, qd, p
    return jnp.stack([0.5 * jnp.sin(3.0 * t), 0.2 * jnp.cos(2.0 * t)])


def _turn(q: Any) -> Any:
    return q[1]


def _driven(**keywords: Any) -> np.ndarray:
    """End of the spherical pendulum under a force that turns with time, and viscous friction about the axis."""
    free = spherical_pendulum(m=1.0, R=1.0, g=G)
    effects = (jms.AppliedForce(_push), jms.Friction(jms.Viscous(0.05), along=_turn))
    scene = jms.Scene(free.lagrangian, params=free.params, effects=effects)
    run = jms.simulate(scene, [PHI0, 0.0], [0.0, SPIN0], ORDER_T1, **keywords)
    return np.concatenate([run.q[-1], run.qd[-1]])


def _driven_reference() -> np.ndarray:
    return _driven(solver=dfx.Dopri8(), rtol=1e-13, atol=1e-14)


def _hung(**keywords: Any) -> np.ndarray:
    """End of the Cartesian pendulum."""
    run = jms.simulate(_on_circle(0.0), *_START, ORDER_T1, **keywords)
    return np.concatenate([run.q[-1], run.qd[-1]])


def _swing(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, p
    return 0.5 * qd[0] ** 2 + G * jnp.cos(q[0])


def _hung_reference() -> np.ndarray:
    """The same in the angle, without a constraint."""
    scene = jms.Scene(_swing)
    run = jms.simulate(scene, [ANGLE0], [0.0], ORDER_T1, solver=dfx.Dopri8(), rtol=1e-13, atol=1e-14)
    (a,), (w,) = np.asarray(run.q[-1]), np.asarray(run.qd[-1])
    return np.array([math.sin(a), -math.cos(a), w * math.cos(a), w * math.sin(a)])


def _setting(row: dict[str, Any]) -> str:
    return f"dt 1/{1.0 / row['dt']:.0f} s" if "dt" in row else f"rtol {row['rtol']:.0e}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{round(value, 2) + 0.0:.2f}"


def _long_table(content: dict[str, Any]) -> dict[str, Any]:
    rows = [
        [
            row["solver"].split(",")[0],
            _setting(row),
            f"{row['steps']:,}".replace(",", " "),
            f"{row['run_s']:.1f}",
            f"{1e6 * row['run_s'] / row['steps']:.1f}",
            f"{row['energy']['largest']:.0e}",
            f"{row['energy']['end']:.0e}",
            _number(row["energy"]["growth"]),
            f"{row['momentum']['largest']:.0e}",
            f"{row['phi']['end']:.0e}",
            _number(row["phi"]["growth"]),
        ]
        for row in content["long_runs"]
    ]
    columns = ["solver", "dt or rtol", "steps", "run [s]", "step [us]", "energy, largest error", "at the end", "growth"]
    columns += ["momentum, largest error", "phi at the end, error [rad]", "growth"]
    periods = content["long_runs"][0]["periods"][-1]
    caption = (
        f"Spherical pendulum, {periods:.0f} periods of {content['problem']['period_s']:.2f} s: relative errors of the"
        " energy and of the angular momentum about the vertical, error of the angle phi against its closed form."
        f" Growth: exponent of time over the last two decades, where the angle is not lost (swing"
        f" {content['problem']['swing']:.2f} rad). One run each."
        f" {machine_line(content['machine'])}"
    )
    return {"columns": columns, "rows": rows, "caption": caption}


def _constraint_table(content: dict[str, Any]) -> dict[str, Any]:
    rows = [
        [
            row["solver"],
            _setting(row),
            row["treatment"],
            f"{row['steps']:,}".replace(",", " "),
            f"{row['run_s']:.2f}",
            f"{row['position']:.0e}",
            f"{row['velocity']:.0e}",
            f"{row['energy']:.0e}",
            _number(row["growth"]),
            "yes" if row["ok"] else "no",
        ]
        for row in content["constraint_drift"]
    ]
    columns = ["solver", "dt or rtol", "constraint", "steps", "run [s]", "x^2 + z^2 - l^2, largest [m^2]"]
    columns += ["x x' + z z', largest [m^2/s]", "energy, largest error", "growth", "accepted"]
    caption = (
        f"Pendulum of 1 m in Cartesian coordinates, let go at {ANGLE0:g} rad, {content['seconds']} s."
        " With project=True states are projected after every step and where they are kept, else nowhere; growth as"
        " above. Accepted: whether the run was reported as a success. One run each."
        f" {machine_line(content['machine'])}"
    )
    return {"columns": columns, "rows": rows, "caption": caption}


def _order_table(content: dict[str, Any]) -> dict[str, Any]:
    stages = list(next(iter(content["orders"].values())))
    rows = [
        [name, *(f"{found[count]['orders'][-1]:.2f}" for count in stages)] for name, found in content["orders"].items()
    ]
    caption = (
        f"Observed orders of Gauss, from the errors of q and qd at {ORDER_T1:g} s at the last halving of the step, to"
        f" {', '.join(f'1/{1 / ORDER_STEPS[int(count)][-1]:.0f}' for count in stages)} s: spherical pendulum driven and"
        f" damped, and the Cartesian pendulum. {machine_line(content['machine'])}"
    )
    return {"columns": ["Gauss", *(f"{count} stage{'s' * (count != '1')}" for count in stages)], "rows": rows} | {
        "caption": caption
    }


def _target_table(content: dict[str, Any]) -> dict[str, Any]:
    rows = []

    def add(what: str, target: str, measured: str, met: bool) -> None:
        rows.append([what, target, measured, "yes" if met else "no"])

    for row in content["long_runs"]:
        if "dt" in row:
            name, growth = f"{row['solver'].split(',')[0]}, {_setting(row)}", row["energy"]["growth"]
            add(f"growth of the energy error, {name}", "within 0.1 of 0", _number(growth), abs(growth) <= 0.1)
            add(f"error of the momentum, {name}", "< 1e-12", *_below(row["momentum"]["largest"], 1e-12))
    for row in content["constraint_drift"]:
        if row["treatment"] == "projected":
            name = f"{row['solver']}, {_setting(row)}"
            add(f"drift off the constraint in {SECONDS} s, {name} [m^2]", "< 1e-9", *_below(row["position"], 1e-9))
            if "dt" in row:
                growth = row["growth"]
                add(
                    f"growth of the energy error, {name}, projected",
                    "within 0.1 of 0",
                    _number(growth),
                    abs(growth) <= 0.1,
                )
    for case, found in content["orders"].items():
        for count, one in found.items():
            order, wanted = one["orders"][-1], 2 * int(count)
            add(f"order, Gauss({count}) {case}", f"{wanted} within 0.2", _number(order), abs(order - wanted) <= 0.2)
    caption = f"Targets. {machine_line(content['machine'])}"
    return {"columns": ["quantity", "target", "measured", "met"], "rows": rows, "caption": caption}


def _below(value: float, limit: float) -> tuple[str, bool]:
    return f"{value:.0e}", value < limit


def _spread(places: np.ndarray, gap: float, top: float) -> np.ndarray:
    """Places moved apart to at least `gap`, in their order, none above `top`."""
    order = np.argsort(places)
    moved = places[order].copy()
    for _ in range(500):
        for i in range(len(moved) - 1):
            lack = gap - (moved[i + 1] - moved[i])
            if lack > 0:
                moved[i] -= 0.5 * lack
                moved[i + 1] += 0.5 * lack
        moved[-1] = min(moved[-1], top)
    result = np.empty_like(moved)
    result[order] = moved
    return result


def draw(content: dict[str, Any], path: Path) -> None:
    """Errors of the energy and of the angle over periods, one line for each solver, named at its end."""
    figure, axes = plt.subplots(1, 2, figsize=(13.0, 5.4), layout="constrained")
    rows = content["long_runs"]
    gauss, others = [row for row in rows if "dt" in row], [row for row in rows if "dt" not in row]
    colors = {row["solver"]: mpl.colormaps["Blues"](0.55 + 0.14 * i) for i, row in enumerate(gauss)}
    colors |= {row["solver"]: mpl.colormaps["YlOrRd"](0.92 - 0.1 * i) for i, row in enumerate(others)}
    for panel, key in zip(axes, ("energy", "phi"), strict=True):
        ends = np.array([row[key]["windows"][-1] for row in rows])
        for row in rows:
            panel.loglog(
                row["periods"],
                row[key]["windows"],
                "-" if "dt" in row else "--",
                color=colors[row["solver"]],
                lw=2.0 if "dt" in row else 1.4,
            )
        low, high = panel.get_ylim()
        gap = 0.045 * math.log10(high / low)
        for row, place in zip(rows, 10.0 ** _spread(np.log10(ends), gap, math.log10(high)), strict=True):
            panel.annotate(
                f"{row['solver'].split(',')[0]}, {_setting(row)}",
                (row["periods"][-1], place),
                xytext=(6.0, 0.0),
                textcoords="offset points",
                va="center",
                fontsize=9.0,
                color=colors[row["solver"]],
                annotation_clip=False,
            )
        panel.set_xlabel(f"time [periods of {content['problem']['period_s']:.2f} s]")
        panel.grid(which="major", alpha=0.25)
        panel.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("relative error of the energy, largest in a period")
    axes[1].set_ylabel("error of the angle phi [rad], largest in a period")
    axes[0].set_title("Energy: no drift with Gauss (solid), linear with the others", loc="left")
    axes[1].set_title("Angle: linear in time with Gauss, quadratic with the others", loc="left")
    write_figure(figure, path)


if __name__ == "__main__":
    main()
