"""Branches of orbits and of equilibria: their class, and the continuation that both share."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Generic, TypeVar

import equinox as eqx
import numpy as np
from scipy.optimize import brentq

from .._core.arguments import as_float, did_you_mean
from .._core.readable import AbstractReadable, Table, table_of
from ..scene import Scene, elements
from ._equilibrium import Equilibrium
from ._newton import Condition
from ._orbit import PeriodicOrbit
from ._rest import RestPoint
from ._return_map import OrbitError, ShotOrbit

FOLD, DOUBLING, TORUS, CROSSING, HOPF = "fold", "period doubling", "Neimark-Sacker", "branch point", "Hopf"
ONSET, LOSS, GRAZING, ORDER = "onset of stick", "loss of stick", "grazing", "order of modes"

# Lengths of steps along a branch are in the scales of the unknowns.
# First and shortest step, relative to the longest.
_FIRST, _SHORTEST = 0.1, 1e-5
# A step is halved if the cosine between its tangents is smaller, unless it is short relative to the longest.
_STRAIGHT, _SHORT = 0.9, 1e-2
# Largest distance of two neighbours, relative to the step along the tangent.
_FAR = 3.0
# The branch ends in an equilibrium at this fraction of its largest amplitude.
_VANISHED = 1e-3
# The next step is longer after at most this number of Newton iterations.
_EASY = 3
# Tolerance of the location of a bifurcation, relative to the step.
_ROOT = 1e-10
# A test function jumps, and has no root, if its value at the sign change exceeds this fraction of its ends.
_JUMP = 1e-3

OrbitT = TypeVar("OrbitT", PeriodicOrbit, Equilibrium)
# A solution of the equations of an orbit, or of those of an equilibrium.
SolutionT = TypeVar("SolutionT", ShotOrbit, RestPoint)
StepT = TypeVar("StepT", bound="AbstractStep")


class BifurcationPoint(eqx.Module, Generic[OrbitT]):
    """An orbit at which a branch turns, or at which stability or the sequence of modes changes.

    - `kind`: of orbits `"fold"`, `"period doubling"`, `"Neimark-Sacker"`, or `"branch point"` (a multiplier of 1
      without a fold). At a change of the sequence of modes `"onset of stick"`, `"loss of stick"`, `"grazing"` (one
      impact or reversal more or less), or `"order of modes"` (the same changes in another order). Of equilibria
      `"fold"`, `"branch point"`, or `"Hopf"`, at which a branch of periodic orbits begins.
    - `value`: of the parameter.
    - `index`: the point lies between the orbits `index` and `index + 1` of the branch.
    - `orbit`: the orbit.
    - `direction`: at a period doubling the direction of the state towards the orbits of twice the period, shape `[n]`;
      of equilibria empty, shape `[0]`.
    """

    kind: str = eqx.field(static=True)
    value: float
    index: int = eqx.field(static=True)
    orbit: OrbitT
    direction: np.ndarray


class Branch(AbstractReadable, eqx.Module, Generic[OrbitT]):
    """A branch of periodic orbits, or of equilibria, over a number of the scene.

    - `parameter`: name of the number.
    - `values`: of the parameter, shape `[orbits]`.
    - `orbits`: a `PeriodicOrbit` or an `Equilibrium` each, in order along the branch.
    - `points`: `BifurcationPoint`s in order along the branch.
    - `ending`: a sentence that says why the branch ends.

    **Example:**

    ```python
    belt = jms.problems.belt_oscillator
    scene = belt.scene(belt.stribeck(), c=2.0)
    branch = jms.continue_equilibria(scene, [0.06], "friction.belt_velocity", (0.05, 0.5), step=0.1)
    print([f"{point.kind} at {point.value:.4f} m/s" for point in branch.points])
    ```

    ```text
    ['Hopf at 0.3544 m/s']
    ```
    """

    parameter: str = eqx.field(static=True)
    values: np.ndarray
    orbits: tuple[OrbitT, ...]
    points: tuple[BifurcationPoint[OrbitT], ...]
    ending: str = eqx.field(static=True)

    @property
    def amplitude(self) -> np.ndarray:
        """Half the distance between the turning points of each coordinate, shape `[orbits, dof]`."""
        return np.array([each.amplitude for each in self.orbits])

    @property
    def period(self) -> np.ndarray:
        """Periods [s], shape `[orbits]`; of equilibria that of small oscillations, infinite without oscillations."""
        return np.array([float(each.period) for each in self.orbits])

    @property
    def multipliers(self) -> np.ndarray:
        """Floquet multipliers of periodic orbits, complex, shape `[orbits, n]`."""
        return np.array([each.multipliers for each in self.orbits if isinstance(each, PeriodicOrbit)])

    @property
    def eigenvalues(self) -> np.ndarray:
        """Eigenvalues of equilibria [1/s], complex, shape `[orbits, k]`."""
        return np.array([each.eigenvalues for each in self.orbits if isinstance(each, Equilibrium)])

    @property
    def stable(self) -> np.ndarray:
        """Whether each orbit is stable, shape `[orbits]`."""
        return np.array([each.stable for each in self.orbits])


@table_of.register
def _(branch: Branch) -> Table:
    """Bifurcation points, and the end of the branch."""
    at_rest = isinstance(branch.orbits[0], Equilibrium)
    rows = [
        (
            each.kind,
            f"{each.value:.8g}",
            ", ".join(f"{float(x):.6g}" for x in (each.orbit.q if at_rest else each.orbit.amplitude)),
            f"{float(each.orbit.period):.6g}",
        )
        for each in branch.points
    ]
    span = f"{branch.values.min():.6g} to {branch.values.max():.6g}"
    kind = "equilibria" if at_rest else "orbits"
    title = (
        f"Branch of {len(branch.orbits)} {kind}, {branch.parameter} {span}, {int(branch.stable.sum())} of them stable"
    )
    head = ("", branch.parameter, "at" if at_rest else "amplitude", "period [s]")
    return Table(title, head, rows, (branch.ending,))


class AbstractStep(abc.ABC, Generic[SolutionT, OrbitT]):
    """An orbit or equilibrium of a branch, and the tangent along which the branch goes on.

    - `shot`: the solution of its equations.
    - `orbit`: the orbit.
    - `scale`: magnitudes of the unknowns. `tangent`: unit vector in these scales.
    """

    shot: SolutionT
    orbit: OrbitT
    scale: np.ndarray
    tangent: np.ndarray

    def along(self, length: float) -> tuple[np.ndarray, Condition]:
        """The unknowns at this distance along the tangent, and the condition that a solution is there."""
        unknowns = self.shot.unknowns

        def distance(shot: SolutionT) -> float:
            return float(self.tangent @ ((shot.unknowns - unknowns) / self.scale)) - length

        return unknowns + length * self.tangent * self.scale, Condition(distance, lambda _: self.tangent)

    @abc.abstractmethod
    def corrected(self, length: float) -> tuple[SolutionT, int]:
        """The solution at this distance along the tangent, and the number of iterations."""

    @abc.abstractmethod
    def moved_to(self: StepT, shot: SolutionT) -> StepT:
        """The step that begins at a solution, with the tangent in the same sense."""

    @abc.abstractmethod
    def tests(self) -> Mapping[str, Callable[[SolutionT], float]]:
        """Functions that change their sign at bifurcations, by kind; without that of folds."""

    @abc.abstractmethod
    def bifurcation(self, kind: str, length: float, index: int) -> BifurcationPoint[OrbitT] | None:
        """The bifurcation at a root of a test function, at this distance along the tangent; None if there is none."""

    def mode_change(
        self, other: AbstractStep[SolutionT, OrbitT], length: float, index: int
    ) -> tuple[float, BifurcationPoint[OrbitT]] | None:
        """The change of the sequence of modes before the next orbit, and its distance; None without one."""
        del other, length, index
        return None

    def corner(self: StepT, index: int) -> tuple[StepT, BifurcationPoint[OrbitT]] | None:
        """The next orbit behind a corner of the branch, and the bifurcation at the corner; None without a corner."""
        del index
        return None


def tangent_at(shot: ShotOrbit | RestPoint, scale: np.ndarray, sense: np.ndarray, *rows: np.ndarray) -> np.ndarray:
    """Unit tangent of the solutions in their scales, in the sense of a scaled vector; `rows` are further equations."""
    tangent = np.linalg.svd(np.vstack([shot.scaled(scale)[0], *rows]))[2][-1]
    return tangent if tangent @ sense >= 0 else -tangent


def follow(
    steps: list[StepT],
    points: list[BifurcationPoint] | None,
    span: Sequence[float],
    longest: float,
    most: int,
    grown: Callable[[int, float], None] | None = None,
) -> str:
    """Add orbits and bifurcation points until the branch leaves the span; returns why it ends.

    Without `points` no bifurcations are located, and corners end the branch. `grown` is called after each orbit.
    """
    length, (low, high) = _FIRST * longest, sorted(span)
    largest = np.max([np.asarray(each.orbit.amplitude) for each in steps], axis=0)
    while len(steps) < most:
        now = steps[-1]
        amplitude = np.asarray(now.orbit.amplitude)
        largest = np.maximum(largest, amplitude)
        if np.any(amplitude < _VANISHED * largest) and np.all(amplitude <= _VANISHED * largest):
            return f"It ends at {now.shot.value:.8g}, where the orbits vanish in an equilibrium: a Hopf point."
        if len(steps) > 1 and not low < now.shot.value < high:
            return "It ends at the end of the span."
        length = min(length, _length_to_end(now, low, high))
        try:
            shot, count = now.corrected(length)
            if np.linalg.norm((shot.unknowns - now.shot.unknowns) / now.scale) > _FAR * length:
                raise OrbitError("The next orbit is on another branch.")
            after = now.moved_to(shot)
        except OrbitError as error:
            length *= 0.5
            if length >= _SHORTEST * longest:
                continue
            behind_corner = points and points[-1].index == len(steps) - 2
            turned = None if points is None or behind_corner else now.corner(len(steps) - 1)
            if points is None or turned is None:
                return f"It ends at {now.shot.value:.8g}, where the continuation fails: {error}"
            steps.append(turned[0])
            points.append(turned[1])
            length = _FIRST * longest
            continue
        turn = float(after.tangent * after.scale / now.scale @ now.tangent)
        turn /= float(np.linalg.norm(after.tangent * after.scale / now.scale))
        if turn < _STRAIGHT and length > _SHORT * longest:
            length *= 0.5
            continue
        if points is not None:
            points += _bifurcations(now, after, length, len(steps) - 1)
        steps.append(after)
        if grown is not None:
            grown(len(steps), after.shot.value)
        length = min(longest, 1.5 * length if count <= _EASY else length)
    return f"It ends at the limit of {most} orbits."


def _length_to_end(now: AbstractStep, low: float, high: float) -> float:
    """Length of a step that ends just beyond the end of the span, by the tangent."""
    rate = now.tangent[-1] * now.scale[-1]
    distance = high - now.shot.value if rate > 0 else now.shot.value - low
    return np.inf if rate == 0 or distance <= 0 else (1.0 + 1e-6) * distance / abs(rate)


def _bifurcations(one: StepT, two: StepT, length: float, index: int) -> list[BifurcationPoint]:
    """Bifurcations on a step of this length between two orbits, in order along it."""

    def turning(shot: ShotOrbit | RestPoint) -> float:
        return float(tangent_at(shot, one.scale, one.tangent)[-1])

    located: list[tuple[float, BifurcationPoint]] = []
    for kind, test in {FOLD: turning, **one.tests()}.items():
        end = float(two.tangent[-1]) if kind == FOLD else test(two.shot)
        at = _root(one, test, length, (test(one.shot), end))
        point = None if at is None else one.bifurcation(kind, at, index)
        if at is not None and point is not None:
            located.append((at, point))
    change = one.mode_change(two, length, index)
    if change is not None:
        located.append(change)
    if any(point.kind == FOLD for _, point in located):  # a fold has a multiplier of 1 too, but is no branch point
        located = [pair for pair in located if pair[1].kind != CROSSING]
    return [point for _, point in sorted(located, key=lambda pair: pair[0])]


def _root(one: AbstractStep, test: Callable[..., float], length: float, ends: tuple[float, float]) -> float | None:
    """Distance at which a test function is zero; None without a root, or if orbits near it are not found."""
    if not ends[0] * ends[1] < 0:
        return None
    known = {0.0: ends[0], length: ends[1]}

    def value(at: float) -> float:
        return known[at] if at in known else test(one.corrected(at)[0])

    try:
        at: float = brentq(value, 0.0, length, xtol=_ROOT * length)  # pyright: ignore[reportAssignmentType] - a number
        return at if abs(value(at)) < _JUMP * max(map(abs, ends)) else None
    except OrbitError:
        return None


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
    """Check that a name is that of a number of the scene.

    **Raises:**

    - `ValueError` with all names.
    """
    known = elements(scene)
    if parameter not in known:
        raise ValueError(
            f"parameter must be the name of a number of the scene, but {parameter!r} was given; there are:"
            f" {', '.join(known)}.{did_you_mean(parameter, known)}"
        )
