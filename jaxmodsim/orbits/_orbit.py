"""The class of periodic orbits, and its construction from a solution of the orbit's equations."""

from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._core.arrays import is_known
from .._core.readable import AbstractReadable, Table, short, table_of
from ..scene import State, quantity_of
from ..simulation import Trajectory
from ._neutral import neutral_directions
from ._return_map import OrbitError, OrbitProblem, ShotOrbit, unpack
from ._settle import holding_mode, magnitudes, run_for, states_of

# A multiplier nearer to the unit circle, or an eigenvalue nearer to the imaginary axis, does not decide on stability.
NEUTRAL = 1e-6
# Residuals above this value are printed.
_WORTH_SAYING = 1e-9
# Intervals of a segment between which extrema are interpolated.
_INTERVALS = 512
# The state before an event is saved this number of rounding units of time before it.
_BEFORE = 8192.0
# Largest residual relative to the extent of an orbit, and as a multiple of the tolerance of the run.
_MISSED, _TOLERANCES = 1e-6, 1e3
# A multiplier that a phase of stick makes zero is below this value, up to errors of the run.
_ZERO = 1e-4
# Number of orthogonal iterations for the eigenvalues of a product.
_SWEEPS = 4

# Name of an element, its mode before and after.
ModeSequence: TypeAlias = tuple[tuple[str, str, str], ...]


class PeriodicOrbit(AbstractReadable, eqx.Module):
    """A periodic orbit of a scene.

    `q`, `qd`, `z`, `period`, `lowest`, `highest` and `advance` have derivatives by all numbers of the scene.

    - `t0`: time [s] at the start: 0, except along a branch after a change of modes was at the start.
    - `q`, `qd`, `z`: state at the start, as in `simulate`.
    - `period`: [s].
    - `lowest`, `highest`: smallest and largest value of each coordinate, shape `[dof]`.
    - `multipliers`: Floquet multipliers, complex, shape `[n]`. The first `neutral` ones are exactly 1: one for an
      unknown period, one for each shift, one for each coordinate that sticks throughout. The others are in order of
      falling magnitude. A phase with an element in stick makes one of them zero, a phase with a closed contact two.
    - `autonomous`: whether the period was unknown.
    - `residual`: largest difference of the state after a period, relative to the extent of the orbit.
    - `runs`: the `Trajectory` over each segment of the period.
    - `sequence`: mode changes along the orbit: element, mode before, mode after.
    - `stick`: fraction of the period in which each friction element sticks or each contact is closed, by name. A
      coordinate that sticks throughout stays at the guess, or where the run from the guess settles.
    - `advance`: advance of each coordinate in a period [m or rad], shape `[dof]`; zero for those that return.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    orbit = jms.periodic_orbit(scene, ([0.0], [0.0]), settle=20.0)
    print(f"amplitude {orbit.amplitude[0]:.5f} m, stick {100 * orbit.stick['friction']:.2f} %, {orbit.stability}")
    ```

    ```text
    amplitude 0.03162 m, stick 61.32 %, stable
    ```
    """

    t0: Float[Array, ""]
    q: Float[Array, " dof"]
    qd: Float[Array, " dof"]
    z: dict[str, PyTree]
    period: Float[Array, ""]
    lowest: Float[Array, " dof"]
    highest: Float[Array, " dof"]
    multipliers: np.ndarray
    autonomous: bool = eqx.field(static=True)
    residual: float = eqx.field(static=True)
    runs: tuple[Trajectory, ...]
    sequence: ModeSequence = eqx.field(static=True)
    stick: dict[str, float]
    advance: Float[Array, " dof"]
    neutral: int = eqx.field(static=True)

    @property
    def state(self) -> State:
        """State at the start."""
        return State(self.q, self.qd, self.z)

    @property
    def run(self) -> Trajectory:
        """The run over the period.

        **Raises:**

        - `ValueError` for an orbit with several segments.
        """
        run, *others = self.runs
        if others:
            raise ValueError(
                f"This orbit was found in {len(self.runs)} segments: it has one run each, in `orbit.runs`."
            )
        return run

    @property
    def amplitude(self) -> Float[Array, " dof"]:
        """Half the distance between the turning points of each coordinate, shape `[dof]`."""
        return 0.5 * (self.highest - self.lowest)

    @property
    def energy(self) -> float:
        """Energy [J] dissipated in a period, which equals the supplied energy; impacts need two more runs."""
        return sum(float(run.energy.dissipated[-1]) for run in self.runs)

    @property
    def stable(self) -> bool:
        """Whether all multipliers, except those that are exactly 1, are inside the unit circle."""
        return self.stability == "stable"

    @property
    def stability(self) -> str:
        """`stable`, `unstable` with the multiplier, or `neutral` if first order does not decide."""
        multipliers = self.multipliers[self.neutral :]
        if not len(multipliers) or np.max(np.abs(multipliers)) < 1.0 - NEUTRAL:
            return "stable"
        largest = multipliers[int(np.argmax(np.abs(multipliers)))]
        if abs(largest) <= 1.0 + NEUTRAL:
            return "neutral: a multiplier is on the unit circle, and stability is not decided to first order"
        if abs(largest.imag) > NEUTRAL:
            return f"unstable: a pair of complex multipliers of magnitude {abs(largest):.6g}"
        return f"unstable: a multiplier of {largest.real:.6g}"


