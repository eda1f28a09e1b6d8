"""Systems that are linear between stick-slip events: their scene, and a reference by matrix exponentials in NumPy.

`M q'' + C q' + K q = L w(t) - D^T f` with dry friction forces f along the rows of D. In each combination of stick and
slip the system is linear, and the loads w(t) (polynomials, harmonics, harmonics that grow with time, a sampled signal)
obey a linear differential equation of their own. State and loads together are therefore propagated by matrix
exponentials, which are exact but for rounding.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial.polynomial import polyval

from jaxmodsim.friction import Coulomb
from jaxmodsim.scene import AppliedForce, Friction, Scene, Signal

# Grid points of one period of the fastest harmonic or natural oscillation, and the least number along a run.
_PER_PERIOD, _PER_RUN = 64, 2000
# Grid points that are propagated at once, and terms of the Taylor series within one grid step.
_CHUNK, _TERMS = 64, 20
# Points at which a guard is looked at within a grid step that may hold an event.
_FINE = 64
# What is zero to rounding, relative to the limits of friction; slip velocities relative to the largest; and how far
# guards have to pass zero.
_ZERO, _STILL, _ROUNDING = 1e-9, 1e-12, 1e-13


@dataclass(frozen=True)
class LinearStickSlip:
    """`M q'' + C q' + K q = L w(t) - D^T f`: n coordinates, m elements with Coulomb friction and stiction.

    The loads are combinations of `w(t) = (1, t, t^2)`, of `sin(w t), cos(w t), t sin(w t), t cos(w t)` for each angular
    frequency w in turn, and of the value and the rate of a sampled signal: b = 5 + 4 frequencies.

    - `mass` [kg], `damping` [N s/m], `stiffness` [N/m]: shape `[n, n]`.
    - `directions`: rows D of the slip velocities `D q' - B w(t)`, shape `[m, n]`.
    - `Fc`, `Fs`: forces in slip and largest forces in stick [N], shape `[m]`.
    - `frequencies`: angular frequencies [rad/s], shape `[k]`.
    - `load`: L [N], shape `[n, b]`.
    - `belt`: B, velocities of the surfaces [m/s], shape `[m, b]`.
    - `sample_times`, `sample_values`, `linear`: as for `Signal`; of no length without a signal.
    """

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    directions: np.ndarray
    Fc: np.ndarray
    Fs: np.ndarray
    frequencies: np.ndarray
    load: np.ndarray
    belt: np.ndarray
    sample_times: np.ndarray = field(default_factory=lambda: np.zeros(0))
    sample_values: np.ndarray = field(default_factory=lambda: np.zeros(0))
    linear: bool = False

    @property
    def size(self) -> int:
        """Number n of coordinates."""
        return self.mass.shape[0]

    @cached_property
    def load_rate(self) -> np.ndarray:
        """S of `w' = S w`, shape `[b, b]`."""
        count = 5 + 4 * len(self.frequencies)
        rate = np.zeros((count, count))
        rate[1, 0], rate[2, 1] = 1.0, 2.0
        for i, w in enumerate(self.frequencies):
            at = 3 + 4 * i
            rate[at, at + 1], rate[at + 1, at] = w, -w
            rate[at + 2, at + 3], rate[at + 3, at + 2] = w, -w
            rate[at + 2, at] = rate[at + 3, at + 1] = 1.0
        rate[count - 2, count - 1] = 1.0
        return rate

    def loads(self, t: float) -> np.ndarray:
        """w(t), shape `[b]`; at a sample of the signal the value and the rate after it."""
        waves = [[math.sin(w * t), math.cos(w * t)] for w in self.frequencies]
        parts = [[1.0, t, t * t], *([s, c, t * s, t * c] for s, c in waves), self._sample(t)]
        return np.concatenate(parts)

    def _sample(self, t: float) -> list[float]:
        times, values = self.sample_times, self.sample_values
        if not len(times):
            return [0.0, 0.0]
        i = int(np.searchsorted(times, t, side="right")) - 1
        if i < 0 or i == len(times) - 1 or not self.linear:
            return [float(values[max(i, 0)]), 0.0]
        slope = (values[i + 1] - values[i]) / (times[i + 1] - times[i])
        return [float(values[i] + slope * (t - times[i])), float(slope)]


@dataclass(frozen=True)
class StickSlipMotion:
    """The motion of a `LinearStickSlip`.

    - `q`, `qd`: coordinates [m] and velocities [m/s] at t1, shape `[n]`.
    - `q_scale`, `qd_scale`: largest magnitudes along the run, shape `[n]`.
    - `times`: instants [s] at which modes change.
    - `modes`: modes from t0 and from each of these instants on, shape `[1 + instants, m]`; 0 in stick, else the sign of
      the slip velocity.
    - `margin`: how far the run is from one with other events: the smallest distance from its limit, over the limit, of
      a force in stick that has an extremum near it (on either side) or must hold an element at the end of its slip; the
      smallest slip velocity, over the largest, at which an element turns without coming to rest.
    - `spacing`: shortest time between two instants, and between an instant and t0 or t1 [s].
    """

    q: np.ndarray
    qd: np.ndarray
    q_scale: np.ndarray
    qd_scale: np.ndarray
    times: np.ndarray
    modes: np.ndarray
    margin: float
    spacing: float

    @property
    def num_events(self) -> int:
        """Number of mode changes; elements that change at one instant count one each."""
        return int(np.sum(self.modes[1:] != self.modes[:-1]))


class _Mode:
    """The linear system in one combination of stick and slip.

    - `rate`: G of `x' = G x` for x = (q, qd, w).
    - `force`: rows of the friction forces, shape `[m, x]`.
    - `slip_rate`: rows of the slip accelerations.
    - `held`: elements in slip, at their limit, that sticking ones keep from moving.
    - `guards`, `of`: rows that are positive while the mode holds, and the element of each.
    """

    def __init__(self, system: LinearStickSlip, sigma: tuple[int, ...], step: float) -> None:
        """Assemble the system in the modes `sigma` for a grid of this step."""
        n, rate = system.size, system.load_rate
        rows, mode = system.directions, np.array(sigma)
        stick, total = mode == 0, 2 * n + len(rate)
        inverse = np.linalg.inv(system.mass)
        force = np.zeros((len(mode), total))
        force[:, 2 * n] = mode * system.Fc
        push = np.hstack([-system.stiffness, -system.damping, system.load])
        free = rows @ inverse @ (push - rows.T @ force)
        free[:, 2 * n :] -= system.belt @ rate
        if stick.any():
            # Where elements are redundant the forces with the least sum of f^2/Fs are taken.
            weight = np.sqrt(np.maximum(system.Fs[stick], 1e-12))
            coupling = rows[stick] @ inverse @ rows[stick].T
            force[stick] = weight[:, None] * (np.linalg.pinv(coupling * weight, rcond=1e-9) @ free[stick])
        self.rate = np.zeros((total, total))
        self.rate[:n, n : 2 * n] = np.eye(n)
        self.rate[n : 2 * n] = inverse @ (push - rows.T @ force)
        self.rate[2 * n :, 2 * n :] = rate
        self.force = force
        self.slip = np.hstack([np.zeros_like(rows), rows, -system.belt])
        self.slip_rate = self.slip @ self.rate
        rank = np.linalg.matrix_rank(rows[stick]) if stick.any() else 0
        self.held = np.array(
            [not s and rank > 0 and np.linalg.matrix_rank(np.vstack([rows[stick], r])) == rank
             for s, r in zip(stick, rows, strict=True)]
        )  # fmt: skip
        limit = np.zeros(total)
        limit[2 * n] = 1.0
        guards, of = [], []
        for i in range(len(mode)):
            if stick[i]:
                guards += [system.Fs[i] * limit - force[i], system.Fs[i] * limit + force[i]]
                of += [i, i]
            elif not self.held[i]:
                guards.append(mode[i] * self.slip[i])
                of.append(i)
        self.mode, self.stick, self.step = mode, stick, step
        self.guards, self.of = np.reshape(guards, (-1, total)), np.array(of, int)

    @cached_property
    def powers(self) -> np.ndarray:
        """Propagators over 1, 2, ... grid steps, shape `[chunk, x, x]`."""
        # A step is short enough for the series, also in `series`; `scipy.linalg.expm` loses digits from SciPy 1.18 on.
        term = one = np.eye(len(self.rate))
        for i in range(1, _TERMS):
            term = self.rate @ term * (self.step / i)
            one = one + term
        powers = one[None]
        while len(powers) < _CHUNK:
            powers = np.concatenate([powers, powers @ powers[-1]])
        return powers

    def series(self, x: np.ndarray) -> np.ndarray:
        """Taylor coefficients of x(t) from here on, shape `[terms, x]`."""
        terms = [x]
        for i in range(1, _TERMS):
            terms.append(self.rate @ terms[-1] / i)
        return np.array(terms)

    def derivatives(self, rows: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Rows times x, x', x'' and x''', shape `[4, rows]`."""
        first = self.rate @ x
        second = self.rate @ first
        return np.array([rows @ each for each in (x, first, second, self.rate @ second)])


