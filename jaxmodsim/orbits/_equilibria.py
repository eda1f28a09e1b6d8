"""`continue_equilibria`: branches of equilibria, and the Hopf points at which orbits begin."""

from __future__ import annotations  # `help` shows types as they are written here

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import ArrayLike

from .._core.arguments import as_float, as_whole
from ..scene import Scene, replace_elements
from ._branch import (
    CROSSING,
    HOPF,
    AbstractStep,
    BifurcationPoint,
    Branch,
    check_parameter,
    follow,
    read_span,
    tangent_at,
)
from ._equilibrium import Equilibrium, describe_rest, nearest_oscillation, prepare_rest, refuse_time, rest_scale
from ._rest import RestPoint, RestProblem, solve_rest

# A pair of eigenvalues is on the imaginary axis if the ratio of real to imaginary part is smaller.
_AXIS = 1e-6


def continue_equilibria(
    scene: Scene,
    q0: ArrayLike | list[float],
    parameter: str,
    span: Sequence[float],
    *,
    ends: Mapping[str, int] | None = None,
    step: float = 0.02,
    max_equilibria: int = 500,
) -> Branch[Equilibrium]:
    """Follow equilibria over a number of the scene, by pseudo-arclength continuation.

    The branch passes folds. It locates folds, branch points, and Hopf points, at which a pair of complex eigenvalues
    crosses the imaginary axis and a branch of periodic orbits begins: `continue_orbits` takes a Hopf point as its
    guess.

    **Arguments:**

    - `scene`, `q0`, `ends`: as for `equilibrium`, which finds the first equilibrium, at the first value of `span`.
    - `parameter`: name of a number of the scene, such as `"friction.belt_velocity"`.
    - `span`: `(first, last)` value. The branch goes from the first towards the last, and ends when it leaves the span.
    - `step`: longest step, 0 to 1: the change of the parameter relative to the span, and of the state relative to its
      size.
    - `max_equilibria`: largest number of equilibria.

    **Returns:**

    A `Branch` whose `orbits` are `Equilibrium`s.

    **Raises:**

    - `ValueError` as `equilibrium`, and for an unknown parameter.
    - `OrbitError` if the first equilibrium is not found. Where the continuation fails later the branch ends, and
      `Branch.ending` has the reason.

    **Example:**

    ```python
    belt = jms.problems.belt_oscillator
    scene = belt.scene(belt.stribeck(), c=2.0)
    branch = jms.continue_equilibria(scene, [0.06], "friction.belt_velocity", (0.05, 0.5), step=0.1)
    print(branch.values[[0, -1]].round(2), branch.stable[[0, -1]])
    ```

    ```text
    [0.05 0.5 ] [False  True]
    ```
    """
    first, last = read_span(span)
    check_parameter(scene, parameter)
    step, most = as_float(step, name="step", lower=0.0), as_whole(max_equilibria, name="max_equilibria")
    problem, x, dof = prepare_rest(replace_elements(scene, {parameter: first}), q0, ends, parameter)
    shot, _ = solve_rest(problem, x, first, dof, rest_scale(x, dof, abs(last - first)))
    refuse_time(problem, shot, dof)
    change = np.linalg.lstsq(shot.by[:, :-1], -shot.by[:, -1], rcond=None)[0]
    scale = rest_scale(shot.x, dof, abs(last - first), change)
    tangent = tangent_at(shot, scale, np.append(np.zeros(len(x)), last - first) / scale)
    steps = [EquilibriumStep(problem, shot, describe_rest(problem, shot, dof), scale, tangent)]
    points: list[BifurcationPoint[Equilibrium]] = []
    ending = follow(steps, points, (first, last), step, most)
    values = np.array([each.shot.value for each in steps])
    return Branch(parameter, values, tuple(each.orbit for each in steps), tuple(points), ending)


@dataclass(frozen=True)
class EquilibriumStep(AbstractStep[RestPoint, Equilibrium]):
    """An equilibrium of a branch, as `AbstractStep`."""

    problem: RestProblem
    shot: RestPoint
    orbit: Equilibrium
    scale: np.ndarray
    tangent: np.ndarray

    def corrected(self, length: float) -> tuple[RestPoint, int]:
        """The equilibrium at this distance along the tangent, and the number of iterations."""
        ahead, there = self.along(length)
        return solve_rest(self.problem, ahead[:-1], float(ahead[-1]), len(self.orbit.q), self.scale, [there])

    def moved_to(self, shot: RestPoint) -> EquilibriumStep:
        """The step that begins at an equilibrium, with the tangent in the same sense."""
        orbit = describe_rest(self.problem, shot, len(self.orbit.q))
        return EquilibriumStep(self.problem, shot, orbit, self.scale, tangent_at(shot, self.scale, self.tangent))

    def tests(self) -> dict[str, Callable[[RestPoint], float]]:
        """Test functions of the eigenvalues."""
        return {CROSSING: _crossing, HOPF: _oscillating}

    def bifurcation(self, kind: str, length: float, index: int) -> BifurcationPoint[Equilibrium] | None:
        """The bifurcation at this distance; None for two real eigenvalues of opposite signs, a neutral saddle."""
        shot, _ = self.corrected(length)
        rest = describe_rest(self.problem, shot, len(self.orbit.q))
        rate = nearest_oscillation(rest.eigenvalues)
        if kind == HOPF and not abs(rate.real) < _AXIS * rate.imag:
            return None
        return BifurcationPoint(kind, shot.value, index, rest, np.zeros(0))


def _crossing(shot: RestPoint) -> float:
    """The product of all eigenvalues, relative to the largest."""
    values = np.linalg.eigvals(shot.linearised)
    return float(np.prod(values / np.max(np.abs(values))).real)


def _oscillating(shot: RestPoint) -> float:
    """The product of all sums of two eigenvalues, each relative to their magnitudes."""
    values = np.linalg.eigvals(shot.linearised)
    i, j = np.triu_indices(len(values), 1)
    return float(np.prod((values[i] + values[j]) / (np.abs(values[i]) + np.abs(values[j]))).real) if len(i) else 1.0