def format_complex(x: complex) -> str:
    """A complex number with six digits."""
    return f"{x.real:.6g}" if abs(x.imag) < 1e-12 else f"{x.real:.6g}{x.imag:+.6g}j"


@table_of.register
def _(orbit: PeriodicOrbit) -> Table:
    """Extent, period, stability, modes."""
    if not is_known(orbit.period):
        return Table("PeriodicOrbit, traced", (), [])
    scene = orbit.runs[0].scene
    columns = {"lowest": orbit.lowest, "highest": orbit.highest, "velocity at the start": orbit.qd}
    if np.any(orbit.advance):
        columns["advance"] = orbit.advance
    rows = [
        (quantity_of(scene, f"q[{i}]").label, *(short(x[i]) for x in columns.values())) for i in range(len(orbit.q))
    ]
    kind = "autonomous" if orbit.autonomous else "forced"
    held = [name for name, share in orbit.stick.items() if share > 1.0 - 1e-12 and name in scene.event_driven]
    changes = [f"{name}: {before} to {after}" for name, before, after in orbit.sequence]
    notes = [
        f"multipliers {', '.join(map(format_complex, orbit.multipliers))}",
        *(f"{name} sticks throughout, at or near the guess; other positions are possible" for name in held),
        *(f"{name} held {100 * share:.4g} % of the period" for name, share in orbit.stick.items() if name not in held),
        f"mode changes: {', '.join(changes) or 'none'}",
        *([f"residual {orbit.residual:.2g}"] if orbit.residual > _WORTH_SAYING else []),
    ]
    title = f"PeriodicOrbit, {kind}, period {short(orbit.period)} s, {orbit.stability}"
    return Table(title, ("", *columns), rows, tuple(notes))


class Extremes(NamedTuple):
    """The smallest or largest values of the coordinates along an orbit, shape `[dof]` each.

    - `time`: approximate time [s]. `acceleration`: at this time, infinite if the velocity is not zero (impacts, ends).
    - `struck`: name of the contact that is struck, or "". The time is then just before the impact.
    """

    value: np.ndarray
    time: np.ndarray
    acceleration: np.ndarray
    struck: tuple[str, ...]


