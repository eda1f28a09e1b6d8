"""`simulate`: a scene in, a trajectory out."""

import math
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import ArrayLike, PyTree

from .._core.arguments import as_flag, as_mapping, as_whole, check_real
from ..scene import Friction, Scene, check_step
from ..solvers import ImplicitFriction
from ._outcome import SUCCESS, SimulationError, describe_failure, outcome_messages
from ._search import reach
from ._solve import Options, Problem, Solved, solve
from ._trajectory import Trajectory, trajectory


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
    max_steps: int = 16384,
    max_events: int = 1024,
    hold_chatter: bool = False,
    project: bool = True,
    throw: bool = True,
    accuracy: float | None = None,
    observable: str | Callable[[Trajectory], Any] | None = None,
) -> Trajectory:
    """Run a scene from `t0` to `t1`.

    Compiled on the first call for a scene of this structure; changing numbers, of the scene or of the arguments,
    compiles nothing anew. All numbers run in the floating type of the scene and the initial state together.

    **Arguments:**

    - `scene`: the `Scene`.
    - `q0`, `qd0`: initial coordinates and velocities, shape `[dof]`. Of an element that sticks at t0 the slip velocity
      is taken away, and with it the derivative by that velocity. They must obey the constraints to six digits, and are
      then moved onto them; `jaxmodsim.consistent` finds such states.
    - `t1`: end time [s], >= t0.
    - `t0`: start time [s].
    - `ts`: times [s] at which the run is kept, increasing, within `[t0, t1]`; by default the end alone, in arrays of
      length one.
    - `z0`: initial own states of effects, by effect name; those left out start at rest.
    - `rtol`, `atol`: relative and absolute tolerance of the local error. What is smaller than `atol` is not resolved:
      let it lie below the smallest velocity [m/s] and deflection [m] that decide anything. Above the width of a
      `Regularized` law it is refused.
    - `dt`: fixed step [s], > 0, instead of tolerances. A sample of a `Signal` in between divides the step.
    - `dtmax`: longest step [s], > 0. Steps resolve the load of what sticks to `rtol` of its limit, as long as the load
      is smooth on the scale of its own derivatives. What cannot be seen is a pulse out of rest that is shorter than a
      step: give it as a `Signal`, on whose samples steps end, or bound the step by its length. Where a missed pulse
      shows at a saved time, the run fails.
      Derivatives are those of the steps that were made: of a run in which nothing moves, such as one that starts and
      stays in equilibrium, they need a bound, too, that resolves what would move. `check_gradients` tells.
    - `solver`: any diffrax solver. By default `Rodas5P` where an effect is stiff (LuGre, `Regularized`) or, on one
      coordinate, runs by events (set-valued laws); `diffrax.Tsit5` otherwise. `ImplicitFriction` for fixed steps that
      may be too long for the stiffness of friction.
    - `adjoint`: how diffrax differentiates the run. By default for reverse mode (`jax.grad`), by
      `diffrax.RecursiveCheckpointAdjoint(checkpoints=max_steps)`, which keeps the state before each step; with fewer
      checkpoints derivatives through events lose digits. Pass `diffrax.ForwardMode()` for `jax.jvp` and `jax.jacfwd`.
      Not `diffrax.BacksolveAdjoint`.
    - `max_steps`: limit of the number of steps. In reverse mode memory is set aside for the state before each of them.
    - `max_events`: limit of the number of instants at which set-valued laws change modes. Inside `jax.jit`
      `run.events` has as many entries for each such law, so a smaller one is faster there.
    - `hold_chatter`: whether an element whose mode changes accumulate is held in stick, with whatever force that takes,
      be it above the limit, instead of ending the run.
    - `project`: whether the state is moved onto the constraints after every step, and wherever it is kept, by the
      smallest changes in the metric of the masses. Without, constraints hold for the accelerations alone and drift with
      the error of integration, but for their own `stabilise`.
    - `throw`: whether a run that ends early raises; otherwise `run.result` says how it ended, and what was computed
      is kept. Likewise for an accuracy that is not reached, of which `run.accuracy.remark` says why.
    - `accuracy`: largest error of `observable`, from 1e-12 to 0.1, instead of `rtol`, `atol` and `dt`. Solver and
      tolerances are searched for, by about ten runs of two methods, so that numbers must be known (not traced): the
      run with the least work is taken whose difference to tighter runs by either method is within the accuracy. In
      scenes with events the second method makes steps of at most 1/127 of the run, unless `dtmax` bounds both, so that
      the two look at different places. What steps over a short pulse in all of them is not seen: `dtmax`.
      `run.accuracy` reports it, and `run.accuracy.options` are the arguments for more such runs. With `solver` given
      the tolerances alone are chosen. Errors are relative to the largest magnitude of the observable at the saved
      times (of fewer than 11, at 101 times along the run), or to 1e-6 of its unit where it stays below that.
    - `observable`: what `accuracy` is of: `"q[0]"`, `"qd[0]"`, the name of an effect for its force (`[i]` behind for a
      component), or a function of the `Trajectory` that returns numbers of shape `[]`, `[time]` or `[time, k]`, each
      column relative to its own largest magnitude among the numbers returned. By default all coordinates and
      velocities, each relative to its own.

    **Returns:**

    A `Trajectory`.

    **Raises:**

    - `ValueError` for wrong shapes, types or ranges, before anything runs; for `accuracy` where numbers are traced.
    - `SimulationError` if the run ended early, or no run of the accuracy was found, and `throw` is set. Inside
      `jax.jit`, `jax.vmap` or `jax.grad` the same sentence comes as equinox's run-time error. That calls Python, and
      JAX keeps no compiled program that does in its persistent cache: pass `throw=False` there, and read `run.result`.
    """
    throw = as_flag(throw, name="throw")
    problem, options = prepare(
        scene,
        q0,
        qd0,
        t1,
        t0,
        ts,
        z0,
        rtol,
        atol,
        dt,
        dtmax,
        solver,
        adjoint,
        max_steps,
        max_events,
        hold_chatter,
        project,
    )
    if accuracy is not None or observable is not None:
        return reach(problem, options, accuracy, observable, (rtol, atol), throw)
    try:
        solved = solve(problem, options)
    except TypeError as error:
        if "custom_vjp" in str(error) and adjoint is None:
            raise TypeError(
                "Forward-mode derivatives of simulate need adjoint=diffrax.ForwardMode(); the default adjoint is for"
                " reverse mode (jax.grad)."
            ) from error
        raise
    if throw:
        solved = _raise_early_end(problem, solved)
    return trajectory(problem, options, solved)


