"""Two runs with LuGre friction, and the solvers that make them: each with the settings a careful user would choose.

- `TESTBENCH`: a box of 2 kg on a table, pulled by the force `1 N/s * t` for 10 s from rest;
- `PULLED`: a box of 1 kg, pulled for 20 s through a spring of 2 N/m whose end moves at 0.1 m/s, with the law of 1995.

State (x [m], v [m/s], z [m]). `jaxmodsim` gets the scene; the others get the vector field written by hand, which is the
better bargain for them, and no check of parameters or outcome.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import casadi
import diffrax as dfx
import jax
import jax.numpy as jnp
import numba
import numpy as np
from scipy.integrate import solve_ivp
from sksundae.cvode import CVODE

import jaxmodsim as jms
from jaxmodsim.problems import pulled_box, ramped_box

PARAMETERS = ("sigma0", "sigma1", "sigma2", "Fc", "Fs", "vs")
MAX_STEPS = 1_000_000
OURS, CVODES, SUNDAE, KVAERNO5 = "jaxmodsim", "CVODES (CasADi)", "CVODE (scikit-sundae)", "diffrax Kvaerno5"
OBSERVE = {"v": (lambda run: run.qd[-1, 0], "m/s")}
# What error measures are relative to: the largest of each over the run.
MEASURES = ("x_run", "v_run", "z_run", "F_run")


@dataclass(frozen=True)
class Task:
    """A run: `mass x'' = rate t - stiffness x - F(v, z)` from rest.

    - `scene`: from the law.
    - `numbers`: of the law, in the order of `PARAMETERS`.
    - `mass` [kg], `rate` [N/s], `stiffness` [N/m], `t1` [s].
    - `samples`: number of equispaced times over which errors are taken.
    - `atol`: absolute tolerance for a relative one.
    - `bristle`: order of its deflection [m].
    - `confirmed`: to which relative difference two reference solutions agree.
    """

    scene: Callable[[Any], jms.Scene]
    numbers: tuple[float, ...]
    mass: float
    rate: float
    stiffness: float
    t1: float
    samples: int
    atol: float
    bristle: float
    confirmed: float

    @cached_property
    def nominal(self) -> np.ndarray:
        """The numbers of the law."""
        return np.array(self.numbers)

    @cached_property
    def times(self) -> np.ndarray:
        """Times over which errors are taken [s]."""
        return np.linspace(0.0, self.t1, self.samples)

    def load(self, t: Any, x: Any) -> Any:
        """Force on the box besides friction [N]."""
        return self.rate * t - self.stiffness * x if self.stiffness else self.rate * t

    def friction(self, states: np.ndarray) -> np.ndarray:
        """Friction force [N] at states of the shape `[time, 3]`."""
        sigma0, sigma1, sigma2, coulomb, stiction, vs = self.numbers
        _, v, z = states.T
        rate = v - sigma0 * np.abs(v) / (coulomb + (stiction - coulomb) * np.exp(-((v / vs) ** 2))) * z
        return sigma0 * z + sigma1 * rate + sigma2 * v


# Positions of interest reach 2 mm (z) to 50 m (x).
TESTBENCH = Task(ramped_box, (750.0, 0.0, 0.1, 1.5, 1.75, 0.2), 2.0, 1.0, 0.0, 10.0, 101, 1e-3, 1e-3, 1e-9)
# The bristle reaches 15 um; with a finer absolute tolerance all solvers take longer for the same error.
PULLED = Task(pulled_box, (1e5, math.sqrt(1e5), 0.4, 1.0, 1.5, 1e-3), 1.0, 0.2, 2.0, 20.0, 4001, 1e-4, 1e-6, 1e-7)


@dataclass(frozen=True)
class Peer:
    """One way of making a run.

    - `once`: `once(rtol)` returns a function without arguments that makes one run and waits for the end state.
    - `record`: `record(rtol)` returns the states at `Task.times`, shape `[time, 3]`, and the number of steps.
    - `many`: by the way it is done, `many[way](rtol, sets)`: a function that runs every row of `sets` and waits.
    - `velocity`: `velocity(p, rtol, adjoint)`, the end velocity as a JAX function; None outside JAX.
    """

    name: str
    once: Callable[[float], Callable[[], Any]]
    record: Callable[[float], tuple[np.ndarray, int]]
    many: dict[str, Callable[[float, np.ndarray], Callable[[], Any]]]
    velocity: Callable[..., Any] | None = None


# Ways of running many sets.
VMAP, GROUPS, SWEEP, LOOP = "vmap", "lax.map, 64 at a time", "sweep", "loop"


def parameter_sets(count: int) -> np.ndarray:
    """Sets of the testbench's six parameters, within 20 %, `sigma1` from 0 to 10 N s/m; always the same."""
    rng = np.random.default_rng(20240229)
    sets = TESTBENCH.nominal * (1.0 + 0.2 * rng.uniform(-1.0, 1.0, (count, 6)))
    sets[:, 1] = rng.uniform(0.0, 10.0, count)
    sets[:, 4] = np.maximum(sets[:, 4], 1.02 * sets[:, 3])
    return sets


