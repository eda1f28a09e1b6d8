"""`continue_orbits`: a branch of periodic orbits over a number of the scene."""

from __future__ import annotations  # `help` shows types as they are written here

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Array, PyTree

from .._core.arguments import as_float, as_whole, did_you_mean
from .._core.progress import reported
from ..scene import Scene, elements, replace_elements
from ._branch import DOUBLING, Branch, SpecialOrbit
from ._describe import describe
from ._newton import newton
from ._periodic_orbit import Guess, prepare, shoot
from ._return_map import OrbitError, PeriodFn, Section
from ._special import locate
from ._step import BranchStep, step_at
from ._store import BranchStore

# Steps along the branch, in the scales of the unknowns: the first and the shortest as parts of the longest.
_FIRST, _SHORTEST = 0.1, 1e-5
# Cosine of the angle between two tangents below which a step is made shorter, but for steps that are short already.
_STRAIGHT, _SHORT = 0.9, 1e-2
# Distance of two neighbours, in steps along the tangent.
_FAR = 3.0
# Iterations of Newton up to which the next step is longer.
_EASY = 3
# First step to the orbits of twice the period, in the extent of the orbit.
_BESIDE = 0.02

BranchProgress: TypeAlias = Callable[[int, float], None]


def continue_orbits(
    scene: Scene,
    guess: Guess | SpecialOrbit,
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
) -> Branch:
    """Follow periodic orbits over a number of the scene, by pseudo-arclength continuation.

    It passes folds, where the branch turns back, and orbits that lose their stability, which it names and locates, as
    it does those at which the sequence of modes changes. One program is compiled for the whole branch.

    **Arguments:**

    - `scene`, `period`, `section`, `settle`, `rtol`, `atol`: as for `periodic_orbit`, which finds the first orbit, at
      the first value of `span`. For a branch over the frequency of the force `period` is a function of `params`.
    - `guess`: as there; or a period doubling of another branch, a `SpecialOrbit`, for the branch of the orbits of twice
      the period that begins there, within `span`; with the `period` of the branch it lies on.
    - `parameter`: name of a number of the scene, such as `"W"` or `"friction.Fc"`, as `jaxmodsim.scene.elements` lists
      them.
    - `span`: `(first, last)` value. The branch goes from the first towards the last, and ends where it leaves the span.
    - `step`: longest step, 0 to 1: the change of the parameter in parts of the span, and of the state in parts of its
      extent.
    - `max_orbits`: largest number of orbits.
    - `out`: folder of a Zarr store to which the branch is written as it grows, and from which the same call goes on.
      Needs the extra `sweep`.
    - `progress`: True for a line that says how far it has come, or a function of the number of orbits and the value.

    **Returns:**

    A `Branch`.

    **Raises:**

    - `ValueError` as `periodic_orbit`, for a parameter that is not there, and a store of another branch.
    - `OrbitError` where there is no first orbit. A branch that cannot be followed further ends there, and says so.

    ??? cite "Reference"

        ```bibtex
        @article{keller1977numerical,
            author={Keller, H. B.}, title={Numerical solution of bifurcation and nonlinear eigenvalue problems},
            journal={Applications of Bifurcation Theory}, pages={359--384}, year={1977},
        }
        ```
    """
    first, last = _span(span)
    check_parameter(scene, parameter)
    step, most = as_float(step, name="step", lower=0.0), as_whole(max_orbits, name="max_orbits")
    if isinstance(guess, SpecialOrbit):
        begin = _doubled(scene, guess, parameter, last - first, period, section, rtol, atol)
    else:
        there = replace_elements(scene, {parameter: first})
        problem, start, dof = prepare(there, guess, period, section, settle, rtol, atol, parameter)
        shot = shoot(problem, start, first, dof)
        sense = np.zeros(len(start.scale))
        sense[-1] = last - first
        begin = step_at(problem, shot, describe(problem, shot, dof)[0], abs(last - first), sense)
    store = None if out is None else BranchStore(Path(out), scene, parameter, (first, last))
    steps, points = [begin], []
    if store is not None and store.steps:
        steps, points = store.read(begin)
    with reported(progress, "branch", lambda count, value: f"{count} orbits, {parameter} = {value:.6g}") as report:
        ending = _follow(steps, points, sorted((first, last)), step, most, report, store)
    if store is not None:
        store.write(steps, points)
    values = np.array([each.shot.value for each in steps])
    return Branch(parameter, values, tuple(each.orbit for each in steps), tuple(points), ending)


