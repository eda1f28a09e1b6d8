"""Identifiability: what the motion of a record lacks, and combinations of parameters that it does not determine."""

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, PyTree

from ..._core.arrays import on_device
from ..._core.parameters import modules_of
from ...friction import AbstractAsymmetric, AbstractLaw
from ...scene import Friction, Scene, replace_numbers, scene_numbers
from ..model._engines import mass_of
from ..model._observe import RecordedMotion, Slip, slip_of
from ._estimate import FitDiagnostics, IdentifiabilityIssue, ParameterEstimate

# A bristle that stays below this share of its limit is in presliding.
_NEAR_LIMIT = 0.9
# The Stribeck curve falls up to this speed, in units of vs, and shows in at least so many samples there.
_CURVE, _SEEN = 2.0, 5
# Slip back below this share of the largest speed is none.
_NO_REVERSAL = 0.02
# Largest over smallest slip speed from which viscous and Coulomb friction are distinguishable.
_SPEED_SPAN = 1.3
# Share of the friction force from which inertia shows.
_INERTIA = 0.05
# A combination with a larger standard error, relative to its parameters, is undetermined.
_WEAK = 0.3
# Entries of a direction below this share of the largest are left out; changes that differ by less are equal.
_PART, _EQUAL = 0.2, 0.15


class Element(NamedTuple):
    """A friction element with its slip in the records.

    - `name`: of its effect, empty for a law by itself. `law`: its law.
    - `slips`: one a record. `numbers`: all numbers of the model by name. `free`: names of the free ones.
    - `alike`: names of the other free numbers with a large correlation, by name.
    """

    name: str
    law: AbstractLaw
    slips: tuple[Slip, ...]
    numbers: Mapping[str, np.ndarray]
    free: tuple[str, ...]
    alike: Mapping[str, tuple[str, ...]]

    @property
    def prefix(self) -> str:
        """Prefix of its numbers' names."""
        return f"{self.name}." if self.name else ""

    def own(self, *symbols: str) -> tuple[str, ...]:
        """Free parameters of this element with these symbols, of both directions and all entries."""
        sides, names = ("", "forward", "backward"), []
        for name in self.free:
            side, _, symbol = name.removeprefix(self.prefix).rpartition(".")
            if name.startswith(self.prefix) and side in sides and symbol.split("[")[0] in symbols:
                names.append(name)
        return tuple(names)

    def number(self, symbol: str) -> np.ndarray | None:
        """A number of the law; that of forward slip if it depends on the direction."""
        return self.numbers.get(self.prefix + symbol, self.numbers.get(f"{self.prefix}forward.{symbol}"))

    @property
    def speeds(self) -> np.ndarray:
        """Slip speeds of all records."""
        return np.abs(np.concatenate([slip.v for slip in self.slips]))

    def issue(self, sentence: str, about: tuple[str, ...]) -> IdentifiabilityIssue | None:
        """An issue about some parameters, whose names replace `{}`; None if there are none."""
        label = f"{self.name}: " if self.name not in ("", "friction") else ""
        return IdentifiabilityIssue(label + sentence.format(_listed(about)), about) if about else None


def _are(about: tuple[str, ...]) -> str:
    return "are" if len(about) > 1 else "is"


def presliding(element: Element) -> IdentifiabilityIssue | None:
    """The bristle never comes near its limit."""
    sigma0, Fc, Fs, vs = (element.number(symbol) for symbol in ("sigma0", "Fc", "Fs", "vs"))
    if sigma0 is None or Fc is None:
        return None
    Fs, vs = (Fc if Fs is None else Fs), (1.0 if vs is None else vs)
    share = max(_bristle_share(slip, *(float(x) for x in (sigma0, Fc, Fs, vs))) for slip in element.slips)
    if share >= _NEAR_LIMIT:
        return None
    stroke = 0.0
    for x in (slip.x for slip in element.slips):
        turns = np.flatnonzero(np.diff(np.sign(np.diff(x))) != 0) + 1
        stroke = max(stroke, float(np.max(np.abs(np.diff(x[[0, *turns.tolist(), len(x) - 1]])))))
    about = element.own("Fc", "Fs", "vs", "Fba", "vd", "sigma2")
    return element.issue(
        f"This record never leaves presliding: between reversals it slips {stroke:.2g} at most, and the bristle reaches"
        f" {100 * share:.0f} % of its limit ({float(Fs) / float(sigma0):.2g}): {{}}"
        f" {'cannot be told apart' if len(about) > 1 else 'is not seen'}.",
        about,
    )