def peers(task: Task = TESTBENCH, only: tuple[str, ...] = ()) -> list[Peer]:
    """All solvers under test, or those of these names.

    Of diffrax's own these are the fastest on the testbench, implicit and explicit, and two of higher order.
    """
    found = {
        OURS: lambda: ours(task),
        KVAERNO5: lambda: by_diffrax(task, KVAERNO5, dfx.Kvaerno5(), stacked=True),
        "diffrax Kvaerno3": lambda: by_diffrax(task, "diffrax Kvaerno3", dfx.Kvaerno3(), stacked=True),
        "diffrax Heun": lambda: by_diffrax(task, "diffrax Heun", dfx.Heun()),
        "diffrax Tsit5": lambda: by_diffrax(task, "diffrax Tsit5", dfx.Tsit5()),
        "diffrax Dopri8": lambda: by_diffrax(task, "diffrax Dopri8", dfx.Dopri8()),
        CVODES: lambda: by_casadi(task),
        SUNDAE: lambda: by_sundae(task),
        "scipy LSODA": lambda: by_scipy(task, "LSODA"),
        "scipy Radau": lambda: by_scipy(task, "Radau"),
    }
    return [make() for name, make in found.items() if name in (only or found)]


def ours(task: Task) -> Peer:
    """`simulate`, called as a user calls it."""
    scene = task.scene(jms.LuGre(*task.numbers))

    def once(rtol: float) -> Callable[[], Any]:
        atol = task.atol * rtol
        return lambda: jms.simulate(scene, [0.0], [0.0], task.t1, rtol=rtol, atol=atol).qd.block_until_ready()

    def record(rtol: float) -> tuple[np.ndarray, int]:
        return our_record(task, rtol, task.atol * rtol)

    def velocity(p: Any, rtol: Any, adjoint: Any = None) -> Any:
        scene = task.scene(jms.LuGre(*p))
        run = jms.simulate(scene, [0.0], [0.0], task.t1, rtol=rtol, atol=task.atol * rtol, adjoint=adjoint)
        return run.qd[-1, 0]

    def swept(rtol: float, sets: np.ndarray) -> Callable[[], Any]:
        return lambda: run_sweep(sets, rtol)["v"].values

    return Peer(OURS, once, record, _batched(velocity) | {SWEEP: swept}, velocity)


def our_record(task: Task, rtol: float, atol: float) -> tuple[np.ndarray, int]:
    """States at the times of the task, and the number of steps."""
    scene = task.scene(jms.LuGre(*task.numbers))
    run = jms.simulate(scene, [0.0], [0.0], task.t1, ts=task.times, rtol=rtol, atol=atol, max_steps=MAX_STEPS)
    states = np.stack([run.q[:, 0], run.qd[:, 0], run.z["friction"]], axis=1)
    return states, int(run.stats["num_steps"])


def run_sweep(sets: np.ndarray, rtol: float | np.ndarray, **options: Any) -> Any:
    """Sets of the testbench's parameters by `sweep`, with one tolerance for all or one for each."""
    over = {f"friction.{name}": sets[:, i] for i, name in enumerate(PARAMETERS)}
    tolerance = {"rtol": rtol, "atol": TESTBENCH.atol * rtol}
    start: dict[str, Any] = {"q0": [0.0], "qd0": [0.0], "t1": TESTBENCH.t1}
    scene = testbench()
    if np.ndim(rtol) == 0:
        return jms.sweep(scene, {"set": over}, OBSERVE, **(start | tolerance | options))
    return jms.sweep(scene, {"set": over | tolerance}, OBSERVE, **(start | options))


