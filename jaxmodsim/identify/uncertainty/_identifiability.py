"""What a record cannot tell: causes in the motion, and combinations of parameters that are not determined."""

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ..._core.arrays import on_device
from ..._core.parameters import modules_of
from ...friction import AbstractAsymmetric, AbstractLaw, Dahl, ElastoPlastic, LuGre, MaxwellSlip
from ...scene import Friction, Scene, replace_numbers, scene_numbers
from ..model._observe import RecordedMotion, Slip, slip_of
from ._estimate import FitDiagnostics, IdentifiabilityIssue, ParameterEstimate

# A bristle below this share of its limit is in presliding.
_NEAR_LIMIT = 0.9
# Speeds in units of vs up to which the Stribeck curve falls, and samples there that make it seen.
_CURVE, _SEEN = 2.0, 5
# Slip back of less than this share of the largest speed is none.
_NO_REVERSAL = 0.02
# Largest over smallest speed in slip from which on viscous and Coulomb friction tell themselves apart.
_SPEED_SPAN = 1.3
# Share of the friction force that inertia must have to be seen.
_INERTIA = 0.05
# A combination known worse than this, relative to its parameters, is called undetermined.
_WEAK = 0.3
# Entries of a direction below this share of the largest do not belong to it; those nearer than this are equal.
_PART, _EQUAL = 0.2, 0.15


class Element(NamedTuple):
    """A friction element as its records moved it.

    - `name`: of its effect, empty for a law by itself. `law`: its law.
    - `slips`: one a record. `numbers`: all numbers of the model by name. `free`: names of the free ones.
    - `alike`: names of the other free ones that the figures hardly tell apart from each.
    """

    name: str
    law: AbstractLaw
    slips: tuple[Slip, ...]
    numbers: Mapping[str, np.ndarray]
    free: tuple[str, ...]
    alike: Mapping[str, tuple[str, ...]]

    def own(self, *symbols: str) -> tuple[str, ...]:
        """Free parameters of this element with these symbols, of both directions and all entries."""
        prefix = f"{self.name}." if self.name else ""
        return tuple(
            name
            for name in self.free
            if name.startswith(prefix) and name.rsplit(".", 1)[-1].split("[")[0] in symbols and _under(name, prefix)
        )

    def number(self, symbol: str) -> np.ndarray | None:
        """A number of the law; that of forward slip where it depends on the direction."""
        prefix = f"{self.name}." if self.name else ""
        for name in (prefix + symbol, f"{prefix}forward.{symbol}"):
            if name in self.numbers:
                return self.numbers[name]
        return None

    def has(self, *kinds: type) -> bool:
        """Whether a law of these kinds is in it."""
        return any(isinstance(module, kinds) for _, module in modules_of(self.law))

    @property
    def speeds(self) -> np.ndarray:
        """Slip speeds of all records."""
        return np.abs(np.concatenate([slip.v for slip in self.slips]))

    @property
    def label(self) -> str:
        """For sentences about one element of several."""
        return f"{self.name}: " if self.name not in ("", "friction") else ""


def _under(name: str, prefix: str) -> bool:
    """Whether the rest of a name is a symbol, or one of a direction."""
    return name.removeprefix(prefix).rpartition(".")[0] in ("", "forward", "backward")


def presliding(element: Element) -> IdentifiabilityIssue | None:
    """The bristle never comes near its limit."""
    if element.has(MaxwellSlip):
        return _idle_elements(element)
    sigma0, Fc = element.number("sigma0"), element.number("Fc")
    if not element.has(LuGre, Dahl, ElastoPlastic) or sigma0 is None or Fc is None:
        return None
    Fs, vs = element.number("Fs"), element.number("vs")
    level = (float(Fc), float(Fc if Fs is None else Fs), float(1.0 if vs is None else vs))
    share = max(_bristle_share(slip, float(sigma0), *level) for slip in element.slips)
    about = element.own("Fc", "Fs", "vs", "Fba", "vd", "sigma2")
    if share >= _NEAR_LIMIT or not about:
        return None
    rest = "cannot be told apart" if len(about) > 1 else "is not seen"
    stroke = max(_largest_stroke(slip.x) for slip in element.slips)
    return IdentifiabilityIssue(
        f"{element.label}This record never leaves presliding: between reversals it slips {stroke:.2g} at most, and the"
        f" bristle reaches {100 * share:.0f} % of its limit ({level[1] / float(sigma0):.2g}):"
        f" {_listed(about)} {rest}.",
        about,
    )