def _bristle_share(slip: Slip, sigma0: float, Fc: float, Fs: float, vs: float) -> float:
    """Largest deflection of a bristle, relative to that of steady slip."""
    z, largest = 0.0, 0.0
    for dx, v in zip(np.diff(slip.x).tolist(), np.abs(slip.v[1:]).tolist(), strict=True):
        limit = (Fc + (Fs - Fc) * math.exp(-((v / vs) ** 2))) / sigma0
        end = math.copysign(limit, dx)
        z = end + (z - end) * math.exp(-min(abs(dx) / limit, 700.0)) if limit > 0 else 0.0
        largest = max(largest, abs(z) / limit if limit > 0 else math.inf)
    return largest


def idle_elements(element: Element) -> IdentifiabilityIssue | None:
    """Some of several elastic elements never slip."""
    k, Fc = element.number("k"), element.number("Fc")
    if k is None or Fc is None or np.ndim(k) != 1 or np.shape(k) != np.shape(Fc):
        return None
    reached = np.zeros_like(k)
    for slip in element.slips:
        z = np.zeros_like(k)
        for dx in np.diff(slip.x):
            z = np.clip(z + dx, -Fc / k, Fc / k)
            reached = np.maximum(reached, np.abs(z) * k / Fc)
    about = tuple(f for f in element.own("Fc") if reached[int(f.rsplit("[", 1)[1][:-1])] < _NEAR_LIMIT)
    return element.issue("Elements that never slip in this record: {} cannot be seen.", about)


def never_sticks(element: Element) -> IdentifiabilityIssue | None:
    """It slips all the time in one direction, so that the bristle never deflects anew."""
    if element.number("sigma0") is None:
        return None
    for slip in element.slips:
        top = float(np.max(np.abs(slip.v)))
        if np.min(slip.v) <= 0.1 * top and np.max(slip.v) >= -0.1 * top:
            return None
    about = element.own("sigma0", "sigma1", "Fs", "vs", "Fba")
    return element.issue(f"This record never sticks nor reverses: {{}} {_are(about)} not seen.", about)


def stribeck_unseen(element: Element) -> IdentifiabilityIssue | None:
    """Too few samples on the falling part of the Stribeck curve."""
    if (vs := element.number("vs")) is None:
        return None
    speeds, about = element.speeds, element.own("Fs", "vs", "exponent")
    moving = min(1e-3 * float(np.max(speeds)), 0.1 * float(vs))
    count = int(np.sum((speeds < _CURVE * vs) & (speeds > moving)))
    if count >= _SEEN:
        return None
    return element.issue(
        f"Only {count} samples slip more slowly than {_CURVE:g} vs = {_CURVE * float(vs):.2g}, where the Stribeck curve"
        f" falls: {{}} {_are(about)} not seen.",
        about,
    )


def stribeck_not_passed(element: Element) -> IdentifiabilityIssue | None:
    """It never slips faster than the Stribeck curve falls."""
    vs, top = element.number("vs"), float(np.max(element.speeds))
    if vs is None or top >= _CURVE * float(vs):
        return None
    return element.issue(
        f"The speed never exceeds {_CURVE:g} vs (at most {top:.2g} against vs = {float(vs):.2g}), so the Stribeck curve"
        " is not passed: {} cannot be told apart.",
        element.own("Fc", "Fs", "vs", "sigma2", "Fv"),
    )


def one_direction(element: Element) -> IdentifiabilityIssue | None:
    """It never slips back."""
    low = min(float(np.min(slip.v)) for slip in element.slips)
    high = max(float(np.max(slip.v)) for slip in element.slips)
    forwards = low >= -_NO_REVERSAL * high
    if not (forwards or high <= -_NO_REVERSAL * low):
        return None
    text = "This record moves in one direction only:"
    if any(isinstance(module, AbstractAsymmetric) for _, module in modules_of(element.law)):
        unseen = f"{element.prefix}{'backward' if forwards else 'forward'}"
        return element.issue(f"{text} nothing is seen of {{}}.", tuple(f for f in element.free if f.startswith(unseen)))
    level = element.own("Fc")
    about = tuple(dict.fromkeys([*level, *(other for name in level for other in element.alike.get(name, ()))]))
    return element.issue(f"{text} a constant force and {_listed(level)} look the same.", about)


