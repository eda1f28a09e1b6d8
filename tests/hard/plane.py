"""Exact slip in the plane: dying in a turn, passing rest, and stick under a load that turns."""

import math
from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array

from jaxmodsim.friction import Coulomb
from jaxmodsim.scene import AppliedForce, Friction, Scene

from .case import HardCase, motion, position

FAMILY = "friction in the plane"
# Limit of friction [N] on a mass of 1 kg.
_F = 1.0


def _pulled(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * jnp.sum(qd**2) + p["f"] * q[0]


def _place(q: Array) -> Array:
    return q


def _puck(f: float) -> Scene:
    return Scene(_pulled, params={"f": f}, effects=(Friction(Coulomb(_F), along=_place),))


def _way(f: float, v: float, c: float) -> float:
    """A function of speed and cosine of its angle from the load f whose rate is the velocity along that."""
    return -(v**2) * (f * (1.0 + c * c) + 2.0 * _F * c) / (4.0 * (_F * _F - f * f))


def _dies() -> HardCase:
    angle = 2.0
    return HardCase(
        "slip_dies_in_a_turn",
        "A load of 0.9 of the limit turns slip to itself, ever faster: at the end the direction has no rate.",
        "Steps become ever shorter, or the puck creeps on at the width of a regularised law.",
        motion(
            _puck(0.9),
            [0.0, 0.0],
            [math.cos(angle), math.sin(angle)],
            6.0,
            by="f",
            read=position,
            numbers={"atol": 1e-8},
        ),
        lambda f: -_way(f, 1.0, math.cos(angle)),
    )


def _turned(f: float, angle: float, t: float) -> float:
    """Way at time t along a load above the limit, from a slip of 1 m/s at that angle.

    The speed is `C tan(angle/2)^(F/f)/sin(angle)`, and `v (F + f cos(angle))` grows at the rate `f^2 - F^2`.
    """

    def speed(w: float) -> float:
        return (w / first) ** (_F / f) * (1.0 + w * w) / w / ((1.0 + first * first) / first)

    def cosine(w: float) -> float:
        return (1.0 - w * w) / (1.0 + w * w)

    first = math.tan(0.5 * angle)
    goal = _F + f * math.cos(angle) + (f * f - _F * _F) * t
    low, high = math.log(first) - 60.0, math.log(first)
    for _ in range(200):
        middle = 0.5 * (low + high)
        w = math.exp(middle)
        low, high = (middle, high) if speed(w) * (_F + f * cosine(w)) > goal else (low, middle)
    w = math.exp(0.5 * (low + high))
    return _way(f, speed(w), cosine(w)) - _way(f, 1.0, math.cos(angle))


def _passes() -> HardCase:
    angle = math.pi - 1e-3
    answer: Callable[[float], float] = lambda f: _turned(f, angle, 1.0)  # noqa: E731
    return HardCase(
        "slip_passes_rest",
        "A load above the limit turns slip round at a speed of 2e-5 m/s: it passes rest, and does not stop there.",
        "It stops, or a step goes over the turn and the force is that of the old direction.",
        motion(_puck(2.0), [0.0, 0.0], [math.cos(angle), math.sin(angle)], 1.0, by="f", read=position),
        answer,
        scale=0.1,
        # The turn takes a hundred rounding units of the time.
        single=1e-2,
    )


def _round(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return p["load"] * jnp.stack([jnp.cos(20.0 * t), jnp.sin(20.0 * t)])


def _turns() -> HardCase:
    scene = Scene(
        _pulled,
        params={"f": 0.0, "load": 0.999},
        effects=(AppliedForce(_round), Friction(Coulomb(_F), along=_place)),
    )
    return HardCase(
        "load_turns_in_stick",
        "A load of 0.999 of the limit goes round thirty times: stick holds it in all directions.",
        "Friction along each axis by itself holds the corner of a square; a regularised law creeps.",
        motion(scene, [0.0, 0.0], [0.0, 0.0], 10.0, by="load", read=position, numbers={"atol": 1e-7}),
        lambda _: 0.0,
        lambda _: 0.0,
        scale=1.0,
    )


def cases() -> list[HardCase]:
    """All of the family."""
    return [_dies(), _passes(), _turns()]
