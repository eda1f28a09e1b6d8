"""A periodic orbit of a branch: the step to the next one, and the bifurcations between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np

from ._branch import (
    CROSSING,
    DOUBLING,
    FOLD,
    GRAZING,
    LOSS,
    ONSET,
    ORDER,
    TORUS,
    AbstractStep,
    BifurcationPoint,
    tangent_at,
)
from ._newton import Condition, newton, split
from ._orbit import ModeSequence, PeriodicOrbit, describe, floquet
from ._return_map import OrbitError, OrbitProblem, ShotOrbit, evaluate
from ._settle import held, magnitudes, states_of

# A function of the multipliers that are not exactly 1.
Test: TypeAlias = Callable[[np.ndarray], float]

# Step of finite differences, in the scales of the unknowns: the iteration needs few digits of the derivatives.
_DIFFERENCE = 1e-6
# An orbit is moved to another start if a change of modes is nearer than this fraction of the largest possible distance.
_CLOSE = 0.2
# Tolerance of the location of a change of modes, relative to the step.
_CUT = 1e-6
# Step away from a corner of the branch, in the scales of the unknowns.
_BEHIND = 1e-3
# Multipliers are complex and on the unit circle within this distance.
_CIRCLE = 1e-4


@dataclass(frozen=True)
class OrbitStep(AbstractStep[ShotOrbit, PeriodicOrbit]):
    """A periodic orbit of a branch, as `AbstractStep`.

    - `critical`: a test function that is zero along the whole curve, of bifurcations of one kind; None for a branch.
    """

    problem: OrbitProblem = field(repr=False)
    shot: ShotOrbit
    orbit: PeriodicOrbit = field(repr=False)
    scale: np.ndarray
    tangent: np.ndarray
    critical: Test | None = field(default=None, repr=False)

    def corrected(self, length: float) -> tuple[ShotOrbit, int]:
        """The orbit at this distance along the tangent, and the number of iterations."""
        unknowns, there = self.along(length)
        x, period, values = split(unknowns, self.shot, self.problem.autonomous)
        conditions = [there]
        if self.critical is not None:
            conditions.append(critical_condition(self.problem, self.critical, self.scale, len(self.orbit.q)))
        return newton(self.problem, x, period, values, len(self.orbit.q), self.scale, conditions)

    def moved_to(self, shot: ShotOrbit) -> OrbitStep:
        """The step that begins at an orbit; the orbit is moved to another start if a change of modes is near."""
        orbit = describe(self.problem, shot, len(self.orbit.q))[0]
        sense = self.tangent * self.scale
        later = _clear_of_events(orbit)
        if later is None or self.problem.section is not None:
            return self.next_at(self.problem, shot, orbit, sense)
        return self._restarted(shot, sense, later)

    def next_at(self, problem: OrbitProblem, shot: ShotOrbit, orbit: PeriodicOrbit, sense: np.ndarray) -> OrbitStep:
        """The step at an orbit, along `sense`."""
        return step_at(problem, shot, orbit, self.scale[-len(shot.values) :], sense, self.critical)

    def _restarted(self, shot: ShotOrbit, sense: np.ndarray, later: float) -> OrbitStep:
        """The step at the same orbit with a start that is this much later [s]."""
        n, dof = shot.x.size, len(self.orbit.q)
        t0 = float(self.problem.phase) * shot.period
        none = 0.0 * self.problem.free
        open_ended = replace(self.problem, period=None, phase=jnp.asarray(t0 / later), free=none, pinned=none)
        moved = evaluate(open_ended, shot.x, later, shot.values, dof)
        x = shot.x + moved.residual[:n]
        by_values = moved.by[:n, n + 1 :] @ sense[-len(shot.values) :]
        sense = np.concatenate([moved.monodromy @ sense[:n] + by_values, sense[n:]])
        normal = moved.flows[0] / self.scale[:n] ** 2
        phase = jnp.zeros(()) if self.problem.autonomous else jnp.asarray((t0 + later) / shot.period % 1.0)
        problem = replace(self.problem, phase=phase, anchor=jnp.asarray(x[0]), normal=jnp.asarray(normal))
        shot, _ = newton(problem, x, shot.period, shot.values, dof, self.scale)
        return self.next_at(problem, shot, describe(problem, shot, dof)[0], sense)

    def tests(self) -> dict[str, Callable[[ShotOrbit], float]]:
        """Test functions of the multipliers."""

        def value(test: Test, shot: ShotOrbit) -> float:
            return test(_multipliers(self.problem, shot, self.scale, len(self.orbit.q)))

        return {kind: partial(value, TESTS[kind]) for kind in (DOUBLING, TORUS, CROSSING)}

    def bifurcation(self, kind: str, length: float, index: int) -> BifurcationPoint[PeriodicOrbit] | None:
        """The bifurcation at this distance; None for two real multipliers whose product is 1."""
        shot, _ = self.corrected(length)
        if kind == TORUS:
            pair = _multipliers(self.problem, shot, self.scale, len(self.orbit.q))
            if not np.any((np.abs(np.abs(pair) - 1.0) < _CIRCLE) & (np.abs(np.imag(pair)) > _CIRCLE)):
                return None
        scale = self.scale[: shot.x.shape[1]]
        values, vectors = np.linalg.eig(shot.monodromy * scale[None, :] / scale[:, None])
        direction = scale * np.real(vectors[:, int(np.argmin(np.abs(values + 1.0)))])
        orbit = describe(self.problem, shot, len(self.orbit.q))[0]
        return BifurcationPoint(
            kind, shot.value, index, orbit, direction if kind == DOUBLING else np.zeros_like(direction)
        )

    def mode_change(
        self, other: AbstractStep[ShotOrbit, PeriodicOrbit], length: float, index: int
    ) -> tuple[float, BifurcationPoint[PeriodicOrbit]] | None:
        """The change of the sequence of modes before the next orbit, located by bisection."""
        before, after = _cycle(self.orbit.sequence), _cycle(other.orbit.sequence)
        if before == after:
            return None
        low, high = 0.0, length
        # At a grazing the derivative of the run is unbounded on the side with the strike, where Newton may fail.
        singular_before, failed = len(before) > len(after), False
        while high - low > _CUT * length:
            middle = 0.5 * (low + high)
            try:
                orbit = describe(self.problem, self.corrected(middle)[0], len(self.orbit.q))[0]
                same = _cycle(orbit.sequence) == before
            except OrbitError:
                same, failed = singular_before, True
            low, high = (middle, high) if same else (low, middle)
        at = low if failed and not singular_before else high
        point = self.bifurcation(_kind_of_change(before, after), at, index)
        return None if point is None else (at, point)

    def corner(self, index: int) -> tuple[OrbitStep, BifurcationPoint[PeriodicOrbit]] | None:
        """The next orbit behind a corner, at which the sequence of modes changes, and the bifurcation there.

        The branch may turn back at the corner, or go on. The tangent behind it is that of a run near the orbit that
        has the other modes.
        """
        before, at = _cycle(self.orbit.sequence), self.shot.unknowns
        sides = [self.tangent * self.scale, *np.diag(self.scale)[: self.shot.x.size]]
        for side, sign in product(sides, (1.0, -1.0)):
            unknowns = split(at + sign * _BEHIND * side, self.shot, self.problem.autonomous)
            shot = evaluate(self.problem, *unknowns, len(self.orbit.q))
            if shot.failure:
                continue
            tangent = tangent_at(shot, self.scale, np.zeros(len(self.scale)))
            for sense in (1.0, -1.0):
                try:
                    turned = replace(self, tangent=sense * tangent)
                    turned = turned.moved_to(turned.corrected(_BEHIND)[0])
                except OrbitError:
                    continue
                after = _cycle(turned.orbit.sequence)
                if after != before:
                    kind, none = _kind_of_change(before, after), np.zeros(self.shot.x.size)
                    return turned, BifurcationPoint(kind, self.shot.value, index, self.orbit, none)
        return None


def step_at(
    problem: OrbitProblem,
    shot: ShotOrbit,
    orbit: PeriodicOrbit,
    spans: np.ndarray,
    sense: np.ndarray,
    critical: Test | None = None,
) -> OrbitStep:
    """The step at an orbit, with the tangent along `sense`, in the units of the unknowns.

    `spans` are the scales of the parameters.
    """
    dof = len(orbit.q)
    scale = magnitudes(problem, states_of(*orbit.runs), dof, shot.period)
    scale = np.concatenate([scale if problem.autonomous else scale[:-1], spans])
    if problem.autonomous and problem.section is None:
        n = shot.x.size
        normal = shot.flows[0] / scale[:n] ** 2
        problem = replace(problem, normal=jnp.asarray(normal), anchor=jnp.asarray(shot.x[0]))
        by = shot.by.copy()
        by[n, :n] = normal
        shot = shot._replace(by=by)
    rows = [] if critical is None else [critical_condition(problem, critical, scale, dof).by(shot)]
    return OrbitStep(problem, shot, orbit, scale, tangent_at(shot, scale, sense / scale, *rows), critical)


def critical_condition(problem: OrbitProblem, test: Test, scale: np.ndarray, dof: int) -> Condition:
    """The condition that a test function is zero, with derivatives by finite differences."""

    def value(shot: ShotOrbit) -> float:
        return test(_multipliers(problem, shot, scale, dof))

    def by(shot: ShotOrbit) -> np.ndarray:
        here, row = value(shot), []
        for moved in shot.unknowns + _DIFFERENCE * np.diag(scale):
            beside = evaluate(problem, *split(moved, shot, problem.autonomous), dof)
            row.append((value(beside) - here) / _DIFFERENCE)
        return np.array(row)

    return Condition(value, by)


def _multipliers(problem: OrbitProblem, shot: ShotOrbit, scale: np.ndarray, dof: int) -> np.ndarray:
    """All multipliers except those that are exactly 1."""
    return floquet(problem, shot, 0, scale[: shot.x.shape[1]], dof)


def _crossing(multipliers: np.ndarray) -> float:
    return float(np.prod(multipliers - 1.0).real)


def _doubling(multipliers: np.ndarray) -> float:
    return float(np.prod(multipliers + 1.0).real)


def _torus(multipliers: np.ndarray) -> float:
    i, j = np.triu_indices(len(multipliers), 1)
    return float(np.prod(multipliers[i] * multipliers[j] - 1.0).real)


# Test functions, which are zero at bifurcations, by kind.
TESTS: dict[str, Test] = {FOLD: _crossing, CROSSING: _crossing, DOUBLING: _doubling, TORUS: _torus}


def _cycle(sequence: ModeSequence) -> ModeSequence:
    """The rotation of a sequence of modes that does not depend on the start of the orbit."""
    return min((sequence[i:] + sequence[:i] for i in range(len(sequence))), default=sequence)


def _kind_of_change(before: ModeSequence, after: ModeSequence) -> str:
    if sorted(before) == sorted(after):
        return ORDER
    sticks = [sum(mode == "stick" for _, _, mode in each) for each in (before, after)]
    return GRAZING if sticks[0] == sticks[1] else ONSET if sticks[0] < sticks[1] else LOSS


def _clear_of_events(orbit: PeriodicOrbit) -> float | None:
    """Delay [s] to a start far from changes of modes, in slip if possible; None if the start is far enough."""
    t = np.asarray(orbit.run.events.t)
    times, period = np.sort(t[np.isfinite(t)]) - float(orbit.t0), float(orbit.period)
    if not len(times):
        return None
    gaps = np.diff([*times, times[0] + period])
    middles = (times + 0.5 * gaps) % period
    at = np.searchsorted(np.asarray(orbit.run.t) - float(orbit.t0), middles)
    stuck = held(orbit.run)[np.clip(at, 0, len(orbit.run.t) - 1)]
    best = min(range(len(gaps)), key=lambda i: (stuck[i], -gaps[i]))
    near = min(np.min(times), period - np.max(times))
    return float(middles[best]) if near < _CLOSE * 0.5 * gaps[best] else None
