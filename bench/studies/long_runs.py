"""Long runs: energy, momentum and motion over 100 000 periods.

The problem is a spherical pendulum, regular and away from the poles, by fixed steps of `Gauss` with momenta and by
adaptive solvers with velocities. Energy is relative to the lowest point of the sphere. The angle phi has a closed form,
a Jacobi elliptic function. Errors are the largest over windows of one period. Their growth is the slope of their
logarithm over that of time in the last two decades: 0 for bounded errors, 1 for linear drift. It is omitted for angle
errors above 0.1 rad. Times are those of one run each, after compilation.
"""

import itertools
import math
import time
from pathlib import Path
from typing import Any

import diffrax as dfx
import jax
import numpy as np
from scipy.special import ellipj, ellipk

import jaxmodsim as jms
from bench.record import Result
from jaxmodsim.problems import spherical_pendulum

G, PHI0, SPIN0 = 9.81, 2.0, 2.0
PERIODS, LIMIT = 100_000, 1_000_000_000
# Steps are powers of two, so that times are exact; a window is slightly longer than one period.
DT, SAMPLES = 1.0 / 32.0, 36
# Angle errors [rad] above this value have no growth; the range of the angle is 0.65.
LOST = 0.1
LONG: dict[str, dict[str, Any]] = {
    "Gauss(1), dt 1/32 s": {"solver": jms.Gauss(1), "dt": DT},
    "Gauss(2), dt 1/32 s": {"solver": jms.Gauss(2), "dt": DT},
    "Gauss(3), dt 1/32 s": {"solver": jms.Gauss(3), "dt": DT},
    "Gauss(3), dt 1/64 s": {"solver": jms.Gauss(3), "dt": DT / 2},
    "Rodas5P, rtol 1e-06": {"solver": jms.Rodas5P(), "rtol": 1e-6, "atol": 1e-9},
    "Tsit5, rtol 1e-06": {"solver": dfx.Tsit5(), "rtol": 1e-6, "atol": 1e-9},
    "Tsit5, rtol 1e-09": {"solver": dfx.Tsit5(), "rtol": 1e-9, "atol": 1e-12},
    "Dopri8, rtol 1e-09": {"solver": dfx.Dopri8(), "rtol": 1e-9, "atol": 1e-12},
    "Dopri8, rtol 1e-12": {"solver": dfx.Dopri8(), "rtol": 1e-12, "atol": 1e-15},
}


def main(smoke: bool, out: Path) -> Result:
    """Run all solvers; a smoke run has one."""
    del out
    closed, periods = Closed(), 300 if smoke else PERIODS
    result = Result("long_runs", ("diffrax", "scipy", "numpy"), {"period": closed.period, "periods": periods})
    result.settings["swing"] = math.acos(closed.lower) - PHI0
    scene, windows = spherical_pendulum.scene(m=1.0, R=1.0, g=G), _windows(periods, closed.period)
    times = windows.ravel()
    for name, how in list(LONG.items())[: 1 if smoke else None]:

        def simulate(ts: np.ndarray, how: dict[str, Any] = how) -> jms.Trajectory:
            return jms.simulate(scene, [PHI0, 0.0], [0.0, SPIN0], ts[-1], ts=ts, max_steps=LIMIT, **how)

        jax.block_until_ready(simulate(times * (1.0 / 1024.0)).q)  # compiles
        start = time.perf_counter()
        run = simulate(times)
        jax.block_until_ready(run.q)
        seconds = time.perf_counter() - start
        (phi, _), (phi_rate, theta_rate) = np.asarray(run.q).T, np.asarray(run.qd).T
        momentum = np.sin(phi) ** 2 * theta_rate
        energy = 0.5 * phi_rate**2 + 0.5 * np.sin(phi) ** 2 * theta_rate**2 + G * np.cos(phi)
        errors = {
            "energy": np.abs(energy - closed.energy) / (closed.energy + G),
            "momentum": np.abs(momentum / closed.momentum - 1.0),
            "phi": np.abs(phi - closed.phi(times)),
        }
        about: dict[str, Any] = {"case": "spherical pendulum", "peer": name}
        result.add("steps", int(run.stats["num_steps"]), **about)
        result.add("run", seconds, "s", **about)
        for quantity, values in errors.items():
            over, unit = values.reshape(windows.shape).max(axis=1), "rad" if quantity == "phi" else "1"
            result.add(f"error of {quantity}, largest", float(over.max()), unit, **about)
            result.add(f"error of {quantity}, at the end", float(over[-1]), unit, **about)
            growth = _growth(windows[:, -1], over, LOST if quantity == "phi" else math.inf)
            result.add(f"growth of the error of {quantity}", growth, **about)
            if quantity != "momentum":
                for end, value in zip(windows[:, -1] / closed.period, over, strict=True):
                    result.add(f"error of {quantity}", float(value), unit, **about, at=float(end))
        print(f"{name}: {seconds:.1f} s")
    return result


class Closed:
    """Closed form of the spherical pendulum from a turning point of phi, with unit mass and radius.

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


def _windows(periods: int, period: float) -> np.ndarray:
    """Saved times, shape `[windows, SAMPLES]`: windows of a period, evenly spaced in the logarithm of time."""
    last = int(periods * period / DT) - SAMPLES
    starts = np.unique(np.geomspace(period / DT, last, 36).astype(int))
    kept = [starts[0]]
    kept += [start for before, start in itertools.pairwise(starts) if start - before >= SAMPLES]
    return DT * (np.array(kept)[:, None] + np.arange(SAMPLES)[None, :])


def _growth(t: np.ndarray, error: np.ndarray, lost: float = math.inf) -> float | None:
    """Slope of log error over log t in the last two decades; None if most errors there exceed `lost`."""
    late = t >= 0.01 * t[-1]
    use = late & (error > 0) & (np.maximum.accumulate(error) < lost)
    return float(np.polyfit(np.log(t[use]), np.log(error[use]), 1)[0]) if 2 * use.sum() > late.sum() else None
