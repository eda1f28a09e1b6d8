"""An equilibrium of a branch, and the step to the next one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ._equilibrium import Equilibrium, described_rest
from ._rest import RestPoint, RestProblem, solve_rest


@dataclass(frozen=True)
class RestStep:
    """An equilibrium of a branch, and the direction in which the branch goes on; as `BranchStep`."""

    problem: RestProblem
    shot: RestPoint
    orbit: Equilibrium
    scale: np.ndarray
    tangent: np.ndarray

    def corrected(self, length: float) -> tuple[RestPoint, int]:
        """The equilibrium at this distance along the tangent, and the number of iterations."""
        unknowns = self.shot.unknowns
        ahead = unknowns + length * self.tangent * self.scale

        def along(point: RestPoint) -> tuple[float, np.ndarray]:
            return float(self.tangent @ ((point.unknowns - unknowns) / self.scale)) - length, self.tangent

        return solve_rest(self.problem, ahead[:-1], float(ahead[-1]), len(self.orbit.q), self.scale, along)

    def described(self, shot: RestPoint) -> RestStep:
        """What follows at a corrected equilibrium, with the tangent in the same sense."""
        return rest_step_at(self.problem, shot, self.scale, self.tangent * self.scale, len(self.orbit.q))


def rest_step_at(problem: RestProblem, point: RestPoint, scale: np.ndarray, sense: np.ndarray, dof: int) -> RestStep:
    return RestStep(problem, point, described_rest(problem, point, dof), scale, tangent_at(point, scale, sense / scale))


def tangent_at(point: RestPoint, scale: np.ndarray, sense: np.ndarray) -> np.ndarray:
    """Unit vector along the branch, in the scales of the unknowns."""
    tangent = np.linalg.svd(point.scaled(scale)[0])[2][-1]
    return tangent if tangent @ sense >= 0 else -tangent
