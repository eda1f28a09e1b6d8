"""Newton's iteration for the equations of a periodic orbit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ._return_map import OrbitError, OrbitProblem, ShotOrbit, evaluate

_ITERATIONS, _HALVINGS = 30, 6
# Residuals in the scales of the unknowns: the iteration ends at the first. If it stalls, a residual below the second,
# or below this multiple of the tolerance of the run, counts as converged.
_GOAL, _ENOUGH, _TOLERANCES = 1e-12, 1e-8, 10.0
# Relative size of singular values that count as zero.
_RANK = 1e-10
# The iteration has collapsed to an equilibrium if the period falls below this fraction of the first one.
_COLLAPSED = 1e-3
# Section and orbit are tangent if the sine of their angle is smaller.
_TANGENT = 1e-8


@dataclass(frozen=True)
class Condition:
    """An additional equation, one for each parameter that is an unknown.

    - `residual`: its value at a solution. `by`: its derivatives by the unknowns in their scales.
    """

    residual: Callable[[Any], float]
    by: Callable[[Any], np.ndarray]


def all_residuals(point: Any, scale: np.ndarray, conditions: Sequence[Condition]) -> np.ndarray:
    """Residuals of the equations in their scales, and of the conditions."""
    return np.append(point.scaled(scale)[1], [each.residual(point) for each in conditions])


def all_derivatives(point: Any, scale: np.ndarray, conditions: Sequence[Condition]) -> np.ndarray:
    """Derivatives of `all_residuals` by the scaled unknowns."""
    return np.vstack([point.scaled(scale)[0], *(each.by(point) for each in conditions)])


def newton(
    problem: OrbitProblem,
    x: np.ndarray,
    period: float,
    values: np.ndarray,
    dof: int,
    scale: np.ndarray,
    conditions: Sequence[Condition] = (),
) -> tuple[ShotOrbit, int]:
    """Solve the equations. Without conditions the parameters are constant.

    `scale` has the magnitudes of the unknowns of `ShotOrbit.by`. Returns the solution and the number of iterations.

    **Raises:**

    - `OrbitError` if the iteration does not converge.
    """
    point = evaluate(problem, x, period, values, dof)
    if point.failure:
        raise OrbitError(f"The run over one period failed: {point.failure}")
    size, history = _size(point, scale, conditions), []
    enough = max(_ENOUGH, _TOLERANCES * float(problem.rtol))
    for i in range(_ITERATIONS):
        _refuse_tangent(point, scale)
        history.append(size)
        if problem.autonomous and point.period < _COLLAPSED * period:
            raise OrbitError(
                "The iteration converges to an equilibrium, which has any period: there is no orbit near the start."
                " Begin nearer to the orbit, with a longer `settle`."
            )
        if size < _GOAL:
            return point, i
        step = _step(point, scale, conditions)
        trial, after = point, size
        for halving in range(_HALVINGS):
            unknowns = point.unknowns + step * 0.5**halving
            trial = evaluate(problem, *split(unknowns, point, problem.autonomous), dof)
            after = np.inf if trial.failure else _size(trial, scale, conditions)
            if after < size or size < enough:
                break
        else:
            break
        if size < enough and not after < 0.5 * size:
            # The errors of the run allow no better solution.
            return (point if size <= after else trial), i
        point, size = trial, after
    raise OrbitError(
        f"No convergence to a periodic orbit: after {len(history)} iterations the relative residual is {size:.3g}"
        f" (first {history[0]:.3g}, least {min(history):.3g}). Begin nearer to the orbit, with a longer `settle`. If"
        " the sequence of modes changes between iterations, begin away from grazing motions."
    )


def _refuse_tangent(point: ShotOrbit, scale: np.ndarray) -> None:
    n = point.x.shape[1]
    for row in point.by[point.x.size :, :n] * scale[:n]:
        flow = point.flows[0] / scale[:n]
        if abs(row @ flow) <= _TANGENT * np.linalg.norm(row) * np.linalg.norm(flow):
            raise OrbitError(
                "The section is degenerate: the orbit is tangent to it, or rests on it. Pass a section that the motion"
                " crosses with some speed, or none."
            )


def _size(point: ShotOrbit, scale: np.ndarray, conditions: Sequence[Condition]) -> float:
    """Largest residual, in the scales."""
    return float(np.max(np.abs(all_residuals(point, scale, conditions))))


def _step(point: ShotOrbit, scale: np.ndarray, conditions: Sequence[Condition]) -> np.ndarray:
    by, residual = (of(point, scale, conditions) for of in (all_derivatives, all_residuals))
    step = -np.linalg.lstsq(by[:, : len(by)], residual, rcond=_RANK)[0]
    return scale * np.append(step, np.zeros(len(scale) - len(step)))


def split(unknowns: np.ndarray, point: ShotOrbit, autonomous: bool) -> tuple[np.ndarray, float, np.ndarray]:
    """Starts, period and values of the parameters from a vector like `ShotOrbit.unknowns` of this shot."""
    size = point.x.size
    period = float(unknowns[size]) if autonomous else point.period
    return unknowns[:size].reshape(point.x.shape), period, unknowns[size + autonomous :]