def _first_crossing(coefficients: np.ndarray, length: float) -> float | None:
    """First time in (0, length] at which a guard, a polynomial, falls through zero."""
    at = np.linspace(0.0, length, _FINE + 1)
    values = polyval(at, coefficients)
    values[0] = max(values[0], 0.0)
    lowest = int(np.argmin(values[1:])) + 1
    if values[lowest] >= 0:
        return None
    i = int(np.argmax(values[1:] < 0)) + 1
    low, high = at[i - 1], at[i]
    if i == 1 and values[0] < _ZERO * np.abs(values).max():
        # From zero the guard rises first.
        low = next((s for s in high * 0.5 ** np.arange(1, 30) if polyval(s, coefficients) > 0), low)
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if polyval(middle, coefficients) < 0 else (middle, high)
    return high


class _Run:
    """Propagation of one system; see `motion`."""

    def __init__(self, system: LinearStickSlip, t0: float, t1: float) -> None:
        """A run without any events so far."""
        self.system, self.t0, self.t1 = system, t0, t1
        modes = [np.sqrt(np.abs(np.linalg.eigvals(np.linalg.solve(system.mass, system.stiffness)))).max()]
        modes.append(np.abs(np.linalg.solve(system.mass, system.damping)).max())
        fastest = max([*modes, *np.abs(system.frequencies), 1e-300])
        self.step = min(2.0 * math.pi / fastest / _PER_PERIOD, (t1 - t0) / _PER_RUN)
        self.known: dict[tuple[int, ...], _Mode] = {}
        self.scale, self.slip_scale = np.zeros(2 * system.size), np.zeros(len(system.Fs))
        self.force_margin, self.turns = math.inf, [(0, math.inf)]

    def mode(self, sigma: tuple[int, ...]) -> _Mode:
        """The system in these modes."""
        if sigma not in self.known:
            self.known[sigma] = _Mode(self.system, sigma, self.step)
        return self.known[sigma]

    def next_mode(self, x: np.ndarray, before: _Mode | None) -> _Mode:
        """The modes from this state on: of those that are consistent one with the most elements in stick.

        Without stiction all of them give the same motion. Where they differ by elements at their limit that others keep
        from moving, the one is taken that is furthest from its limits.
        """
        slip = self.mode((0,) * len(self.system.Fs)).slip @ x
        still = np.abs(slip) <= self.still_slip
        if before is not None:
            still |= before.stick | before.held
        choices = [(0, 1, -1) if s else (int(np.sign(v)),) for s, v in zip(still, slip, strict=True)]
        best, chosen = (-1, -math.inf), None
        for sigma in sorted(product(*choices), key=lambda each: -each.count(0)):
            if sigma.count(0) < best[0]:
                break
            mode = self.mode(sigma)
            if self.is_consistent(mode, x, still):
                use = np.abs(mode.force @ x)[mode.stick] / self.system.Fs[mode.stick]
                rank = (sigma.count(0), -float(use.max(initial=0.0)))
                best, chosen = (rank, mode) if rank > best else (best, chosen)
        if chosen is None:
            raise ArithmeticError(f"No mode is consistent with the slip velocities {slip}.")
        return chosen

    def is_consistent(self, mode: _Mode, x: np.ndarray, still: np.ndarray) -> bool:
        """Whether forces in stick stay within their limits, and elements at rest start in their directions."""
        per_rate = (0.1 / self.step) ** np.arange(4.0)
        for row, i in zip(mode.guards, mode.of, strict=True):
            if mode.stick[i]:
                ahead, scale = mode.derivatives(row[None], x)[:, 0], self.system.Fs[i]
            elif still[i]:
                ahead, scale = mode.derivatives(row[None] @ mode.rate, x)[:, 0], self.acceleration_scale[i]
            else:
                continue
            decides = np.abs(ahead) > _ZERO * scale * per_rate
            if decides.any() and ahead[np.argmax(decides)] < 0:
                return False
            if not decides.any() and not mode.stick[i]:
                return False  # an element that does not start to slip sticks
        return True

    @cached_property
    def acceleration_scale(self) -> np.ndarray:
        """Accelerations that the elements' limits give [m/s^2]."""
        rows = self.system.directions
        return np.sum(rows @ np.linalg.inv(self.system.mass) * rows, axis=1) * self.system.Fs

    @property
    def still_slip(self) -> np.ndarray:
        """Slip velocities that are none [m/s]."""
        return _STILL * np.maximum(self.slip_scale, self.acceleration_scale * self.step)

    def advance(self, mode: _Mode, x: np.ndarray, t: float, stop: float) -> tuple[np.ndarray, float, int | None]:
        """To the first event before `stop`, or there; returns state, time and the element of the event."""
        n = 2 * self.system.size
        while stop - t > 4.0 * math.ulp(stop):  # what is shorter changes nothing
            count = min(int((stop - t) / self.step), _CHUNK)
            length = self.step if count else stop - t
            after = mode.powers[:count] @ x if count else np.atleast_2d(polyval(length, mode.series(x)))
            grid = np.vstack([x, after])
            for k in self.suspects(mode, grid, length):
                fired = self.earliest(mode, grid[k], length)
                if fired is not None:
                    s, i = fired
                    self.note(grid[: k + 1], mode)
                    return np.asarray(polyval(s, mode.series(grid[k]))), t + k * length + s, i
            self.note(grid, mode)
            t = t + count * length if count else stop
            # The loads are known; their propagation would gather rounding.
            x = np.concatenate([grid[-1][:n], self.system.loads(t) if t < stop else grid[-1][n:]])
        return x, stop, None

    def note(self, grid: np.ndarray, mode: _Mode) -> None:
        """Keep the largest magnitudes."""
        n = 2 * self.system.size
        self.scale = np.maximum(self.scale, np.abs(grid[:, :n]).max(axis=0))
        self.slip_scale = np.maximum(self.slip_scale, np.abs(grid @ mode.slip.T).max(axis=0))

    def suspects(self, mode: _Mode, grid: np.ndarray, length: float) -> np.ndarray:
        """Grid steps in which a guard is negative at the end or has a minimum near zero."""
        values, slopes = grid @ mode.guards.T, grid @ (mode.guards @ mode.rate).T
        turns = (slopes[:-1] < 0) & (slopes[1:] > 0)
        bend = np.maximum(slopes[1:] - slopes[:-1], 1e-300) / length
        lowest = values[:-1] - 0.5 * slopes[:-1] ** 2 / bend
        level = np.where(mode.stick[mode.of], self.system.Fs[mode.of], self.slip_scale[mode.of])
        return np.flatnonzero(((values[1:] < 0) | (turns & (lowest < 0.05 * level))).any(axis=1))

    def earliest(self, mode: _Mode, x: np.ndarray, length: float) -> tuple[float, int] | None:
        """Time and element of the first event within a grid step; notes what comes near to one."""
        series, crossings = mode.series(x), []
        for row, i in zip(mode.guards, mode.of, strict=True):
            guard = series @ row
            level = self.system.Fs[i] if mode.stick[i] else self.still_slip[i] / _STILL
            s = _first_crossing(guard + np.eye(1, _TERMS)[0] * _ROUNDING * level, length)
            if s is not None:
                crossings.append((s, int(i), row))
                continue
            values = polyval(np.linspace(0.0, length, _FINE + 1), guard)
            if 0 < np.argmin(values) < _FINE:
                self.note_near(mode, int(i), float(values.min()))
        if not crossings:
            return None
        s, i, row = min(crossings, key=lambda each: each[0])
        _, slope, bend, _ = mode.derivatives(row[None], polyval(s, series))[:, 0]
        if bend > 0:
            # How far the guard would go on to fall.
            self.note_near(mode, i, 0.5 * slope**2 / bend)
        return s, i

    def note_near(self, mode: _Mode, i: int, distance: float) -> None:
        """Keep the distance of an extremum of a guard from zero."""
        if mode.stick[i]:
            self.force_margin = min(self.force_margin, abs(distance) / self.system.Fs[i])
        else:
            self.turns.append((i, abs(distance)))

    def note_stop(self, x: np.ndarray, i: int, mode: _Mode) -> None:
        """Keep the distance from its limit of the force that holds an element whose slip ends, or fails to."""
        held = mode if mode.stick[i] else self.mode(tuple(0 if k == i else int(s) for k, s in enumerate(mode.mode)))
        self.force_margin = min(self.force_margin, abs(1.0 - abs(held.force[i] @ x) / self.system.Fs[i]))


