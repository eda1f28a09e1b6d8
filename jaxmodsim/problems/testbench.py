"""The test bench: a box on a table under a rising force, with several friction models."""

import time
from dataclasses import dataclass

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

from ..friction import AbstractLaw, DeadZone, Regularized, Sign
from ..metrics import break_away
from ..simulation import Trajectory, simulate
from . import ramped_box

T1 = 10.0
MASS = 2.0
FIXED_STEP = 0.01
REGULARISED_WIDTH = 1e-3
# In stick friction equals the applied force. Break-away is the last time with a difference below this value [N].
BREAK_AWAY_GAP = 0.05
# Time span of the measured oscillation in stick, after the transient and well before break-away [s].
STICK_SPAN = (0.2, 1.2)
SIGMA0 = (75.0, 750.0, 7500.0, 75000.0)
SIGMA1 = (0.0, 5.0, 20.0, 80.0)


@dataclass(frozen=True)
class RampCase:
    """One run of the bench.

    - `part`: part of the exercise, a to e.
    - `label`: description in tables and figures.
    - `law`: friction law.
    - `ramp`: rise of the applied force [N/s].
    - `v0`: initial velocity [m/s].
    - `dt`: fixed step [s], or None for adaptive steps.
    - `solver`: None for the scene's default.
    """

    part: str
    label: str
    law: AbstractLaw
    ramp: float = 1.0
    v0: float = 0.0
    dt: float | None = None
    solver: dfx.AbstractSolver | None = None


@dataclass(frozen=True)
class RampRun:
    """Series of a run of the ramped box.

    - `label`: description in tables and figures.
    - `t`: times [s].
    - `velocity`: velocity of the box [m/s].
    - `applied`, `friction`: forces [N].
    - `note`: a sentence for the figure, such as the reason of an early end.
    """

    label: str
    t: np.ndarray
    velocity: np.ndarray
    applied: np.ndarray
    friction: np.ndarray
    note: str = ""


@dataclass(frozen=True)
class RampResult:
    """A case with its run, and the numbers of its row in the table."""

    case: RampCase
    run: RampRun
    break_away: float
    crossings: int
    steps: int
    milliseconds: float
    ok: bool
    ending: str


def ramp_cases() -> list[RampCase]:
    """The runs of parts a to e of the exercise; b and d both event-driven and regularised.

    **Returns:**

    The cases in the order of the exercise.
    """
    coulomb, stribeck = ramped_box.coulomb(), ramped_box.stribeck()
    return [
        RampCase("a", "sign, 1 N/s, adaptive", Sign(coulomb)),
        RampCase("a", "sign, 1 N/s, Euler 10 ms", Sign(coulomb), dt=FIXED_STEP, solver=dfx.Euler()),
        RampCase("a", "sign, 3 N/s, Euler 10 ms", Sign(coulomb), ramp=3.0, dt=FIXED_STEP, solver=dfx.Euler()),
        RampCase("b", "Coulomb, exact", coulomb),
        RampCase("b", "Coulomb, regularised 1 mm/s", Regularized(coulomb, REGULARISED_WIDTH)),
        RampCase("c", "dead zone 1 m/s, v0 = 0", DeadZone(coulomb, 1.0), dt=FIXED_STEP),
        RampCase("c", "dead zone 1 m/s, v0 = -2 m/s", DeadZone(coulomb, 1.0), v0=-2.0, dt=FIXED_STEP),
        RampCase(
            "c",
            "dead zone 0.1 mm/s, v0 = -1 m/s",
            DeadZone(coulomb, 1e-4),
            v0=-1.0,
            dt=FIXED_STEP,
            solver=dfx.Euler(),
        ),
        RampCase("d", "Stribeck, exact", stribeck),
        RampCase("d", "Stribeck, regularised 1 mm/s", Regularized(stribeck, REGULARISED_WIDTH)),
        RampCase("e", "LuGre, sigma0 750, sigma1 0", ramped_box.lugre()),
        RampCase("e", "LuGre, sigma0 7500, sigma1 80", ramped_box.lugre(sigma0=7500.0, sigma1=80.0)),
    ]