def prepare(
    scene: Any,
    q0: Any,
    qd0: Any,
    t1: Any,
    t0: Any = 0.0,
    ts: Any = None,
    z0: Any = None,
    rtol: Any = 1e-6,
    atol: Any = 1e-9,
    dt: Any = None,
    dtmax: Any = None,
    solver: Any = None,
    adjoint: Any = None,
    max_steps: Any = 16384,
    max_events: Any = 1024,
    hold_chatter: Any = False,
    project: Any = True,
) -> tuple[Problem, Options]:
    """Convert and check the arguments of `simulate`: its numbers, and what is compiled in."""
    problem = _problem(scene, q0, qd0, t1, t0, ts, z0, rtol, atol, dt, dtmax)
    max_steps, max_events = as_whole(max_steps, name="max_steps"), as_whole(max_events, name="max_events")
    hold_chatter, project = as_flag(hold_chatter, name="hold_chatter"), as_flag(project, name="project")
    solver_arrays, solver_rest = _split(solver, dfx.AbstractSolver, "solver")
    if isinstance(solver, ImplicitFriction):
        if dt is None:
            raise ValueError(
                "ImplicitFriction takes fixed steps and has no estimate of its error: pass the step, as in dt=1e-3."
            )
        check_step(scene)
    if isinstance(adjoint, dfx.BacksolveAdjoint):
        raise ValueError(
            "simulate cannot use diffrax.BacksolveAdjoint, which knows neither events nor projections nor what is kept"
            " of a run. Leave adjoint out, or pass diffrax.ForwardMode()."
        )
    adjoint_arrays, adjoint_rest = _split(adjoint, dfx.AbstractAdjoint, "adjoint")
    problem = problem._replace(plugins=(solver_arrays, adjoint_arrays))
    options = Options(solver_rest, adjoint_rest, max_steps, max_events, hold_chatter, project)
    return problem, options


