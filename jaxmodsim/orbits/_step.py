"""An orbit of a branch, and the step to the next one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np

from ._describe import describe
from ._newton import Condition, newton, scaled, split
from ._orbit import PeriodicOrbit
from ._return_map import OrbitProblem, ShotOrbit, evaluate
from ._settle import held, magnitudes, states_of

# Of a problem, a point, the scales of the unknowns, and the number of coordinates.
Test: TypeAlias = Callable[[OrbitProblem, ShotOrbit, np.ndarray, int], float]

# Step of differences, in the scales of the unknowns: the iteration needs few digits of the derivatives.
_DIFFERENCE = 1e-6
# Part of the largest possible distance from a change of modes at which orbits begin elsewhere.
_CLOSE = 0.2


@dataclass(frozen=True)
class BranchStep:
    """An orbit of a branch, and the direction in which the branch goes on.

    - `scale`: magnitudes of the unknowns; `tangent`: unit vector in these.
    - `test`: a function of the orbits that is zero on all of the branch, one of special orbits; None of any others.
    """

    problem: OrbitProblem = field(repr=False)
    shot: ShotOrbit
    orbit: PeriodicOrbit = field(repr=False)
    scale: np.ndarray
    tangent: np.ndarray
    test: Test | None = field(default=None, repr=False)

    def corrected(self, length: float) -> tuple[ShotOrbit, int]:
        """The orbit at this distance along the tangent, and the number of iterations."""
        unknowns, size = self.shot.unknowns, self.shot.x.size
        ahead = unknowns + length * self.tangent * self.scale

        def along(shot: ShotOrbit) -> float:
            return float(self.tangent @ ((shot.unknowns - unknowns) / self.scale)) - length

        period = float(ahead[size]) if self.problem.autonomous else self.shot.period
        return newton(
            *(self.problem, ahead[:size].reshape(self.shot.x.shape), period, ahead[-len(self.shot.values) :]),
            *(len(self.orbit.q), self.scale, (Condition(along, lambda _: self.tangent), *self.special)),
        )

    @property
    def special(self) -> tuple[Condition, ...]:
        """That the orbits are special ones, if all are."""
        return () if self.test is None else (test_condition(self.problem, self.test, self.scale, len(self.orbit.q)),)

    def described(self, shot: ShotOrbit) -> BranchStep:
        """What follows at a corrected orbit, with the tangent in the same sense."""
        orbit = describe(self.problem, shot, len(self.orbit.q))[0]
        sense = self.tangent * self.scale
        later = _clear_of_events(orbit)
        if later is None or self.problem.section is not None:
            return self.next_at(self.problem, shot, orbit, sense)
        return self.restarted(shot, sense, later)

    def next_at(self, problem: OrbitProblem, shot: ShotOrbit, orbit: PeriodicOrbit, sense: np.ndarray) -> BranchStep:
        """What follows at an orbit, along `sense`."""
        return step_at(problem, shot, orbit, self.scale[-len(shot.values) :], sense, self.test)

    def restarted(self, shot: ShotOrbit, sense: np.ndarray, later: float) -> BranchStep:
        """At an orbit that begins so much later [s], away from changes of modes."""
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


def step_at(
    problem: OrbitProblem,
    shot: ShotOrbit,
    orbit: PeriodicOrbit,
    spans: np.ndarray,
    sense: np.ndarray,
    test: Test | None = None,
) -> BranchStep:
    """The tangent at an orbit, from which the next one is predicted; along `sense`, in the units of the unknowns.

    `spans` are the scales of the parameters.
    """
    scale = magnitudes(problem, states_of(*orbit.runs), len(orbit.q), shot.period)
    scale = np.concatenate([scale if problem.autonomous else scale[:-1], spans])
    if problem.autonomous and problem.section is None:
        n = shot.x.size
        normal = shot.flows[0] / scale[:n] ** 2
        problem = replace(problem, normal=jnp.asarray(normal), anchor=jnp.asarray(shot.x[0]))
        by = shot.by.copy()
        by[n, :n] = normal
        shot = shot._replace(by=by)
    step = BranchStep(problem, shot, orbit, scale, np.zeros(len(scale)), test)
    tangent = np.linalg.svd(np.vstack([scaled(shot, scale), *(each.by(shot) for each in step.special)]))[2][-1]
    return replace(step, tangent=tangent if tangent @ (sense / scale) >= 0 else -tangent)


def test_condition(problem: OrbitProblem, test: Test, scale: np.ndarray, dof: int) -> Condition:
    """That a function of the orbits is zero, with its derivatives by differences of shots."""

    def by(shot: ShotOrbit) -> np.ndarray:
        here, row = test(problem, shot, scale, dof), []
        for moved in shot.unknowns + _DIFFERENCE * np.diag(scale):
            beside = evaluate(problem, *split(moved, shot, problem.autonomous), dof)
            row.append((test(problem, beside, scale, dof) - here) / _DIFFERENCE)
        return np.array(row)

    return Condition(lambda shot: test(problem, shot, scale, dof), by)


def _clear_of_events(orbit: PeriodicOrbit) -> float | None:
    """How much later [s] an orbit begins far from changes of modes, in slip if it slips; None where it does now."""
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