@cache
def testbench() -> jms.Scene:
    """The scene of the testbench: made once, and not before JAX has its settings."""
    return TESTBENCH.scene(jms.LuGre(*TESTBENCH.numbers))


def _batched(velocity: Callable[..., Any]) -> dict[str, Callable[[float, np.ndarray], Callable[[], Any]]]:
    def jitted(over: Callable[[Any, Any], Any]) -> Callable[[float, np.ndarray], Callable[[], Any]]:
        def many(rtol: float, sets: np.ndarray) -> Callable[[], Any]:
            run, given = jax.jit(lambda sets: over(lambda p: velocity(p, rtol), sets)), jnp.asarray(sets)
            return lambda: run(given).block_until_ready()

        return many

    return {
        VMAP: jitted(lambda one, sets: jax.vmap(one)(sets)),
        GROUPS: jitted(lambda one, sets: jax.lax.map(one, sets, batch_size=64)),
    }


def lugre_field(t: Any, y: Any, p: Any, task: Task = TESTBENCH) -> Any:
    """The vector field by hand, for JAX: a tuple of three scalars."""
    sigma0, sigma1, sigma2, coulomb, stiction, vs = (p[i] for i in range(6))
    x, v, z = y
    ratio = v / vs
    level = coulomb + (stiction - coulomb) * jnp.exp(-ratio * ratio)
    rate = v - sigma0 * jnp.abs(v) / level * z
    return v, (task.load(t, x) - (sigma0 * z + sigma1 * rate + sigma2 * v)) / task.mass, rate


def diffrax_run(
    task: Task, p: Any, rtol: Any, solver: Any, *, ts: Any = None, adjoint: Any = None, stacked: bool = False
) -> Any:
    """A run by plain diffrax with its default controller; the state is a tuple of scalars, or one vector."""

    def field(t: Any, y: Any, p: Any) -> Any:
        return lugre_field(t, y, p, task)

    def stacked_field(t: Any, y: Any, p: Any) -> Any:
        return jnp.stack(field(t, (y[0], y[1], y[2]), p))

    zero = jnp.zeros(())
    return dfx.diffeqsolve(
        dfx.ODETerm(stacked_field if stacked else field),
        solver,
        0.0,
        task.t1,
        None,
        jnp.zeros(3) if stacked else (zero, zero, zero),
        args=p,
        saveat=dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=ts),
        stepsize_controller=dfx.PIDController(rtol=rtol, atol=task.atol * rtol),
        adjoint=dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        max_steps=MAX_STEPS,
        throw=False,
    )


def by_diffrax(task: Task, name: str, solver: Any, *, stacked: bool = False) -> Peer:
    """Plain diffrax; `stacked`: whether one vector beats scalars as the state of one run. In batches scalars win."""
    end = jax.jit(lambda p, rtol: diffrax_run(task, p, rtol, solver, stacked=stacked).ys)
    full = jax.jit(lambda p, rtol, ts: _full(diffrax_run(task, p, rtol, solver, ts=ts, stacked=stacked)))

    def once(rtol: float) -> Callable[[], Any]:
        p, tolerance = jnp.asarray(task.nominal), jnp.asarray(rtol)
        return lambda: jax.block_until_ready(end(p, tolerance))

    def record(rtol: float) -> tuple[np.ndarray, int]:
        states, steps, okay = full(jnp.asarray(task.nominal), rtol, task.times)
        if not okay:
            raise RuntimeError(f"the run at rtol = {rtol:g} did not reach its end")
        return np.asarray(states), int(steps)

    def velocity(p: Any, rtol: Any, adjoint: Any = None) -> Any:
        ys = diffrax_run(task, p, rtol, solver, adjoint=adjoint, stacked=stacked).ys
        return ys[-1, 1] if stacked else ys[1][-1]

    def scalar_velocity(p: Any, rtol: Any) -> Any:
        return diffrax_run(task, p, rtol, solver).ys[1][-1]

    return Peer(name, once, record, _batched(scalar_velocity), velocity)


def _full(solution: Any) -> tuple[Any, Any, Any]:
    ys = solution.ys
    states = jnp.stack(ys, axis=1) if isinstance(ys, tuple) else ys
    return states, solution.stats["num_steps"], solution.result == dfx.RESULTS.successful


