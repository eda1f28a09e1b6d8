"""The LuGre testbench, and the solvers that run it: each with the settings a careful user would choose.

A box of 2 kg on a table, pulled by the force `1 N/s * t` for 10 s from rest, with LuGre friction; state
(x [m], v [m/s], z [m]). `jaxmodsim` gets the scene; the others get the vector field written by hand, which is the
better bargain for them, and no check of parameters or outcome.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi
import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jaxmodsim as jms
from jaxmodsim.problems import box_lugre, ramped_box

PARAMETERS = ("sigma0", "sigma1", "sigma2", "Fc", "Fs", "vs")
NOMINAL = np.array([750.0, 0.0, 0.1, 1.5, 1.75, 0.2])
MASS, T1 = 2.0, 10.0
TIMES = np.linspace(0.0, T1, 101)
# Absolute tolerance for a relative one: positions of interest reach 2 mm (z) to 50 m (x).
ATOL = 1e-3
MAX_STEPS = 1_000_000


@dataclass(frozen=True)
class Peer:
    """One way of running the testbench.

    - `once`: `once(rtol)` returns a function without arguments that makes one run and waits for the end state.
    - `record`: `record(rtol)` returns the states at `TIMES`, shape `[101, 3]`, and the number of steps.
    - `many`: `many(rtol, sets)` returns a function that runs every row of `sets` and waits; None where there is none.
    - `velocity`: `velocity(p, rtol, adjoint)`, the end velocity as a JAX function; None outside JAX.
    - `serial`: whether `many` is a plain loop.
    """

    name: str
    once: Callable[[float], Callable[[], Any]]
    record: Callable[[float], tuple[np.ndarray, int]]
    many: Callable[[float, np.ndarray], Callable[[], Any]]
    velocity: Callable[..., Any] | None = None
    serial: bool = False


def parameter_sets(count: int) -> np.ndarray:
    """Sets of the six parameters, within 20 % of the nominal ones, `sigma1` from 0 to 10 N s/m; always the same."""
    rng = np.random.default_rng(20240229)
    sets = NOMINAL * (1.0 + 0.2 * rng.uniform(-1.0, 1.0, (count, 6)))
    sets[:, 1] = rng.uniform(0.0, 10.0, count)
    sets[:, 4] = np.maximum(sets[:, 4], 1.02 * sets[:, 3])
    return sets


def peers() -> list[Peer]:
    """All solvers under test."""
    return [
        _jaxmodsim(),
        _diffrax("diffrax Kvaerno5", dfx.Kvaerno5(), stacked=True),
        _diffrax("diffrax Tsit5", dfx.Tsit5(), stacked=False),
        _cvodes(),
        _lsoda(),
    ]


def _jaxmodsim() -> Peer:
    scene = ramped_box(box_lugre())

    def once(rtol: float) -> Callable[[], Any]:
        return lambda: jms.simulate(scene, [0.0], [0.0], T1, rtol=rtol, atol=ATOL * rtol).qd.block_until_ready()

    def record(rtol: float) -> tuple[np.ndarray, int]:
        run = jms.simulate(scene, [0.0], [0.0], T1, ts=TIMES, rtol=rtol, atol=ATOL * rtol)
        states = np.stack([run.q[:, 0], run.qd[:, 0], run.z["friction"]], axis=1)
        return states, int(run.stats["num_steps"])

    def velocity(p: Any, rtol: Any, adjoint: Any = None) -> Any:
        scene = ramped_box(jms.LuGre(*p))
        return jms.simulate(scene, [0.0], [0.0], T1, rtol=rtol, atol=ATOL * rtol, adjoint=adjoint).qd[-1, 0]

    return Peer("jaxmodsim", once, record, _batched(velocity), velocity)


def _batched(velocity: Callable[..., Any]) -> Callable[[float, np.ndarray], Callable[[], Any]]:
    def many(rtol: float, sets: np.ndarray) -> Callable[[], Any]:
        run, given = jax.jit(jax.vmap(lambda p: velocity(p, rtol))), jnp.asarray(sets)
        return lambda: run(given).block_until_ready()

    return many


def lugre_field(t: Any, y: Any, p: Any) -> Any:
    """The vector field by hand, for JAX: a tuple of three scalars."""
    sigma0, sigma1, sigma2, coulomb, stiction, vs = (p[i] for i in range(6))
    _, v, z = y
    ratio = v / vs
    level = coulomb + (stiction - coulomb) * jnp.exp(-ratio * ratio)
    rate = v - sigma0 * jnp.abs(v) / level * z
    return v, (t - (sigma0 * z + sigma1 * rate + sigma2 * v)) / MASS, rate


def diffrax_run(p: Any, rtol: Any, solver: Any, *, ts: Any = None, adjoint: Any = None, stacked: bool = False) -> Any:
    """A run by plain diffrax with its default controller; the state is a tuple of scalars, or one vector."""

    def stacked_field(t: Any, y: Any, p: Any) -> Any:
        return jnp.stack(lugre_field(t, (y[0], y[1], y[2]), p))

    zero = jnp.zeros(())
    return dfx.diffeqsolve(
        dfx.ODETerm(stacked_field if stacked else lugre_field),
        solver,
        0.0,
        T1,
        None,
        jnp.zeros(3) if stacked else (zero, zero, zero),
        args=p,
        saveat=dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=ts),
        stepsize_controller=dfx.PIDController(rtol=rtol, atol=ATOL * rtol),
        adjoint=dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        max_steps=MAX_STEPS,
        throw=False,
    )


def _diffrax(name: str, solver: Any, *, stacked: bool) -> Peer:
    """Plain diffrax; `stacked`: whether one vector beats scalars as the state of one run. In batches scalars win."""
    end = jax.jit(lambda p, rtol: diffrax_run(p, rtol, solver, stacked=stacked).ys)
    full = jax.jit(lambda p, rtol, ts: _full(diffrax_run(p, rtol, solver, ts=ts, stacked=stacked)))

    def once(rtol: float) -> Callable[[], Any]:
        p, tolerance = jnp.asarray(NOMINAL), jnp.asarray(rtol)
        return lambda: jax.block_until_ready(end(p, tolerance))

    def record(rtol: float) -> tuple[np.ndarray, int]:
        states, steps, okay = full(jnp.asarray(NOMINAL), rtol, TIMES)
        if not okay:
            raise RuntimeError(f"the run at rtol = {rtol:g} did not reach its end")
        return np.asarray(states), int(steps)

    def velocity(p: Any, rtol: Any, adjoint: Any = None) -> Any:
        ys = diffrax_run(p, rtol, solver, adjoint=adjoint, stacked=stacked).ys
        return ys[-1, 1] if stacked else ys[1][-1]

    def scalar_velocity(p: Any, rtol: Any) -> Any:
        return diffrax_run(p, rtol, solver).ys[1][-1]

    return Peer(name, once, record, _batched(scalar_velocity), velocity)


def _full(solution: Any) -> tuple[Any, Any, Any]:
    ys = solution.ys
    states = jnp.stack(ys, axis=1) if isinstance(ys, tuple) else ys
    return states, solution.stats["num_steps"], solution.result == dfx.RESULTS.successful


def _cvodes() -> Peer:
    t, p, y = casadi.SX.sym("t"), casadi.SX.sym("p", 6), casadi.SX.sym("y", 3)
    sigma0, sigma1, sigma2, coulomb, stiction, vs = (p[i] for i in range(6))
    v, z = y[1], y[2]
    level = coulomb + (stiction - coulomb) * casadi.exp(-((v / vs) ** 2))
    rate = v - sigma0 * casadi.fabs(v) / level * z
    force = sigma0 * z + sigma1 * rate + sigma2 * v
    dae = {"t": t, "x": y, "p": p, "ode": casadi.vertcat(v, (t - force) / MASS, rate)}

    def integrator(rtol: float, grid: Any) -> Any:
        options = {"reltol": rtol, "abstol": ATOL * rtol, "max_num_steps": MAX_STEPS}
        return casadi.integrator("run", "cvodes", dae, 0.0, grid, options)

    def once(rtol: float) -> Callable[[], Any]:
        run, y0, given = integrator(rtol, T1), casadi.DM.zeros(3), casadi.DM(NOMINAL)
        return lambda: run(x0=y0, p=given)

    def record(rtol: float) -> tuple[np.ndarray, int]:
        run = integrator(rtol, TIMES[1:].tolist())
        states = np.asarray(run(x0=casadi.DM.zeros(3), p=casadi.DM(NOMINAL))["xf"]).T
        return np.vstack([np.zeros(3), states]), int(run.stats()["nsteps"])

    def many(rtol: float, sets: np.ndarray) -> Callable[[], Any]:
        run, y0, given = integrator(rtol, T1), casadi.DM.zeros(3), [casadi.DM(row) for row in sets]
        return lambda: np.array([float(run(x0=y0, p=row)["xf"][1]) for row in given])

    return Peer("CVODES (CasADi)", once, record, many, serial=True)


def scipy_field(t: float, y: np.ndarray, *p: float) -> tuple[float, float, float]:
    """The vector field by hand in plain Python, which for three numbers is faster than in NumPy."""
    sigma0, sigma1, sigma2, coulomb, stiction, vs = p
    _, v, z = y.tolist()
    ratio = v / vs
    rate = v - sigma0 * abs(v) / (coulomb + (stiction - coulomb) * math.exp(-ratio * ratio)) * z
    return v, (t - (sigma0 * z + sigma1 * rate + sigma2 * v)) / MASS, rate


def scipy_run(method: str, rtol: float, p: np.ndarray, ts: np.ndarray | None = None) -> Any:
    """A run by `scipy.integrate.solve_ivp`."""
    done = solve_ivp(
        scipy_field, (0.0, T1), np.zeros(3), method, t_eval=ts, args=tuple(p.tolist()), rtol=rtol, atol=ATOL * rtol
    )
    if not done.success:
        raise RuntimeError(done.message)
    return done


def _lsoda() -> Peer:
    def record(rtol: float) -> tuple[np.ndarray, int]:
        # The steps are those of a run that keeps them all.
        return scipy_run("LSODA", rtol, NOMINAL, TIMES).y.T, scipy_run("LSODA", rtol, NOMINAL).t.size - 1

    def many(rtol: float, sets: np.ndarray) -> Callable[[], Any]:
        return lambda: np.array([scipy_run("LSODA", rtol, row).y[1, -1] for row in sets])

    return Peer("scipy LSODA", lambda rtol: lambda: scipy_run("LSODA", rtol, NOMINAL), record, many, serial=True)


def reference_solution() -> tuple[np.ndarray, float]:
    """States at `TIMES` from `simulate` at 1e-12, which an explicit method of order 8 must confirm to 1e-9."""
    run = jms.simulate(ramped_box(box_lugre()), [0.0], [0.0], T1, ts=TIMES, rtol=1e-12, atol=1e-14)
    states = np.stack([run.q[:, 0], run.qd[:, 0], run.z["friction"]], axis=1)
    other = scipy_run("DOP853", 1e-12, NOMINAL, TIMES).y.T
    disagreement = float(np.max(np.abs(states - other) / np.abs(other).max(axis=0)))
    if not disagreement < 1e-9:
        raise AssertionError(f"The two reference solutions differ by {disagreement:.1e}.")
    return states, disagreement


def error_ladder(peer: Peer, reference: np.ndarray, tolerances: tuple[float, ...]) -> list[dict[str, Any]]:
    """Steps and errors at each tolerance: of x, v, z over the run relative to their maxima, and of v at the end."""
    rows: list[dict[str, Any]] = []
    for rtol in tolerances:
        try:
            states, steps = peer.record(rtol)
        except Exception as error:  # a peer that fails is a result
            rows.append({"rtol": rtol, "failed": f"{type(error).__name__}: {error}"})
            continue
        worst = np.max(np.abs(states - reference), axis=0) / np.abs(reference).max(axis=0)
        end = abs(states[-1, 1] / reference[-1, 1] - 1.0)
        errors = dict(zip(("x_run", "v_run", "z_run"), worst.tolist(), strict=True))
        rows.append({"rtol": rtol, "steps": steps, **errors, "v_end": float(end)})
    return rows
