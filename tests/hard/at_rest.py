"""Derivatives of machines that stand still, and of events of the user's own."""

import math
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.linalg import expm
from scipy.optimize import brentq

from jaxmodsim.friction import Coulomb
from jaxmodsim.scene import AppliedForce, Friction, Scene, Switch

from .case import HardCase, motion, position, velocity

FAMILY = "derivatives at rest"

_G = 9.81
# The options that a user gets.
_DEFAULTS = {"rtol": 1e-6, "atol": 1e-9}
_NAIVE = "The steps grow without bound, as the motion has no error: the derivative is off by up to 1e13."

_Numbers = dict[str, Array]


def _hanging(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2 - _G * p["m"] * q[0]


def _damper(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
    return -p["c"] * qd


def _settles(x: float, m: float, k: float, c: float, t: float, v: float = 0.0) -> float:
    """Place at t of `m x'' + c x' + k x = 0` from x, v."""
    w = math.sqrt(k / m)  # time in 1/w, else the exponential loses digits
    return float(expm(np.array([[0.0, w], [-w, -c / m]]) * t)[0] @ (x, v / w))


def _hanging_mass(name: str, why: str, k: float, c: float, t: float) -> HardCase:
    """Started at rest at -g/k; with another mass it goes to -m g/k."""
    scene = Scene(_hanging, params={"m": 1.0, "k": k, "c": c}, effects=(AppliedForce(_damper),))
    x0 = -_G / k
    return HardCase(
        name,
        f"A mass hangs at rest on {k:g} N/m, {c:g} N s/m. {why}",
        _NAIVE,
        motion(scene, [x0], [0.0], t, by="m", read=position, numbers=_DEFAULTS, max_steps=8192),
        lambda m: -m * _G / k + _settles(x0 + m * _G / k, m, k, c, t),
    )


def _suspension() -> HardCase:
    def lagrangian(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
        return _hanging(t, q, qd, p) + 0.5 * qd[1] ** 2 - 20.0 * q[1] ** 2

    def forces(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
        return jnp.stack([-200.0 * qd[0], jnp.sin(3.0 * t) - 0.3 * qd[1]])

    scene = Scene(lagrangian, params={"m": 1.0, "k": 1e4}, effects=(AppliedForce(forces),))
    return HardCase(
        "rest_beside_motion",
        "A suspension of 1e4 N/m stands beside a coordinate that is driven: only the latter limits the steps.",
        "dq/dm is NaN after 20 s, with a success code.",
        motion(scene, [-_G / 1e4, 0.0], [0.0, 0.0], 20.0, by="m", read=position, max_steps=16384),
        lambda m: -m * _G / 1e4,
    )


def _on_a_stuck_mass() -> HardCase:
    def lagrangian(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
        return _hanging(t, q[1:] - q[:1], qd[1:], p) + 0.5 * qd[0] ** 2

    friction = Friction(Coulomb(20.0), along=lambda q: q[0])

    def drag(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
        return jnp.stack([0.0 * qd[0], -p["c"] * qd[1]])

    effects = (friction, AppliedForce(drag))
    scene = Scene(lagrangian, params={"m": 1.0, "k": 400.0, "c": 4.0}, effects=effects)
    x0 = -_G / 400.0
    return HardCase(
        "rest_in_stick",
        "A mass hangs at rest on another one that Coulomb friction holds.",
        _NAIVE,
        motion(
            scene, [0.0, x0], [0.0, 0.0], 1.0, by="m", read=lambda run: run.q[-1, 1], numbers=_DEFAULTS, max_steps=8192
        ),
        lambda m: -m * _G / 400.0 + _settles(x0 + m * _G / 400.0, m, 400.0, 4.0, 1.0),
        asks="position of the hanging mass at 1 s [m]",
    )


def _sliding() -> HardCase:
    """A belt holds a mass on a spring at Fc/k; with another k it moves to the new place."""

    def lagrangian(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
        return 0.5 * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2

    belt = Friction(Coulomb(1.0), belt_velocity=0.5)
    scene = Scene(lagrangian, params={"k": 100.0, "c": 20.0}, effects=(belt, AppliedForce(_damper)))
    return HardCase(
        "steady_sliding",
        "A mass on a spring stands still on a belt that slides below it: slip, but no motion.",
        "The derivative by the stiffness is 30 % off.",
        motion(scene, [0.01], [0.0], 1.1, by="k", read=position, numbers=_DEFAULTS, max_steps=8192),
        lambda k: 1.0 / k + _settles(0.01 - 1.0 / k, 1.0, k, 20.0, 1.1),
    )


def _drivetrain() -> HardCase:
    def lagrangian(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
        return 0.5 * qd[0] ** 2 + qd[1] ** 2 - 0.5e6 * (q[0] - q[1]) ** 2

    def forces(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
        return jnp.stack([p["torque"] - 50.0 * (qd[0] - qd[1]), 50.0 * (qd[0] - qd[1])])

    scene = Scene(lagrangian, params={"torque": 0.0}, effects=(AppliedForce(forces),))
    return HardCase(
        "coasting_drivetrain",
        "Two inertias coast on a shaft of 1e6 N m/rad: the shaft is at rest, and the coast is a straight line.",
        "The derivative by a torque is off by 1e8.",
        motion(scene, [0.0, 0.0], [1.0, 1.0], 2.0, by="torque", read=velocity, max_steps=16384),
        lambda torque: 1.0 + 2.0 * torque / 3.0,  # the rings of the shaft have decayed by exp(-75)
        asks="speed at 2 s [rad/s]",
        skips=dict.fromkeys(("forward float32", "reverse float32"), "the twist of the shaft is rounding: 9 % off"),
    )


def _free(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
    return 0.5 * p["m"] * qd[0] ** 2


def _since(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
    return t - p["ts"]


def _force(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
    return p["F"] * jnp.ones_like(q)


def _lead(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
    return p["lead"] * jnp.ones_like(q)


def _pushed(name: str, why: str, naive: str, friction: float, lead: float) -> HardCase:
    """A box of 2 kg pushed by F from ts on, under a constant lead that Coulomb friction holds."""
    push = Switch(_since, above=_force, name="push")
    held = (AppliedForce(_lead), Friction(Coulomb(friction))) if friction else ()
    scene = Scene(_free, params={"m": 2.0, "ts": 3.0, "F": 7.0, "lead": lead}, effects=(*held, push))
    return HardCase(
        name,
        why,
        naive,
        motion(scene, [0.0], [0.0], 10.0, by="ts", read=position),
        lambda ts: (7.0 + lead - friction) / 4.0 * (10.0 - ts) ** 2,
    )


_SIDES = {"k": (4.0, 30.0), "c": (0.1, 0.6)}


def _two_springs(level: float) -> float:
    """X at 6 s from x = 1 at rest: one spring and damper where x + 0.3 x' is below a level, others above."""
    x, now = np.array([1.0, 0.0]), 0.0
    side = int(x[0] > level)
    while True:
        a = np.array([[0.0, 1.0], [-_SIDES["k"][side], -_SIDES["c"][side]]])

        def guard(h: float, a: np.ndarray = a, x: np.ndarray = x) -> float:
            return float(expm(a * h) @ x @ (1.0, 0.3)) - level

        grid = np.linspace(1e-6, 6.0 - now, 500)
        crossed = np.flatnonzero((np.array([guard(h) for h in grid]) > 0) != bool(side))
        if not crossed.size:
            return float((expm(a * (6.0 - now)) @ x)[0])
        h = float(brentq(guard, grid[crossed[0] - 1], grid[crossed[0]], xtol=1e-15))  # pyright: ignore[reportArgumentType]
        now, x, side = now + h, expm(a * h) @ x, 1 - side


def _in_turns() -> HardCase:
    def spring(i: int, t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
        return -_SIDES["k"][i] * q - _SIDES["c"][i] * qd

    def guard(t: Array, q: Array, qd: Array, p: _Numbers) -> Array:
        return q[0] + 0.3 * qd[0] - p["level"]

    scene = Scene(
        _free,
        params={"m": 1.0, "level": 0.2},
        effects=(Switch(guard, above=partial(spring, 1), below=partial(spring, 0)),),
    )
    return HardCase(
        "two_linear_systems",
        "x' = A x, with one of two matrices by the sign of a guard of position and velocity.",
        "jnp.where between the two: derivatives without the saltation at the crossings.",
        motion(scene, [1.0], [0.0], 6.0, by="level", read=position),
        _two_springs,
        scale=0.1,
    )


def cases() -> list[HardCase]:
    """The cases of this family."""
    return [
        _hanging_mass("rest_early", "After one tenth of its time constant.", 400.0, 4.0, 0.05),
        _hanging_mass("rest_one_second", "After two time constants.", 400.0, 4.0, 1.0),
        _hanging_mass("rest_late", "After fifteen time constants.", 400.0, 4.0, 7.5),
        _hanging_mass("rest_undamped", "Nothing decays: 48 periods.", 1e4, 0.0, 3.0),
        _hanging_mass("rest_stiff", "It settles within 1e-4 s.", 1e8, 2e4, 1e-3),
        _suspension(),
        _on_a_stuck_mass(),
        _sliding(),
        _drivetrain(),
        _pushed(
            "switching_time",
            "A force that begins at a time which is a number of the scene.",
            "jnp.where(t > ts, F, 0): the derivative by ts is zero.",
            0.0,
            0.0,
        ),
        _pushed(
            "switch_out_of_stick",
            "A force that begins at a number of the scene breaks a stick at the same instant.",
            "The derivative by the time is zero, as that of a break-away whose instant is fixed.",
            3.0,
            1.0,
        ),
        _in_turns(),
    ]