def by_casadi(task: Task) -> Peer:
    """CVODES with a Jacobian from CasADi's own derivatives."""
    t, p, y = casadi.SX.sym("t"), casadi.SX.sym("p", 6), casadi.SX.sym("y", 3)
    sigma0, sigma1, sigma2, coulomb, stiction, vs = (p[i] for i in range(6))
    x, v, z = y[0], y[1], y[2]
    level = coulomb + (stiction - coulomb) * casadi.exp(-((v / vs) ** 2))
    rate = v - sigma0 * casadi.fabs(v) / level * z
    force = sigma0 * z + sigma1 * rate + sigma2 * v
    dae = {"t": t, "x": y, "p": p, "ode": casadi.vertcat(v, (task.load(t, x) - force) / task.mass, rate)}

    def integrator(rtol: float, grid: Any) -> Any:
        options = {"reltol": rtol, "abstol": task.atol * rtol, "max_num_steps": MAX_STEPS}
        return casadi.integrator("run", "cvodes", dae, 0.0, grid, options)

    def once(rtol: float) -> Callable[[], Any]:
        run, y0, given = integrator(rtol, task.t1), casadi.DM.zeros(3), casadi.DM(task.nominal)
        return lambda: run(x0=y0, p=given)

    def record(rtol: float) -> tuple[np.ndarray, int]:
        run = integrator(rtol, task.times[1:].tolist())
        states = np.asarray(run(x0=casadi.DM.zeros(3), p=casadi.DM(task.nominal))["xf"]).T
        return np.vstack([np.zeros(3), states]), int(run.stats()["nsteps"])

    def many(rtol: float, sets: np.ndarray) -> Callable[[], Any]:
        run, y0, given = integrator(rtol, task.t1), casadi.DM.zeros(3), [casadi.DM(row) for row in sets]
        return lambda: np.array([float(run(x0=y0, p=row)["xf"][1]) for row in given])

    return Peer(CVODES, once, record, {LOOP: many})


def by_sundae(task: Task) -> Peer:
    """CVODE by scikit-sundae: field compiled by numba, Jacobian by differences, as one by hand takes more steps."""
    mass, rate, stiffness = task.mass, task.rate, task.stiffness

    @numba.njit
    def field(t: Any, y: Any, yp: Any, p: Any) -> None:
        v, z = y[1], y[2]
        ratio = v / p[5]
        yp[0] = v
        yp[2] = v - p[0] * abs(v) / (p[3] + (p[4] - p[3]) * math.exp(-ratio * ratio)) * z
        yp[1] = (rate * t - stiffness * y[0] - (p[0] * z + p[1] * yp[2] + p[2] * v)) / mass

    def solver(rtol: float, p: np.ndarray) -> Any:
        def rhs(t: float, y: np.ndarray, yp: np.ndarray) -> None:
            field(t, y, yp, p)

        return CVODE(rhs, rtol=rtol, atol=task.atol * rtol, max_num_steps=MAX_STEPS)

    ends, y0 = np.array([0.0, task.t1]), np.zeros(3)

    def solved(run: Any, times: np.ndarray) -> Any:
        done = run.solve(times, y0)
        if not done.success:
            raise RuntimeError(done.message)
        return done

    def once(rtol: float) -> Callable[[], Any]:
        run = solver(rtol, task.nominal)
        return lambda: solved(run, ends)

    def record(rtol: float) -> tuple[np.ndarray, int]:
        run = solver(rtol, task.nominal)
        return solved(run, task.times).y, solved(run, ends).t.size - 1

    def many(rtol: float, sets: np.ndarray) -> Callable[[], Any]:
        p = task.nominal.copy()
        run = solver(rtol, p)

        def one(row: np.ndarray) -> float:
            p[:] = row
            return solved(run, ends).y[-1, 1]

        return lambda: np.array([one(row) for row in sets])

    return Peer(SUNDAE, once, record, {LOOP: many})


def scipy_run(task: Task, method: str, rtol: float, p: np.ndarray, ts: np.ndarray | None = None) -> Any:
    """A run by `scipy.integrate.solve_ivp`, its field in plain Python: for three numbers faster than NumPy."""
    sigma0, sigma1, sigma2, coulomb, stiction, vs = p.tolist()

    def field(t: float, y: np.ndarray) -> tuple[float, float, float]:
        x, v, z = y.tolist()
        ratio = v / vs
        rate = v - sigma0 * abs(v) / (coulomb + (stiction - coulomb) * math.exp(-ratio * ratio)) * z
        return v, (task.load(t, x) - (sigma0 * z + sigma1 * rate + sigma2 * v)) / task.mass, rate

    done = solve_ivp(field, (0.0, task.t1), np.zeros(3), method, t_eval=ts, rtol=rtol, atol=task.atol * rtol)
    if not done.success:
        raise RuntimeError(done.message)
    return done


