"""`simulate`, which runs a scene."""

from __future__ import annotations  # `help` then shows the names of types

import math
import time

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import ArrayLike, PyTree

from .._core.arguments import as_flag
from .._core.arrays import is_known
from .._core.functions import Function
from .._core.speed import recommend_tuning, warn_about_compilation, warn_about_fixed_steps, warn_about_rounding
from .._core.user_errors import LastLines
from ..scene import Scene, State, vector_field
from ..solvers import Gauss, ImplicitFriction, Rodas5P
from ._outcome import SUCCESS, SimulationError, describe_start, outcome_messages, violation_code
from ._run_request import MOST_EVENTS, MOST_STEPS, RunRequest, run_request
from ._solve import RunOutput, compiled_runs, default_solver, solve
from ._trajectory import Trajectory, trajectory

_IMPLICIT = (dfx.AbstractImplicitSolver, Gauss, ImplicitFriction, Rodas5P)
# Longest fixed step of an explicit solver, times the fastest rate, without a warning about derivatives.
_LONGEST = 2.0
# Multiple of the relative tolerance above which rounding of the steps in single precision gives a warning.
_ROUNDING = 2.0


def simulate(
    scene: Scene,
    q0: ArrayLike | list[float],
    qd0: ArrayLike | list[float],
    t1: ArrayLike,
    *,
    t0: ArrayLike = 0.0,
    ts: ArrayLike | list[float] | None = None,
    z0: dict[str, PyTree] | None = None,
    rtol: ArrayLike = 1e-6,
    atol: ArrayLike = 1e-9,
    dt: ArrayLike | None = None,
    dtmax: ArrayLike | None = None,
    solver: dfx.AbstractSolver | None = None,
    adjoint: dfx.AbstractAdjoint | None = None,
    max_steps: int = MOST_STEPS,
    max_events: int = MOST_EVENTS,
    stick_on_chatter: bool = False,
    project: bool = True,
    record: tuple[str, ...] = (),
    throw: bool = True,
) -> Trajectory:
    """Run a scene from `t0` to `t1`.

    The first call for a scene of this structure compiles a program; changes of numbers, in the scene or in the
    arguments, do not compile another one. All numbers have the common floating type of scene and initial state;
    defaults, such as the `belt_velocity` of `Friction`, take it, too.

    **Arguments:**

    - `scene`: the `Scene`.
    - `q0`, `qd0`: initial coordinates and velocities, shape `[dof]`. An element that sticks at t0 loses its slip
      velocity, and with it the derivative with respect to that. They must obey the constraints to six digits, and are
      then moved onto them; `jaxmodsim.project_initial_state` finds such states.
    - `t1`: end time [s], >= t0.
    - `t0`: start time [s].
    - `ts`: times [s] at which the run is saved, increasing, within `[t0, t1]`; by default the end alone, in arrays of
      length one.
    - `z0`: initial states of effects, by effect name; others start at rest.
    - `rtol`, `atol`: relative and absolute tolerance of the local error. Values below `atol` are not resolved: choose
      it below the smallest velocity [m/s] and deflection [m] that matter. It must not be above the width of a
      `Regularized` law. `rtol` below 64 roundings (8e-6 in float32, 1.4e-14 in float64) counts as that, and `atol`
      rises by the same factor. The rounding of n steps in float32 is about 6e-8 sqrt(n) of the state; if that exceeds
      `rtol`, one warning is logged.
    - `dt`: fixed step [s], > 0, instead of tolerances. A sample of a `Signal` within a step divides it. Derivatives
      of a scene at rest need `dt` below 2 over its fastest rate [1/s] with explicit solvers; outside `jax.jit` a
      longer step logs one warning.
    - `dtmax`: longest step [s], > 0. Steps resolve the load of a sticking element to `rtol` of its limit, if the load
      is smooth on the scale of its derivatives. A pulse from rest that is shorter than a step may be missed: pass it as
      a `Signal`, on whose samples steps end, or bound the step by its length. The run fails if a missed pulse shows at
      a saved time.
    - `solver`: any diffrax solver. By default `Rodas5P` if an effect is stiff (LuGre, `Regularized`) or, on one
      coordinate, runs by events (set-valued laws); `diffrax.Tsit5` otherwise. `ImplicitFriction` for fixed steps that
      may be too long for the stiffness of friction.
    - `adjoint`: method of differentiation. By default `StoredSteps()`, for both modes: `jax.grad`, `jax.jacfwd`,
      `jax.hessian`. The steps of a differentiated run keep `rtol` for the derivative, too.
      `StoredSteps(every=k)` needs a k-th of the memory. Adjoints of diffrax control the error of the state alone, so
      their derivatives are wrong near rest. `diffrax.ForwardMode()` supports forward mode alone and stores
      nothing. `diffrax.RecursiveCheckpointAdjoint` repeats steps from checkpoints: their rounding differs from that
      of the run, and derivatives through events lose digits. `diffrax.BacksolveAdjoint` is not supported.
    - `max_steps`: limit of the number of steps. Derivatives reserve memory for the state before each of them.
    - `max_events`: limit of the number of instants at which set-valued laws change modes. Inside `jax.jit`, and with
      recorded events, `run.events` has this number of entries for each such law, so that a smaller one is faster.
    - `stick_on_chatter`: whether a friction element whose mode changes accumulate stays in stick, by any force, even
      above its limit, instead of ending the run.
    - `project`: whether the state is projected onto the constraints after every step, and when it is saved, by the
      smallest changes in the metric of the masses. Without it, constraints hold for the accelerations alone, and drift
      with the error of integration, apart from their own `stabilise`.
    - `record`: `"events"`, `"energy"` or both, recorded during the run. Otherwise the first access to `run.events` or
      `run.energy` repeats the run. Outside `jax.jit`, `jax.vmap` and `jax.grad` every run records its first 16 events.
      With `"energy"` the steps are chosen for the work, too.
    - `throw`: whether a run that ends early raises an error; otherwise `run.result` has the outcome, and the trajectory
      the part that was computed.

    **Returns:**

    A `Trajectory`.

    **Raises:**

    - `ValueError` for wrong shapes, types or ranges, before the run.
    - `SimulationError` if the run ends early and `throw` is set. Inside `jax.jit`, `jax.vmap` or `jax.grad` it is a
      run-time error of equinox with the same message, which also appears after the traceback. This error calls Python,
      and JAX does not keep programs with callbacks in its persistent cache. To cache such programs, pass `throw=False`
      and read `run.result`.

    **Example:**

    ```python
    def lagrangian(t, q, qd, p):
        return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2

    scene = jms.Scene(lagrangian, {"m": 1.0, "k": 4.0}, (jms.Friction(jms.Coulomb(Fc=0.6)),))
    run = jms.simulate(scene, q0=[1.0], qd0=[0.0], t1=6.0, ts=jnp.linspace(0.0, 6.0, 5))
    print(run.q[:, 0].round(4), "m")
    ```

    ```text
    [ 1.     -0.6915  0.3781 -0.0778 -0.1   ] m
    ```
    """
    recommend_tuning()
    throw = as_flag(throw, name="throw")
    request = run_request(
        *(scene, q0, qd0, t1),
        t0=t0,
        ts=ts,
        z0=z0,
        rtol=rtol,
        atol=atol,
        dt=dt,
        dtmax=dtmax,
        solver=solver,
        adjoint=adjoint,
        max_steps=max_steps,
        max_events=max_events,
        stick_on_chatter=stick_on_chatter,
        project=project,
        record=record,
    )
    if throw and scene.constraints:
        _check_initial_state(request)
    compiled, began = compiled_runs(), time.perf_counter()
    solved = solve(request)
    if compiled_runs() > compiled:
        warn_about_compilation(time.perf_counter() - began, _functions(scene))
    if throw:
        solved = _raise_early_end(request, solved)
        _check_rounding(request, solved)
        _check_fixed_steps(request, solved)
    return trajectory(request, solved)