def _stop_slip(system: LinearStickSlip, mode: _Mode, x: np.ndarray) -> np.ndarray:
    """State with the rest of slip that rounding leaves to sticking elements taken away."""
    if not mode.stick.any():
        return x
    n, rows = system.size, system.directions[mode.stick]
    respond = np.linalg.solve(system.mass, rows.T)
    impulse = np.linalg.pinv(rows @ respond, rcond=1e-9) @ (mode.slip[mode.stick] @ x)
    return np.concatenate([x[:n], x[n : 2 * n] - respond @ impulse, x[2 * n :]])


def motion(
    system: LinearStickSlip, q0: np.ndarray, qd0: np.ndarray, t1: float, *, t0: float = 0.0, max_events: int = 10000
) -> StickSlipMotion:
    """The motion from `t0` to `t1`, event by event.

    States are propagated on a grid of 64 points a period of the fastest oscillation. Where a guard changes its sign
    between two points, or has a minimum there that is near zero, the event is found on a Taylor series from the point
    before, to rounding. Modes after an instant are found among all combinations for the elements at rest: in stick the
    force must be within the limit, and in slip the element must start in its direction.

    **Arguments:**

    - `system`: the `LinearStickSlip`.
    - `q0`, `qd0`: coordinates [m] and velocities [m/s] at t0, shape `[n]`.
    - `t1`, `t0`: end and start [s].
    - `max_events`: largest number of instants at which modes change.

    **Returns:**

    A `StickSlipMotion`.

    **Raises:**

    - `ArithmeticError` where no mode is consistent, or there are more events.
    """
    run = _Run(system, t0, t1)
    n, t = system.size, float(t0)
    x = np.concatenate([np.asarray(q0, float), np.asarray(qd0, float), system.loads(t)])
    run.note(x[None], run.mode((0,) * len(system.Fs)))
    mode = run.next_mode(x, None)
    x = _stop_slip(system, mode, x)
    stops = [s for s in system.sample_times if t0 < s < t1] + [float(t1)]
    times, modes, passes = [], [mode.mode], 0
    for stop in stops:
        while t < stop:
            x, t, fired = run.advance(mode, x, t, stop)
            if t == t1:
                break
            x = np.concatenate([x[: 2 * n], system.loads(t)])
            after = run.next_mode(x, mode)
            if fired is not None and not mode.stick[fired] and not mode.held[fired]:
                run.note_stop(x, fired, after)
            if (after.mode != mode.mode).any():
                times.append(t)
                modes.append(after.mode)
            passes += 1
            if passes > max_events + len(stops):
                raise ArithmeticError(f"There are more than {max_events} events by t = {t}.")
            mode, x = after, _stop_slip(system, after, x)
    turns = [d / run.slip_scale[i] for i, d in run.turns if math.isfinite(d) and run.slip_scale[i] > 0]
    instants = np.array(times)
    spacing = float(np.min(np.diff([t0, *instants, t1]), initial=math.inf))
    return StickSlipMotion(
        x[:n], x[n : 2 * n], run.scale[:n], run.scale[n:], instants, np.array(modes), min([run.force_margin, *turns]),
        spacing,
    )  # fmt: skip


