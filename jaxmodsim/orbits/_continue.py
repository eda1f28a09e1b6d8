"""`continue_orbits` and `continue_bifurcation`: branches of periodic orbits, and curves of their bifurcations."""

from __future__ import annotations  # `help` shows types as they are written here

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

import equinox as eqx
import numpy as np

from .._core.arguments import as_float, as_whole
from .._core.progress import reported
from .._core.readable import AbstractReadable, Table, table_of
from ..scene import Scene, replace_elements
from ._branch import BifurcationPoint, Branch, check_parameter, follow, read_span
from ._equilibrium import Equilibrium
from ._newton import Condition, newton
from ._orbit import PeriodicOrbit, describe
from ._orbit_step import TESTS, critical_condition, step_at
from ._periodic_orbit import Guess, prepare, shoot
from ._return_map import PeriodFn, Section, ShotOrbit
from ._starts import first_step
from ._store import BranchStore

BranchProgress: TypeAlias = Callable[[int, float], None]


def continue_orbits(
    scene: Scene,
    guess: Guess | BifurcationPoint[PeriodicOrbit] | BifurcationPoint[Equilibrium],
    parameter: str,
    span: Sequence[float],
    *,
    period: float | PeriodFn | None = None,
    section: Section | None = None,
    settle: float | None = None,
    step: float = 0.02,
    max_orbits: int = 500,
    out: str | Path | None = None,
    progress: bool | BranchProgress = False,
    rtol: float = 1e-10,
    atol: float = 1e-12,
) -> Branch[PeriodicOrbit]:
    """Follow periodic orbits over a number of the scene, by pseudo-arclength continuation.

    The branch passes folds and includes unstable orbits. It locates and classifies bifurcations, and changes of the
    sequence of modes, at which it may turn back at a corner. One program is compiled for the whole branch.

    **Arguments:**

    - `scene`, `period`, `section`, `settle`, `rtol`, `atol`: as for `periodic_orbit`, which finds the first orbit, at
      the first value of `span`. For a branch over the frequency of the force `period` is a function of `params`.
    - `guess`: as for `periodic_orbit`; or a `BifurcationPoint` within `span`, at which another branch begins. At a
      period doubling the orbits have twice the period; pass the `period` of the branch of the point. At a Hopf point of
      equilibria the orbits begin with zero amplitude, and may exist on either side of it.
    - `parameter`: name of a number of the scene, such as `"W"` or `"friction.Fc"`, as listed by
      `jaxmodsim.scene.elements`.
    - `span`: `(first, last)` value. The branch goes from the first towards the last, and ends when it leaves the span.
    - `step`: longest step, 0 to 1: the change of the parameter relative to the span, and of the state relative to its
      extent.
    - `max_orbits`: largest number of orbits.
    - `out`: folder of a Zarr store. The branch is written to it as it grows, and the same call resumes from it. Needs
      the extra `sweep`.
    - `progress`: True for a progress line, or a function of the number of orbits and the value.

    **Returns:**

    A `Branch`.

    **Raises:**

    - `ValueError` as `periodic_orbit`, for an unknown parameter, and for a store of another branch.
    - `OrbitError` if the first orbit is not found. Where the continuation fails later the branch ends, and
      `Branch.ending` has the reason.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    branch = jms.continue_orbits(scene, ([0.0], [0.0]), "k", (100.0, 110.0), settle=20.0, step=0.5)
    print(f"periods from {branch.period[0]:.4f} to {branch.period[-1]:.4f} s, all stable: {branch.stable.all()}")
    ```

    ```text
    periods from 0.9785 to 0.9091 s, all stable: True
    ```

    ??? cite "Reference"

        ```bibtex
        @article{keller1977numerical,
            author={Keller, H. B.}, title={Numerical solution of bifurcation and nonlinear eigenvalue problems},
            journal={Applications of Bifurcation Theory}, pages={359--384}, year={1977},
        }
        ```
    """
    first, last = read_span(span)
    check_parameter(scene, parameter)
    step, most = as_float(step, name="step", lower=0.0), as_whole(max_orbits, name="max_orbits")
    if isinstance(guess, BifurcationPoint):
        begin = first_step(scene, guess, parameter, (first, last), period, section, rtol, atol)
    else:
        at_first = replace_elements(scene, {parameter: first})
        problem, start, dof = prepare(at_first, guess, period, section, settle, rtol, atol, (parameter,))
        shot = shoot(problem, start, dof)
        sense = np.zeros(len(start.scale))
        sense[-1] = last - first
        begin = step_at(problem, shot, describe(problem, shot, dof)[0], np.array([abs(last - first)]), sense)
    store = None if out is None else BranchStore(Path(out), scene, parameter, (first, last))
    steps = [begin]
    points: list[BifurcationPoint[PeriodicOrbit]] = []
    if store is not None and store.steps:
        steps, points = store.read(begin)
    with reported(progress, "branch", lambda count, value: f"{count} orbits, {parameter} = {value:.6g}") as report:

        def grown(count: int, value: float) -> None:
            if report is not None:
                report(count, value)
            if store is not None:
                store.write_often(steps, points)

        ending = follow(steps, points, (first, last), step, most, grown)
    if store is not None:
        store.write(steps, points)
    values = np.array([each.shot.value for each in steps])
    return Branch(parameter, values, tuple(each.orbit for each in steps), tuple(points), ending)