def _follow(
    steps: list[BranchStep],
    points: list[SpecialOrbit],
    span: Sequence[float],
    longest: float,
    most: int,
    report: BranchProgress | None,
    store: BranchStore | None,
) -> str:
    """Add orbits and special ones until the branch leaves the span; returns why it ends."""
    length, low, high = _FIRST * longest, *span
    while len(steps) < most:
        now = steps[-1]
        if len(steps) > 1 and not low < now.shot.value < high:
            return "It ends at the end of the span."
        length = min(length, _to_end(now, low, high))
        try:
            shot, count = now.corrected(length)
            if np.linalg.norm((shot.unknowns - now.shot.unknowns) / now.scale) > _FAR * length:
                raise OrbitError("The next orbit is on another branch.")
            made = now.described(shot)
        except OrbitError as error:
            length *= 0.5
            if length < _SHORTEST * longest:
                return f"It ends at {now.shot.value:.8g}, from where it cannot be followed: {error}"
            continue
        turn = float(made.tangent * made.scale / now.scale @ now.tangent)
        turn /= float(np.linalg.norm(made.tangent * made.scale / now.scale))
        if turn < _STRAIGHT and length > _SHORT * longest:
            length *= 0.5
            continue
        points += locate(now, made, length, len(steps) - 1)
        steps.append(made)
        if report is not None:
            report(len(steps), made.shot.value)
        if store is not None:
            store.write_often(steps, points)
        length = min(longest, 1.5 * length if count <= _EASY else length)
    return f"It ends with the {most} orbits that max_orbits allows."


def _to_end(now: BranchStep, low: float, high: float) -> float:
    """Length of a step that ends on the end of the span, as far as the tangent tells, or a little beyond it."""
    rate = now.tangent[-1] * now.scale[-1]
    distance = high - now.shot.value if rate > 0 else now.shot.value - low
    return np.inf if rate == 0 or distance <= 0 else (1.0 + 1e-6) * distance / abs(rate)


def _doubled(
    scene: Scene,
    point: SpecialOrbit,
    parameter: str,
    span: float,
    period: float | PeriodFn | None,
    section: Section | None,
    rtol: float,
    atol: float,
) -> BranchStep:
    """The start of the branch of twice the period: beside a period doubling, along its direction."""
    if point.kind != DOUBLING:
        raise ValueError(f"Another branch starts at a period doubling, but a {point.kind} was given.")
    there = replace_elements(scene, {parameter: point.value})
    doubled = None if period is None else _Twice(period)
    problem, start, dof = prepare(there, point.orbit, doubled, section, None, rtol, atol, parameter)
    twice = 2.0 * start.period if problem.autonomous else start.period
    n, scale = len(start.x), start.scale.copy()
    scale[-1] = abs(span)
    if problem.autonomous:
        scale[n] = twice
    tangent = np.zeros(len(scale))
    tangent[:n] = point.direction / scale[:n]
    tangent /= np.linalg.norm(tangent)
    shot = newton(problem, start.x, twice, point.value, dof, scale, None)[0]
    here = BranchStep(problem, shot, point.orbit, scale, tangent)
    shot, _ = here.corrected(_BESIDE)
    return here.described(shot)


@dataclass(frozen=True)
class _Twice:
    """Two periods."""

    period: float | PeriodFn

    def __call__(self, params: PyTree) -> Array | float:
        """Their length [s]."""
        return 2.0 * (self.period(params) if callable(self.period) else self.period)


def _span(span: Sequence[float]) -> tuple[float, float]:
    if not isinstance(span, Sequence | np.ndarray) or len(span) != 2:
        raise ValueError(f"span must be (first, last), as in (0.2, 1.2), but {span!r} was given.")
    first, last = (as_float(x, name="span") for x in span)
    if first == last:
        raise ValueError(f"span must have two different values, but both are {first:g}.")
    return first, last


def check_parameter(scene: Scene, parameter: str) -> None:
    """Refuse what is no number of the scene.

    **Raises:**

    - `ValueError` with the numbers that there are.
    """
    known = elements(scene)
    if parameter not in known:
        raise ValueError(
            f"parameter must be the name of a number of the scene, but {parameter!r} was given; there are:"
            f" {', '.join(known)}.{did_you_mean(parameter, known)}"
        )
