"""Newton's iteration for the equations of an orbit."""

from collections.abc import Callable

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

# Rows that are added to the equations: their residual and derivatives at a point.
Extra = Callable[[ShotOrbit], tuple[float, np.ndarray]]


def newton(
    problem: OrbitProblem, x: np.ndarray, period: float, value: float, dof: int, scale: np.ndarray, extra: Extra | None
) -> tuple[ShotOrbit, int]:
    """Solve the equations; with `extra` the parameter is one of the unknowns.

    `scale` has the magnitudes of the unknowns of `ShotOrbit.by`. Returns the point and the number of iterations.

    **Raises:**

    - `OrbitError` where it does not converge.
    """
    point = _checked(evaluate(problem, x, period, value, dof))
    size, history = _size(point, scale, extra), []
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
        step = _step(point, scale, extra)
        made = None
        for halving in range(_HALVINGS):
            unknowns = point.unknowns + step * 0.5**halving
            made = evaluate(problem, *_split(unknowns, point, problem.autonomous), dof)
            after = np.inf if made.failure else _size(made, scale, extra)
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
    n = len(point.x)
    for row in point.by[n:, :n] * scale[:n]:
        flow = point.flow / scale[:n]
        if abs(row @ flow) <= _TANGENT * np.linalg.norm(row) * np.linalg.norm(flow):
            raise OrbitError(
                "The section is degenerate: the orbit does not cross it but runs along it, or rests on it. Pass a"
                " section that the motion crosses with some speed, or none."
            )


def _size(point: ShotOrbit, scale: np.ndarray, extra: Extra | None) -> float:
    """Largest residual, in the scales."""
    n = len(point.x)
    size = np.max(np.abs(point.residual[:n]) / scale[:n])
    for row, residual in zip(point.by[n:], point.residual[n:], strict=True):
        size = max(size, abs(residual) / max(np.max(np.abs(row) * scale), 1e-300))
    return size if extra is None else max(size, abs(extra(point)[0]))


def scaled(point: ShotOrbit, scale: np.ndarray) -> np.ndarray:
    """Derivatives of the equations with rows and columns in the scales of the unknowns; `[equations, unknowns]`."""
    n = len(point.x)
    by = point.by * scale
    rows = [scale[:n], np.max(np.abs(by[n:]), axis=1, initial=1e-300)]
    return by / np.concatenate(rows)[:, None]


def _step(point: ShotOrbit, scale: np.ndarray, extra: Extra | None) -> np.ndarray:
    n = len(point.x)
    by = scaled(point, scale)
    rows = np.concatenate([scale[:n], np.max(np.abs(point.by[n:] * scale), axis=1, initial=1e-300)])
    residual = point.residual / rows
    if extra is None:
        by = by[:, :-1]
    else:
        more, row = extra(point)
        by, residual = np.vstack([by, row]), np.append(residual, more)
    step = -np.linalg.lstsq(by, residual, rcond=_RANK)[0]
    return scale * (np.append(step, 0.0) if extra is None else step)


def _split(unknowns: np.ndarray, point: ShotOrbit, autonomous: bool) -> tuple[np.ndarray, float, float]:
    n = len(point.x)
    return unknowns[:n], float(unknowns[n]) if autonomous else point.period, float(unknowns[-1])