def by_scipy(task: Task, method: str) -> Peer:
    """A method of scipy."""

    def record(rtol: float) -> tuple[np.ndarray, int]:
        # The steps are those of a run that keeps them all.
        nominal = task.nominal
        states = scipy_run(task, method, rtol, nominal, task.times).y.T
        return states, scipy_run(task, method, rtol, nominal).t.size - 1

    def many(rtol: float, sets: np.ndarray) -> Callable[[], Any]:
        return lambda: np.array([scipy_run(task, method, rtol, row).y[1, -1] for row in sets])

    def once(rtol: float) -> Callable[[], Any]:
        return lambda: scipy_run(task, method, rtol, task.nominal)

    return Peer(f"scipy {method}", once, record, {LOOP: many})


def rk4_states(task: Task, h: float) -> np.ndarray:
    """States at the times of the task by the classical method of order 4, with steps of about `h`, compiled."""
    count = round(task.t1 / (task.samples - 1) / h)
    h = task.t1 / (task.samples - 1) / count

    def moved(y: Any, slope: Any, by: float) -> Any:
        return tuple(a + by * b for a, b in zip(y, slope, strict=True))

    def step(i: Any, y: Any, t0: Any, p: Any) -> Any:
        t = t0 + i * h
        a = lugre_field(t, y, p, task)
        b = lugre_field(t + h / 2, moved(y, a, h / 2), p, task)
        c = lugre_field(t + h / 2, moved(y, b, h / 2), p, task)
        d = lugre_field(t + h, moved(y, c, h), p, task)
        return tuple(y[k] + h / 6 * (a[k] + 2 * b[k] + 2 * c[k] + d[k]) for k in range(3))

    @jax.jit
    def run(p: Any, ts: Any) -> Any:
        def sample(y: Any, t0: Any) -> Any:
            y = jax.lax.fori_loop(0, count, lambda i, y: step(i, y, t0, p), y)
            return y, jnp.stack(y)

        return jax.lax.scan(sample, (jnp.zeros(()),) * 3, ts)[1]

    states = run(jnp.asarray(task.nominal), jnp.asarray(task.times[:-1]))
    return np.vstack([np.zeros(3), np.asarray(states)])


def reference_solution(task: Task = TESTBENCH) -> tuple[np.ndarray, float]:
    """States at the times of the task from `simulate` at 1e-12, which RK4 with steps of 10 us must confirm."""
    # The absolute tolerance suits the smallest of the state, the bristle.
    states, _ = our_record(task, 1e-12, 1e-11 * task.bristle)
    other = rk4_states(task, 1e-5)
    disagreement = float(np.max(np.abs(states - other) / np.abs(other).max(axis=0)))
    if not disagreement < task.confirmed:
        raise AssertionError(f"The two reference solutions differ by {disagreement:.1e}.")
    return states, disagreement


def error_ladder(
    peer: Peer, reference: np.ndarray, tolerances: tuple[float, ...], task: Task = TESTBENCH
) -> list[dict[str, Any]]:
    """Steps and errors at each tolerance.

    Of x, v, z and the friction force F over the run, relative to the largest of each; of F in newtons; of v at the end.
    """
    rows: list[dict[str, Any]] = []
    exact = np.column_stack([reference, task.friction(reference)])
    for rtol in tolerances:
        try:
            states, steps = peer.record(rtol)
        except Exception as error:  # a peer that fails is a result
            rows.append({"rtol": rtol, "failed": f"{type(error).__name__}: {error}"})
            continue
        rows.append({"rtol": rtol, "steps": steps, **errors_of(states, exact, task)})
    return rows


def errors_of(states: np.ndarray, exact: np.ndarray, task: Task) -> dict[str, float]:
    """Errors of states against those of the reference, with its friction as the fourth column."""
    worst = np.max(np.abs(np.column_stack([states, task.friction(states)]) - exact), axis=0)
    errors = dict(zip(MEASURES, (worst / np.abs(exact).max(axis=0)).tolist(), strict=True))
    return errors | {"F_newtons": float(worst[3]), "v_end": float(abs(states[-1, 1] / exact[-1, 1] - 1.0))}
