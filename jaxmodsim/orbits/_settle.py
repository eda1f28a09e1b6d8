"""The start of the search for an orbit: a simulation that settles."""

from collections.abc import Sequence

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ..scene import State
from ..simulation import SimulationError, Trajectory
from ._neutral import anchored, moving_on
from ._return_map import MAX_STEPS, OrbitError, OrbitProblem, Section, SettledState, run_between

# Number of saved times of a run.
_TIMES = 4001
# A run returns if two states are nearer than this, relative to its extent.
_NEAR = 0.02
# Largest such distance, if the run comes no nearer.
_FAR = 0.2
# Sufficient distance of the start of a segment from changes of modes, in segments.
_CLEAR = 0.1
# A range below this number of tolerances of the run is no motion.
_NOISE = 10.0
# Returns are searched for in this last fraction of the run.
_LAST = 0.5


def run_for(problem: OrbitProblem, state: State, t0: float, ts: np.ndarray) -> Trajectory:
    """A run of the scene from t0 to the last of the times `ts`."""
    try:
        return run_between(problem, problem.scene, state, (t0, ts[-1]), jnp.asarray(ts), max_steps=MAX_STEPS)
    except SimulationError as error:
        raise OrbitError(f"The run over one period, or until it settles, failed: {error}") from error


def states_of(*runs: Trajectory) -> np.ndarray:
    """States along consecutive runs, shape `[time, n]`."""
    return np.concatenate([_states(run) for run in runs])


def _states(run: Trajectory) -> np.ndarray:
    rows = [run.q, run.qd, *jtu.tree_leaves(run.z)]
    return np.concatenate([np.asarray(x).reshape(len(run.t), -1) for x in rows], axis=1)


def modes_of(run: Trajectory) -> np.ndarray:
    """Modes along a run, shape `[time, elements]`."""
    none = np.zeros((len(run.t), 0))
    return np.stack([np.asarray(mode) for mode in run.mode.values()], axis=1) if run.mode else none


def held(run: Trajectory) -> np.ndarray:
    """Number of elements in stick and of closed contacts at each time of a run, shape `[time]`."""
    return np.sum(modes_of(run) == np.asarray([holding_mode(run, name) for name in run.mode]), axis=1)


def holding_mode(run: Trajectory, name: str) -> float:
    """The mode in which an element holds a velocity at zero: stick, or a closed contact; NaN for a switch."""
    return 0.0 if name in run.scene.event_driven else 1.0 if name in run.scene.contacts else np.nan


def held_throughout(runs: Sequence[Trajectory], since: int = 0) -> tuple[str, ...]:
    """Names of the friction elements that stick at all times of the runs, from the index `since` on."""
    names = runs[0].scene.event_driven
    return tuple(name for name in names if not any(np.any(run.mode[name][since:]) for run in runs))