def _known(*values: Any) -> bool:
    return not any(isinstance(value, jax.core.Tracer) for value in values)


def _array(value: Any, dtype: Any) -> Any:
    """As an array of `dtype`: NumPy for what is known (cheaper to hand over), JAX for what is traced or on a device."""
    if isinstance(value, jax.Array):
        return value if value.dtype == dtype else value.astype(dtype)
    return np.asarray(value, dtype)


def _problem(
    scene: Any, q0: Any, qd0: Any, t1: Any, t0: Any, ts: Any, z0: Any, rtol: Any, atol: Any, dt: Any, dtmax: Any
) -> Problem:
    """Convert and check all numbers of a run."""
    if not isinstance(scene, Scene):
        raise ValueError(f"simulate needs a Scene, but a {type(scene).__name__} was given.")
    # A list may hold numbers that are traced, as in qd0=[scene.params["v"]].
    q0, qd0, ts = (
        jnp.asarray(value) if isinstance(value, list | tuple) and not _known(*value) else value
        for value in (q0, qd0, ts)
    )
    given = {"q0": q0, "qd0": qd0, "t1": t1, "t0": t0, "rtol": rtol, "atol": atol}
    given |= {name: value for name, value in (("ts", ts), ("dt", dt), ("dtmax", dtmax)) if value is not None}
    for name, value in given.items():
        if type(value) is not float:
            check_real(value, name=name)
    kinds = {x.dtype for x in (*jtu.tree_leaves(scene), q0, qd0) if hasattr(x, "dtype")}
    dtype = kinds.pop() if len(kinds) == 1 else jnp.result_type(*kinds) if kinds else jnp.result_type(float)
    if not jnp.issubdtype(dtype, jnp.floating):
        dtype = jnp.result_type(float)
    array = {name: _array(value, dtype) for name, value in given.items()}
    for name in ("q0", "qd0"):
        if array[name].ndim != 1 or array[name].shape[0] == 0 or array[name].shape != array["q0"].shape:
            raise ValueError(
                f"q0 and qd0 must both have the shape [dof], but q0 has the shape {array['q0'].shape} and qd0"
                f" {array['qd0'].shape}."
            )
    for name in ("t0", "t1", "rtol", "atol", "dt", "dtmax"):
        if name in array and array[name].shape != ():
            raise ValueError(f"{name} must be one number, but has the shape {array[name].shape}.")
    _check_values(array)
    _check_span(t0, t1, array)
    if array["q0"].shape != (1,):
        _check_slips(scene, array["q0"], array["t0"])
    return Problem(
        scene,
        array["q0"],
        array["qd0"],
        {} if z0 is None else _own_states(scene, array["q0"], z0, dtype),
        array["t0"],
        array["t1"],
        array.get("ts"),
        array["rtol"],
        array["atol"],
        array.get("dt"),
        array.get("dtmax"),
        None,
    )


def _check_span(t0: Any, t1: Any, array: dict[str, Any]) -> None:
    """Refuse times that differ, but not in the type the run has: it would end where it begins, and all be well."""
    if _known(t0, t1) and array["t0"] == array["t1"] and t0 != t1:
        raise ValueError(
            f"t0 = {t0} and t1 = {t1} are the same number in {array['t0'].dtype}: count the time from another moment,"
            " or pass q0 in float64."
        )


def _check_slips(scene: Scene, q0: Any, t0: Any) -> None:
    """Refuse the velocity of a belt that is a number where slip is a vector."""
    for i, effect in enumerate(scene.effects):
        if not isinstance(effect, Friction) or effect.along is None or callable(effect.belt_velocity):
            continue
        # Asked first, as the rest takes time.
        if _known(effect.belt_velocity) and np.any(np.asarray(effect.belt_velocity) != 0):
            effect.check_belt(q0, scene.bind_time(jnp.asarray(t0)).params, scene.names[i])


