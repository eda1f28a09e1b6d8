"""Newton's iteration for the equations of an orbit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ._return_map import OrbitError, OrbitProblem, ShotOrbit, evaluate

_ITERATIONS, _HALVINGS = 30, 6
# Residuals, in the scales of the unknowns: where the iteration ends, and what counts as an orbit where it ends earlier,
# or so many tolerances of the run.
_GOAL, _ENOUGH, _TOLERANCES = 1e-12, 1e-8, 10.0
# Singular values below this part of the largest one are no directions.
_RANK = 1e-10
# Part of the first period below which an iteration has run into an equilibrium.
_COLLAPSED = 1e-3
# Angle between section and orbit that is none.
_TANGENT = 1e-8


@dataclass(frozen=True)
class Condition:
    """An equation that is added to those of an orbit, for each parameter that is an unknown.

    - `residual`: at a point; `by`: its derivatives there, by the unknowns in their scales.
    """

    residual: Callable[[ShotOrbit], float]
    by: Callable[[ShotOrbit], np.ndarray]


def newton(
    problem: OrbitProblem,
    x: np.ndarray,
    period: float,
    values: np.ndarray,
    dof: int,
    scale: np.ndarray,
    conditions: Sequence[Condition] = (),
) -> tuple[ShotOrbit, int]:
    """Solve the equations; without conditions the parameters stay.

    `scale` has the magnitudes of the unknowns of `ShotOrbit.by`. Returns the point and the number of iterations.

    **Raises:**

    - `OrbitError` where it does not converge.
    """
    point = _checked(evaluate(problem, x, period, values, dof))
    size, history = _size(point, scale, conditions), []
    enough = max(_ENOUGH, _TOLERANCES * float(problem.rtol))
    for i in range(_ITERATIONS):
        _refuse_tangent(point, scale)
        history.append(size)
        if problem.autonomous and point.period < _COLLAPSED * period:
            raise OrbitError(
                "The iteration runs into an equilibrium, where every period will do: there is no orbit near the start."
                " Begin nearer to it, from a longer `settle`."
            )
        if size < _GOAL:
            return point, i
        step = _step(point, scale, conditions)
        made = None
        for halving in range(_HALVINGS):
            unknowns = point.unknowns + step * 0.5**halving
            made = evaluate(problem, *split(unknowns, point, problem.autonomous), dof)
            after = np.inf if made.failure else _size(made, scale, conditions)
            if after < size or size < enough:
                break
        else:
            break
        if size < enough and not after < 0.5 * size:
            # As near as the steps of the run let it come.
            return (point if size <= after else made), i
        point, size = made, after
    raise OrbitError(
        f"No convergence to a periodic orbit: after {len(history)} iterations the state misses itself by {size:.3g} of"
        f" its size (first {history[0]:.3g}, least {min(history):.3g}). Begin nearer to the orbit, from a longer"
        " `settle`; or the sequence of modes changes from one iteration to the next: begin away from where the motion"
        " grazes."
    )


def _checked(point: ShotOrbit) -> ShotOrbit:
    if point.failure:
        raise OrbitError(f"The run over one period failed: {point.failure}")
    return point


def _refuse_tangent(point: ShotOrbit, scale: np.ndarray) -> None:
    n = point.x.shape[1]
    for row in point.by[point.x.size :, :n] * scale[:n]:
        flow = point.flows[0] / scale[:n]
        if abs(row @ flow) <= _TANGENT * np.linalg.norm(row) * np.linalg.norm(flow):
            raise OrbitError(
                "The section is degenerate: the orbit does not cross it but runs along it, or rests on it. Pass a"
                " section that the motion crosses with some speed, or none."
            )


def _rows(point: ShotOrbit, scale: np.ndarray) -> np.ndarray:
    """Scales of the equations: of states those of the state, of the plane its largest derivative."""
    size = point.x.size
    return np.append(scale[:size], np.max(np.abs(point.by[size:] * scale), axis=1, initial=1e-300))


def _size(point: ShotOrbit, scale: np.ndarray, conditions: Sequence[Condition]) -> float:
    """Largest residual, in the scales."""
    size = float(np.max(np.abs(point.residual) / _rows(point, scale)))
    return max([size, *(abs(each.residual(point)) for each in conditions)])


def scaled(point: ShotOrbit, scale: np.ndarray) -> np.ndarray:
    """Derivatives of the equations with rows and columns in the scales of the unknowns; `[equations, unknowns]`."""
    return point.by * scale / _rows(point, scale)[:, None]


def _step(point: ShotOrbit, scale: np.ndarray, conditions: Sequence[Condition]) -> np.ndarray:
    by, residual = scaled(point, scale), point.residual / _rows(point, scale)
    if conditions:
        by = np.vstack([by, *(each.by(point) for each in conditions)])
        residual = np.append(residual, [each.residual(point) for each in conditions])
    step = -np.linalg.lstsq(by[:, : len(by)], residual, rcond=_RANK)[0]
    return scale * np.append(step, np.zeros(len(scale) - len(step)))


def split(unknowns: np.ndarray, point: ShotOrbit, autonomous: bool) -> tuple[np.ndarray, float, np.ndarray]:
    """Starts, period and values of the parameters in a vector as `ShotOrbit.unknowns` of this point."""
    size = point.x.size
    period = float(unknowns[size]) if autonomous else point.period
    return unknowns[:size].reshape(point.x.shape), period, unknowns[size + autonomous :]
