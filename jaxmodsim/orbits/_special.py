"""Special orbits between two neighbours on a branch."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from ._branch import CROSSING, DOUBLING, FOLD, GRAZING, LOSS, ONSET, TORUS, SpecialOrbit
from ._describe import describe, floquet, mode_sequence
from ._newton import scaled
from ._orbit import Sequence
from ._return_map import OrbitError, ShotOrbit
from ._step import BranchStep

# Part of a step to which special orbits are located: where a function is zero, and where the modes change.
_ROOT, _CUT = 1e-10, 1e-6
# Part of its ends above which a function that changes its sign has jumped.
_JUMP = 1e-3
# Distance of complex multipliers from the unit circle, and of their angle from the real axis, that is none.
_CIRCLE = 1e-4

_Test = Callable[[BranchStep, ShotOrbit], float]


def locate(one: BranchStep, two: BranchStep, length: float, index: int) -> list[SpecialOrbit]:
    """Special orbits on the step of this length from the one to the other, in order along it."""
    tests: dict[str, _Test] = {FOLD: _turning, DOUBLING: _doubling, TORUS: _torus, CROSSING: _crossing}
    located: list[tuple[float, SpecialOrbit]] = []
    for kind, test in tests.items():
        ends = test(one, one.shot), float(two.tangent[-1]) if kind == FOLD else test(one, two.shot)
        at = _root(one, test, length, ends) if ends[0] * ends[1] < 0 else None
        if at is not None and (kind != TORUS or _is_torus(one, at)):
            located.append((at, _special(one, at, kind, index)))
    if any(each.kind == FOLD for _, each in located):
        located = [each for each in located if each[1].kind != CROSSING]
    before, after = (_cycle(x.orbit.sequence) for x in (one, two))
    if before != after:
        at = _cut(one, before, after, length)
        located.append((at, _special(one, at, _change(before, after), index)))
    return [each for _, each in sorted(located, key=lambda pair: pair[0])]


def _multipliers(one: BranchStep, shot: ShotOrbit) -> np.ndarray:
    values = floquet(one.problem, shot, 0, one.scale[: len(shot.x)])
    return values[1:] if one.problem.autonomous else values


def _turning(one: BranchStep, shot: ShotOrbit) -> float:
    """How the parameter changes along the branch."""
    tangent = np.linalg.svd(scaled(shot, one.scale))[2][-1]
    return float(tangent[-1] * np.sign(tangent @ one.tangent))


def _doubling(one: BranchStep, shot: ShotOrbit) -> float:
    return float(np.prod(_multipliers(one, shot) + 1.0).real)


def _crossing(one: BranchStep, shot: ShotOrbit) -> float:
    return float(np.prod(_multipliers(one, shot) - 1.0).real)


def _torus(one: BranchStep, shot: ShotOrbit) -> float:
    values = _multipliers(one, shot)
    i, j = np.triu_indices(len(values), 1)
    return float(np.prod(values[i] * values[j] - 1.0).real) if len(i) else 1.0


def _is_torus(one: BranchStep, at: float) -> bool:
    """Whether it is a pair of complex multipliers whose product is 1, not two real ones."""
    values = _multipliers(one, one.corrected(at)[0])
    return bool(np.any((np.abs(np.abs(values) - 1.0) < _CIRCLE) & (np.abs(np.imag(values)) > _CIRCLE)))


def _root(one: BranchStep, test: _Test, length: float, ends: tuple[float, float]) -> float | None:
    """Where on the step a function is zero; None where it jumps, or the orbits there are not found."""
    known = {0.0: ends[0], length: ends[1]}

    def value(at: float) -> float:
        return known[at] if at in known else test(one, one.corrected(at)[0])

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
            same = _cycle(mode_sequence(one.problem, one.corrected(middle)[0], dof)) == before
        except OrbitError:
            same, failed = singular_before, True
        low, high = (middle, high) if same else (low, middle)
    return low if failed and not singular_before else high


def _cycle(sequence: Sequence) -> Sequence:
    """A sequence of modes from a change on that does not depend on where the orbit begins."""
    return min((sequence[i:] + sequence[:i] for i in range(len(sequence))), default=sequence)


def _change(before: Sequence, after: Sequence) -> str:
    sticks = [sum(mode == "stick" for _, _, mode in each) for each in (before, after)]
    return GRAZING if sticks[0] == sticks[1] else ONSET if sticks[0] < sticks[1] else LOSS


def _special(one: BranchStep, at: float, kind: str, index: int) -> SpecialOrbit:
    shot = one.corrected(at)[0]
    scale = one.scale[: len(shot.x)]
    values, vectors = np.linalg.eig(shot.monodromy * scale[None, :] / scale[:, None])
    direction = scale * np.real(vectors[:, int(np.argmin(np.abs(values + 1.0)))])
    orbit = describe(one.problem, shot, len(one.orbit.q))[0]
    return SpecialOrbit(kind, shot.value, index, orbit, direction if kind == DOUBLING else np.zeros_like(direction))