def one_speed(element: Element) -> IdentifiabilityIssue | None:
    """It slips at one speed."""
    speeds, about = element.speeds, element.own("Fc", "Fv", "sigma2")
    moving = speeds[speeds > 0.05 * np.max(speeds)]
    if len(about) < 2 or not moving.size:
        return None
    low, high = np.percentile(moving, [5.0, 95.0])
    if high > _SPEED_SPAN * low:
        return None
    return element.issue(
        f"This record slips at nearly one speed ({low:.2g} to {high:.2g}): {{}} cannot be told apart.", about
    )


RULES: tuple[Callable[[Element], IdentifiabilityIssue | None], ...] = (
    presliding,
    idle_elements,
    never_sticks,
    one_direction,
    stribeck_not_passed,
    stribeck_unseen,
    one_speed,
)


def identifiability_issues(
    model: Scene | AbstractLaw,
    motions: Iterable[RecordedMotion],
    dof: int,
    numbers: Mapping[str, np.ndarray],
    free: tuple[str, ...],
    uncertain: Mapping[str, tuple[str, ...]],
) -> tuple[IdentifiabilityIssue, ...]:
    """Causes in the motion of uncertain free parameters.

    **Arguments:**

    - `model`: the fitted scene, or a law by itself.
    - `motions`: one a record. `dof`: number of coordinates.
    - `numbers`: all numbers of the model by name. `free`: names of the fitted ones.
    - `uncertain`: the uncertain ones, each with the others that have a large correlation with it.
    """
    motions = tuple(motions)
    frictions: list[tuple[str, AbstractLaw, Friction | None, PyTree]] = []
    if isinstance(model, Scene):
        for name, effect in model.friction.items():
            if any(f.startswith(f"{name}.") for f in free):
                frictions.append((name, effect.law, effect, model.params))
    else:
        frictions.append(("", model, None, None))
    issues: list[IdentifiabilityIssue | None] = []
    for name, law, effect, params in frictions:
        slips = tuple(slip for motion in motions if (slip := slip_of(effect, motion, params, dof)) is not None)
        if len(slips) == len(motions):
            element = Element(name, law, slips, numbers, free, uncertain)
            issues += [rule(element) for rule in RULES]
    if dof == 1 and isinstance(model, Scene):
        issues.append(slow(model, motions, numbers, tuple(f for f in free if f in uncertain)))
    kept: list[IdentifiabilityIssue] = []
    for issue in issues:
        if issue is None or not set(uncertain) & set(issue.about):
            continue
        if not any(set(issue.about) <= set(other.about) for other in kept):
            kept.append(issue)
    return tuple(kept)


def slow(
    scene: Scene, motions: tuple[RecordedMotion, ...], numbers: Mapping[str, np.ndarray], doubtful: tuple[str, ...]
) -> IdentifiabilityIssue | None:
    """Inertia forces are small against friction."""
    friction = [
        float(np.sum(x)) for name, x in numbers.items() if name.rsplit(".", 1)[-1] == "Fc" and np.all(np.isfinite(x))
    ]
    if not friction or not all(0 in motion.q for motion in motions):
        return None
    about, largest = [], 0.0
    acceleration = np.concatenate([np.gradient(motion.qd[0], motion.t) for motion in motions])
    for name in doubtful:
        if "." in name or name not in scene_numbers(scene) or np.ndim(numbers[name]):
            continue
        value, start = float(numbers[name]), motions[0]
        point = tuple(on_device(each) for each in (start.t[0], start.q[0][:1], start.qd[0][:1]))
        more, mass = (float(_mass(replace_numbers(scene, {name: on_device(x)}), *point)) for x in (1.01 * value, value))
        change = (more - mass) / 0.01
        force = abs(change) * float(np.sqrt(np.mean(acceleration**2)))
        if change != 0.0 and force < _INERTIA * max(friction):
            about.append(name)
            largest = max(largest, force)
    if not about:
        return None
    return IdentifiabilityIssue(
        f"Inertia hardly shows: accelerations reach {np.max(np.abs(acceleration)):.2g}, and the force of inertia is"
        f" {largest:.2g} against {max(friction):.2g} of friction: {_listed(about)} cannot be seen.",
        tuple(about),
    )


