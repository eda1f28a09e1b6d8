"""`continue_special`: a curve of special orbits over two numbers of the scene."""

from __future__ import annotations  # `help` shows types as they are written here

from collections.abc import Sequence

import equinox as eqx
import numpy as np

from .._core.arguments import as_float, as_whole
from .._core.progress import reported
from .._core.readable import AbstractReadable, Table, table_of
from ..scene import Scene, replace_elements
from ._branch import SpecialOrbit
from ._continue import BranchProgress, check_parameter, follow, read_span
from ._describe import describe
from ._newton import Condition, newton
from ._orbit import PeriodicOrbit
from ._periodic_orbit import prepare
from ._return_map import PeriodFn, Section, ShotOrbit
from ._special import TESTS
from ._step import step_at, test_condition


class SpecialCurve(AbstractReadable, eqx.Module):
    """Special orbits of one kind over two numbers of the scene.

    - `kind`: as of `SpecialOrbit`.
    - `parameters`: names of the two numbers.
    - `values`: of them, shape `[orbits, 2]`.
    - `orbits`: a `PeriodicOrbit` each, in order along the curve.
    - `ending`: why it ends, in words.
    """

    kind: str = eqx.field(static=True)
    parameters: tuple[str, str] = eqx.field(static=True)
    values: np.ndarray
    orbits: tuple[PeriodicOrbit, ...]
    ending: str = eqx.field(static=True)


def continue_special(
    scene: Scene,
    point: SpecialOrbit,
    parameters: tuple[str, str],
    span: Sequence[float],
    *,
    period: float | PeriodFn | None = None,
    section: Section | None = None,
    step: float = 0.1,
    max_orbits: int = 200,
    progress: bool | BranchProgress = False,
    rtol: float = 1e-10,
    atol: float = 1e-12,
) -> SpecialCurve:
    """Follow a fold, period doubling, Neimark-Sacker or branch point over two numbers of the scene.

    The equations of an orbit and the one that its multipliers meet there are solved along the curve by its arclength,
    so that it may turn back in either number.

    **Arguments:**

    - `scene`, `period`, `section`, `rtol`, `atol`: as for the branch on which the point lies.
    - `point`: the special orbit, one of `Branch.points`.
    - `parameters`: names of two numbers of the scene: that of the branch, and another one.
    - `span`: `(first, last)` value of the second number. The curve begins at the first one, best the one that the
      branch was followed with, and ends where it leaves the span.
    - `step`: longest step, 0 to 1: the changes of the second number in parts of the span, of the first one in parts of
      its value, and of the state in parts of its extent.
    - `max_orbits`, `progress`: as for `continue_orbits`.

    **Returns:**

    A `SpecialCurve`. Where multipliers meet on the unit circle a curve of one kind may end in another one.

    **Raises:**

    - `ValueError` as `continue_orbits`, and for a point where the sequence of modes changes.
    - `OrbitError` if there is no such orbit at the first value.

    ??? cite "Reference"

        ```bibtex
        @book{kuznetsov2004elements,
            author={Kuznetsov, Y. A.}, title={Elements of Applied Bifurcation Theory}, edition={3}, chapter={10},
            publisher={Springer}, year={2004},
        }
        ```
    """
    first, last = read_span(span)
    longest, most = as_float(step, name="step", lower=0.0), as_whole(max_orbits, name="max_orbits")
    one, other = _names(scene, point, parameters)
    test = TESTS[point.kind]
    there = replace_elements(scene, {one: point.value, other: first})
    problem, start, dof = prepare(there, point.orbit, period, section, None, rtol, atol, (one, other))
    spans = np.array([abs(point.value) or 1.0, abs(last - first)])
    scale = np.concatenate([start.scale[:-2], spans])
    sense = np.zeros(len(scale))
    sense[-1] = last - first

    def from_first(shot: ShotOrbit) -> float:
        return (shot.value - first) / spans[1]

    held = Condition(from_first, lambda _: np.abs(np.sign(sense)))
    conditions = (test_condition(problem, test, scale, dof), held)
    shot, _ = newton(problem, start.x, start.period, problem.values, dof, scale, conditions)
    steps = [step_at(problem, shot, describe(problem, shot, dof)[0], spans, sense, test)]
    with reported(progress, "curve", lambda count, value: f"{count} orbits, {other} = {value:.6g}") as report:

        def grown() -> None:
            if report is not None:
                report(len(steps), steps[-1].shot.value)

        ending = follow(steps, [], sorted((first, last)), longest, most, lambda *_: [], grown=grown)
    values = np.array([each.shot.values for each in steps])
    return SpecialCurve(point.kind, (one, other), values, tuple(each.orbit for each in steps), ending)


def _names(scene: Scene, point: SpecialOrbit, parameters: tuple[str, str]) -> tuple[str, str]:
    if point.kind not in TESTS:
        raise ValueError(f"A curve starts at a special orbit of a branch: {', '.join(TESTS)}; {point.kind} was given.")
    if isinstance(parameters, str) or len(parameters) != 2 or parameters[0] == parameters[1]:
        raise ValueError(
            f"parameters must be the names of two numbers of the scene, that of the branch first, but {parameters!r}"
            " was given."
        )
    one, other = parameters
    for name in (one, other):
        check_parameter(scene, name)
    return one, other


@table_of.register
def _(curve: SpecialCurve) -> Table:
    """Its ends, and why it ends."""
    rows = [tuple(f"{x:.8g}" for x in curve.values[i]) for i in (0, -1)]
    title = f"Curve of {len(curve.orbits)} orbits: {curve.kind}"
    return Table(title, curve.parameters, rows, (curve.ending,))
