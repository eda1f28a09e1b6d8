"""Neutral directions, in which an orbit has no unique position: shifts of the machine, coordinates in stick."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..scene import Scene, quantity_of
from ._return_map import OrbitError, OrbitProblem, SettledState, ShotOrbit, evaluate

# Length of the shift that tests whether a scene is invariant, relative to the extent of the motion.
_SHIFT = 7.3
# Tolerances of the derivatives of the return map for a shift and for a coordinate in stick, and of equal residuals.
_SHIFTED, _STUCK, _SAME = 1e-7, 1e-6, 1e-6
# A coordinate advances if its change after a period exceeds this fraction of its range.
_MOVES_ON = 0.9


def anchored(problem: OrbitProblem, start: SettledState, dof: int) -> tuple[OrbitProblem, SettledState]:
    """The problem with the segments, anchor, neutral directions and plane of a start.

    The plane of an orbit of unknown period is normal to the flow at the start, in the scales.
    """
    x = jnp.asarray(start.x[0])
    none, cuts = jnp.zeros((len(x), len(x))), jnp.asarray(start.cuts)
    problem = replace(problem, normal=0.0 * x, anchor=x, cuts=cuts, free=none, pinned=none, held=start.held)
    point = evaluate(problem, start.x, start.period, problem.values, dof)
    if point.failure:
        raise OrbitError(f"The run over one period failed: {point.failure}")
    moved = np.sum(point.residual[: start.x.size].reshape(start.x.shape), axis=0)
    problem = pin(problem, point, start.scale, dof)
    moving = moving_on(problem.scene, moved - np.asarray(problem.free) @ moved, start.scale[:dof])
    if problem.autonomous and problem.section is None:
        problem = replace(problem, normal=jnp.asarray(point.flows[0] / start.scale[: len(x)] ** 2))
    return problem, start._replace(moving=moving)


def pin(problem: OrbitProblem, point: ShotOrbit, scale: np.ndarray, dof: int) -> OrbitProblem:
    """The problem with the invariant shifts of the scene, along which the start of the orbit is pinned.

    `point` is near the orbit. The start is also pinned along coordinates that stick throughout, of `problem.held`.
    """
    s = scale[: point.x.shape[1]]
    names = tuple(name for name in problem.held if len(_held(problem, (name,), point, s, dof)))
    shifts = _shifts(problem, point, s, dof, _held(problem, names, point, s, dof)) * s[:, None]
    problem = replace(problem, held=names, free=jnp.asarray(shifts @ np.linalg.pinv(shifts / s[:, None]) / s))
    basis = neutral_directions(problem, point, s, dof)
    return replace(problem, pinned=jnp.asarray(s[:, None] * (basis @ basis.T) / s))


def neutral_directions(problem: OrbitProblem, point: ShotOrbit, scale: np.ndarray, dof: int) -> np.ndarray:
    """An orthonormal basis of the neutral directions in the scales of the state, shape `[n, k]`."""
    s = scale[: point.x.shape[1]]
    shifts, sizes, _ = np.linalg.svd(np.asarray(problem.free) * s / s[:, None])
    columns = np.hstack([shifts[:, sizes > 0.5], _held(problem, problem.held, point, s, dof).T])
    basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return basis[:, sizes > _STUCK]


def moving_on(scene: Scene, moved: np.ndarray, extent: np.ndarray) -> str:
    """A sentence that names coordinates that advance in a period; `extent` is half the range of each [m or rad]."""
    far = np.flatnonzero(np.abs(moved[: len(extent)]) > 2.0 * _MOVES_ON * extent)
    if not len(far):
        return ""
    names = ", ".join(f"{quantity_of(scene, f'q[{i}]').name} by {moved[i]:.6g}" for i in far)
    return (
        f" In a period the machine advances, {names}, but such a shift changes its motion. An orbit that advances needs"
        " a scene whose forces, friction and gaps are the same after any shift of these coordinates."
    )


def differs(one: ShotOrbit, other: ShotOrbit, scale: np.ndarray) -> bool:
    """Whether the residuals of two shots differ by more than their errors."""
    growth = max(1.0, float(np.max(np.abs(np.linalg.eigvals(one.maps)))))
    apart = np.abs(one.residual - other.residual)[: one.x.size] / scale[: one.x.size]
    return bool(other.failure) or not float(np.max(apart)) < _SAME * growth


def shifted(problem: OrbitProblem, point: ShotOrbit, by: np.ndarray, dof: int) -> ShotOrbit:
    """The shot with all starts and the anchor shifted."""
    problem = eqx.tree_at(lambda p: p.anchor, problem, problem.anchor + by)
    return evaluate(problem, point.x + by, point.period, point.values, dof)


def _held(problem: OrbitProblem, names: tuple[str, ...], point: ShotOrbit, s: np.ndarray, dof: int) -> np.ndarray:
    """Scaled directions in which these elements hold the coordinates for the whole period, shape `[rows, n]`.

    A coordinate in stick is conserved: it is a left eigenvector of the monodromy matrix with the eigenvalue 1.
    """
    scene = problem.with_values(point.values).bind_time(problem.spans[0, 0] * point.period)
    monodromy, rows = point.monodromy * s / s[:, None], [np.zeros((0, len(s)))]
    for name in names:
        along = np.atleast_2d(scene.event_driven[name].direction(jnp.asarray(point.x[0, :dof]), scene.params))
        row = np.pad(along * s[:dof], ((0, 0), (0, len(s) - dof)))
        kept = row / np.linalg.norm(row, axis=1, keepdims=True) @ monodromy
        if np.max(np.abs(kept @ monodromy - kept)) < _STUCK and np.min(np.linalg.norm(kept, axis=1)) > 0.1:
            rows.append(kept)
    return np.vstack(rows)


def _shifts(problem: OrbitProblem, point: ShotOrbit, s: np.ndarray, dof: int, held: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the shifts of coordinates that change no run, in the scales, shape `[n, k]`."""
    n = len(s)
    monodromy = point.monodromy * s / s[:, None]
    change = np.vstack([(monodromy - np.eye(n))[:, :dof], held[:, :dof]])
    _, sizes, rows = np.linalg.svd(change)
    kept = [np.zeros(n)] * 0
    for row in rows[sizes < _SHIFTED * max(1.0, float(np.linalg.norm(monodromy)))]:
        direction = np.pad(row, (0, n - dof))
        by = _SHIFT * direction * s
        if not differs(point, shifted(problem, point, by, dof), np.tile(s, len(point.x))) and _same_gaps(
            problem, point, by, dof
        ):
            kept.append(direction)
    return np.array(kept).reshape(-1, n).T


def _same_gaps(problem: OrbitProblem, point: ShotOrbit, by: np.ndarray, dof: int) -> bool:
    """Whether a shift keeps the gaps of contacts, which matters for contacts that never close in the run."""
    scene, t = problem.with_values(point.values), problem.spans[0, 0] * point.period
    one, other = (jnp.asarray(x[:dof]) for x in (point.x[0], point.x[0] + by))
    apart = [each.error(t, one, scene.params) - each.error(t, other, scene.params) for each in scene.contacts.values()]
    return bool(np.max(np.abs(np.asarray(apart)), initial=0.0) < _SAME * np.max(np.abs(by)))