def _bristle_share(slip: Slip, sigma0: float, Fc: float, Fs: float, vs: float) -> float:
    """Largest deflection of a LuGre bristle in units of that of steady slip."""
    x = slip.x.tolist()
    z, largest = 0.0, 0.0
    for dx, v in zip(np.diff(x).tolist(), np.abs(slip.v[1:]).tolist(), strict=True):
        limit = (Fc + (Fs - Fc) * math.exp(-((v / vs) ** 2))) / sigma0
        end = math.copysign(limit, dx)
        z = end + (z - end) * math.exp(-min(abs(dx) / limit, 700.0)) if limit > 0 else 0.0
        largest = max(largest, abs(z) / limit if limit > 0 else math.inf)
    return largest


def _largest_stroke(x: np.ndarray) -> float:
    """Largest way between two reversals."""
    turns = np.flatnonzero(np.diff(np.sign(np.diff(x))) != 0) + 1
    return float(np.max(np.abs(np.diff(x[[0, *turns.tolist(), len(x) - 1]]))))


def _idle_elements(element: Element) -> IdentifiabilityIssue | None:
    k, Fc = element.number("k"), element.number("Fc")
    if k is None or Fc is None:
        return None
    reached = np.zeros_like(k)
    for slip in element.slips:
        z = np.zeros_like(k)
        for dx in np.diff(slip.x):
            z = np.clip(z + dx, -Fc / k, Fc / k)
            reached = np.maximum(reached, np.abs(z) * k / Fc)
    about = tuple(f for f in element.own("Fc") if reached[int(f.rsplit("[", 1)[1][:-1])] < _NEAR_LIMIT)
    if not about:
        return None
    return IdentifiabilityIssue(
        f"{element.label}Elements that never slip in this record: {_listed(about)} cannot be seen.", about
    )


def never_sticks(element: Element) -> IdentifiabilityIssue | None:
    """It slips all the time in one direction, so that the bristle never deflects anew."""
    about = element.own("sigma0", "sigma1", "Fs", "vs", "Fba") if element.number("sigma0") is not None else ()
    if not about:
        return None
    for slip in element.slips:
        top = float(np.max(np.abs(slip.v)))
        if np.min(slip.v) <= 0.1 * top and np.max(slip.v) >= -0.1 * top:
            return None
    return IdentifiabilityIssue(
        f"{element.label}This record never sticks nor reverses: {_listed(about)}"
        f" {'are' if len(about) > 1 else 'is'} not seen.",
        about,
    )


def stribeck_unseen(element: Element) -> IdentifiabilityIssue | None:
    """Too few samples on the falling part of the Stribeck curve."""
    vs = element.number("vs")
    about = element.own("Fs", "vs", "exponent")
    if vs is None or not about:
        return None
    speeds, moving = element.speeds, 1e-3 * float(np.max(element.speeds))
    count = int(np.sum((speeds < _CURVE * vs) & (speeds > min(moving, 0.1 * float(vs)))))
    if count >= _SEEN:
        return None
    return IdentifiabilityIssue(
        f"{element.label}Only {count} samples slip more slowly than {_CURVE:g} vs = {_CURVE * float(vs):.2g}, where the"
        f" Stribeck curve falls: {_listed(about)} {'are' if len(about) > 1 else 'is'} not seen.",
        about,
    )


def stribeck_not_passed(element: Element) -> IdentifiabilityIssue | None:
    """It never slips faster than the Stribeck curve falls."""
    vs = element.number("vs")
    about = element.own("Fc", "Fs", "vs", "sigma2", "Fv")
    if vs is None or not about:
        return None
    top = float(np.max(element.speeds))
    if top >= _CURVE * float(vs):
        return None
    return IdentifiabilityIssue(
        f"{element.label}The speed never exceeds {_CURVE:g} vs (at most {top:.2g} against vs = {float(vs):.2g}), so the"
        f" Stribeck curve is not passed: {_listed(about)} cannot be told apart.",
        about,
    )


def one_direction(element: Element) -> IdentifiabilityIssue | None:
    """It never slips back."""
    low = min(float(np.min(slip.v)) for slip in element.slips)
    high = max(float(np.max(slip.v)) for slip in element.slips)
    forwards = low >= -_NO_REVERSAL * high
    if not (forwards or high <= -_NO_REVERSAL * low):
        return None
    if element.has(AbstractAsymmetric):
        unseen = "backward" if forwards else "forward"
        level = about = tuple(
            f for f in element.free if f.startswith(f"{element.name}.{unseen}." if element.name else unseen)
        )
        text = "nothing is seen of {}"
    else:
        level = element.own("Fc")
        about = tuple(dict.fromkeys([*level, *(other for name in level for other in element.alike.get(name, ()))]))
        text = "a constant force and {} look the same"
    if not about:
        return None
    text = text.format(_listed(level))
    return IdentifiabilityIssue(f"{element.label}This record moves in one direction only: {text}.", about)