def begins(at: np.ndarray, modes: np.ndarray, held: np.ndarray, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the states at which segments begin, and their times: about equally long, if possible in slip.

    `at` are the times of the states in periods, from 0 on, in any order.
    """
    order = np.argsort(at, kind="stable")
    changes = at[order][1:][np.any(np.diff(modes[order], axis=0) != 0, axis=1)]
    clear = np.min(np.abs(at[:, None] - changes), axis=1, initial=_CLEAR / segments)
    first = int(np.argmin(at))
    chosen = [first]
    for target in np.arange(1, segments) / segments:
        near = np.flatnonzero(np.abs(at - target) < 0.45 / segments)
        chosen.append(min(map(int, near), key=lambda i: (held[i], -clear[i], abs(at[i] - target))))
    return np.asarray(chosen), at[chosen] - at[first]


def settled(problem: OrbitProblem, state: State, settle: float, section: Section | None, segments: int) -> SettledState:
    """The state after `settle` seconds, where an orbit of unknown period may begin, and a first period.

    **Raises:**

    - `OrbitError` if the run comes to rest, or does not return.
    """
    if problem.period is not None:
        period = float(problem.period(problem.scene.params))
        t0 = float(problem.phase) * period
        count = max(round(settle / period), 0)
        if count:
            run = run_for(problem, state, t0, np.asarray([t0 + count * period]))
            state = jtu.tree_map(lambda a: a[-1], State(run.q, run.qd, run.z))
        run = run_for(problem, state, t0, np.linspace(t0, t0 + period, 257))
        return cut(problem, [run], period, segments)
    ts = np.linspace((1.0 - _LAST) * settle, settle, _TIMES)
    run = run_for(problem, state, 0.0, ts)
    x = states_of(run)
    dof = state.q.shape[-1]
    scale = magnitudes(problem, x, dof, settle)
    returning, moving = x, ""
    if moving_on(problem.scene, x[-1] - x[0], scale[:dof]):
        half = SettledState(x[:1], np.zeros(1), ts[-1] - ts[0], scale, ())
        here, half = anchored(problem, half, dof)
        returning, moving = x - x @ np.asarray(here.free).T, half.moving
    period = _return_time(ts, returning / scale[: x.shape[1]], moving)
    last = ts >= settle - period
    scale = magnitudes(problem, x[last], dof, period)
    at = _beginning(run, x / scale[:-1], np.flatnonzero(last), section)
    since = (ts[last] - ts[at]) / period % 1.0
    chosen, cuts = begins(since, modes_of(run)[last], held(run)[last], segments)
    return SettledState(x[last][chosen], cuts, period, scale, held_throughout([run], int(np.argmax(last))))


def cut(problem: OrbitProblem, runs: Sequence[Trajectory], period: float, segments: int) -> SettledState:
    """A start on runs that lead through a period, one after the other."""
    t, x = np.concatenate([np.asarray(run.t) for run in runs]), states_of(*runs)
    modes, stuck = (np.concatenate([of(run) for run in runs]) for of in (modes_of, held))
    chosen, cuts = begins((t - t[0]) / period, modes, stuck, segments)
    scale = magnitudes(problem, x, runs[0].q.shape[1], period)
    return SettledState(x[chosen], cuts, period, scale, held_throughout(runs))


def magnitudes(problem: OrbitProblem, x: np.ndarray, dof: int, period: float) -> np.ndarray:
    """Half the range of each entry of the state along a run, and the period; entries at rest have their magnitude.

    A range within the errors of the run counts as rest. The velocity of a coordinate has at least the magnitude of the
    coordinate over the period.
    """
    half, size = 0.5 * np.ptp(x, axis=0), np.max(np.abs(x), axis=0)
    noise = _NOISE * (float(problem.rtol) * size + float(problem.atol))
    half = np.where(half > noise, half, np.where(size > noise, size, 1.0))
    half[dof : 2 * dof] = np.maximum(0.5 * np.ptp(x[:, dof : 2 * dof], axis=0), half[:dof] / period)
    return np.append(half, period)


def _return_time(ts: np.ndarray, x: np.ndarray, moving: str) -> float:
    """Time [s] since the run was last in its final state, searched backwards along its path."""
    begin, way = x[1:][::-1] - x[-1], (x[:-1] - x[1:])[::-1]
    length = np.sum(way * way, axis=1)
    part = np.clip(-np.sum(begin * way, axis=1) / np.where(length > 0, length, 1.0), 0.0, 1.0)
    apart = np.max(np.abs(begin + part[:, None] * way), axis=1)
    away = np.flatnonzero(apart > 0.5)
    if not len(away):
        raise OrbitError(
            "The run comes to rest, or does not move enough to have a period. Begin at another state. An equilibrium is"
            " no periodic orbit."
        )
    first = int(away[0])
    later = apart[first:]
    lowest = np.flatnonzero((later[1:-1] <= later[:-2]) & (later[1:-1] < later[2:])) + 1
    near = [int(i) for i in lowest if later[i] < max(_NEAR, 3.0 * np.min(later[lowest]))]
    if not near or later[near[0]] > _FAR:
        raise OrbitError(
            "The run does not return to an earlier state in the second half of `settle`. Pass a longer `settle`. If the"
            f" motion decays, begin farther from rest: there may be no stable orbit here.{moving}"
        )
    return float((first + near[0] + part[first + near[0]]) * (ts[1] - ts[0]))


def _beginning(run: Trajectory, x: np.ndarray, last: np.ndarray, section: Section | None) -> int:
    """Index of the start of an orbit: on the section, or in the middle of its longest phase, in slip if possible."""
    if section is not None:
        values = np.asarray([float(section(run.q[i], run.qd[i])) for i in last])
        up = np.flatnonzero((values[:-1] < 0) & (values[1:] >= 0))
        if not len(up):
            raise OrbitError(
                f"The section is not crossed from below along the orbit: its values range from {values.min():.4g} to"
                f" {values.max():.4g}. Pass a section that is zero on the orbit, or none."
            )
        return int(last[up[-1]])
    if run.modes is None:
        speed = np.linalg.norm(np.diff(x[last], axis=0), axis=1)
        return int(last[int(np.argmax(speed))])
    modes, stuck = modes_of(run)[last], held(run)[last]
    cuts = np.flatnonzero(np.any(modes[1:] != modes[:-1], axis=1)) + 1
    pieces = np.split(np.arange(len(last)), cuts)
    if len(pieces) > 1 and np.array_equal(modes[-1], modes[0]):
        # The first and the last piece are one phase.
        pieces = [np.concatenate([pieces[-1], pieces[0]]), *pieces[1:-1]]
    piece = min(pieces, key=lambda each: (stuck[each[0]], -len(each)))
    return int(last[piece[len(piece) // 2]])