def _check_rounding(request: RunRequest, solved: RunOutput) -> None:
    """Log a warning for a run in single precision whose rounding exceeds its tolerance.

    Rounding errors grow as the square root of the number of steps. For a box that a spring pulls by 1 m, with LuGre
    bristles of 1e3 to 1e7 N/m and 300 to 4000 steps, the error was 0.5 to 3.2 times `eps/2 sqrt(steps)`.
    """
    steps = solved.stats["num_steps"]
    if solved.t.dtype == jnp.float32 and request.dt is None and is_known(steps, request.rtol):
        rounding = 0.5 * float(jnp.finfo(jnp.float32).eps) * math.sqrt(int(steps))
        if rounding > _ROUNDING * float(request.rtol):
            warn_about_rounding()


def _check_fixed_steps(request: RunRequest, solved: RunOutput) -> None:
    """Log a warning for explicit fixed steps, of a differentiated run, beyond about the limit of stability.

    At rest the motion stays accurate, but the derivative grows without bound. The rate is the spectral radius of the
    vector field at the end of the run, which is known outside `jax.jit` alone.
    """
    if request.dt is None or is_known(*jtu.tree_leaves(request)):
        return
    end = (solved.t[-1], jtu.tree_map(lambda x: x[-1], (solved.y, solved.mode)), request.scene, request.dt)
    t, (y, mode), scene, dt = lax.stop_gradient(end)
    solver = default_solver(scene, y.q.shape[0], True) if request.solver is None else request.solver.whole
    if not is_known(*jtu.tree_leaves((t, y, mode, scene))) or isinstance(solver, _IMPLICIT):
        return
    numbers, as_state = ravel_pytree(y)
    jacobian = jax.jacfwd(lambda x: ravel_pytree(vector_field(t, as_state(x), scene.bind_time(t), mode))[0])(numbers)
    reach = float(dt) * max(abs(np.linalg.eigvals(np.asarray(jacobian))), default=0.0)
    if reach > _LONGEST:
        warn_about_fixed_steps(type(solver).__name__, float(dt), float(dt) * _LONGEST / reach)


