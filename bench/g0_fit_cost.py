"""What a fit costs: the EMPS record, one model, against least squares with finite differences.

(a) over the same simulation written by hand in numba, (b) over `scipy.integrate.solve_ivp`, step by step, on a tenth
of the record; and many starts of a LuGre fit side by side. One process, the same model (Coulomb, regularised with the
same width, and viscous friction, mass and offset), the same steps (one linearly implicit step of RODAS3 for each
sample), the same start, bounds and tolerance. Record: A. Janot, M. Gautier, M. Brunot, "Data set and reference models
of EMPS", Workshop on Nonlinear System Identification Benchmarks, 2019; it lies beside the repository and not in it.
"""

import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _measure import machine_line
from _options import begin
from _report import new_result, write_result
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import jaxmodsim as jms
from jaxmodsim.identify import AXIS_MODELS, MultiStart, axis_scene, replay, rough_axis

RECORD = Path(__file__).parents[2] / "shared" / "data" / "emps" / "train.csv"
DRIVE_GAIN = 35.15065188248547
FREE = AXIS_MODELS["coulomb"].free
RTOL = 1e-6
NAMES = ("sigma0", "sigma1", "sigma2", "Fc", "Fs", "vs")


def main() -> None:
    """Measure, and write `fit_cost.json`."""
    options = begin("Cost of fits.", smoke="a short record, few starts, into a temporary folder", record=RECORD)
    rows: list[list[str]] = []
    content = new_result("fit_cost", options, "scipy", "numba")
    if options.record.exists():
        content |= axis_costs(options.record, options.smoke, rows)
    else:
        print(f"without the measured axis: there is no record at {options.record}")
    content |= many_starts(8 if options.smoke else 256, rows)
    caption = (
        "Four numbers of the EMPS axis by open-loop simulation, and 256 starts of LuGre's six on 2 000 samples; one"
        " process. An evaluation of ours is a run with all derivatives, of the others a run."
        f" {machine_line(content['machine'])}"
    )
    columns = ["fit", "cold [s]", "warm [s]", "evaluations", "RMSE"]
    content["tables"] = [{"columns": columns, "rows": rows, "caption": caption}]
    write_result(content, options)


def timed(work: Any) -> tuple[Any, float]:
    """Result and seconds."""
    started = time.perf_counter()
    result = work()
    return result, time.perf_counter() - started


