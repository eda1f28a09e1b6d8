"""Special orbits between two neighbours on a branch."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any, TypeVar

import numpy as np
from scipy.optimize import brentq

from ._branch import CROSSING, DOUBLING, FOLD, GRAZING, LOSS, ONSET, ORDER, TORUS, OrbitT, SpecialOrbit
from ._describe import describe, floquet
from ._newton import scaled, split
from ._orbit import PeriodicOrbit, Sequence
from ._rest_step import RestStep
from ._return_map import OrbitError, OrbitProblem, ShotOrbit, evaluate
from ._step import BranchStep, Test

# Part of a step to which special orbits are located: where a function is zero, and where the modes change.
_ROOT, _CUT = 1e-10, 1e-6
# Part of its ends above which a function that changes its sign has jumped.
_JUMP = 1e-3
# Step away from a corner of the branch, in the scales of the unknowns.
_BEHIND = 1e-3
# Distance of complex multipliers from the unit circle, and of their angle from the real axis, that is none.
_CIRCLE = 1e-4

_Step = TypeVar("_Step", BranchStep, RestStep)


def locate(one: BranchStep, two: BranchStep, length: float, index: int) -> list[SpecialOrbit]:
    """Special orbits on the step of this length from the one to the other, in order along it."""
    located: list[tuple[float, SpecialOrbit]] = []
    for kind in (FOLD, DOUBLING, TORUS, CROSSING):

        def test(shot: ShotOrbit, kind: str = kind) -> float:
            return _turning(one, shot) if kind == FOLD else TESTS[kind](one.problem, shot, one.scale, len(one.orbit.q))

        ends = test(one.shot), float(two.tangent[-1]) if kind == FOLD else test(two.shot)
        at = root_on_step(one, test, length, ends)
        if at is not None and (kind != TORUS or _is_torus(one, at)):
            located.append((at, _special(one, at, kind, index)))
    before, after = (_cycle(x.orbit.sequence) for x in (one, two))
    if before != after:
        at = _cut(one, before, after, length)
        located.append((at, _special(one, at, _change(before, after), index)))
    return in_order(located)


def in_order(located: list[tuple[float, SpecialOrbit[OrbitT]]]) -> list[SpecialOrbit[OrbitT]]:
    """Special orbits by where they are on a step; a fold, whose multiplier is 1 as well, is no branch point."""
    folds = any(each.kind == FOLD for _, each in located)
    kept = [pair for pair in located if not (folds and pair[1].kind == CROSSING)]
    return [each for _, each in sorted(kept, key=lambda pair: pair[0])]


def corner(now: BranchStep, index: int) -> tuple[BranchStep, SpecialOrbit[PeriodicOrbit]] | None:
    """The next orbit where a branch has a corner, as the sequence of modes changes, and the special orbit there.

    The branch may turn back there, to the values of the parameter it came from, or go on. Its tangent behind the corner
    is that of a run beside the orbit that has the other modes already.
    """
    before, at = _cycle(now.orbit.sequence), now.shot.unknowns
    sides = [now.tangent * now.scale, *np.diag(now.scale)[: now.shot.x.size]]
    for side, sign in product(sides, (1.0, -1.0)):
        unknowns = split(at + sign * _BEHIND * side, now.shot, now.problem.autonomous)
        shot = evaluate(now.problem, *unknowns, len(now.orbit.q))
        if shot.failure:
            continue
        tangent = np.linalg.svd(scaled(shot, now.scale))[2][-1]
        for sense in (1.0, -1.0):
            try:
                made = replace(now, tangent=sense * tangent)
                made = made.described(made.corrected(_BEHIND)[0])
            except OrbitError:
                continue
            after = _cycle(made.orbit.sequence)
            if after != before:
                kind = _change(before, after)
                return made, SpecialOrbit(kind, now.shot.value, index, now.orbit, np.zeros(now.shot.x.size))
    return None


def _multipliers(problem: OrbitProblem, shot: ShotOrbit, scale: np.ndarray, dof: int) -> np.ndarray:
    """All but those that are exactly 1."""
    return floquet(problem, shot, 0, scale[: shot.x.shape[1]], dof)


def _turning(one: BranchStep, shot: ShotOrbit) -> float:
    """How the parameter changes along the branch."""
    tangent = np.linalg.svd(scaled(shot, one.scale))[2][-1]
    return float(tangent[-1] * np.sign(tangent @ one.tangent))


def _doubling(problem: OrbitProblem, shot: ShotOrbit, scale: np.ndarray, dof: int) -> float:
    return float(np.prod(_multipliers(problem, shot, scale, dof) + 1.0).real)


def _crossing(problem: OrbitProblem, shot: ShotOrbit, scale: np.ndarray, dof: int) -> float:
    return float(np.prod(_multipliers(problem, shot, scale, dof) - 1.0).real)


def _torus(problem: OrbitProblem, shot: ShotOrbit, scale: np.ndarray, dof: int) -> float:
    values = _multipliers(problem, shot, scale, dof)
    i, j = np.triu_indices(len(values), 1)
    return float(np.prod(values[i] * values[j] - 1.0).real) if len(i) else 1.0


# What is zero at special orbits.
TESTS: dict[str, Test] = {FOLD: _crossing, CROSSING: _crossing, DOUBLING: _doubling, TORUS: _torus}


def _is_torus(one: BranchStep, at: float) -> bool:
    """Whether it is a pair of complex multipliers whose product is 1, not two real ones."""
    values = _multipliers(one.problem, one.corrected(at)[0], one.scale, len(one.orbit.q))
    return bool(np.any((np.abs(np.abs(values) - 1.0) < _CIRCLE) & (np.abs(np.imag(values)) > _CIRCLE)))


def root_on_step(one: _Step, test: Callable[[Any], float], length: float, ends: tuple[float, float]) -> float | None:
    """Where on the step a function is zero; None where it is not, jumps, or the orbits there are not found."""
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


def _cut(one: BranchStep, before: Sequence, after: Sequence, length: float) -> float:
    """Where on the step the sequence of modes is another one."""
    low, high, dof = 0.0, length, len(one.orbit.q)
    # Beside a grazing the derivative of the run is unbounded where it strikes: Newton's iteration may fail there.
    singular_before, failed = len(before) > len(after), False
    while high - low > _CUT * length:
        middle = 0.5 * (low + high)
        try:
            same = _cycle(describe(one.problem, one.corrected(middle)[0], dof)[0].sequence) == before
        except OrbitError:
            same, failed = singular_before, True
        low, high = (middle, high) if same else (low, middle)
    return low if failed and not singular_before else high


def _cycle(sequence: Sequence) -> Sequence:
    """A sequence of modes from a change on that does not depend on where the orbit begins."""
    return min((sequence[i:] + sequence[:i] for i in range(len(sequence))), default=sequence)


def _change(before: Sequence, after: Sequence) -> str:
    if sorted(before) == sorted(after):
        return ORDER
    sticks = [sum(mode == "stick" for _, _, mode in each) for each in (before, after)]
    return GRAZING if sticks[0] == sticks[1] else ONSET if sticks[0] < sticks[1] else LOSS


def _special(one: BranchStep, at: float, kind: str, index: int) -> SpecialOrbit:
    shot = one.corrected(at)[0]
    scale = one.scale[: shot.x.shape[1]]
    values, vectors = np.linalg.eig(shot.monodromy * scale[None, :] / scale[:, None])
    direction = scale * np.real(vectors[:, int(np.argmin(np.abs(values + 1.0)))])
    orbit = describe(one.problem, shot, len(one.orbit.q))[0]
    return SpecialOrbit(kind, shot.value, index, orbit, direction if kind == DOUBLING else np.zeros_like(direction))