def _functions(scene: Scene) -> list[object]:
    """The user's functions in a scene."""
    nodes = jtu.tree_leaves(scene, is_leaf=lambda x: isinstance(x, Function))
    return [each.fn for each in nodes if isinstance(each, Function)]


def _check_initial_state(request: RunRequest) -> None:
    """Raise an error for a known initial state that violates constraints or contacts, before the compilation."""
    start = request.t0, request.q0, request.qd0
    if is_known(*jtu.tree_leaves((request.scene, start))):
        t0, q0, qd0 = map(jnp.asarray, start)
        y = State(q0, qd0, {})
        code = violation_code(request.scene, t0, y)
        if is_known(code) and int(code) != SUCCESS:
            raise SimulationError(describe_start(request.scene, float(t0), y, int(code)))


def _raise_early_end(request: RunRequest, solved: RunOutput) -> RunOutput:
    """Raise an error for a run that ended early: at once for known values, by a run-time check for traced ones."""
    if is_known(solved.code):
        if failure := solved.failure(request.scene):
            raise SimulationError(failure)
        return solved
    messages = LastLines(outcome_messages(request.scene, request.q0.shape[0]))
    one = jnp.ones((), solved.t.dtype)
    solved, one = eqx.branched_error_if((solved, one), solved.code != SUCCESS, solved.code, messages)
    # Tangents pass by the check: XLA would drop it from a program that returns a derivative alone. A factor is in both.
    return jtu.tree_map(lambda x: x * one.astype(x.dtype) if eqx.is_inexact_array(x) else x, solved)
