"""An orbit of a branch, and the step to the next one."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np

from ._describe import describe
from ._newton import newton, scaled
from ._orbit import PeriodicOrbit
from ._return_map import OrbitProblem, ShotOrbit, evaluate
from ._settle import held, magnitudes, states_of

# Part of the largest possible distance from a change of modes at which orbits begin elsewhere.
_CLOSE = 0.2


@dataclass(frozen=True)
class BranchStep:
    """An orbit of a branch, and the direction in which the branch goes on.

    - `scale`: magnitudes of the unknowns; `tangent`: unit vector in these.
    """

    problem: OrbitProblem = field(repr=False)
    shot: ShotOrbit
    orbit: PeriodicOrbit = field(repr=False)
    scale: np.ndarray
    tangent: np.ndarray

    def corrected(self, length: float) -> tuple[ShotOrbit, int]:
        """The orbit at this distance along the tangent, and the number of iterations."""
        unknowns, n = self.shot.unknowns, len(self.shot.x)
        ahead = unknowns + length * self.tangent * self.scale

        def along(shot: ShotOrbit) -> tuple[float, np.ndarray]:
            return float(self.tangent @ ((shot.unknowns - unknowns) / self.scale)) - length, self.tangent

        period = float(ahead[n]) if self.problem.autonomous else self.shot.period
        return newton(self.problem, ahead[:n], period, float(ahead[-1]), len(self.orbit.q), self.scale, along)

    def described(self, shot: ShotOrbit) -> BranchStep:
        """What follows at a corrected orbit, with the tangent in the same sense."""
        orbit = describe(self.problem, shot, len(self.orbit.q))[0]
        sense = self.tangent * self.scale
        later = _clear_of_events(orbit)
        if later is None or self.problem.section is not None:
            return step_at(self.problem, shot, orbit, float(self.scale[-1]), sense)
        return self.restarted(shot, sense, later)

    def restarted(self, shot: ShotOrbit, sense: np.ndarray, later: float) -> BranchStep:
        """At an orbit that begins so much later [s], away from changes of modes."""
        n, dof = len(shot.x), len(self.orbit.q)
        t0 = float(self.problem.phase) * shot.period
        free = replace(self.problem, period=None, phase=jnp.asarray(t0 / later))
        moved = evaluate(free, shot.x, later, shot.value, dof)
        x = shot.x + moved.residual[:n]
        sense = np.concatenate([moved.map_by[:, :n] @ sense[:n] + moved.map_by[:, -1] * sense[-1], sense[n:]])
        normal = moved.flow / self.scale[:n] ** 2
        phase = jnp.zeros(()) if self.problem.autonomous else jnp.asarray((t0 + later) / shot.period % 1.0)
        problem = replace(self.problem, phase=phase, anchor=jnp.asarray(x), normal=jnp.asarray(normal))
        shot, _ = newton(problem, x, shot.period, shot.value, dof, self.scale, None)
        return step_at(problem, shot, describe(problem, shot, dof)[0], float(self.scale[-1]), sense)


def step_at(problem: OrbitProblem, shot: ShotOrbit, orbit: PeriodicOrbit, span: float, sense: np.ndarray) -> BranchStep:
    """The tangent at an orbit, from which the next one is predicted; along `sense`, in the units of the unknowns."""
    scale = magnitudes(states_of(orbit.run), shot.period)
    scale = np.append(scale if problem.autonomous else scale[:-1], span)
    if problem.autonomous and problem.section is None:
        n = len(shot.x)
        normal = shot.flow / scale[:n] ** 2
        problem = replace(problem, normal=jnp.asarray(normal), anchor=jnp.asarray(shot.x))
        by = shot.by.copy()
        by[n, :n] = normal
        shot = shot._replace(by=by)
    tangent = np.linalg.svd(scaled(shot, scale))[2][-1]
    return BranchStep(problem, shot, orbit, scale, tangent if tangent @ (sense / scale) >= 0 else -tangent)


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