def run_ramp(case: RampCase) -> RampResult:
    """Run a case and compute its numbers; the second, warm run is timed.

    **Returns:**

    A `RampResult`; a run that ends early is a result, too.
    """
    scene = ramped_box.scene(case.law, ramp=case.ramp, m=MASS)
    # The saved times contain every fixed step, which reveals chattering.
    ts = jnp.linspace(0.0, T1, 1001)

    def go() -> Trajectory:
        return simulate(scene, [0.0], [case.v0], T1, ts=ts, dt=case.dt, solver=case.solver, max_steps=4096, throw=False)

    go()
    started = time.perf_counter()
    run = jax.block_until_ready(go())
    elapsed = 1e3 * (time.perf_counter() - started)
    reached = np.isfinite(np.asarray(run.t))
    t, v = np.asarray(run.t)[reached], np.asarray(run.qd)[reached, 0]
    forces = {name: np.asarray(force)[reached] for name, force in run.forces.items()}
    ok = bool(run.result.ok)
    note = "" if ok else f"{int(run.stats['num_steps'])} steps used up at t = {1e3 * float(run.t_end):.3g} ms"
    drawn = RampRun(case.label, t, v, forces["pull"][:, 0], forces["friction"], note)
    return RampResult(
        case,
        drawn,
        _break_away(run, drawn) if ok and not isinstance(case.law, Sign) else float("nan"),
        int(np.sum(v[1:] * v[:-1] < 0)),
        int(run.stats["num_steps"]),
        elapsed,
        ok,
        "reached t1" if ok else f"stopped at {1e3 * float(run.t_end):.2g} ms",
    )


def _break_away(result: Trajectory, run: RampRun) -> float:
    """Time of the break-away event, or the last time at which friction equals the applied force; NaN without one."""
    if result.mode:
        return float(break_away()(result))
    stuck = np.flatnonzero(np.abs(run.applied - run.friction) <= BREAK_AWAY_GAP)
    if stuck.size < 2 or stuck[-1] + 1 >= run.t.size:
        return float("nan")
    return float(run.t[stuck[-1]])


def _oscillation(t: np.ndarray, gap: np.ndarray, sigma0: float) -> np.ndarray:
    """Amplitude of `gap` [N] about a parabola, at the natural frequency sqrt(sigma0/m) of the bristle, in stick."""
    inside = (t >= STICK_SPAN[0]) & (t <= STICK_SPAN[1])
    phase = np.sqrt(sigma0 / MASS) * t[inside]
    basis = np.column_stack([np.vander(t[inside], 3), np.cos(phase), np.sin(phase)])
    weights = np.linalg.lstsq(basis, gap[:, inside].T, rcond=None)[0]
    return np.hypot(weights[3], weights[4])


def stick_sweep() -> dict[str, np.ndarray]:
    """Run LuGre friction over a grid of sigma0 and sigma1, in one vmap.

    **Returns:**

    `t` [s]; `sigma0` [N/m], `sigma1` [N s/m]; `oscillation` [N]: amplitude of friction about the applied force in
    stick; `creep` [m]: displacement at 1.5 s; `speed10` [m/s]: velocity at the end; `steps`; each of
    shape `[sigma0, sigma1]`; and `gap` [N], friction less applied force, `[sigma0, sigma1, time]`.

    **Raises:**

    - `RuntimeError` if a run ends early.
    """
    ts = jnp.linspace(0.0, T1, 2001)

    def one(sigma0: jax.Array, sigma1: jax.Array) -> tuple[jax.Array, ...]:
        scene = ramped_box.scene(ramped_box.lugre(sigma0=sigma0, sigma1=sigma1), m=MASS)
        run = simulate(scene, [0.0], [0.0], T1, ts=ts, rtol=1e-8, atol=1e-11, max_steps=65536, throw=False)
        gap = run.forces["friction"] - run.forces["pull"][:, 0]
        return run.q[300, 0], run.qd[-1, 0], run.stats["num_steps"], gap, run.result.ok

    grid = jax.jit(jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None)))
    results = grid(jnp.asarray(SIGMA0), jnp.asarray(SIGMA1))
    creep, speed, steps, gap, ok = (np.asarray(x) for x in results)
    if not ok.all():
        raise RuntimeError("A run of the LuGre sweep ended early.")
    return {
        "t": np.asarray(ts),
        "sigma0": np.asarray(SIGMA0),
        "sigma1": np.asarray(SIGMA1),
        "oscillation": np.stack([_oscillation(np.asarray(ts), row, s0) for row, s0 in zip(gap, SIGMA0, strict=True)]),
        "creep": creep,
        "speed10": speed,
        "steps": steps,
        "gap": gap,
    }