def _waves(t: Array, frequencies: Array) -> Array:
    """What the loads of a `LinearStickSlip` are combinations of, but for the sampled signal."""
    sine, cosine = jnp.sin(frequencies * t), jnp.cos(frequencies * t)
    harmonics = jnp.stack([sine, cosine, t * sine, t * cosine], axis=1)
    return jnp.concatenate([jnp.stack([jnp.ones_like(t), t, t * t]), jnp.reshape(harmonics, -1)])


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    kinetic = 0.5 * jnp.sum(qd * jnp.sum(p["mass"] * qd[None, :], axis=1))
    return kinetic - 0.5 * jnp.sum(q * jnp.sum(p["stiffness"] * q[None, :], axis=1))


def _load(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    waves = jnp.sum(p["load"] * _waves(t, p["frequencies"])[None, :], axis=1)
    return waves - jnp.sum(p["damping"] * qd[None, :], axis=1)


def _load_and_signal(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return _load(t, q, qd, p) + p["signal_load"] * p["signal"]


class _WeightedSum(eqx.Module):
    """A row of numbers: displacement of an element at q, or velocity of a surface at t, which moves in waves."""

    row: Float[Array, " n"]
    frequencies: Float[Array, " frequencies"] | None = None

    def __call__(self, x: Array) -> Array:
        """The row times q, or times the waves at t."""
        return jnp.sum(self.row * (x if self.frequencies is None else _waves(x, self.frequencies)))


def system(
    load: Sequence[Sequence[float]],
    limits: Sequence[tuple[float, float]],
    frequencies: Sequence[float] = (),
    *,
    mass: float = 2.0,
    stiffness: float | np.ndarray = 0.0,
    directions: Sequence[Sequence[float]] | None = None,
    belt: Sequence[float] = (),
) -> LinearStickSlip:
    """The system of equal masses without damping, from what is not zero, and (Fc, Fs) of each element."""
    n, count, m = len(load), 5 + 4 * len(frequencies), len(limits)
    loads, belts = np.zeros((n, count)), np.zeros((m, count))
    for row, given in zip(loads, load, strict=True):
        row[: len(given)] = given
    belts[:, : len(belt)] = belt
    rows = np.eye(n) if directions is None else np.array(directions, float)
    Fc, Fs = np.array(limits).T
    springs = np.ones((1, 1)) * stiffness if n == 1 else np.zeros((n, n)) + stiffness
    return LinearStickSlip(
        mass * np.eye(n), np.zeros((n, n)), springs, rows, Fc, Fs, np.array(frequencies), loads, belts
    )


def scene(system: LinearStickSlip, *, moving: bool | None = None) -> Scene:
    """The scene of a `LinearStickSlip`, whose motion is `motion`.

    Scenes of systems with the same numbers of coordinates, elements, frequencies and samples have the same structure,
    so that their numbers can be stacked for `jax.vmap`.

    **Arguments:**

    - `system`: the `LinearStickSlip`. Belts must not depend on its signal.
    - `moving`: whether surfaces move; by default where `belt` is not zero.

    **Returns:**

    A `Scene` with the coordinates of the system [m] and the effects `load`, `element_0`, `element_1`, ...
    """
    moving = bool(np.any(system.belt)) if moving is None else moving
    frequencies = jnp.asarray(system.frequencies)
    params = {name: getattr(system, name) for name in ("mass", "stiffness", "damping")}
    params |= {"load": system.load[:, :-2], "frequencies": frequencies}
    load = _load
    if len(system.sample_times):
        params["signal"] = Signal(system.sample_times, system.sample_values, linear=system.linear)
        params["signal_load"] = system.load[:, -2]
        load = _load_and_signal
    elements = [
        Friction(
            Coulomb(Fc, Fs),
            along=_WeightedSum(jnp.asarray(row)),
            belt_velocity=_WeightedSum(jnp.asarray(belt[:-2]), frequencies) if moving else 0.0,
            name=f"element_{i}",
        )
        for i, (Fc, Fs, row, belt) in enumerate(zip(system.Fc, system.Fs, system.directions, system.belt, strict=True))
    ]
    return Scene(_lagrangian, params=params, effects=(AppliedForce(load, name="load"), *elements))
