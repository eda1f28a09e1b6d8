"""From a solved start to a `PeriodicOrbit`."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..simulation import Trajectory
from ._neutral import neutral_directions
from ._orbit import PeriodicOrbit, Sequence
from ._return_map import OrbitError, OrbitProblem, ShotOrbit, unpack
from ._settle import holding_mode, magnitudes, run_for, states_of

# Intervals along a segment of an orbit between which extrema are interpolated.
_INTERVALS = 512
# Rounding units of time by which a state before an event is saved before it.
_BEFORE = 8192.0
# Residual in the extent of an orbit that is none, or so many tolerances of the run.
_MISSED, _TOLERANCES = 1e-6, 1e3
# Multipliers that a phase in stick makes zero are that small but for errors of the run.
_ZERO = 1e-4
# Passes through the segments after which a basis is that of the multipliers, if these differ.
_SWEEPS = 4


class Extremes(NamedTuple):
    """The least or greatest values of the coordinates along an orbit, shape `[dof]` each.

    - `time`: about when [s]; `acceleration`: then, infinite where the velocity is not zero (an impact, the ends).
    - `struck`: names of the contacts that are struck then, "" where there is no impact; the time is before the impact.
    """

    value: np.ndarray
    time: np.ndarray
    acceleration: np.ndarray
    struck: tuple[str, ...]


def describe(problem: OrbitProblem, point: ShotOrbit, dof: int) -> tuple[PeriodicOrbit, Extremes, Extremes]:
    """The orbit, and its least and greatest coordinates."""
    problem, period = eqx.tree_at(lambda p: p.scene, problem, problem.with_values(point.values)), point.period
    scene, spans = problem.scene, np.asarray(problem.spans) * period
    states = [unpack(scene, jnp.asarray(x), dof) for x in point.x]
    # Their ends alone are kept: of what is read from them, events, a log is made beside another run.
    once = [run_for(problem, x, begin, np.asarray([end])) for x, (begin, end) in zip(states, spans, strict=True)]
    changes = [_changes(each) for each in once]
    runs = []
    for x, (begin, end), events in zip(states, spans, changes, strict=True):
        times = np.clip([change[0] for change in events], begin, end)
        times = np.concatenate([np.maximum(times - _before(end), begin), times])
        # Of a length that few numbers of events change, for which nothing is compiled anew.
        padding = (-len(times)) % 16
        grid = np.linspace(begin, end, _INTERVALS + 1)
        runs.append(run_for(problem, x, begin, np.sort(np.concatenate([grid, times, [end] * padding]))))
    happened = [change for events in changes for change in events]
    whole = float(spans[0, 0]), float(spans[-1, 1])
    shares, held = _shares(once[0], runs[0], happened, whole)
    strikes = [(x[0], scene.part_names[x[1]]) for x in happened if scene.part_names[x[1]] in scene.contacts]
    lowest, highest = (_extremes(runs, sign, strikes) for sign in (-1.0, 1.0))
    scale = magnitudes(problem, states_of(*runs), dof, period)[:-1]
    for name in problem.held:
        if any(scene.part_names[i] == name for _, i, _, _ in happened):
            raise OrbitError(
                f"{name} sticks throughout near the start of the search, and the orbit begins in the place where it"
                " sticks; but in this place it slips on the orbit. Begin where it sticks, or from a longer `settle`."
            )
    missed = float(np.max(np.abs(point.residual[: point.x.size].reshape(point.x.shape)) / scale))
    if missed > max(_MISSED, _TOLERANCES * float(problem.rtol)):
        raise OrbitError(
            f"No convergence to a periodic orbit: the state misses itself by {missed:.3g} of the extent of the motion."
            " Errors grow out of all digits on a run over the period: pass more `segments`."
        )
    values = floquet(problem, point, held, scale, dof)
    neutral = point.x.shape[1] - len(values)
    orbit = PeriodicOrbit(
        jnp.asarray(whole[0]),
        *states[0],
        jnp.asarray(period),
        jnp.asarray(lowest.value),
        jnp.asarray(highest.value),
        np.append(np.ones(neutral), values),
        problem.autonomous,
        missed,
        tuple(runs),
        tuple(change for each in once for change in _sequence(each)),
        shares,
        jnp.asarray(point.advance[:dof]),
        neutral,
    )
    return orbit, lowest, highest


def _before(end: float) -> float:
    """How long [s] before an event the state before it is saved."""
    return _BEFORE * float(np.finfo(float).eps) * abs(end)


def _changes(run: Trajectory) -> list[tuple[float, int, int, int]]:
    """Events along a run: time, element, mode before and after."""
    events = run.events
    columns = (np.asarray(x).tolist() for x in (events.t, events.effect, events.before, events.after))
    return [x for x in zip(*columns, strict=True) if x[0] < np.inf]


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
        held = [name for name, mode in modes.items() if mode == holding_mode(once, name)]
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


def floquet(problem: OrbitProblem, point: ShotOrbit, zeros: int, scale: np.ndarray, dof: int) -> np.ndarray:
    """Floquet multipliers but for those that are exactly 1, with the zeros that are known exactly."""
    maps = list(point.maps * scale[None, :] / scale[:, None])
    bases = [np.eye(len(scale))] * len(maps)
    if problem.autonomous:
        # The planes normal to the flow: along the flow the multiplier is 1.
        bases = [np.linalg.svd((flow / scale)[None, :])[2][1:].T for flow in point.flows]
    if np.any(problem.pinned):
        along = bases[0].T @ neutral_directions(problem, point, scale, dof)
        bases[0] = bases[0] @ np.linalg.svd(along)[0][:, along.shape[1] :]
    maps = [b.T @ x @ a for a, x, b in zip(bases, maps, [*bases[1:], bases[0]], strict=True)]
    values = _eigenvalues_of_product(maps).astype(complex)
    values = values[np.argsort(-np.abs(values), kind="stable")]
    small = np.arange(len(values)) >= len(values) - zeros
    return np.where(small & (np.abs(values) < _ZERO), 0.0, values)


def _eigenvalues_of_product(maps: list[np.ndarray]) -> np.ndarray:
    """Eigenvalues of the product of matrices, the first one on the right, of which the product itself loses the small.

    Orthogonal iteration: passing through all factors again and again a basis turns into that in which each of them is
    triangular, and the product of those has each eigenvalue in its own row.
    """
    first = basis = product = np.eye(maps[0].shape[1])
    if len(maps) == 1:
        return np.linalg.eigvals(maps[0])
    for _ in range(_SWEEPS):
        first, product = basis, np.eye(len(basis))
        for each in maps:
            basis, triangle = np.linalg.qr(each @ basis)
            product = triangle @ product
    return np.linalg.eigvals(product @ (first.T @ basis))


def _extremes(runs: list[Trajectory], sign: float, strikes: list[tuple[float, str]]) -> Extremes:
    """Where `sign q` is greatest along runs: on cubics between their times, which are on either side of each event."""
    t, q, qd = (np.concatenate([np.asarray(getattr(run, name)) for run in runs]) for name in ("t", "q", "qd"))
    q, qd = sign * q, sign * qd
    h = np.diff(t)[:, None]
    a, b, c = q[:-1], h * qd[:-1], np.diff(q, axis=0)
    u, v = 3.0 * c - 2.0 * b - h * qd[1:], b + h * qd[1:] - 2.0 * c  # a + b s + u s^2 + v s^3
    # Root of the derivative at which it falls, in a form without cancellation.
    root = np.sqrt(np.maximum(u * u - 3.0 * v * b, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(u < 0, b / (root - u), (-u - root) / (3.0 * v))
    resolution = _before(t[-1])
    inside = (s > 0) & (s < 1) & (h > 2.0 * resolution)  # between the states before and after an event is no motion
    s = np.where(inside, s, 0.0)
    values = a + s * (b + s * (u + s * v))
    values = np.concatenate([values, q[-1:]])
    at = np.concatenate([t[:-1, None] + s * h, np.full((1, q.shape[1]), t[-1])])
    with np.errstate(divide="ignore", invalid="ignore"):
        acceleration = np.where(inside, (2.0 * u + 6.0 * v * s) / h**2, np.inf)
    acceleration = np.concatenate([acceleration, np.full((1, q.shape[1]), np.inf)])
    place = np.argmax(values, axis=0), np.arange(q.shape[1])
    time = at[place]
    hit = [next((x for x in strikes if abs(x[0] - each) <= 2.0 * resolution), None) for each in time]
    time = np.array([each if x is None else x[0] - resolution for each, x in zip(time, hit, strict=True)])
    struck = tuple("" if x is None else x[1] for x in hit)
    return Extremes(sign * values[place], time, sign * acceleration[place], struck)
