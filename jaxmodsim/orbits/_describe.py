"""From a solved start to a `PeriodicOrbit`."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..simulation import Trajectory
from ._orbit import PeriodicOrbit, Sequence
from ._return_map import OrbitProblem, ShotOrbit, unpack
from ._settle import magnitudes, run_for, states_of

# Intervals along an orbit between which extrema are interpolated.
_INTERVALS = 512
# Multipliers that a phase in stick makes zero are that small but for errors of the run.
_ZERO = 1e-4


class Extremes(NamedTuple):
    """The least or greatest values of the coordinates along an orbit, shape `[dof]` each.

    - `time`: about when [s]; `acceleration`: then, infinite where the velocity is not zero (an impact, the ends).
    """

    value: np.ndarray
    time: np.ndarray
    acceleration: np.ndarray


def describe(problem: OrbitProblem, point: ShotOrbit, dof: int) -> tuple[PeriodicOrbit, Extremes, Extremes]:
    """The orbit, and its least and greatest coordinates."""
    problem, once = _once(problem, point, dof)
    scene, period = problem.scene, point.period
    state = unpack(scene, jnp.asarray(point.x), dof)
    changes = [x for x in zip(*(np.asarray(each).tolist() for each in once.events), strict=True) if x[0] < np.inf]
    begin, end = float(once.inputs.t0), float(once.inputs.t1)
    times = np.clip([x[0] for x in changes], begin, end)
    # Of a length that few numbers of events change, for which nothing is compiled anew.
    padding = (-len(times)) % 16
    run = run_for(
        *(problem, state, begin),
        np.sort(np.concatenate([np.linspace(begin, end, _INTERVALS + 1), times, [end] * padding])),
    )
    shares, held = _shares(once, run, changes, (begin, end))
    strikes = times[[scene.part_names[i] in scene.contacts for _, i, _, _ in changes]]
    lowest, highest = (_extremes(run, sign, strikes) for sign in (-1.0, 1.0))
    x = states_of(run)
    scale = magnitudes(x, period)[:-1]
    orbit = PeriodicOrbit(
        jnp.asarray(begin),
        *state,
        jnp.asarray(period),
        jnp.asarray(lowest.value),
        jnp.asarray(highest.value),
        floquet(problem, point, held, scale),
        problem.autonomous,
        float(np.max(np.abs(point.residual[: len(point.x)]) / scale)),
        run,
        _sequence(once),
        shares,
    )
    return orbit, lowest, highest


def _once(problem: OrbitProblem, point: ShotOrbit, dof: int) -> tuple[OrbitProblem, Trajectory]:
    """The problem at the value of the parameter, and a run over a period of which the end alone is kept."""
    problem = eqx.tree_at(lambda p: p.scene, problem, problem.with_value(point.value))
    state = unpack(problem.scene, jnp.asarray(point.x), dof)
    t0 = float(problem.phase) * point.period
    return problem, run_for(problem, state, t0, np.asarray([t0 + point.period]))


def mode_sequence(problem: OrbitProblem, point: ShotOrbit, dof: int) -> Sequence:
    """Mode changes of a period, from the start of the orbit on."""
    return _sequence(_once(problem, point, dof)[1])


def _sequence(run: Trajectory) -> Sequence:
    return tuple((x.effect, x.before, x.after) for x in run.mode_changes)


def _shares(
    once: Trajectory, run: Trajectory, changes: list[tuple[float, int, int, int]], span: tuple[float, float]
) -> tuple[dict[str, float], int]:
    """Part of the period in which each element is held, and the number of multipliers that must be zero."""
    scene = once.scene
    if run.modes is None:
        return {}, 0
    friction, names = list(scene.event_driven), scene.part_names
    first = {name: int(x[0]) for name, x in run.mode.items()}
    for _, i, before, _ in reversed(changes):
        first[names[i]] = int(before)
    (t, end), zeros = span, 0
    period, modes, shares = end - t, dict(first), dict.fromkeys(first, 0.0)
    for time, i, _, after in [*changes, (end, -1, 0, 0)]:
        held = [name for name, mode in modes.items() if (mode == 0) == (name in friction)]
        for name in held:
            shares[name] += (time - t) / period
        if time - t > 1e-9 * period:
            sticking = [name for name in held if name in friction]
            zeros = max(zeros, _directions(once, sticking, t) + 2 * (len(held) - len(sticking)))
        t = time
        if i >= 0:
            modes[names[i]] = int(after)
    return shares, zeros


def _directions(run: Trajectory, held: list[str], t: float) -> int:
    """Number of independent velocities that these sticking elements take away."""
    scene = run.scene.bind_time(jnp.asarray(t))
    if not held:
        return 0
    rows = [np.asarray(scene.event_driven[name].direction(run.q[-1], scene.params)) for name in held]
    return int(np.linalg.matrix_rank(np.vstack(rows), tol=1e-6))


def floquet(problem: OrbitProblem, point: ShotOrbit, zeros: int, scale: np.ndarray) -> np.ndarray:
    """Floquet multipliers, with the 1 and the zeros that are known exactly."""
    monodromy = point.monodromy * scale[None, :] / scale[:, None]
    if problem.autonomous:
        # On the plane normal to the flow, along the flow: what is left are the others.
        flow = point.flow / scale
        flow = flow / np.linalg.norm(flow)
        basis = np.linalg.svd(flow[None, :])[2][1:].T
        monodromy = basis.T @ monodromy @ basis
    values = np.linalg.eigvals(monodromy).astype(complex)
    values = values[np.argsort(-np.abs(values), kind="stable")]
    small = np.arange(len(values)) >= len(values) - zeros
    values = np.where(small & (np.abs(values) < _ZERO), 0.0, values)
    return np.append(1.0, values) if problem.autonomous else values


def _extremes(run: Trajectory, sign: float, strikes: np.ndarray) -> Extremes:
    """Where `sign q` is greatest along a run: on cubics between the times of the run.

    Before an impact the velocity is another one than at it, so there the ends of the interval are all.
    """
    t, q, qd = np.asarray(run.t), sign * np.asarray(run.q), sign * np.asarray(run.qd)
    h = np.diff(t)[:, None]
    a, b, c = q[:-1], h * qd[:-1], np.diff(q, axis=0)
    u, v = 3.0 * c - 2.0 * b - h * qd[1:], b + h * qd[1:] - 2.0 * c  # a + b s + u s^2 + v s^3
    # Root of the derivative at which it falls, in a form without cancellation.
    root = np.sqrt(np.maximum(u * u - 3.0 * v * b, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(u < 0, b / (root - u), (-u - root) / (3.0 * v))
    inside = (s > 0) & (s < 1) & (h > 0) & ~np.isin(t[1:], strikes)[:, None]
    s = np.where(inside, s, 0.0)
    values = a + s * (b + s * (u + s * v))
    values = np.concatenate([values, q[-1:]])
    at = np.concatenate([t[:-1, None] + s * h, np.full((1, q.shape[1]), t[-1])])
    with np.errstate(divide="ignore", invalid="ignore"):
        acceleration = np.where(inside, (2.0 * u + 6.0 * v * s) / h**2, np.inf)
    acceleration = np.concatenate([acceleration, np.full((1, q.shape[1]), np.inf)])
    place = np.argmax(values, axis=0), np.arange(q.shape[1])
    return Extremes(sign * values[place], at[place], sign * acceleration[place])
