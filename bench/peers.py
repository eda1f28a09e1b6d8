"""The peers of the matrix: `jaxmodsim`, and careful implementations of each case with other programs.

`jaxmodsim` gets the scene, and looks for all modes of stick and slip. The others get the equations written by hand, and
of the belt know that stick and slip towards one side alternate for ever, which is the better bargain for them. A maker
imports its package itself: `importable` leaves out a peer whose package is missing.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import jaxmodsim as jms
from bench.record import OURS, Call
from bench.tasks import LUGRE, MAX_STEPS, Belt, Box

KVAERNO5, CVODES, SUNDAE = "diffrax Kvaerno5", "CVODES (CasADi)", "CVODE (scikit-sundae)"
SCANNED = "legs in `lax.scan`"
# Batch methods.
VMAP, GROUPS, SWEEP, LOOP = "vmap", "lax.map, 64 at a time", "sweep", "loop"


@dataclass(frozen=True)
class Peer:
    """A program that runs a case.

    - `once`: `once(rtol)` returns a function without arguments that makes one run and waits for the end state.
    - `record`: `record(rtol)` returns what `errors` of the task judges, and the number of steps, None if unknown.
    - `many`: by the way it is done, `many[way](rtol, sets)`: a function that runs every row of `sets` and waits.
    - `traced`: `traced(p, rtol, adjoint)`, the end value as a JAX function; None outside JAX.
    - `differentiated`: whether derivatives of `traced` are measured.
    """

    once: Callable[[float], Call]
    record: Callable[[float], tuple[np.ndarray, int | None]]
    many: dict[str, Callable[[float, np.ndarray], Call]] = field(default_factory=dict)
    traced: Callable[..., Any] | None = None
    differentiated: bool = False


def makers(task: Box | Belt) -> dict[str, Callable[[], Any]]:
    """Functions that build each peer of a case, by name.

    Of diffrax's own solvers for the box these are the fastest on the testbench, implicit and explicit, and two of
    higher order.
    """
    if isinstance(task, Belt):
        legs = {f"scipy {method}": partial(scipy_legs, task, method) for method in ("RK45", "DOP853", "LSODA")}
        return {OURS: lambda: our_belt(task), SCANNED: lambda: legs_scanned(task), **legs}
    return {
        OURS: lambda: our_box(task),
        KVAERNO5: lambda: by_diffrax(task, dfx.Kvaerno5(), stacked=True, differentiated=True),
        "diffrax Kvaerno3": lambda: by_diffrax(task, dfx.Kvaerno3(), stacked=True),
        "diffrax Heun": lambda: by_diffrax(task, dfx.Heun()),
        "diffrax Tsit5": lambda: by_diffrax(task, dfx.Tsit5()),
        "diffrax Dopri8": lambda: by_diffrax(task, dfx.Dopri8()),
        CVODES: lambda: by_casadi(task),
        SUNDAE: lambda: by_sundae(task),
        "scipy LSODA": lambda: by_scipy(task, "LSODA"),
        "scipy Radau": lambda: by_scipy(task, "Radau"),
    }


def batched(traced: Callable[..., Any]) -> dict[str, Callable[[float, np.ndarray], Call]]:
    """One call over many sets of parameters, at once and in groups."""

    def many(over: Callable[..., Any], rtol: float, sets: np.ndarray) -> Call:
        run, given = jax.jit(lambda sets: over(lambda p: traced(p, rtol), sets)), jnp.asarray(sets)
        return lambda: np.asarray(run(given))

    groups = partial(jax.lax.map, batch_size=64)
    return {VMAP: partial(many, lambda one, sets: jax.vmap(one)(sets)), GROUPS: partial(many, groups)}


def our_box(task: Box) -> Peer:
    """`simulate` and `sweep`, called as a user calls them."""
    scene = task.scene(task.numbers)

    def once(rtol: float) -> Call:
        atol = task.atol * rtol
        return lambda: jms.simulate(scene, [0.0], [0.0], task.t1, rtol=rtol, atol=atol).qd.block_until_ready()

    def traced(p: Any, rtol: Any, adjoint: Any = None) -> Any:
        return task.simulate(p, rtol, adjoint=adjoint).qd[-1, 0]

    many = batched(traced) | {SWEEP: lambda rtol, sets: lambda: run_sweep(task, sets, rtol)["v"].values}
    return Peer(once, lambda rtol: task.our_states(rtol, task.atol * rtol), many, traced, True)


def run_sweep(task: Box, sets: np.ndarray, rtol: float, **options: Any) -> Any:
    """Sets of the six parameters by `sweep`."""
    over = {"set": {f"friction.{name}": sets[:, i] for i, name in enumerate(LUGRE)}}
    start: dict[str, Any] = {"q0": [0.0], "qd0": [0.0], "t1": task.t1, "rtol": rtol, "atol": task.atol * rtol}
    return jms.sweep(task.scene(task.numbers), over, {"v": (_end_velocity, "m/s")}, **(start | options))


def _end_velocity(run: jms.Trajectory) -> Any:
    return run.qd[-1, 0]


def diffrax_run(
    task: Box, p: Any, rtol: Any, solver: Any, *, ts: Any = None, stacked: bool = False, adjoint: Any = None
) -> Any:
    """A run by plain diffrax with its default controller; the state is a tuple of scalars or a vector."""

    def stacked_field(t: Any, y: Any, p: Any) -> Any:
        return jnp.stack(task.field(t, (y[0], y[1], y[2]), p))

    return dfx.diffeqsolve(
        dfx.ODETerm(stacked_field if stacked else task.field), solver, 0.0, task.t1, None,
        jnp.zeros(3) if stacked else (jnp.zeros(()),) * 3, args=p,
        saveat=dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=ts),
        stepsize_controller=dfx.PIDController(rtol=rtol, atol=task.atol * rtol),
        adjoint=dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint, max_steps=MAX_STEPS, throw=False,
    )  # fmt: skip


def by_diffrax(task: Box, solver: Any, *, stacked: bool = False, differentiated: bool = False) -> Peer:
    """Plain diffrax. `stacked`: whether the state of a single run is a vector; batches use scalars."""
    p = jnp.asarray(task.numbers)
    end = jax.jit(lambda p, rtol: diffrax_run(task, p, rtol, solver, stacked=stacked).ys)

    @jax.jit
    def full(p: Any, rtol: Any, ts: Any) -> Any:
        run = diffrax_run(task, p, rtol, solver, ts=ts, stacked=stacked)
        states = run.ys if stacked else jnp.stack(run.ys, axis=1)
        return states, run.stats["num_steps"], run.result == dfx.RESULTS.successful

    def record(rtol: float) -> tuple[np.ndarray, int]:
        states, steps, okay = full(p, rtol, task.times)
        if not okay:
            raise RuntimeError(f"the run at rtol = {rtol:g} did not reach its end")
        return np.asarray(states), int(steps)

    def once(rtol: float) -> Call:
        tolerance = jnp.asarray(rtol)
        return lambda: jax.block_until_ready(end(p, tolerance))

    def traced(p: Any, rtol: Any, adjoint: Any = None) -> Any:
        ys = diffrax_run(task, p, rtol, solver, adjoint=adjoint, stacked=stacked).ys
        return ys[-1, 1] if stacked else ys[1][-1]

    def in_scalars(p: Any, rtol: Any) -> Any:
        return diffrax_run(task, p, rtol, solver).ys[1][-1]

    return Peer(once, record, batched(in_scalars), traced, differentiated)


def looped(task: Box, solver: Callable[[float, Any], Callable[[np.ndarray], Any]]) -> Peer:
    """A peer outside JAX, which runs sets of parameters one after the other.

    - `solver`: `solver(rtol, ts)` returns a function of the six numbers, which returns the states at `ts` (at some
      times up to the end without) and a function that says how many steps were made.
    """
    p = np.array(task.numbers)

    def record(rtol: float) -> tuple[np.ndarray, int]:
        states = solver(rtol, task.times)(p)[0]
        # The number of steps is that of a run that saves all of them.
        states = states if len(states) == task.samples else np.vstack([np.zeros(3), states])
        return states, solver(rtol, None)(p)[1]()

    def many(rtol: float, sets: np.ndarray) -> Call:
        run = solver(rtol, None)
        return lambda: np.array([run(row)[0][-1, 1] for row in sets])

    return Peer(lambda rtol: partial(solver(rtol, None), p), record, {LOOP: many})


def by_casadi(task: Box) -> Peer:
    """CVODES with a Jacobian by CasADi."""
    import casadi

    t, p, y = casadi.SX.sym("t"), casadi.SX.sym("p", 6), casadi.SX.sym("y", 3)
    sigma0, sigma1, sigma2, coulomb, stiction, vs = (p[i] for i in range(6))
    x, v, z = y[0], y[1], y[2]
    level = coulomb + (stiction - coulomb) * casadi.exp(-((v / vs) ** 2))
    rate = v - sigma0 * casadi.fabs(v) / level * z
    force = sigma0 * z + sigma1 * rate + sigma2 * v
    dae = {"t": t, "x": y, "p": p, "ode": casadi.vertcat(v, (task.load(t, x) - force) / task.mass, rate)}

    def solver(rtol: float, ts: Any) -> Any:
        options = {"reltol": rtol, "abstol": task.atol * rtol, "max_num_steps": MAX_STEPS}
        grid, y0 = task.t1 if ts is None else ts[1:].tolist(), casadi.DM.zeros(3)
        run = casadi.integrator("run", "cvodes", dae, 0.0, grid, options)
        return lambda p: (np.asarray(run(x0=y0, p=p)["xf"]).T, lambda: int(run.stats()["nsteps"]))

    return looped(task, solver)


def by_sundae(task: Box) -> Peer:
    """CVODE by scikit-sundae, with a field compiled by numba; a Jacobian by differences takes fewer steps."""
    import numba
    from sksundae.cvode import CVODE

    mass, rate, stiffness = task.mass, task.rate, task.stiffness
    y0, ends = np.zeros(3), np.array([0.0, task.t1])

    @numba.njit
    def compiled(t: Any, y: Any, yp: Any, p: Any) -> None:
        v, z = y[1], y[2]
        ratio = v / p[5]
        yp[0] = v
        yp[2] = v - p[0] * abs(v) / (p[3] + (p[4] - p[3]) * math.exp(-ratio * ratio)) * z
        yp[1] = (rate * t - stiffness * y[0] - (p[0] * z + p[1] * yp[2] + p[2] * v)) / mass

    def solver(rtol: float, ts: Any) -> Any:
        own = np.zeros(6)

        def rhs(t: float, y: np.ndarray, yp: np.ndarray) -> None:
            compiled(t, y, yp, own)

        program = CVODE(rhs, rtol=rtol, atol=task.atol * rtol, max_num_steps=MAX_STEPS)

        def run(p: np.ndarray) -> Any:
            own[:] = p
            done = program.solve(ends if ts is None else ts, y0)
            if not done.success:
                raise RuntimeError(done.message)
            return done.y, lambda: done.t.size - 1

        return run

    return looped(task, solver)


def by_scipy(task: Box, method: str) -> Peer:
    """A method of `solve_ivp`, with its field in plain Python, which is faster than NumPy for three numbers."""
    from scipy.integrate import solve_ivp

    def run(rtol: float, ts: Any, p: np.ndarray) -> Any:
        sigma0, sigma1, sigma2, coulomb, stiction, vs = p.tolist()

        def field(t: float, y: np.ndarray) -> tuple[float, float, float]:
            x, v, z = y.tolist()
            ratio = v / vs
            rate = v - sigma0 * abs(v) / (coulomb + (stiction - coulomb) * math.exp(-ratio * ratio)) * z
            return v, (task.load(t, x) - (sigma0 * z + sigma1 * rate + sigma2 * v)) / task.mass, rate

        done = solve_ivp(field, (0.0, task.t1), np.zeros(3), method, t_eval=ts, rtol=rtol, atol=task.atol * rtol)
        if not done.success:
            raise RuntimeError(done.message)
        return done.y.T, lambda: done.t.size - 1

    return looped(task, lambda rtol, ts: partial(run, rtol, ts))


# The belt: each peer is judged by the end positions of all sets.


def _judged(task: Belt, run: Callable[[np.ndarray, float], float]) -> Callable[[float], tuple[np.ndarray, None]]:
    return lambda rtol: (np.array([run(p, rtol) for p in task.judged]), None)


def our_belt(task: Belt) -> Peer:
    """`simulate`."""
    scene, start = task.scene(task.numbers), [task.numbers[4]]

    def once(rtol: float) -> Call:
        return lambda: float(jms.simulate(scene, [0.0], start, task.t1, rtol=rtol, atol=task.atol * rtol).q[-1, 0])

    def traced(p: Any, rtol: Any, adjoint: Any = None) -> Any:
        return task.simulate(p, rtol, adjoint=adjoint, max_steps=262_144, max_events=4096).q[-1, 0]

    run = jax.jit(traced)
    return Peer(once, _judged(task, lambda p, rtol: float(run(p, rtol))), batched(traced), traced, True)


def _leg(task: Belt, t: Any, y: Any, p: Any, rtol: Any, *, sticks: bool) -> tuple[Any, Any]:
    """Time and state at the end of one leg by plain diffrax: the next event, with the velocity reset, or `t1`."""

    def field(t: Any, y: Any, p: Any) -> Any:
        del t
        return y[1], jnp.zeros_like(y[1]) if sticks else (p[0] - p[2] * y[0]) / p[3]

    def guard(t: Any, y: Any, args: Any, **given: Any) -> Any:
        del t, given
        return args[1] - args[2] * y[0] if sticks else y[1] - args[4]

    # The remaining load falls through zero; the slip velocity starts at zero, is negative, and rises through zero.
    event = dfx.Event(guard, optx.Newton(rtol, task.atol * rtol, optx.rms_norm), direction=not sticks)
    done = dfx.diffeqsolve(
        dfx.ODETerm(field), dfx.Tsit5(), t, task.t1, None, y, args=p, event=event, max_steps=4096, throw=False,
        stepsize_controller=dfx.PIDController(rtol=rtol, atol=task.atol * rtol),
    )  # fmt: skip
    assert done.ys is not None
    assert done.ts is not None
    x, v = (values[-1] for values in done.ys)
    return done.ts[-1], (x, v if sticks else jnp.where(done.ts[-1] < task.t1, p[4], v))


def legs_scanned(task: Belt) -> Peer:
    """A `lax.scan` over cycles of two legs; legs after the end have no duration."""

    def traced(p: Any, rtol: Any, adjoint: Any = None) -> Any:
        del adjoint

        def cycle(carry: Any, _: None) -> tuple[Any, None]:
            for sticks in (True, False):
                carry = _leg(task, *carry, p, rtol, sticks=sticks)
            return carry, None

        return jax.lax.scan(cycle, (jnp.zeros(()), (jnp.zeros(()), p[4])), length=68)[0][1][0]

    run, p = jax.jit(traced), jnp.asarray(task.numbers)
    judged = _judged(task, lambda p, rtol: float(run(p, rtol)))
    return Peer(lambda rtol: lambda: float(run(p, rtol)), judged, batched(traced), traced, True)


def scipy_legs(task: Belt, method: str) -> Peer:
    """`solve_ivp` with terminal events, restarted at each."""
    from scipy.integrate import solve_ivp

    def run(p: np.ndarray, rtol: float) -> float:
        coulomb, static, k, m, vb = p.tolist()
        fields = (lambda t, y: (y[1], (coulomb - k * y[0]) / m), lambda t, y: (y[1], 0.0))  # noqa: ARG005
        guards: Any = (lambda t, y: y[1] - vb, lambda t, y: static - k * y[0])  # noqa: ARG005
        for guard, direction in zip(guards, (1, -1), strict=True):
            guard.terminal, guard.direction = True, direction
        t, y, sticks = 0.0, (0.0, vb), True
        while True:
            ends: dict[str, Any] = {"events": guards[sticks], "rtol": rtol, "atol": task.atol * rtol}
            done = solve_ivp(fields[sticks], (t, task.t1), y, method, **ends)
            if not done.success:
                raise RuntimeError(done.message)
            if done.status == 0:
                return float(done.y[0, -1])
            t, y, sticks = done.t[-1], (done.y[0, -1], vb), not sticks

    return Peer(lambda rtol: partial(run, np.array(task.numbers), rtol), _judged(task, run))