def one_speed(element: Element) -> IdentifiabilityIssue | None:
    """It slips at one speed."""
    speeds = element.speeds
    moving = speeds[speeds > 0.05 * np.max(speeds)]
    about = element.own("Fc", "Fv", "sigma2")
    if len(about) < 2 or not moving.size:
        return None
    low, high = np.percentile(moving, [5.0, 95.0])
    if high > _SPEED_SPAN * low:
        return None
    return IdentifiabilityIssue(
        f"{element.label}This record slips at nearly one speed ({low:.2g} to {high:.2g}): {_listed(about)} cannot be"
        " told apart.",
        about,
    )


RULES: tuple[Callable[[Element], IdentifiabilityIssue | None], ...] = (
    presliding,
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
    """Causes for what is uncertain among the free parameters.

    **Arguments:**

    - `model`: the fitted scene, or a law by itself.
    - `motions`: one a record. `dof`: number of coordinates.
    - `numbers`: all numbers of the model by name. `free`: names of the fitted ones.
    - `uncertain`: those that the figures call uncertain, each with the others that it is hardly told apart from.
    """
    motions = tuple(motions)
    if isinstance(model, Scene):
        frictions = [(name, each) for name, each in zip(model.names, model.effects, strict=True)
                     if isinstance(each, Friction)]  # fmt: skip
        laws = [(name, each.law, [slip_of(each, motion, model.params, dof) for motion in motions])
                for name, each in frictions if any(f.startswith(f"{name}.") for f in free)]  # fmt: skip
    else:
        laws = [("", model, [slip_of(None, motion, None, dof) for motion in motions])]
    issues: list[IdentifiabilityIssue | None] = []
    for name, law, slips in laws:
        known = tuple(slip for slip in slips if slip is not None)
        if len(known) == len(slips):
            element = Element(name, law, known, numbers, free, uncertain)
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
        change = _mass(scene, name, float(numbers[name]), motions[0])
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


def _mass(scene: Scene, name: str, value: float, motion: RecordedMotion) -> float:
    """Part of the mass that is due to a parameter."""

    def mass(number: float) -> float:
        t, q, qd = (on_device(each) for each in (motion.t[0], motion.q[0][:1], motion.qd[0][:1]))
        return float(_inertia(replace_numbers(scene, {name: on_device(number)}), t, q, qd))

    return (mass(1.01 * value) - mass(value)) / 0.01


@eqx.filter_jit
def _inertia(scene: Scene, t: Array, q: Float[Array, " one"], qd: Float[Array, " one"]) -> Array:
    return jax.hessian(lambda qd: scene.lagrangian(t, q, qd, scene.params))(qd)[0, 0]


def _listed(names: Iterable[str]) -> str:
    *most, last = names
    return f"{', '.join(most)} and {last}" if most else last


@dataclass(frozen=True)
class SloppyDirection:
    """A way in which the parameters can change together without the record telling.

    - `names`: of the parameters that take part, the strongest first.
    - `changes`: their changes relative to the scale of the estimate or the start, whichever is larger; the largest 1.
    - `error`: standard error along it, relative in the same way.
    - `sentence`: in words.
    """

    names: tuple[str, ...]
    changes: tuple[float, ...]
    error: float
    sentence: str


def sloppy_directions(
    estimate: ParameterEstimate, diagnostics: FitDiagnostics, left_out: Collection[str]
) -> list[SloppyDirection]:
    """Weak directions of the Fisher information in relative parameters, the weakest first."""
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
        directions.append(SloppyDirection(parts, tuple(float(vector[i]) for i in order), error, sentence))
    return [direction for direction in directions if not _covered(direction, directions)]


def _covered(direction: SloppyDirection, directions: list[SloppyDirection]) -> bool:
    """Whether every combination of its parameters is weak, so that there is none to be named."""
    parts = set(direction.names)
    return sum(set(other.names) <= parts for other in directions) >= len(parts)


def _inflation(estimate: ParameterEstimate, diagnostics: FitDiagnostics, keep: list[int]) -> float:
    """What correlation in time and the true size of the residual make of a variance by the Fisher information.

    From the parameters that are known well: of the others the covariance is no more than a large number.
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
    small = 0.1
    changes = ", ".join(f"{name} by {small * c * s:+.2g}" for name, c, s in zip(names, vector, size, strict=True))
    return (
        f"The record determines only combinations of {', '.join(names)}: a change of {changes} together hardly shows"
        f" (this direction is {how})."
    )