def _own_states(scene: Scene, q0: Any, z0: dict[str, PyTree], dtype: Any) -> dict[str, PyTree]:
    """Convert and check the initial own states that were given."""
    z0 = as_mapping(z0, name="z0", example="{'friction': 0.0}")
    states = scene.initial_state(jnp.asarray(q0, dtype))
    for name, state in z0.items():
        if name not in states:
            raise ValueError(
                f"z0 names {name!r}, but the effects with a state of their own are: {', '.join(states) or 'none'}."
            )
        if jtu.tree_structure(state) != jtu.tree_structure(states[name]):
            raise ValueError(f"z0[{name!r}] must have the structure of {states[name]}, but {state} was given.")
        if [jnp.shape(x) for x in jtu.tree_leaves(state)] != [jnp.shape(x) for x in jtu.tree_leaves(states[name])]:
            raise ValueError(f"z0[{name!r}] must have the shapes of {states[name]}, but {state} was given.")
    return {name: jtu.tree_map(lambda x: _array(x, dtype), state) for name, state in z0.items()}


def _check_values(array: dict[str, Any]) -> None:
    """Check the values that are known now; those that are traced are checked in the run."""
    known = {name: np.asarray(value) for name, value in array.items() if _known(value)}
    for name, value in known.items():
        if not (math.isfinite(value) if value.ndim == 0 else np.isfinite(value).all()):
            raise ValueError(f"{name} must be finite, but it is {value}.")
    for name in ("rtol", "atol"):
        if name in known and known[name] < 0:
            raise ValueError(f"{name} must not be negative, but it is {known[name]}.")
    if "rtol" in known and "atol" in known and known["rtol"] + known["atol"] <= 0:
        raise ValueError("rtol and atol must not both be zero.")
    for name in ("dt", "dtmax"):
        if name in known and known[name] <= 0:
            raise ValueError(f"{name} must be positive, but it is {known[name]}.")
    if "dt" in array and "dtmax" in array:
        raise ValueError("dt fixes the step, so dtmax has no place beside it: pass one of them.")
    t0, t1, ts = known.get("t0"), known.get("t1"), known.get("ts")
    if t0 is not None and t1 is not None and t1 < t0:
        raise ValueError(f"t1 must not be before t0, but t0 = {t0} and t1 = {t1}.")
    if "ts" in array and (array["ts"].ndim != 1 or array["ts"].shape[0] == 0):
        raise ValueError(f"ts must be a vector of times, shape [time], but it has the shape {array['ts'].shape}.")
    if ts is not None and (np.diff(ts) < 0).any():
        raise ValueError("ts must increase.")
    if ts is not None and t0 is not None and t1 is not None and not (t0 <= ts[0] and ts[-1] <= t1):
        raise ValueError(f"ts must lie within [t0, t1] = [{t0}, {t1}], but runs from {ts[0]} to {ts[-1]}.")


def _split(plugin: Any, kind: type, name: str) -> tuple[Any, Any]:
    """Arrays of a plug-in, and the rest of it, which is compiled in."""
    if plugin is None:
        return None, None
    if not isinstance(plugin, kind):
        raise ValueError(f"{name} must be a diffrax.{kind.__name__} object, but {plugin!r} was given.")
    return eqx.partition(plugin, eqx.is_array)


def _raise_early_end(problem: Problem, solved: Solved) -> Solved:
    """Raise for a run that ended early: at once where its values are known, by a run-time check where traced."""
    if _known(solved.code):
        code = int(solved.code)
        if code != SUCCESS:
            t, y = solved.end or (solved.t[-1], jtu.tree_map(lambda x: x[-1], solved.y))
            raise SimulationError(describe_failure(problem.scene, float(t), y, code))
        return solved
    messages = outcome_messages(problem.scene, problem.q0.shape[0])
    return eqx.branched_error_if(solved, solved.code != SUCCESS, solved.code, messages)
