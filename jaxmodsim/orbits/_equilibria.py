"""`continue_equilibria`: a branch of equilibria over a number of the scene, and where orbits begin on it."""

from __future__ import annotations  # `help` shows types as they are written here

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from jaxtyping import ArrayLike

from .._core.arguments import as_float, as_whole
from ..scene import Scene, replace_elements
from ._branch import CROSSING, FOLD, HOPF, Branch, SpecialOrbit
from ._continue import check_parameter, follow, read_span
from ._equilibrium import Equilibrium, described_rest, nearest_oscillation, prepare_rest, refuse_time, rest_scale
from ._rest import RestPoint, solve_rest
from ._rest_step import RestStep, rest_step_at, tangent_at
from ._special import in_order, root_on_step

# Real part of a pair of eigenvalues, relative to their size, that is none.
_AXIS = 1e-6

_Test = Callable[[RestStep, RestPoint], float]


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

    It passes folds, and names and locates what is special: folds, branch points, and Hopf points, where a pair of
    complex eigenvalues crosses the imaginary axis and a branch of periodic orbits begins: `continue_orbits` takes such
    a point as its guess.

    **Arguments:**

    - `scene`, `q0`, `ends`: as for `equilibrium`, which finds the first one, at the first value of `span`.
    - `parameter`: name of a number of the scene, such as `"friction.belt_velocity"`.
    - `span`: `(first, last)` value. The branch goes from the first towards the last, and ends where it leaves the span.
    - `step`: longest step, 0 to 1: the change of the parameter in parts of the span, and of the state in parts of its
      size.
    - `max_equilibria`: largest number of equilibria.

    **Returns:**

    A `Branch` whose `orbits` are `Equilibrium`s.

    **Raises:**

    - `ValueError` as `equilibrium`, and for a parameter that is not there.
    - `OrbitError` where there is no first equilibrium. A branch that cannot be followed further ends there, and says
      so.
    """
    first, last = read_span(span)
    check_parameter(scene, parameter)
    step, most = as_float(step, name="step", lower=0.0), as_whole(max_equilibria, name="max_equilibria")
    problem, x, dof = prepare_rest(replace_elements(scene, {parameter: first}), q0, ends, parameter)
    point, _ = solve_rest(problem, x, first, dof, rest_scale(x, dof, abs(last - first)))
    refuse_time(problem, point, dof)
    change = np.linalg.lstsq(point.by[:, :-1], -point.by[:, -1], rcond=None)[0]
    scale = rest_scale(point.x, dof, abs(last - first), change)
    sense = np.append(np.zeros(len(x)), last - first)
    steps = [rest_step_at(problem, point, scale, sense, dof)]
    points: list[SpecialOrbit[Equilibrium]] = []
    ending = follow(steps, points, sorted((first, last)), step, most, _locate)
    values = np.array([each.shot.value for each in steps])
    return Branch(parameter, values, tuple(each.orbit for each in steps), tuple(points), ending)


def _locate(one: RestStep, two: RestStep, length: float, index: int) -> list[SpecialOrbit[Equilibrium]]:
    """Special equilibria on the step of this length from the one to the other, in order along it."""
    tests: dict[str, _Test] = {FOLD: _turning, CROSSING: _crossing, HOPF: _oscillating}
    located: list[tuple[float, SpecialOrbit[Equilibrium]]] = []
    for kind, test in tests.items():
        at = root_on_step(one, partial(test, one), length, (test(one, one.shot), test(one, two.shot)))
        if at is None:
            continue
        shot = one.corrected(at)[0]
        made = described_rest(one.problem, shot, len(one.orbit.q))
        if kind == HOPF:
            rate = nearest_oscillation(made.eigenvalues)
            if not abs(rate.real) < _AXIS * rate.imag:
                continue  # two real eigenvalues of opposite signs: a saddle that contracts as much as it expands
        located.append((at, SpecialOrbit(kind, shot.value, index, made, np.zeros(0))))
    return in_order(located)


def _turning(one: RestStep, point: RestPoint) -> float:
    """How the parameter changes along the branch."""
    return float(tangent_at(point, one.scale, one.tangent)[-1])


def _crossing(_one: RestStep, point: RestPoint) -> float:
    """The product of all eigenvalues, in the size of the largest."""
    values = np.linalg.eigvals(point.linearised)
    return float(np.prod(values / np.max(np.abs(values))).real)


def _oscillating(_one: RestStep, point: RestPoint) -> float:
    """The product of all sums of two eigenvalues, each relative to their sizes."""
    values = np.linalg.eigvals(point.linearised)
    i, j = np.triu_indices(len(values), 1)
    return float(np.prod((values[i] + values[j]) / (np.abs(values[i]) + np.abs(values[j]))).real) if len(i) else 1.0
