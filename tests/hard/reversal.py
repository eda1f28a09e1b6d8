"""Rest and reversal: velocities that are zero, come to zero, or pass it."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmodsim.friction import Coulomb
from jaxmodsim.problems import belt_oscillator, braked_spring, ramped_box
from jaxmodsim.scene import AppliedForce, Friction, Scene

from .case import HardCase, motion, position, velocity

FAMILY = "rest and reversal"
_M = 2.0


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * qd[0] ** 2


def _constant_pull(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.reshape(p["F"], (1,))


def _ramp_and_hold(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.reshape(jnp.minimum(t, p["F"]), (1,))


def _through_zero(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    """With the friction Fc taken off, the acceleration is 2 (t - 1)."""
    return jnp.reshape(p["Fc"] + 2.0 * p["m"] * (t - 1.0), (1,))


def _box(pull: object, law: Coulomb, **params: float) -> Scene:
    return Scene(_lagrangian, params={"m": _M, **params}, effects=(AppliedForce(pull, name="pull"), Friction(law)))


def _ramps() -> list[HardCase]:
    def broken_away(ramp: float, t1: float) -> float:
        return ramp * (t1 - 1.5 / ramp) ** 2 / (2.0 * _M)

    def ramped(name: str, ramp: float, t1: float, why: str, naive: str, single_ends: str = "") -> HardCase:
        task = motion(ramped_box.scene(Coulomb(1.5), ramp=ramp), [0.0], [0.0], t1, by="ramp", read=velocity)
        return HardCase(
            name,
            why,
            naive,
            task,
            lambda ramp: broken_away(ramp, t1),
            single_ends=single_ends,
        )

    return [
        ramped(
            "zero_start",
            1.0,
            10.0,
            "Velocity exactly zero at the start, where friction has no sign.",
            "sign(v) throws the box back and forth: a variable step ends in ever smaller steps, a fixed one shakes.",
        ),
        ramped(
            "tiny_ramp",
            1e-6,
            1e7,
            "The force rises by 1e-6 N/s: the box rests for 1.5e6 s, in which nothing moves and steps grow.",
            "Seventeen days of crossings of zero; or a step over the break-away.",
            # A force of 1.5 N is known to 1e-7 N, what exceeds it rises by 1e-6 N in a second.
            "step size fell below what the time can resolve",
        ),
    ]


def _exactly_at_the_limit() -> list[HardCase]:
    at_rest = _box(_constant_pull, Coulomb(1.5, 1.75), F=1.75)
    no_net = _box(_ramp_and_hold, Coulomb(1.5), F=1.5)
    return [
        HardCase(
            "force_equals_limit",
            "A force that equals Fs to the last bit: at the limit, not beyond it.",
            "Rounding decides whether it moves.",
            motion(at_rest, [0.0], [0.0], 5.0, by="F", read=position),
            lambda _: 0.0,
            scale=1.0,
            undefined="a smaller force leaves it at rest, a larger one moves it by half a metre at once",
        ),
        HardCase(
            "no_net_force",
            "The force rises to Fc = Fs and stays: whether the box breaks away or not, nothing accelerates it.",
            "Endless changes of mode: neither stick nor slip is left for good.",
            motion(no_net, [0.0], [0.0], 5.0, by="F", read=position),
            lambda _: 0.0,
            scale=1.0,
            undefined="below Fc it rests, above it moves: the derivative from above is not that from below",
        ),
    ]


def _spring(name: str, why: str, naive: str, t1: float) -> HardCase:
    def exact(x0: float) -> float:
        return float(braked_spring.motion(jnp.asarray(t1), **(braked_spring.PARAMS | {"x0": x0}))[0])

    task = motion(braked_spring.scene(braked_spring.coulomb()), [1.0], [0.0], t1, by="q0[0]", read=position)
    return HardCase(name, why, naive, task, exact)


def _thrice_pull(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    """Without friction the velocity is c (t - 2)(t - 5)(t - 8)."""
    return jnp.reshape(p["m"] * p["c"] * ((t - 5.0) * (t - 8.0) + (t - 2.0) * (t - 8.0) + (t - 2.0) * (t - 5.0)), (1,))


def _thrice() -> HardCase:
    """Velocity changes its sign three times within one step of ten seconds, of which each part is a polynomial."""

    def exact(c: float) -> float:
        smooth = c * np.poly1d([2.0, 5.0, 8.0], r=True)
        t, v, sign = 0.0, -8.0, -1.0
        while True:
            # In slip the velocity is the smooth one and a straight line.
            part = smooth - float(smooth(t)) + v - np.poly1d([sign * 0.25, -sign * 0.25 * t])
            roots = np.real(part.roots[np.abs(np.imag(part.roots)) < 1e-9])
            later = roots[(roots > t + 1e-6) & (roots < 10.0)]
            if not later.size:
                return float(part(10.0))
            t, v, sign = float(later.min()), 0.0, -sign

    scene = _box(_thrice_pull, Coulomb(0.5), c=0.1)
    task = motion(scene, [0.0], [-8.0], 10.0, by="c", read=velocity, numbers={"dt": 10.0})
    return HardCase(
        "reversals_in_a_step",
        "Three reversals of slip within one fixed step of ten seconds.",
        "The first and the third are seen as one, or none is: friction has the wrong sign for seconds.",
        task,
        exact,
        # The velocity is a polynomial that the method integrates exactly; the power is one of twice the degree.
        conserves=False,
    )


def _vanishing() -> HardCase:
    """Friction so small that it takes 2000 half cycles to come to rest."""
    numbers = {"m": 1.3, "k": 2.7}

    def exact(Fc: float) -> float:
        return float(braked_spring.rest(x0=1.0, Fc=Fc, **numbers).x)

    Fc = 2.7 / 2.0 / 2000.3
    task = motion(
        braked_spring.scene(Coulomb(Fc), **numbers), [1.0], [0.0], 5000.0, by="friction.Fc", read=position,
        max_steps=262144, max_events=4096,
    )  # fmt: skip
    return HardCase(
        "vanishing_friction",
        "2000 reversals before rest; each must lose just the right amount, or the number of half cycles is wrong.",
        "An answer that is off by half cycles, or no rest at all.",
        task,
        exact,
        asks="resting place [m]",
        # Each half cycle takes 2 Fc/k; differences would step over the edges between their numbers.
        slope=lambda _: -2.0 * 2000 / numbers["k"],
        scale=1.0,
        # How many half cycles there are is rounding's in float32.
        single=None,
    )


def _dip() -> HardCase:
    """Slip that touches zero from above 1e-4 m/s deep: `v = (t - 1)^2 - 1e-8`, but for the stick in between.

    From where v is zero the load is below the limit until t = 1, and from there on `v = (t - 1)^2`: what was left of
    v0 is forgotten.
    """
    dip = 1e-4

    def exact(_: float) -> float:
        return 1.0

    scene = _box(_through_zero, Coulomb(1.5), Fc=1.5)
    task = motion(scene, [0.0], [1.0 - dip**2], 2.0, by="qd0[0]", read=velocity)
    return HardCase(
        "dip_of_slip",
        "Slip falls below zero by 1e-8 m/s for 2e-4 s inside a step: two crossings that no end of a step shows.",
        "Value right to 1e-8, derivative by v0 one instead of zero: the stick that forgets v0 is not seen.",
        task,
        exact,
        # In float32 the dip is below the rounding of v.
        single=None,
    )


def _long_stick() -> HardCase:
    """Stick of 6e5 s beside slip of 0.3 s."""
    numbers = belt_oscillator.PARAMS | {"belt": 1e-7}
    t1 = 2.5e6

    def exact(k: float) -> float:
        return float(belt_oscillator.motion(jnp.asarray(t1), **(numbers | {"k": k}))[0])

    task = motion(belt_oscillator.scene(belt_oscillator.coulomb(), belt=1e-7), [0.0], [1e-7], t1, by="k", read=position)
    return HardCase(
        "long_stick",
        "The belt creeps at 1e-7 m/s: stick lasts 6e5 s, two million times as long as slip.",
        "Slip is stepped over, or ten million steps are made in stick.",
        task,
        exact,
        asks="position at 2.5e6 s [m]",
        # From slip to slip the place in stick moves with the belt; what slip leaves is what counts. The times of
        # break-away move by 8000 s for 1 N/m, and what the derivative keeps is small against what they do in slip.
        scale=0.06,
        tolerance=2e-5,
        single=None,
    )


def _turning_belt(t: Array) -> Array:
    return t - 1.0


def _belt_through_zero() -> HardCase:
    """Slip until the belt is met at t = 2/(1 + a) for a start at v0 = 1, friction a = Fc/m; then on with the belt."""

    def exact(Fc: float) -> float:
        a = Fc / _M
        meets = 1.0 / (1.0 + a)
        return -0.5 * a * meets**2 + (0.5 * 9.0 - 3.0) - (0.5 * meets**2 - meets)

    scene = Scene(_lagrangian, params={"m": _M}, effects=(Friction(Coulomb(2.5), belt_velocity=_turning_belt),))
    return HardCase(
        "belt_turns",
        "The belt's velocity passes zero while the box sticks to it; stick is not rest.",
        "A solver that tests v = 0 instead of slip lets go, or holds the box still.",
        motion(scene, [0.0], [0.0], 3.0, by="friction.Fc", read=position),
        exact,
    )


def _fast_belt(t: Array) -> Array:
    return 1e-3 * jnp.sin(2.0 * jnp.pi * 1e3 * t)


def _shaken() -> HardCase:
    """A heavy box on a table that shakes a thousand times a second.

    It is so much slower than the table that slip changes its sign with it: its velocity is a zigzag of slopes +-Fc/m,
    whose corners lie where it crosses the table's.
    """
    speed, rate, m, t1 = 1e-3, 2.0 * math.pi * 1e3, 1e3, 1.0

    def exact(Fc: float) -> float:
        """From corner to corner, each by Newton's iteration; friction pushes with the table."""
        t, v, x, push = 0.0, 0.0, 0.0, Fc / m
        for half in range(1, 2002):
            corner = half * math.pi / rate
            for _ in range(4):
                gap = v + push * (corner - t) - speed * math.sin(rate * corner)
                corner -= gap / (push - speed * rate * math.cos(rate * corner))
            step = min(corner, t1) - t
            x, v, t, push = x + v * step + 0.5 * push * step**2, v + push * step, t + step, -push
        return x

    scene = Scene(_lagrangian, params={"m": m}, effects=(Friction(Coulomb(1.5), belt_velocity=_fast_belt),))
    task = motion(
        scene, [0.0], [0.0], t1, by="friction.Fc", read=position, numbers={"rtol": 1e-6, "atol": 1e-11},
        max_events=8192, max_steps=131072,
    )  # fmt: skip
    return HardCase(
        "shaken_table",
        "Slip changes its sign two thousand times a second, while the acceleration is constant in between: no error"
        " estimate of the motion sees the table.",
        "Steps of many periods: friction of one sign for all of them.",
        task,
        exact,
        tolerance=1e-4,
        # Of 1e-7 m in a second, and corners 5e-4 s apart, float32 keeps two digits.
        single=None,
    )


def cases() -> list[HardCase]:
    """The cases of this family."""
    return [
        *_ramps(),
        *_exactly_at_the_limit(),
        _spring(
            "reversals",
            "Velocity passes zero nine times, without stick, then the mass sticks for good.",
            "A smoothed sign leaves a creep; a step over a reversal takes friction with the wrong sign.",
            30.0,
        ),
        _thrice(),
        _vanishing(),
        _dip(),
        _long_stick(),
        _belt_through_zero(),
        _shaken(),
    ]
