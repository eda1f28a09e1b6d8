"""Contacts: impacts that accumulate, coincide, come a hundred times over, or with a jump; a landing."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmodsim.friction import Coulomb
from jaxmodsim.mechanics import Contact, HuntCrossley, Poisson, end_stops
from jaxmodsim.problems import bouncing_ball
from jaxmodsim.scene import AppliedForce, Friction, Scene, Signal
from jaxmodsim.simulation import Trajectory

from ..problems import vibrating_table
from .case import HardCase, motion, position

FAMILY = "contacts"
_G = 9.81
_FALL = math.sqrt(2.0 / _G)
_TOO_SMALL = "step size fell below"


def _height(t: float, h: float, e: float) -> float:
    return float(bouncing_ball.motion(jnp.asarray(t), h=h, e=e)[0])


def _restitution(t: float, h: float, e: float) -> float:
    """Derivative of the height by the coefficient."""
    return float(jax.grad(lambda e: bouncing_ball.motion(jnp.asarray(t), h=h, e=e)[0])(e))


def _accumulating() -> list[HardCase]:
    e, late = 0.5, 1.34
    return [
        HardCase(
            "last_bounces",
            "A ball on a contact just before it comes to rest: seven bounces, each half as long as the one before.",
            "A penalty gives in by more than the bounce is high; event loops lose the short ones.",
            motion(bouncing_ball.scene(e=e), [1.0], [0.0], late, by="floor.restitution", read=position),
            lambda e: _height(late, 1.0, e),
            lambda e: _restitution(late, 1.0, e),
            scale=1e-3,
            single=1e-2,
            single_ends=_TOO_SMALL,
        ),
        HardCase(
            "rest_on_a_contact",
            "The same long after infinitely many bounces.",
            "It falls through the floor, or hops for ever.",
            motion(bouncing_ball.scene(e=e), [1.0], [0.0], 3.0, by="floor.restitution", read=position),
            lambda _: 0.0,
            lambda _: 0.0,
            scale=1e-3,
            # There some runs end early, by one sentence or another.
            single=None,
        ),
        HardCase(
            "tiny_restitution",
            "A coefficient of 1e-3: a hop of half a micrometre, at whose height the run ends.",
            "The hop is below the tolerance of the event search.",
            motion(
                bouncing_ball.scene(e=1e-3),
                [1.0],
                [0.0],
                _FALL * (1.0 + 1e-3),
                by="floor.restitution",
                read=position,
                numbers={"atol": 1e-13},
            ),
            # The velocity at the end is zero: a hop that is higher is not yet at its height.
            lambda e: _FALL**2 * _G * 1e-3 * (e - 0.5e-3),
            lambda _: _FALL**2 * _G * 1e-3,
            single=None,
        ),
    ]


def _table() -> HardCase:
    p = vibrating_table.PARAMS
    phase, period = float(vibrating_table.bounce_phase()), 2.0 * math.pi / p["omega"]
    v = 0.5 * p["g"] * period
    return HardCase(
        "vibrating_table",
        "A ball on a vibrating table, one bounce a period, ten of them: each impact on a floor that moves.",
        "Impacts located on dense output drift against the table.",
        motion(
            vibrating_table.scene(),
            [p["A"] * math.sin(phase)],
            [v],
            phase / p["omega"] + 10.5 * period,
            by="m",
            read=position,
            numbers={"t0": phase / p["omega"], "rtol": 1e-11, "atol": 1e-14},
        ),
        # The mass does not matter.
        lambda _: p["A"] * math.sin(phase) + 0.5 * v * 0.5 * period,
        lambda _: 0.0,
        single=None,
    )


def _free(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * jnp.sum(qd**2)


def _walls() -> HardCase:
    e, impacts = 0.99, 100
    scene = Scene(_free, constraints=end_stops(_along, lower=0.0, upper=1.0, restitution=e))

    def last(v: float) -> float:
        return 0.5 / v + sum(1.0 / (v * e**k) for k in range(1, impacts))

    t1 = last(1.0) + 0.1
    return HardCase(
        "hundred_impacts",
        "A hundred impacts between two walls; the derivative goes through each of them.",
        "Derivatives of a loop of solves miss how the times of impacts move.",
        motion(scene, [0.5], [1.0], t1, by="qd0[0]", read=position, max_events=256),
        lambda v: v * e**impacts * (t1 - last(v)),
        lambda v: e**impacts * (t1 - last(v)) + e**impacts * last(v),
        # Each of the hundred is located to a few rounding units of the time, 160 s.
        single=5e-2,
    )


def _bar(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * qd[0] ** 2 + 0.05 * qd[1] ** 2 - _G * q[0]


def _one_end(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[0] - 0.5 * jnp.sin(q[1])


def _other_end(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[0] + 0.5 * jnp.sin(q[1])


def _two_supports() -> HardCase:
    scene = Scene(_bar, constraints=(Contact(_one_end, restitution=0.5), Contact(_other_end, restitution=0.5)))
    return HardCase(
        "bar_on_two_supports",
        "A bar falls flat on two supports: both impacts of every bounce are at one instant, to the end of all bounces.",
        "Taken one after the other, the impacts turn the bar.",
        motion(scene, [0.1, 0.0], [0.0, 0.0], 0.3, by="q0[0]", read=position),
        lambda h: _height(0.3, h, 0.5),
        lambda h: float(jax.grad(lambda h: bouncing_ball.motion(jnp.asarray(0.3), h=h, e=0.5)[0])(h)),
        # Rounding tells the two impacts apart, and one after the other they turn the bar.
        single=None,
    )


def _push(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.reshape(p["u"], (1,))


def _at_a_sample() -> HardCase:
    ball = bouncing_ball.scene(e=0.5)
    pushed = Scene(
        ball.lagrangian,
        params={"m": 1.0, "g": _G, "u": Signal([0.0, _FALL], [0.0, 5.0])},
        effects=(AppliedForce(_push),),
        constraints=ball.constraints,
    )
    dt = 0.2
    return HardCase(
        "impact_at_a_sample",
        "The impact is at the instant at which a sampled force jumps.",
        "One of the two is lost.",
        motion(pushed, [1.0], [0.0], _FALL + dt, by="floor.restitution", read=position),
        lambda e: e * _G * _FALL * dt + 0.5 * (5.0 - _G) * dt**2,
        lambda _: _G * _FALL * dt,
    )


def _thrown(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * jnp.sum(qd**2) - _G * q[1]


def _along(q: Array) -> Array:
    return q[0]


def _above(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[1]


def _landing() -> HardCase:
    mu, start = 0.3, 2.0
    friction = Friction(Coulomb(mu), along=_along, normal_force="floor")
    scene = Scene(_thrown, effects=(friction,), constraints=(Contact(_above, name="floor"),))
    landing = math.sqrt(2 * 0.5 / _G)

    def left(mu: float) -> float:
        return start - mu * _G * landing

    return HardCase(
        "lands_and_slides",
        "A block lands on a rough floor, where friction takes a part of its speed at once, slides and stops.",
        "Friction needs the normal force, which is an impulse at the landing.",
        motion(scene, [0.0, 0.5], [start, 0.0], 1.5, by="friction.Fc", read=position),
        lambda mu: start * landing + left(mu) ** 2 / (2.0 * mu * _G),
        lambda mu: -landing * left(mu) / mu - left(mu) ** 2 / (2.0 * mu**2 * _G),
    )


def _speed(run: Trajectory) -> Array:
    return run.qd[-1, 0]


def _at_the_end() -> HardCase:
    wall = (Contact(_first, restitution=0.5, name="wall"),)
    return HardCase(
        "impact_at_the_end",
        "The impact is a nanosecond before t1.",
        "The last step ends before the event is looked for.",
        motion(Scene(_free, constraints=wall), [0.5], [-1.0], 0.5 + 1e-9, by="wall.restitution", read=_speed),
        lambda e: e,
        lambda _: 1.0,
        # There the two are one.
        single=None,
        asks="velocity after the run",
    )


def _ceiling(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return 1.0 - q[0]


def _grazing() -> HardCase:
    e, late, reach = 0.5, 0.5, 1e-3
    start = math.sqrt(2.0 * _G + reach**2)

    def height(v: float) -> float:
        strikes = math.sqrt(v**2 - 2.0 * _G)
        left = late - (v - strikes) / _G
        return 1.0 - e * strikes * left - 0.5 * _G * left**2

    def slope(v: float) -> float:
        strikes = math.sqrt(v**2 - 2.0 * _G)
        left, rate = late - (v - strikes) / _G, v / strikes
        return -e * rate * left - (e * strikes + _G * left) * (rate - 1.0) / _G

    ball = bouncing_ball.scene(e=e)
    scene = Scene(ball.lagrangian, ball.params, constraints=(Contact(_ceiling, restitution=e, name="ceiling"),))
    return HardCase(
        "near_grazing",
        "A ball thrown up touches a ceiling at 1 mm/s, a tenth of a millisecond before it would turn.",
        "The impact is not seen, and the derivative, which has no bound towards grazing, is off by a factor of 4000.",
        motion(scene, [0.0], [start], late, by="qd0[0]", read=position, numbers={"rtol": 1e-11, "atol": 1e-13}),
        height,
        slope,
        tolerance=1e-6,
        single=None,
    )


def _pair(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * jnp.sum(qd**2) - _G * jnp.sum(q)


def _first(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[0]


def _two_accumulations() -> HardCase:
    late = 1.0
    balls = Contact(_first, restitution=0.6, name="one"), Contact(_above, restitution=0.3, name="other")
    return HardCase(
        "rest_while_another_bounces",
        "Two balls: the bounces of one accumulate to rest at 0.84 s, between those of the other.",
        "What ends the bounces of one ends those of the other.",
        motion(Scene(_pair, constraints=balls), [1.0, 1.0], [0.0, 0.0], late, by="one.restitution", read=position),
        lambda e: _height(late, 1.0, e),
        lambda e: _restitution(late, 1.0, e),
        single=None,
    )


def _redundant() -> HardCase:
    ball = bouncing_ball.scene(e=0.5)
    twice = tuple(Contact(_first, restitution=Poisson(0.5), name=name) for name in ("one", "other"))
    scene = Scene(ball.lagrangian, ball.params, constraints=twice)
    return HardCase(
        "redundant_contacts",
        "A ball falls on two floors at the same height: any share of the impulse obeys the law, Poisson's.",
        "A singular system, or twice the impulse.",
        motion(scene, [1.0], [0.0], 1.2, by="q0[0]", read=position),
        lambda h: _height(1.2, h, 0.5),
        lambda h: float(jax.grad(lambda h: bouncing_ball.motion(jnp.asarray(1.2), h=h, e=0.5)[0])(h)),
    )


def _lift(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.stack([0.0 * t, 2.0 * _G * t])


def _lost_in_stick() -> HardCase:
    scene = Scene(
        _thrown,
        effects=(
            AppliedForce(_lift, name="lift"),
            Friction(Coulomb(0.5), along=_along, belt_velocity=0.4, normal_force="belt"),
        ),
        constraints=(Contact(_above, name="belt"),),
    )
    return HardCase(
        "lift_off_in_stick",
        "A block sticks on a belt, is lifted off it at 0.5 s, and flies on at the speed of the belt.",
        "Stick without a load is solved for, or holds the block in the air.",
        motion(scene, [0.0, 0.0], [0.4, 0.0], 1.5, by="qd0[0]", read=position),
        # Whatever it begins with, it has the speed of the belt soon; within rounding of that, at once.
        lambda _: 0.4 * 1.5,
        lambda _: 0.0,
    )


def _stiff() -> HardCase:
    law = HuntCrossley(1e14, damping=0.3)
    scene = Scene(_free, constraints=(Contact(_first, restitution=law, name="wall"),))

    return HardCase(
        "stiff_compliant_contact",
        "A compliant contact of 1e14 N/m^(3/2): it lasts some microseconds of a run of a second.",
        "Explicit steps follow every microsecond, and others pass over the contact.",
        motion(scene, [0.5], [-1.0], 1.0, by="qd0[0]", read=_speed, numbers={"rtol": 1e-9, "atol": 1e-12}),
        lambda v: -v * float(law.restitution(-v)),
        lambda v: -float(jax.grad(lambda v: v * law.restitution(v))(-v)),
        single=1e-2,
        skips=dict.fromkeys(
            ("forward float32", "reverse float32"),
            "the contact lasts some roundings of the time, and the run ends early",
        ),
        asks="motion after the contact",
    )


def _rolling(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * jnp.sum(qd**2) - 0.3 * qd[2] ** 2


def _rim(q: Array) -> Array:
    return q[0] + q[2]


def _oblique() -> HardCase:
    inertia, e = 0.4, 0.8
    friction = Friction(Coulomb(0.1), along=_rim, normal_force="floor")
    scene = Scene(_rolling, effects=(friction,), constraints=(Contact(_above, restitution=e, name="floor"),))
    return HardCase(
        "oblique_impact",
        "A spinning disc strikes a rough floor: friction, an impulse, turns its spin, and slip does not end.",
        "Friction at an instant is left out, or stops the slip that it only slows.",
        motion(scene, [0.0, 1.0, 0.0], [1.0, -2.0, 5.0], 1.0, by="friction.Fc", read=_spin),
        lambda mu: 5.0 - mu * (1.0 + e) * 2.0 / inertia,
        lambda _: -(1.0 + e) * 2.0 / inertia,
        asks="velocities after the impact",
    )


def _spin(run: Trajectory) -> Array:
    return run.qd[-1, 2]


def cases() -> list[HardCase]:
    """All of the family."""
    return [
        *_accumulating(), _table(), _walls(), _two_supports(), _at_a_sample(), _landing(), _at_the_end(), _grazing(),
        _two_accumulations(), _redundant(), _lost_in_stick(), _stiff(), _oblique(),
    ]  # fmt: skip