def describe(problem: OrbitProblem, point: ShotOrbit, dof: int) -> tuple[PeriodicOrbit, Extremes, Extremes]:
    """The orbit at a solution of its equations, and its smallest and largest coordinates."""
    problem, period = eqx.tree_at(lambda p: p.scene, problem, problem.with_values(point.values)), point.period
    scene, spans = problem.scene, np.asarray(problem.spans) * period
    states = [unpack(scene, jnp.asarray(x), dof) for x in point.x]
    # These runs serve for their events, which determine the saved times of the final runs.
    once = [run_for(problem, x, begin, np.asarray([end])) for x, (begin, end) in zip(states, spans, strict=True)]
    changes = [_changes(each) for each in once]
    runs = []
    for x, (begin, end), events in zip(states, spans, changes, strict=True):
        times = np.clip([change[0] for change in events], begin, end)
        times = np.concatenate([np.maximum(times - _before(end), begin), times])
        # The padding keeps the number of times, and with it the compiled program, for most numbers of events.
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
                f"{name} sticks throughout near the start of the search, which fixes its position, but it slips on the"
                " orbit at this position. Begin at a position where it sticks, or pass a longer `settle`."
            )
    missed = float(np.max(np.abs(point.residual[: point.x.size].reshape(point.x.shape)) / scale))
    if missed > max(_MISSED, _TOLERANCES * float(problem.rtol)):
        raise OrbitError(
            f"No convergence to a periodic orbit: the residual is {missed:.3g} of the extent of the motion. Rounding"
            " errors grow too much in a period: pass more `segments`."
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
        tuple((change.effect, change.before, change.after) for each in once for change in each.mode_changes),
        shares,
        jnp.asarray(point.advance[:dof]),
        neutral,
    )
    return orbit, lowest, highest


def _before(end: float) -> float:
    """Time [s] between the saved state before an event and the event."""
    return _BEFORE * float(np.finfo(float).eps) * abs(end)


def _changes(run: Trajectory) -> list[tuple[float, int, int, int]]:
    """Events along a run: time, index of the element, mode before and after."""
    events = run.events
    columns = (np.asarray(x).tolist() for x in (events.t, events.effect, events.before, events.after))
    return [x for x in zip(*columns, strict=True) if x[0] < np.inf]


def _shares(
    once: Trajectory, run: Trajectory, changes: list[tuple[float, int, int, int]], span: tuple[float, float]
) -> tuple[dict[str, float], int]:
    """Fraction of the period in which each element sticks or is closed, and the number of zero multipliers."""
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
    """Number of independent velocities that these elements hold at zero."""
    scene = run.scene.bind_time(jnp.asarray(t))
    if not held:
        return 0
    rows = [np.asarray(scene.event_driven[name].direction(run.q[-1], scene.params)) for name in held]
    return int(np.linalg.matrix_rank(np.vstack(rows), tol=1e-6))


def floquet(problem: OrbitProblem, point: ShotOrbit, zeros: int, scale: np.ndarray, dof: int) -> np.ndarray:
    """Floquet multipliers except those that are exactly 1; the last `zeros` ones are exactly 0."""
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
    """Eigenvalues of a product of matrices, the first one on the right, without loss of the small ones.

    Orthogonal iteration: repeated passes through the factors turn a basis until each factor is triangular in it. The
    product of the triangles then has one eigenvalue in each row.
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
    """Largest `sign q` along runs, on cubics between the saved times, which bracket each event."""
    t, q, qd = (np.concatenate([np.asarray(getattr(run, name)) for run in runs]) for name in ("t", "q", "qd"))
    q, qd = sign * q, sign * qd
    h = np.diff(t)[:, None]
    a, b, c = q[:-1], h * qd[:-1], np.diff(q, axis=0)
    u, v = 3.0 * c - 2.0 * b - h * qd[1:], b + h * qd[1:] - 2.0 * c  # a + b s + u s^2 + v s^3
    # Root with a falling derivative, in a form without cancellation.
    root = np.sqrt(np.maximum(u * u - 3.0 * v * b, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(u < 0, b / (root - u), (-u - root) / (3.0 * v))
    resolution = _before(t[-1])
    inside = (
        (s > 0) & (s < 1) & (h > 2.0 * resolution)
    )  # the states before and after an event are no interval of motion
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
