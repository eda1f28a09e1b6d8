"""Where the search for an orbit starts: a simulation that settles."""

from typing import NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ..scene import State
from ..simulation import SimulationError, Trajectory, simulate
from ._return_map import MAX_EVENTS, MAX_STEPS, OrbitError, OrbitProblem, Section, pack

# Times at which a run is looked at.
_TIMES = 4001
# Distance of two states of a run, in its extent, that is a return.
_NEAR = 0.02
# And the largest one, where a run comes no nearer.
_FAR = 0.2
# Part of the run at its end in which returns are looked for.
_LAST = 0.5


class SettledState(NamedTuple):
    """Where the search starts: state, period [s], and the magnitudes of state and period."""

    x: np.ndarray
    period: float
    scale: np.ndarray


def run_for(problem: OrbitProblem, state: State, t0: float, ts: np.ndarray) -> Trajectory:
    """A run of the scene from t0 to the last of these times."""
    try:
        return simulate(
            *(problem.scene, state.q, state.qd, ts[-1]),
            t0=t0,
            z0=state.z,
            ts=jnp.asarray(ts),
            rtol=problem.rtol,
            atol=problem.atol,
            max_steps=MAX_STEPS,
            max_events=MAX_EVENTS,
        )
    except SimulationError as error:
        raise OrbitError(f"The run over one period, or until it settles, failed: {error}") from error


def states_of(run: Trajectory) -> np.ndarray:
    """States along a run, shape `[time, n]`."""
    rows = [run.q, run.qd, *jtu.tree_leaves(run.z)]
    return np.concatenate([np.asarray(x).reshape(len(run.t), -1) for x in rows], axis=1)


def held(run: Trajectory) -> np.ndarray:
    """How many elements stick, and contacts are closed, at each time of a run that has modes, shape `[time]`."""
    friction = run.scene.event_driven
    return np.sum([np.asarray(mode) == (0 if name in friction else 1) for name, mode in run.mode.items()], axis=0)


def settled(problem: OrbitProblem, state: State, settle: float, section: Section | None) -> SettledState:
    """The state after `settle` seconds, where an orbit of unknown period may begin, and a first period.

    **Raises:**

    - `OrbitError` where the run comes to rest, or does not return.
    """
    if problem.period is not None:
        period = float(problem.period(problem.scene.params))
        t0 = float(problem.phase) * period
        count = max(round(settle / period), 0)
        x = np.asarray(pack(state))
        if count:
            run = run_for(problem, state, t0, np.asarray([t0 + count * period]))
            state, x = jtu.tree_map(lambda a: a[-1], State(run.q, run.qd, run.z)), states_of(run)[-1]
        run = run_for(problem, state, t0, np.linspace(t0, t0 + period, 257))
        return SettledState(x, period, magnitudes(states_of(run), period))
    ts = np.linspace((1.0 - _LAST) * settle, settle, _TIMES)
    run = run_for(problem, state, 0.0, ts)
    x = states_of(run)
    scale = magnitudes(x, 1.0)
    period = _return_time(ts, x / scale[: x.shape[1]])
    last = ts >= settle - period
    scale = magnitudes(x[last], period)
    at = _beginning(run, x, np.flatnonzero(last), section)
    return SettledState(x[at], period, scale)


def magnitudes(x: np.ndarray, period: float) -> np.ndarray:
    """Half the range of each entry of the state along a run, and the period; of what does not move its magnitude."""
    half, size = 0.5 * np.ptp(x, axis=0), np.max(np.abs(x), axis=0)
    half = np.where(half > 1e-9 * size, half, size)
    return np.append(np.where(half > 0, half, 1.0), period)


def _return_time(ts: np.ndarray, x: np.ndarray) -> float:
    """How long before its end a run was last in the same state; from the last piece of its path backwards."""
    begin, way = x[1:][::-1] - x[-1], (x[:-1] - x[1:])[::-1]
    length = np.sum(way * way, axis=1)
    part = np.clip(-np.sum(begin * way, axis=1) / np.where(length > 0, length, 1.0), 0.0, 1.0)
    apart = np.max(np.abs(begin + part[:, None] * way), axis=1)
    away = np.flatnonzero(apart > 0.5)
    if not len(away):
        raise OrbitError(
            "The run comes to rest, or does not move enough to have a period. Begin elsewhere; an equilibrium is no"
            " periodic orbit."
        )
    first = int(away[0])
    later = apart[first:]
    lowest = np.flatnonzero((later[1:-1] <= later[:-2]) & (later[1:-1] < later[2:])) + 1
    near = [int(i) for i in lowest if later[i] < max(_NEAR, 3.0 * np.min(later[lowest]))]
    if not near or later[near[0]] > _FAR:
        raise OrbitError(
            "The run does not return to where it was in the second half of `settle`: pass a longer `settle`, or there"
            " is no stable orbit here."
        )
    return float((first + near[0] + part[first + near[0]]) * (ts[1] - ts[0]))


def _beginning(run: Trajectory, x: np.ndarray, last: np.ndarray, section: Section | None) -> int:
    """Index of a state for an orbit to begin at: on the section, or where no mode changes for longest, in slip."""
    if section is not None:
        values = np.asarray([float(section(run.q[i], run.qd[i])) for i in last])
        up = np.flatnonzero((values[:-1] < 0) & (values[1:] >= 0))
        if not len(up):
            raise OrbitError(
                f"The section is not crossed from below along the orbit: its values go from {values.min():.4g} to"
                f" {values.max():.4g}. Pass one that is zero on it, or none."
            )
        return int(last[up[-1]])
    if run.modes is None:
        speed = np.linalg.norm(np.diff(x[last] / magnitudes(x[last], 1.0)[:-1], axis=0), axis=1)
        return int(last[int(np.argmax(speed))])
    modes, stuck = np.stack([np.asarray(mode) for mode in run.mode.values()], axis=1)[last], held(run)[last]
    cuts = np.flatnonzero(np.any(modes[1:] != modes[:-1], axis=1)) + 1
    pieces = np.split(np.arange(len(last)), cuts)
    pieces = pieces[1:-1] if len(pieces) > 2 else pieces  # the others are cut off by the ends
    piece = min(pieces, key=lambda each: (stuck[each[0]], -len(each)))
    return int(last[piece[len(piece) // 2]])
