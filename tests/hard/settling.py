"""Contacts that settle: on surfaces that move, with friction under them, inside of parts that friction holds."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmodsim.friction import Coulomb
from jaxmodsim.mechanics import Contact, end_stops
from jaxmodsim.problems import bouncing_ball
from jaxmodsim.scene import AppliedForce, Friction, Scene, Signal
from jaxmodsim.simulation import Trajectory, simulate

from ..problems import vibrating_table
from .case import HardCase, RefusedCalls, differentiate, motion, position

FAMILY = "settling contacts"
_G = 9.81
_FALL = math.sqrt(2.0 / _G)


def _shaken() -> list[HardCase]:
    A, omega, late = 2e-3, 20.0, 3.0
    return [
        HardCase(
            f"settles_on_a_shaken_table_{name}",
            f"A ball settles on a table that oscillates by 2 mm, e = {e}: rounding hides its last bounces.",
            "Intervals between impacts never get as short as on a floor at zero; steps end up too small.",
            motion(
                vibrating_table.scene(A=A, omega=omega, e=e), [0.5], [0.0], late,
                by="A", read=position, numbers={"rtol": rtol, "atol": 1e-3 * rtol}, max_events=256,
            ),
            lambda A: A * math.sin(omega * late),
            lambda _: math.sin(omega * late),
            single=None,
        )
        for name, e, rtol in (("half", 0.5, 1e-6), ("most", 0.7, 1e-6), ("tight", 0.5, 1e-9))
    ]  # fmt: skip


def _leaves() -> HardCase:
    A, omega, late = 0.05, 20.0, 0.1

    def height(A: float) -> float:
        leaves = math.asin(_G / (A * omega**2)) / omega
        free = late - leaves
        return _G / omega**2 + A * omega * math.cos(omega * leaves) * free - 0.5 * _G * free**2

    return HardCase(
        "settles_and_leaves_again",
        "A ball settles on a table that rises, and leaves it 25 ms later, where it falls faster than g.",
        "The contact holds the ball, or never closes.",
        motion(vibrating_table.scene(A=A, omega=omega, e=0.2), [1e-4], [A * omega], late, by="A", read=position),
        height,
        lambda A: differentiate(height, A),
        single=None,
    )


def _fall(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * jnp.sum(qd**2) - _G * q[0]


def _rises(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[0] - 0.5 * p["a"] * t**2


def _high(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[0] - p["h"]


def _on(name: str, why: str, gap: Callable[..., Array], by: str, number: float, at: float, slope: float) -> HardCase:
    contact = Contact(gap, restitution=0.6, name="table")
    return HardCase(
        name,
        why,
        "The last bounces are lost in rounding, and steps end up too small.",
        motion(Scene(_fall, {by: number}, constraints=(contact,)), [at + 0.3], [0.0], 4.0, by=by, read=position),
        lambda x: slope * x,
        lambda _: slope,
        single=None,
    )


def _thrown(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * jnp.sum(qd**2) - _G * q[1]


def _along(q: Array) -> Array:
    return q[0]


def _above(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[1]


def _slides() -> list[HardCase]:
    mu, start, fall = 0.3, 4.0, math.sqrt(2 * 0.5 / _G)

    def place(mu: float) -> float:
        return start * fall + (start - mu * _G * fall) ** 2 / (2.0 * mu * _G)

    def case(e: float, by: str, exact: Callable[[float], float], slope: Callable[[float], float]) -> HardCase:
        friction = Friction(Coulomb(mu), along=_along, normal_force="floor")
        scene = Scene(_thrown, effects=(friction,), constraints=(Contact(_above, restitution=e, name="floor"),))
        return HardCase(
            f"bounces_and_slides_{by.split('.')[-1]}",
            f"A block thrown onto a rough floor, e = {e:g}: where it comes to rest does not depend on the coefficient.",
            "The first hops are thousands of times longer than the last, and derivatives are lost between them.",
            motion(scene, [0.0, 0.5], [start, 0.0], 3.0, by=by, read=position),
            exact,
            slope,
            single=None,
        )

    return [
        case(0.01, "floor.restitution", lambda _: place(mu), lambda _: 0.0),
        case(1e-3, "friction.Fc", place, lambda mu: differentiate(place, mu)),
    ]


def _in_a_box(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 2.5 * qd[0] ** 2 + 0.5 * (qd[0] + qd[1]) ** 2


def _pushed(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.stack([0.0 * t, 5.0 + 0.0 * t])


def _inside(q: Array) -> Array:
    return q[1]


def _box() -> HardCase:
    M, m, Fc, push, room = 5.0, 1.0, 15.85, 5.0, 0.5

    def place(e: float) -> float:
        """Flights are similar, each as many times shorter than the one before: a geometric sum."""
        slows, speed = (Fc + push) / M, (1.0 + e) * m / (m + M)
        slip = speed / slows
        rate, gap = e - (slows + push / m) * slip, e * slip - 0.5 * (slows + push / m) * slip**2
        ratio = rate**2 + 2.0 * push / m * gap
        return speed**2 / (2.0 * slows) / (1.0 - ratio) * 2.0 * push / m * room

    scene = Scene(
        _in_a_box,
        effects=(AppliedForce(_pushed), Friction(Coulomb(Fc), along=_along)),
        constraints=end_stops(_inside, upper=room, restitution=0.8, name="end"),
    )
    return HardCase(
        "impacts_inside_a_dry_box",
        "A mass strikes the end of a box that dry friction holds: each impact breaks it loose, down to 1e-8 m/s.",
        "Steps stand still where rounding of the place is all that is left of a flight.",
        motion(scene, [0.0, 0.0], [0.0, 0.0], 10.0, by="end_upper.restitution", read=position, max_events=256),
        place,
        lambda e: differentiate(place, e),
        single=None,
    )


def _pair(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * jnp.sum(qd**2) - _G * jnp.sum(q)


def _first(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[0]


def _both(run: Trajectory) -> Array:
    return jnp.sum(run.q[-1])


def _at_once() -> HardCase:
    scene = Scene(
        _pair, constraints=tuple(Contact(gap, restitution=0.5, name=gap.__name__) for gap in (_first, _above))
    )

    def height(h: float) -> Array:
        return bouncing_ball.motion(jnp.asarray(1.3), h=h, e=0.5)[0]

    return HardCase(
        "two_accumulate_at_once",
        "Two balls bounce to rest at the same instants, from the same height.",
        "One of two simultaneous impacts is missed, or taken for a second one.",
        motion(scene, [1.0, 1.0], [0.0, 0.0], 1.3, by="q0[0]", read=_both),
        lambda h: float(height(h) + height(1.0)),
        lambda h: float(jax.grad(height)(h)),
        single=None,
        asks="sum of the heights at 1.3 s [m]",
    )


def _sampled(run: Trajectory) -> Array:
    return run.qd[0, 0]


def _sample() -> HardCase:
    return HardCase(
        "sample_at_an_impact",
        "The motion is saved exactly at an impact: the velocity is that after it.",
        "Dense output ends with the velocity before.",
        motion(
            bouncing_ball.scene(e=0.5), [1.0], [0.0], 1.0,
            by="floor.restitution", read=_sampled, numbers={"ts": [_FALL, 1.0]},
        ),
        lambda e: e * _G * _FALL,
        lambda _: _G * _FALL,
        single=None,
        asks="velocity at the first impact [m/s]",
    )  # fmt: skip


def _lifted(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[0] - p["u"]


def _refused() -> HardCase:
    def run(linear: Signal, start: float) -> object:
        scene = Scene(_fall, {"u": linear}, constraints=(Contact(_lifted, name="lift"),))
        return simulate(scene, [start], [0.0], 1.0)

    rises = Signal([0.0, 1.0], [0.0, 0.5], linear=True)
    return HardCase(
        "contacts_refused",
        "A surface that a linear signal moves, whose velocity contacts do not see; a start 2 um below a surface.",
        "The impact is one with a surface at rest; the ball starts inside of the floor.",
        RefusedCalls(
            {"signal": lambda: run(rises, 1.0), "start": lambda: run(Signal([0.0], [0.1]), 0.1 - 2e-6)},
            {"signal": "linear Signal", "start": "gap is negative"},
        ),
        asks="an error",
    )


def cases() -> list[HardCase]:
    """All of the family."""
    rising = "A ball settles on a table that accelerates upwards, 4 m up when the run ends."
    high = "A ball settles on a floor at 1000 m: rounding hides bounces below 1e-11 m."
    return [
        *_shaken(), _leaves(), *_slides(), _box(), _at_once(), _sample(), _refused(),
        _on("settles_on_a_rising_table", rising, _rises, "a", 0.5, 0.0, 8.0),
        _on("settles_far_from_zero", high, _high, "h", 1000.0, 1000.0, 1.0),
    ]  # fmt: skip