class BifurcationCurve(AbstractReadable, eqx.Module):
    """Bifurcations of one kind over two numbers of the scene.

    - `kind`: as in `BifurcationPoint`.
    - `parameters`: names of the two numbers.
    - `values`: of the two numbers, shape `[orbits, 2]`.
    - `orbits`: a `PeriodicOrbit` each, in order along the curve.
    - `ending`: a sentence that says why the curve ends.
    """

    kind: str = eqx.field(static=True)
    parameters: tuple[str, str] = eqx.field(static=True)
    values: np.ndarray
    orbits: tuple[PeriodicOrbit, ...]
    ending: str = eqx.field(static=True)


def continue_bifurcation(
    scene: Scene,
    point: BifurcationPoint,
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
) -> BifurcationCurve:
    """Follow a fold, period doubling, Neimark-Sacker or branch point over two numbers of the scene.

    The equations of the orbit and the test function of its multipliers are solved together, with the arclength as the
    parameter of the curve, which may turn back in either number.

    **Arguments:**

    - `scene`, `period`, `section`, `rtol`, `atol`: as for the branch of the point.
    - `point`: a bifurcation, one of `Branch.points`.
    - `parameters`: names of two numbers of the scene: that of the branch, then another one.
    - `span`: `(first, last)` value of the second number. The curve begins at the first value, best the value along the
      branch, and ends when it leaves the span.
    - `step`: longest step, 0 to 1: the change of the second number relative to the span, of the first number relative
      to its value, and of the state relative to its extent.
    - `max_orbits`, `progress`: as for `continue_orbits`.

    **Returns:**

    A `BifurcationCurve`. Where multipliers meet on the unit circle it may end in a curve of another kind.

    **Raises:**

    - `ValueError` as `continue_orbits`, and for a change of the sequence of modes.
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
    if point.kind not in TESTS:
        raise ValueError(f"point must be a bifurcation of a branch: {', '.join(TESTS)}; but a {point.kind} was given.")
    if isinstance(parameters, str) or len(parameters) != 2 or parameters[0] == parameters[1]:
        raise ValueError(
            f"parameters must be the names of two numbers of the scene, that of the branch first, but {parameters!r}"
            " was given."
        )
    one, other = parameters
    for name in parameters:
        check_parameter(scene, name)
    test = TESTS[point.kind]
    at_first = replace_elements(scene, {one: point.value, other: first})
    problem, start, dof = prepare(at_first, point.orbit, period, section, None, rtol, atol, (one, other))
    spans = np.array([abs(point.value) or 1.0, abs(last - first)])
    scale = np.concatenate([start.scale[:-2], spans])
    sense = np.zeros(len(scale))
    sense[-1] = last - first

    def from_first(shot: ShotOrbit) -> float:
        return (shot.value - first) / spans[1]

    fixed = Condition(from_first, lambda _: np.abs(np.sign(sense)))
    conditions = (critical_condition(problem, test, scale, dof), fixed)
    shot, _ = newton(problem, start.x, start.period, problem.values, dof, scale, conditions)
    steps = [step_at(problem, shot, describe(problem, shot, dof)[0], spans, sense, test)]
    with reported(progress, "curve", lambda count, value: f"{count} orbits, {other} = {value:.6g}") as report:
        ending = follow(steps, None, (first, last), longest, most, report)
    values = np.array([each.shot.values for each in steps])
    return BifurcationCurve(point.kind, (one, other), values, tuple(each.orbit for each in steps), ending)


@table_of.register
def _(curve: BifurcationCurve) -> Table:
    """Both ends, and the reason of the second."""
    rows = [tuple(f"{x:.8g}" for x in curve.values[i]) for i in (0, -1)]
    title = f"Curve of {len(curve.orbits)} orbits: {curve.kind}"
    return Table(title, curve.parameters, rows, (curve.ending,))