_mass = eqx.filter_jit(mass_of)


def _listed(names: Iterable[str]) -> str:
    return " and ".join(", ".join(names).rsplit(", ", 1))


def sloppy_directions(
    estimate: ParameterEstimate, diagnostics: FitDiagnostics, left_out: Collection[str]
) -> list[IdentifiabilityIssue]:
    """Weak directions of the Fisher information in relative parameters, the weakest first.

    Each is a combined change of parameters, named in the order of their shares, that hardly changes the output. A
    change is relative to the scale of the estimate or the start, whichever is larger.
    """
    errors = estimate.errors
    names = [
        name
        for name, value in estimate.values.items()
        if name not in left_out and np.isfinite(errors[name]) and value not in estimate.bounds[name]
    ]
    if len(names) < 2:
        return []
    keep = [list(estimate.values).index(name) for name in names]
    size = np.array([max(estimate.scale(name), abs(estimate.start[name])) or 1.0 for name in names])
    relative = estimate.information[np.ix_(keep, keep)] * np.outer(size, size)
    values, vectors = np.linalg.eigh(relative)
    factor = _inflation(estimate, diagnostics, keep)
    directions = []
    for value, vector in zip(values, vectors.T, strict=True):
        error = float(np.sqrt(factor / max(value, 1e-14 * values[-1])))
        vector = vector / vector[np.argmax(np.abs(vector))]
        order = [i for i in np.argsort(-np.abs(vector)) if abs(vector[i]) >= _PART]
        if error < _WEAK or len(order) < 2:
            continue
        parts = tuple(names[i] for i in order)
        sentence = _sentence(estimate, parts, vector[order], error, size[order])
        directions.append(IdentifiabilityIssue(sentence, parts))

    def is_arbitrary(direction: IdentifiabilityIssue) -> bool:
        # Every combination of its parameters is weak, so that none is to be named.
        return sum(set(other.about) <= set(direction.about) for other in directions) >= len(direction.about)

    return [direction for direction in directions if not is_arbitrary(direction)]


def _inflation(estimate: ParameterEstimate, diagnostics: FitDiagnostics, keep: list[int]) -> float:
    """Factor of a variance by the Fisher information for correlation in time and the true size of the residual.

    From the well-known parameters, since the covariance of the others is only a large number.
    """
    level = float(np.mean([(diagnostics.rmse[name] / noise) ** 2 for name, noise in diagnostics.noise.items()]))
    sizes = np.array([estimate.scale(name) for name in estimate.values])[keep]
    variance, white = np.diag(estimate.covariance)[keep], np.diag(estimate.white)[keep]
    known = (variance < (_WEAK * sizes) ** 2) & (white > 0)
    return level * float(np.median(variance[known] / white[known])) if known.any() else level


def _sentence(
    estimate: ParameterEstimate,
    names: tuple[str, ...],
    vector: Float[np.ndarray, " parts"],
    error: float,
    size: Float[np.ndarray, " parts"],
) -> str:
    how = f"known to {100 * error:.0f} % only" if error < 10 else "not known at all"
    if len(names) == 2:
        first = list(estimate.values).index
        (a, x, u), (b, y, v) = sorted(zip(names, vector, vector * size, strict=True), key=lambda part: first(part[0]))
        alike = estimate.units[a] == estimate.units[b]
        positive = min(estimate.values[a], estimate.values[b]) > 0
        if alike and abs(abs(u / v) - 1) < _EQUAL:
            what = f"the sum {a} + {b}" if u * v < 0 else f"the difference {a} - {b}"
            return f"The record determines only {what}; how it is shared between them is {how}."
        if positive and abs(abs(x / y) - 1) < _EQUAL:
            what, other = ("product {} {}", "ratio") if x * y < 0 else ("ratio {}/{}", "common size")
            return f"The record determines only the {what.format(a, b)}; their {other} is {how}."
    changes = ", ".join(f"{name} by {0.1 * c * s:+.2g}" for name, c, s in zip(names, vector, size, strict=True))
    return (
        f"The record determines only combinations of {', '.join(names)}: a change of {changes} together hardly shows"
        f" (this direction is {how})."
    )
