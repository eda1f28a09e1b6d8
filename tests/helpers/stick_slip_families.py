"""Families of stick-slip systems at random, each with its reference.

A member that is ill-conditioned is left out: one that is nearer than `MARGIN` (of the limit, or of the largest slip
velocity) to a run with other events, or has two events within `SPACING` seconds. `Family.left_out` counts them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..problems import linear_stick_slip

MARGIN, SPACING = 1e-4, 1e-4
# Of the family that comes as near as that by intention.
TOUCH = 1e-5


@dataclass(frozen=True)
class Member:
    """A system, its start and end, and its motion."""

    system: linear_stick_slip.LinearStickSlip
    q0: np.ndarray
    qd0: np.ndarray
    t1: float
    motion: linear_stick_slip.StickSlipMotion


@dataclass(frozen=True)
class Family:
    """Members whose scenes have one structure.

    - `left_out`: number of members that were drawn and left out as ill-conditioned.
    """

    name: str
    members: list[Member]
    left_out: int

    @property
    def batch(self) -> tuple[Any, jax.Array, jax.Array, jax.Array]:
        """Scenes, initial states and ends, with a leading axis for the members."""
        moving = any(np.any(each.system.belt) for each in self.members)
        scenes = [linear_stick_slip.scene(each.system, moving=moving) for each in self.members]
        stacked = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *scenes)
        columns = [[each.q0 for each in self.members], [each.qd0 for each in self.members]]
        q0, qd0 = (jnp.asarray(np.stack(column)) for column in columns)
        return stacked, q0, qd0, jnp.asarray([each.t1 for each in self.members])


# System, initial coordinates and velocities, end.
Drawn = tuple[linear_stick_slip.LinearStickSlip, np.ndarray, np.ndarray, float]
Draw = Callable[[np.random.Generator], Drawn]


def system(
    load: np.ndarray,
    limits: np.ndarray,
    frequencies: list[float],
    *,
    mass: Any = 2.0,
    stiffness: Any = 0.0,
    damping: Any = 0.0,
    directions: Any = None,
    belt: Any = None,
) -> linear_stick_slip.LinearStickSlip:
    """A `LinearStickSlip` from what is not zero; `limits` has a row (Fc, Fs) for each element."""
    n, count = len(load), 5 + 4 * len(frequencies)
    full = np.zeros((n, count))
    full[:, : load.shape[1]] = load
    rows = np.eye(n) if directions is None else np.asarray(directions, float)
    surface = np.zeros((len(rows), count))
    if belt is not None:
        surface[:, : np.shape(belt)[1]] = belt
    M, C, K = (x * np.eye(n) if np.ndim(x) == 0 else np.asarray(x, float) for x in (mass, damping, stiffness))
    return linear_stick_slip.LinearStickSlip(
        M, C, K, rows, limits[:, 0], limits[:, 1], np.array(frequencies), full, surface
    )


def harmonic(amplitude: float, growth: float, phase: float) -> np.ndarray:
    """A (1 + g t) sin(w t + phase) by sin, cos, t sin, t cos."""
    s, c = amplitude * math.cos(phase), amplitude * math.sin(phase)
    return np.array([s, c, growth * s, growth * c])


def decades(rng: np.random.Generator, low: float, high: float) -> float:
    return float(10.0 ** rng.uniform(math.log10(low), math.log10(high)))


def limit(rng: np.random.Generator, stiction: bool) -> np.ndarray:
    """(Fc, Fs)."""
    Fc = rng.uniform(0.5, 1.5)
    return np.array([Fc, Fc * (rng.uniform(1.05, 1.6) if stiction else 1.0)])


def at_rest(drawn: linear_stick_slip.LinearStickSlip, t1: float) -> Drawn:
    return drawn, np.zeros(drawn.size), np.zeros(drawn.size), t1


def shaken_box(stiction: bool) -> Draw:
    """A box at rest under A (1 + g t) sin(w t + phi) with a drift: around its limit, or growing towards it in stick."""

    def draw(rng: np.random.Generator) -> Drawn:
        limits, w = limit(rng, stiction), decades(rng, 0.3, 30.0)
        grows = rng.random() < 0.5
        t1 = rng.uniform(*((3.0, 15.0) if grows else (1.0, 6.0))) * 2.0 * math.pi / w
        start = rng.uniform(*((0.3, 0.9) if grows else (0.5, 2.0)))
        growth = rng.uniform(1.0, 1.5) / start - 1.0 if grows else rng.uniform(-0.3, 1.0)
        drift = 0.0 if grows else limits[1] * rng.uniform(-0.2, 0.2, 2) / np.array([1.0, t1])
        wave = harmonic(start * limits[1], growth / t1, rng.uniform(0.0, 2.0 * math.pi))
        return at_rest(system(np.array([[*(drift * np.ones(2)), 0.0, *wave]]), limits[None], [w]), t1)

    return draw


def two_elements(rng: np.random.Generator) -> Drawn:
    """One box with two elements, which break away together."""
    limits, w = np.stack([limit(rng, True), limit(rng, rng.random() < 0.5)]), decades(rng, 0.3, 30.0)
    t1 = rng.uniform(1.0, 6.0) * 2.0 * math.pi / w
    both = limits[:, 1].sum()
    wave = harmonic(rng.uniform(0.6, 2.0) * both, rng.uniform(-0.3, 1.0) / t1, rng.uniform(0.0, 2.0 * math.pi))
    load = np.array([[0.2 * both * rng.uniform(-1.0, 1.0), 0.0, 0.0, *wave]])
    return at_rest(system(load, limits, [w], directions=np.ones((2, 1))), t1)


def two_boxes(rng: np.random.Generator) -> Drawn:
    """Two boxes joined by a spring, the first one shaken."""
    limits, w = np.stack([limit(rng, True), limit(rng, True)]), decades(rng, 0.5, 10.0)
    t1 = rng.uniform(2.0, 5.0) * 2.0 * math.pi / w
    k = 2.0 * w**2 * decades(rng, 0.1, 3.0)
    wave = harmonic(rng.uniform(0.8, 2.5) * limits[0, 1], rng.uniform(-0.2, 0.5) / t1, rng.uniform(0.0, 2.0 * math.pi))
    load = np.array([[0.0, 0.0, 0.0, *wave], np.zeros(7)])
    stiffness = k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return at_rest(system(load, limits, [w], mass=np.diag(rng.uniform(1.0, 3.0, 2)), stiffness=stiffness), t1)


def belt(rng: np.random.Generator) -> Drawn:
    """A spring-held box on a belt whose velocity is b0 + b1 sin(w t)."""
    limits, w, k = limit(rng, rng.random() < 0.7), decades(rng, 0.5, 6.0), decades(rng, 2.0, 30.0)
    b0, b1 = rng.uniform(0.05, 0.4), rng.uniform(0.0, 0.6)
    drawn = system(
        np.zeros((1, 7)),
        limits[None],
        [w],
        mass=rng.uniform(0.5, 2.0),
        stiffness=k,
        damping=rng.uniform(0.0, 0.3),
        belt=np.array([[b0, 0.0, 0.0, b1]]),
    )
    return drawn, np.zeros(1), np.array([b0]), rng.uniform(4.0, 12.0)


def shaken_row(directions: list[list[int]]) -> Draw:
    """Three masses in a row, on springs; the elements act without stiction, and a force shakes the first mass."""

    def draw(rng: np.random.Generator) -> Drawn:
        rows = np.array(directions, float)
        limits = np.stack([limit(rng, False) * (0.7 if len(rows) > 3 and i > 2 else 1.0) for i in range(len(rows))])
        w = decades(rng, 0.5, 4.0)
        k = w**2 * rng.uniform(0.3, 3.0, 3)
        stiffness = np.array([[k[0] + k[1], -k[1], 0.0], [-k[1], k[1] + k[2], -k[2]], [0.0, -k[2], k[2]]])
        load = np.zeros((3, 7))
        load[0, 3:] = harmonic(rng.uniform(2.0, 6.0), rng.uniform(0.0, 0.1), rng.uniform(0.0, 2.0 * math.pi))
        load[2, 0] = rng.uniform(-0.4, 0.4)
        mass = np.diag(rng.uniform(0.7, 1.5, 3))
        drawn = system(load, limits, [w], mass=mass, stiffness=stiffness, directions=rows)
        return at_rest(drawn, rng.uniform(1.0, 2.0) * 2.0 * math.pi / w)

    return draw


# Friction of the first mass on the ground, and between neighbours; or of all masses on the ground, and between
# neighbours: then elements are redundant, and which of them hold is not unique, but the motion is.
stack = shaken_row([[1, 0, 0], [-1, 1, 0], [0, -1, 1]])
chain = shaken_row([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 1, 0], [0, -1, 1]])


def together(rng: np.random.Generator) -> Drawn:
    """Two equal boxes under the same load or opposite ones, alone or joined by a spring: they break away together."""
    limits, w = np.stack([limit(rng, rng.random() < 0.7)] * 2), decades(rng, 0.3, 10.0)
    t1 = rng.uniform(1.0, 5.0) * 2.0 * math.pi / w
    wave = harmonic(rng.uniform(0.8, 2.0) * limits[0, 1], rng.uniform(-0.2, 0.5) / t1, rng.uniform(0.0, 2.0 * math.pi))
    row = np.array([0.1 * rng.uniform(-1.0, 1.0), 0.0, 0.0, *wave])
    k = rng.choice([0.0, 1.0]) * w**2 * rng.uniform(0.1, 1.0)
    load = np.stack([row, rng.choice([-1.0, 1.0]) * row])
    return at_rest(system(load, limits, [w], stiffness=k * np.array([[1.0, -1.0], [-1.0, 1.0]])), t1)


def slow(rng: np.random.Generator) -> Drawn:
    """A load that takes 1e2 to 1e5 s to the limit: even, quadratic or as a sine, some with ripple."""
    limits, t_limit = limit(rng, rng.random() < 0.8), decades(rng, 1e2, 1e5)
    kind, w = rng.integers(3), 0.5 * math.pi / t_limit / 1.3
    Fs, load = limits[1], np.zeros(11)
    load[1 + min(int(kind), 1)] = (0.0 if kind == 2 else Fs) / t_limit ** (1 + kind)
    if kind == 2:
        load[3] = 1.2 * Fs
    ripple = rng.choice([0.0, 1.0]) * rng.uniform(0.005, 0.05) * Fs
    load[7:] = harmonic(ripple, 0.0, rng.uniform(0.0, 2.0 * math.pi))
    cycles = decades(rng, 3.0, 200.0)
    return at_rest(system(load[None], limits[None], [w, 2.0 * math.pi * cycles / t_limit]), 1.1 * t_limit)


def touching(rng: np.random.Generator) -> Drawn:
    """A harmonic load whose peaks stay below the limit by 1e-2 to 1e-5 of it, or exceed it by as much."""
    limits, w = limit(rng, rng.random() < 0.7), decades(rng, 0.3, 30.0)
    near = rng.choice([-1.0, 1.0]) * decades(rng, TOUCH, 1e-2)
    wave = harmonic(limits[1] * (1.0 + near), 0.0, rng.uniform(0.0, 2.0 * math.pi))
    start = np.array([[0.0, 0.0, 0.0, *wave]])
    return at_rest(system(start, limits[None], [w]), rng.uniform(1.0, 4.0) * 2.0 * math.pi / w)


# Pairs of samples.
_PAIRS = 3


def sampled(linear: bool) -> Draw:
    """A shaken box with a signal whose samples lie at its break-aways and near them, and away from its stops.

    The load alone decides the time of a break-away, which is right to rounding. Where a sample is nearer than 1e-9 s
    the jump goes further out, so that rounding does not decide whether the element breaks away.
    """

    def draw(rng: np.random.Generator) -> Drawn:
        drawn, q0, qd0, t1 = shaken_box(True)(rng)
        Fs, load = float(drawn.Fs[0]), drawn.load.copy()
        load[0, -2] = 1.0
        times, values = [0.0], [0.0]
        drawn = replace(drawn, load=load, linear=linear)
        for _ in range(_PAIRS):
            drawn = replace(drawn, sample_times=np.array(times), sample_values=np.array(values))
            motion = linear_stick_slip.motion(drawn, q0, qd0, t1)
            leaves = [
                (t, after[0])
                for t, before, after in zip(motion.times, motion.modes[:-1], motion.modes[1:], strict=True)
                if before[0] == 0 and t > times[-1] + 2e-3 * t1
            ]
            off = rng.choice([0.0, 1e-12, 1e-9, 1e-6, 1e-3 * t1]) * rng.choice([-1.0, 1.0])
            # Where there is none, anywhere later, which may be beyond the end.
            t, out = leaves[0] if leaves else (times[-1] + 0.1 * t1, rng.choice([-1.0, 1.0]))
            t, out = t + off, out if abs(off) < 1e-9 else rng.choice([-1.0, 1.0])
            step = out * rng.uniform(0.02, 0.3) * Fs
            times += [t, t + rng.uniform(0.01, 0.1) * t1]
            if linear:
                values += [values[-1], values[-1] + step]
            else:
                values += [values[-1] + step, values[-1] + step * rng.uniform(-0.5, 0.5)]
        drawn = replace(drawn, sample_times=np.array(times), sample_values=np.array(values))
        return drawn, q0, qd0, t1

    return draw


def _draw(name: str, one: Draw, seed: int, count: int, margin: float = MARGIN) -> Family:
    rng, members, left_out = np.random.default_rng(seed), [], 0
    while len(members) < count:
        drawn, q0, qd0, t1 = one(rng)
        motion = linear_stick_slip.motion(drawn, q0, qd0, t1)
        if motion.margin < margin or motion.spacing < SPACING:
            left_out += 1
        else:
            members.append(Member(drawn, q0, qd0, t1, motion))
    return Family(name, members, left_out)


# By name: how a member is drawn, and what is special.
FAMILIES: dict[str, tuple[Draw, dict[str, Any]]] = {
    "shaken_box": (shaken_box(True), {}),
    "shaken_box_without_stiction": (shaken_box(False), {}),
    "two_elements": (two_elements, {}),
    "two_boxes": (two_boxes, {}),
    "belt": (belt, {}),
    "stack": (stack, {}),
    "chain": (chain, {}),
    "together": (together, {}),
    "slow": (slow, {}),
    "touching": (touching, {"margin": 0.99 * TOUCH}),
    "held_signal": (sampled(False), {}),
    "linear_signal": (sampled(True), {}),
}


def draw_family(name: str, count: int, seed: int = 0) -> Family:
    """`count` well-conditioned members of a family."""
    one, options = FAMILIES[name]
    return _draw(name, one, seed, count, **options)
