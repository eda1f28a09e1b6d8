"""`continue_orbits`: a branch of periodic orbits over a number of the scene."""

from __future__ import annotations  # `help` shows types as they are written here

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np

from .._core.arguments import as_float, as_whole, did_you_mean
from .._core.progress import reported
from ..scene import Scene, elements, replace_elements
from ._branch import Branch, OrbitT, SpecialOrbit
from ._describe import describe
from ._equilibrium import Equilibrium
from ._orbit import PeriodicOrbit
from ._periodic_orbit import Guess, prepare, shoot
from ._rest_step import RestStep
from ._return_map import OrbitError, PeriodFn, Section
from ._special import corner, locate
from ._starts import beside
from ._step import BranchStep, step_at
from ._store import BranchStore

_Step = TypeVar("_Step", BranchStep, RestStep)

# Steps along the branch, in the scales of the unknowns: the first and the shortest as parts of the longest.
_FIRST, _SHORTEST = 0.1, 1e-5
# Cosine of the angle between two tangents below which a step is made shorter, but for steps that are short already.
_STRAIGHT, _SHORT = 0.9, 1e-2
# Distance of two neighbours, in steps along the tangent.
_FAR = 3.0
# Part of the largest amplitude of a branch below which its orbits have vanished.
_VANISHED = 1e-3
# Iterations of Newton up to which the next step is longer.
_EASY = 3

BranchProgress: TypeAlias = Callable[[int, float], None]


def continue_orbits(
    scene: Scene,
    guess: Guess | SpecialOrbit[PeriodicOrbit] | SpecialOrbit[Equilibrium],
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

    It passes folds, where the branch turns back, and orbits that lose their stability, which it names and locates, as
    it does those at which the sequence of modes changes, where the branch may turn back at a corner. One program is
    compiled for the whole branch.

    **Arguments:**

    - `scene`, `period`, `section`, `settle`, `rtol`, `atol`: as for `periodic_orbit`, which finds the first orbit, at
      the first value of `span`. For a branch over the frequency of the force `period` is a function of `params`.
    - `guess`: as there; or where another branch begins, a `SpecialOrbit` within `span`: a period doubling, for the
      orbits of twice the period, with the `period` of the branch it lies on; or a Hopf point of equilibria, whose
      orbits begin with no amplitude, and are followed to either side of it.
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
    first, last = read_span(span)
    check_parameter(scene, parameter)
    step, most = as_float(step, name="step", lower=0.0), as_whole(max_orbits, name="max_orbits")
    if isinstance(guess, SpecialOrbit):
        begin = beside(scene, guess, parameter, (first, last), period, section, rtol, atol)
    else:
        there = replace_elements(scene, {parameter: first})
        problem, start, dof = prepare(there, guess, period, section, settle, rtol, atol, (parameter,))
        shot = shoot(problem, start, dof)
        sense = np.zeros(len(start.scale))
        sense[-1] = last - first
        begin = step_at(problem, shot, describe(problem, shot, dof)[0], np.array([abs(last - first)]), sense)
    store = None if out is None else BranchStore(Path(out), scene, parameter, (first, last))
    steps, points = [begin], []
    if store is not None and store.steps:
        steps, points = store.read(begin)
    with reported(progress, "branch", lambda count, value: f"{count} orbits, {parameter} = {value:.6g}") as report:

        def grown() -> None:
            if report is not None:
                report(len(steps), steps[-1].shot.value)
            if store is not None:
                store.write_often(steps, points)

        ending = follow(steps, points, sorted((first, last)), step, most, locate, corner, grown)
    if store is not None:
        store.write(steps, points)
    values = np.array([each.shot.value for each in steps])
    return Branch(parameter, values, tuple(each.orbit for each in steps), tuple(points), ending)


def follow(
    steps: list[_Step],
    points: list[SpecialOrbit[OrbitT]],
    span: Sequence[float],
    longest: float,
    most: int,
    locate: Callable[[_Step, _Step, float, int], list[SpecialOrbit[OrbitT]]],
    corner: Callable[[_Step, int], tuple[_Step, SpecialOrbit[OrbitT]] | None] | None = None,
    grown: Callable[[], None] | None = None,
) -> str:
    """Add orbits and special ones until the branch leaves the span; returns why it ends.

    `locate` gives the special orbits between two, `corner` what follows where no tangent leads on; `grown` is called
    after each orbit.
    """
    length, low, high = _FIRST * longest, *span
    largest = np.max([np.asarray(each.orbit.amplitude) for each in steps], axis=0)
    while len(steps) < most:
        now = steps[-1]
        amplitude = np.asarray(now.orbit.amplitude)
        largest = np.maximum(largest, amplitude)
        if np.any(amplitude < _VANISHED * largest) and np.all(amplitude <= _VANISHED * largest):
            return f"It ends at {now.shot.value:.8g}, where the orbits vanish in an equilibrium: a Hopf point."
        if len(steps) > 1 and not low < now.shot.value < high:
            return "It ends at the end of the span."
        length = min(length, _to_end(now, low, high))
        try:
            corrected: tuple[Any, int] = now.corrected(length)
            shot, count = corrected
            if np.linalg.norm((shot.unknowns - now.shot.unknowns) / now.scale) > _FAR * length:
                raise OrbitError("The next orbit is on another branch.")
            made = now.described(shot)
        except OrbitError as error:
            length *= 0.5
            if length >= _SHORTEST * longest:
                continue
            turned = corner(now, len(steps) - 1) if corner is not None and not _at_corner(steps, points) else None
            if turned is None:
                return f"It ends at {now.shot.value:.8g}, from where it cannot be followed: {error}"
            made, point = turned
            steps.append(made)
            points.append(point)
            length = _FIRST * longest
            continue
        turn = float(made.tangent * made.scale / now.scale @ now.tangent)
        turn /= float(np.linalg.norm(made.tangent * made.scale / now.scale))
        if turn < _STRAIGHT and length > _SHORT * longest:
            length *= 0.5
            continue
        points += locate(now, made, length, len(steps) - 1)
        steps.append(made)
        if grown is not None:
            grown()
        length = min(longest, 1.5 * length if count <= _EASY else length)
    return f"It ends with the {most} orbits that max_orbits allows."


def _at_corner(steps: Sequence[object], points: Sequence[SpecialOrbit]) -> bool:
    """Whether the last orbit is already the one behind a corner."""
    return bool(points) and points[-1].index == len(steps) - 2


def _to_end(now: BranchStep | RestStep, low: float, high: float) -> float:
    """Length of a step that ends on the end of the span, as far as the tangent tells, or a little beyond it."""
    rate = now.tangent[-1] * now.scale[-1]
    distance = high - now.shot.value if rate > 0 else now.shot.value - low
    return np.inf if rate == 0 or distance <= 0 else (1.0 + 1e-6) * distance / abs(rate)


def read_span(span: Sequence[float]) -> tuple[float, float]:
    """First and last value.

    **Raises:**

    - `ValueError` for anything but two different numbers.
    """
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