def axis_costs(path: Path, smoke: bool, rows: list[list[str]]) -> dict[str, Any]:
    """The axis, by the three ways."""
    t, q, _, u = np.loadtxt(path, delimiter=",", skiprows=1).T
    if smoke:
        t, q, u = t[:2000], q[:2000], u[:2000]
    force = DRIVE_GAIN * u
    record = jms.Record(t, q, {"u": force}, name="EMPS")
    rough = rough_axis(record)
    scene = axis_scene(AXIS_MODELS["coulomb"], rough)
    width = float(scene.effects[1].law.width)  # pyright: ignore[reportAttributeAccessIssue]
    start = np.array([rough.m, rough.offset, rough.Fc, rough.Fv])

    def ours(record: jms.Record) -> Any:
        return jms.fit(scene, record, FREE, limits={"m": (0.0, None)}, rtol=RTOL)

    found, cold = timed(lambda: ours(record))
    warm = float(np.median([timed(lambda: ours(record))[1] for _ in range(3)]))
    rows.append(
        ["jaxmodsim", f"{cold:.1f}", f"{warm:.2f}", f"{found.diagnostics.evaluations}", f"{1e3 * found.rmse:.3f} mm"]
    )

    run = numba_axis(width)
    by_hand, cold_hand = timed(lambda: differences(lambda p: run(t, force, q[0], *p) - q, start))
    warm_hand = float(
        np.median([timed(lambda: differences(lambda p: run(t, force, q[0], *p) - q, start))[1] for _ in range(3)])
    )
    runs = by_hand.nfev + by_hand.njev * start.size
    rmse = float(np.sqrt(2 * by_hand.cost / t.size))
    rows.append(["numba + least_squares", f"{cold_hand:.1f}", f"{warm_hand:.2f}", f"{runs}", f"{1e3 * rmse:.3f} mm"])

    tenth = slice(0, max(t.size // 10, 500))
    part = jms.Record(t[tenth], q[tenth], {"u": force[tenth]}, name="a tenth")
    ours(part)
    short, warm_short = timed(lambda: ours(part))
    sample = solved(t[tenth][:200] if smoke else t[tenth], force[tenth], q[0], width)
    measured = q[tenth][:200] if smoke else q[tenth]
    limit = 1 if smoke else None
    scipy_fit, slow = timed(lambda: differences(lambda p: sample(*p) - measured, start, limit))
    rows.append(
        [
            "jaxmodsim, a tenth",
            "",
            f"{warm_short:.3f}",
            f"{short.diagnostics.evaluations}",
            f"{1e3 * short.rmse:.3f} mm",
        ]
    )
    calls = scipy_fit.nfev + scipy_fit.njev * start.size
    rmse_slow = float(np.sqrt(2 * scipy_fit.cost / measured.size))
    rows.append(["solve_ivp + least_squares, a tenth", "", f"{slow:.1f}", f"{calls}", f"{1e3 * rmse_slow:.3f} mm"])
    print(f"warm, numba over ours: {warm_hand / warm:.2f}; a tenth, solve_ivp over ours: {slow / warm_short:.0f}")
    return {"numba_over_ours": warm_hand / warm, "solve_ivp_over_ours": slow / warm_short}


def differences(residual: Any, start: np.ndarray, most: int | None = None) -> Any:
    """Least squares with bounds and two-point differences."""
    scale = np.maximum(np.abs(start), 1.0)
    bounds = ([0.0, -np.inf, 0.0, 0.0], np.inf)
    return least_squares(residual, start, bounds=bounds, x_scale=scale, ftol=0.1 * RTOL, max_nfev=most)


def numba_axis(width: float) -> Any:
    """The axis by one RODAS3 step for each sample, written out; the Jacobian has one entry that is not constant."""
    import numba

    @numba.njit(fastmath=True)
    def run(t: Any, u: Any, q0: float, m: float, offset: float, Fc: float, Fv: float) -> Any:
        n = t.size
        out = np.empty(n)
        x, v = q0, 0.0
        out[0] = x
        for k in range(n - 1):
            h = t[k + 1] - t[k]
            shift = 2.0 / h
            s = np.tanh(v / width)
            slope = -(Fc * (1 - s * s) / width + Fv) / m
            drive = (u[k] - offset) / m
            det = shift - slope
            a = drive - (Fc * s + Fv * v) / m
            # k_i solves (shift - J) k = f + c/h; J = [[0, 1], [0, slope]].
            v1 = a / det
            x1 = (v + v1) / shift
            v2 = (a + 4 * v1 / h) / det
            x2 = (v + 4 * x1 / h + v2) / shift
            w = v + 2 * v1
            s = np.tanh(w / width)
            a = drive - (Fc * s + Fv * w) / m
            v3 = (a + (v1 - v2) / h) / det
            x3 = (w + (x1 - x2) / h + v3) / shift
            w = v + 2 * v1 + v3
            s = np.tanh(w / width)
            a = drive - (Fc * s + Fv * w) / m
            v4 = (a + (v1 - v2 - 8 / 3 * v3) / h) / det
            x4 = (w + (x1 - x2 - 8 / 3 * x3) / h + v4) / shift
            x += 2 * x1 + x3 + x4
            v += 2 * v1 + v3 + v4
            out[k + 1] = x
        return out

    return run


def solved(t: np.ndarray, u: np.ndarray, q0: float, width: float) -> Any:
    """The axis by `solve_ivp` (LSODA), restarted at every sample because the input jumps there."""

    def run(m: float, offset: float, Fc: float, Fv: float) -> np.ndarray:
        y, out = np.array([q0, 0.0]), np.empty(t.size)
        out[0] = q0
        for k in range(t.size - 1):
            drive = u[k] - offset

            def field(_: float, y: np.ndarray, drive: float = drive) -> list[float]:
                return [y[1], (drive - Fc * np.tanh(y[1] / width) - Fv * y[1]) / m]

            y = solve_ivp(field, (t[k], t[k + 1]), y, method="LSODA", rtol=1e-6, atol=1e-9).y[:, -1]
            out[k + 1] = y[0]
        return out

    return run


def _lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


def _drive(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return jnp.reshape(p["u"], (1,))


DRIVE = jms.AppliedForce(_drive)


def sprung(sigma0: float, sigma1: float, sigma2: float, Fc: float, Fs: float, vs: float) -> jms.Scene:
    """A mass on a spring with LuGre friction."""
    friction = jms.Friction(jms.LuGre(sigma0, sigma1, sigma2, Fc, Fs, vs))
    return jms.Scene(_lagrangian, params={"m": 1.0, "k": 200.0, "u": 0.0}, effects=(DRIVE, friction))


def many_starts(count: int, rows: list[list[str]]) -> dict[str, Any]:
    """Starts of LuGre's six parameters, each wrong by up to a factor of ten, on 2 000 samples."""
    t = np.arange(2000) * 2e-3
    u = 3 * np.sin(2 * np.pi * 0.7 * t) + 2 * np.sin(2 * np.pi * 1.9 * t) + 1.2 * np.sin(2 * np.pi * 0.31 * t)
    zero = jnp.zeros(1)
    truth = sprung(1e4, 40.0, 2.0, 1.0, 1.5, 0.02)
    q = jax.jit(replay, static_argnums=(5, 6))(truth, jnp.asarray(t), {"u": jnp.asarray(u)}, zero, zero)
    noise = 1e-5
    record = jms.Record(t, np.asarray(q) + noise * np.random.default_rng(0).standard_normal(t.size), {"u": u})
    start = sprung(1e5, 4.0, 0.2, 0.3, 2.0, 0.1)
    free = tuple(f"friction.{name}" for name in NAMES)

    def search() -> Any:
        return jms.fit(start, record, free, initializer=MultiStart(count), q0=[0.0])

    found, cold = timed(search)
    _, warm = timed(search)
    reached = int(np.sum(np.array(found.starts) < 1.01 * found.starts[0]))
    rows.append(
        [
            f"LuGre, {count} starts",
            f"{cold:.1f}",
            f"{warm:.1f}",
            f"{reached} reach the best",
            f"{1e6 * found.rmse:.2f} um",
        ]
    )
    return {"starts": count, "starts_cold": cold, "starts_warm": warm, "starts_at_the_best": reached}


if __name__ == "__main__":
    main()
