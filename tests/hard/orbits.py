"""Periodic orbits: unstable, doubled, stiff, sticking often, throughout or hardly, advancing, refused in float32."""

import math
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, root

from jaxmodsim.friction import Coulomb, LuGre, Stribeck, Viscous
from jaxmodsim.orbits import PeriodicOrbit, continue_orbits, periodic_orbit
from jaxmodsim.problems import belt_oscillator, coupled_belts
from jaxmodsim.scene import AppliedForce, Friction, Scene
from jaxmodsim.simulation import simulate

from ..problems import vibrating_table
from .case import HardCase, MeasuredNumber, RefusedCalls

FAMILY = "periodic orbits"
# A bounce a period, past its period doubling.
_TABLE = {"g": 9.81, "A": 1.1e-3, "omega": 120.0, "e": 0.6}
# Bounces of two heights in turn.
_TWICE = {**_TABLE, "A": 0.95e-3}


def _table_period(p: dict[str, Array]) -> Array:
    return 2.0 * math.pi / p["omega"]


def _unstable_multiplier() -> float:
    p, T = _TABLE, 2.0 * math.pi / _TABLE["omega"]
    phase = float(vibrating_table.bounce_phase(**p))
    since = T - phase / p["omega"]
    q0 = p["A"] * math.sin(phase) + 0.5 * p["g"] * since * (T - since)
    guess = ([1.001 * q0], [p["g"] * (0.5 * T - since)])
    orbit = periodic_orbit(vibrating_table.scene(**p), guess, period=_table_period, settle=0.0)
    return float(np.min(np.real(orbit.multipliers)))


def _exact_multiplier() -> float:
    """Of the map of one bounce, of which the determinant is e^2 and the trace follows from the table's acceleration."""
    p = _TABLE
    fall = p["A"] * p["omega"] ** 2 * math.sin(float(vibrating_table.bounce_phase(**p)))
    trace = 1.0 + p["e"] ** 2 - (1.0 + p["e"]) ** 2 * fall / p["g"]
    return 0.5 * trace - math.sqrt(0.25 * trace**2 - p["e"] ** 2)


def _guess_of_two_bounces() -> tuple[list[float], list[float]]:
    """A start beside a bounce a period, from which the ball comes to bounces of two heights."""
    p, T = _TWICE, 2.0 * math.pi / _TWICE["omega"]
    phase = float(vibrating_table.bounce_phase(**p))
    since = T - phase / p["omega"]
    return [p["A"] * math.sin(phase) + 0.5 * p["g"] * since * (T - since)], [1.01 * p["g"] * (0.5 * T - since)]


def _two_periods(p: dict[str, Array]) -> Array:
    return 2.0 * _table_period(p)


def _top_of_two_bounces() -> float:
    orbit = periodic_orbit(vibrating_table.scene(**_TWICE), _guess_of_two_bounces(), period=_two_periods, settle=40.0)
    return float(orbit.highest[0])


def _exact_top() -> float:
    """Of two parabolas between two impacts: equations for the times of impacts and the velocities behind them."""
    g, A, omega, e = (_TWICE[name] for name in ("g", "A", "omega", "e"))
    T = 2.0 * math.pi / omega

    def misses(x: np.ndarray) -> list[float]:
        (one, two), v = x[:2] / omega, x[2:] * g * T
        flights = ((one, v[0], two, v[1]), (two, v[1], one + 2.0 * T, v[0]))
        out = []
        for begin, start, end, after in flights:
            fall, table = end - begin, A * omega * math.cos(omega * end)
            out.append(A * (math.sin(omega * begin) - math.sin(omega * end)) + start * fall - 0.5 * g * fall**2)
            out.append(after - table + e * (start - g * fall - table))
        return [omega**2 * out[0] / g, out[1] / (g * T), omega**2 * out[2] / g, out[3] / (g * T)]

    phase = float(vibrating_table.bounce_phase(**_TWICE))
    x = root(misses, [phase + 0.3, phase - 0.5 + 2.0 * math.pi, 0.6, 0.4], tol=1e-14).x
    tops = A * np.sin(x[:2]) + 0.5 * (x[2:] * g * T) ** 2 / g
    return float(np.max(tops))


def _spring(t: Array, q: Array, qd: Array, p: PyTree) -> Array:
    del t, p
    return 0.5 * jnp.square(qd[0]) - 0.5 * jnp.square(q[0])


def _swing(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    del q, qd
    return jnp.reshape(jnp.cos(p["W"] * t), (1,))


def _swing_period(p: dict[str, Array]) -> Array:
    return 2.0 * math.pi / p["W"]


def _forced(W: float, Fc: float, Fs: float, c: float) -> Scene:
    """Mass and stiffness one under the force cos(W t), with dry friction and a damper."""
    effects = (AppliedForce(_swing), Friction(Coulomb(Fc, Fs)), Friction(Viscous(c), name="damper"))
    return Scene(_spring, params={"W": W}, effects=effects)


def _by_forced_orbit(scene: Scene) -> float:
    return float(periodic_orbit(scene, ([0.0], [0.0]), period=_swing_period).q[0])


def _by_settling(scene: Scene, periods: int) -> float:
    t1 = periods * _swing_period(scene.params)
    return float(simulate(scene, [0.0], [0.0], t1, rtol=1e-11, atol=1e-13, max_steps=400_000, max_events=4096).q[-1, 0])


def _orbit(scene: Scene, settle: float) -> PeriodicOrbit:
    rest = [0.0] * len(scene.effects)
    return periodic_orbit(scene, (rest, rest), settle=settle)


def _period(scene: Scene, settle: float) -> float:
    return float(_orbit(scene, settle).period)


def _period_by_settling(scene: Scene, settle: float) -> float:
    """Time between the last two passages of the first mass through the middle of its way, in a long run."""
    ts = np.linspace(settle - 3.0, settle, 6001)
    rest = [0.0] * len(scene.effects)
    run = simulate(scene, rest, rest, settle, ts=ts, rtol=1e-11, atol=1e-13, max_steps=400_000, max_events=4096)
    x, v = np.asarray(run.q[:, 0]), np.asarray(run.qd[:, 0])
    level = 0.5 * (x.min() + x.max())
    up = np.flatnonzero((x[:-1] < level) & (x[1:] >= level))
    # On the cubic of both ends.
    h, passages = ts[1] - ts[0], []
    for i in up[-2:]:
        a, b = x[i + 1] - x[i], h * v[i]
        cubic = [b + h * v[i + 1] - 2.0 * a, 3.0 * a - 2.0 * b - h * v[i + 1], b, x[i] - level]
        roots = np.roots(cubic)
        passages.append(ts[i] + h * min((r.real for r in roots if abs(r.imag) < 1e-9), key=lambda s: abs(s - 0.5)))
    return float(passages[1] - passages[0])


def _two_masses(t: Array, q: Array, qd: Array, p: PyTree) -> Array:
    del t, p
    return 0.5 * jnp.sum(jnp.square(qd)) - 0.5 * jnp.square(q[0]) - 0.25 * jnp.square(q[1] - q[0])


def _on_the_first(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    del q
    return jnp.stack([jnp.cos(p["W"] * t) - 0.2 * qd[0], jnp.zeros_like(t)])


def _second(q: Array) -> Array:
    return q[1]


def _beside_a_held_mass() -> float:
    """The mass that moves swings about the place in which a spring of 0.5 N/m to the held one leaves it."""
    effects = (AppliedForce(_on_the_first), Friction(Coulomb(2.0), along=_second))
    scene = Scene(_two_masses, params={"W": 0.7}, effects=effects)
    return float(periodic_orbit(scene, ([0.0, 0.3], [0.0, 0.0]), period=_swing_period).highest[0])


# A box that is pulled over a floor by F0 + F1 cos(W t).
_BOX = {"m": 1.3, "F0": 1.0, "F1": 2.5, "W": 2.0}
_FLOOR = 2.0


def _free(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    del t, q
    return 0.5 * p["m"] * jnp.square(qd[0])


def _pull(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    del q, qd
    return jnp.reshape(p["F0"] + p["F1"] * jnp.cos(p["W"] * t), (1,))


def _advance_of_a_box() -> float:
    scene = Scene(_free, params=_BOX, effects=(AppliedForce(_pull), Friction(Coulomb(_FLOOR))))
    return float(periodic_orbit(scene, ([0.0], [0.0]), period=_swing_period).advance[0])


def _exact_advance() -> float:
    """It slips from where the force exceeds friction until its velocity, in closed form, is zero again."""
    m, F0, F1, W = (_BOX[name] for name in ("m", "F0", "F1", "W"))
    begin, mean = -math.acos((_FLOOR - F0) / F1) / W, F0 - _FLOOR

    def momentum(t: float) -> float:
        return mean * (t - begin) + F1 / W * (math.sin(W * t) - math.sin(W * begin))

    end: float = brentq(momentum, 0.0, begin + 2.0 * math.pi / W, xtol=1e-14)  # pyright: ignore[reportAssignmentType]
    s = end - begin
    wave = math.cos(W * begin) - math.cos(W * end) - W * s * math.sin(W * begin)
    return (0.5 * mean * s**2 + F1 / W**2 * wave) / m


# A damped mass on a belt whose friction falls: up to some speed of the belt it sticks and slips.
_FALLING, _DAMPER = {"Fc": 5.0, "Fs": 8.0, "vs": 0.2}, 2.0


def _speed_where_stick_shrinks() -> float:
    scene = belt_oscillator.scene(Stribeck(**_FALLING), c=_DAMPER, belt=0.61)
    branch = continue_orbits(
        *(scene, ([0.0], [0.61]), "friction.belt_velocity", (0.61, 0.66)), settle=20.0, step=0.4, rtol=1e-9
    )
    (point,) = branch.points
    return point.value if not branch.stable[-1] and "end of the span" in branch.ending else math.nan


def _speed_where_slip_touches() -> float:
    """At which the cycle of slip alone, from a touch of the speed of the belt, comes to the next touch."""
    k, (Fc, Fs, vs) = belt_oscillator.PARAMS["k"], _FALLING.values()

    def misses(belt: float) -> float:
        def rate(_: float, y: np.ndarray) -> list[float]:
            friction = Fc + (Fs - Fc) * math.exp(-(((belt - y[1]) / vs) ** 2))
            return [y[1], friction - k * y[0] - _DAMPER * y[1]]

        def fastest(t: float, y: np.ndarray) -> float:
            return rate(t, y)[1]

        start = [(Fs - _DAMPER * belt) / k, belt]
        run = solve_ivp(rate, (0.0, 1.0), start, "DOP853", events=fastest, rtol=1e-12, atol=1e-13)
        assert run.y_events is not None
        return max(y[1] for y in run.y_events[0][1:]) - belt

    return float(brentq(misses, 0.55, 0.7, xtol=1e-12))  # pyright: ignore[reportArgumentType]


def _single() -> object:
    single = jtu.tree_map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, belt_oscillator.scene())
    return periodic_orbit(single, ([0.0], [0.0]), settle=20.0)


def _found(
    name: str,
    why: str,
    naive: str,
    fn: Callable[[], float],
    right: Callable[[], float],
    asks: str,
    tolerance: float = 1e-8,
) -> HardCase:
    """A number of an orbit, and the right one."""
    return HardCase(name, why, naive, MeasuredNumber(fn), lambda _: right(), asks=asks, tolerance=tolerance)


def _without_return() -> list[HardCase]:
    """Orbits along which something does not return, or is not determined."""
    return [
        _found(
            "orbit_beside_a_held_mass",
            "One of two coupled masses sticks throughout: its place is that in which it was put.",
            "Equations that are singular along its place, in which Newton's iteration wanders.",
            _beside_a_held_mass,
            lambda: 0.1 + 1.0 / abs(1.5 - 0.49 + 0.14j),
            "greatest position of the other [m]",
        ),
        _found(
            "orbit_that_advances",
            "A box is pulled over a floor, sticks and slips, and never returns to where it was.",
            "A search for a state that returns finds none.",
            _advance_of_a_box,
            _exact_advance,
            "advance in a period [m]",
        ),
        _found(
            "orbit_stick_shrinks",
            "A branch of stick-slip comes to where its stick shrinks to a point, and turns back without stick.",
            "The derivative of the return map jumps there: a step along the tangent finds no orbit.",
            _speed_where_stick_shrinks,
            _speed_where_slip_touches,
            "speed of the belt [m/s]",
            tolerance=1e-6,
        ),
    ]


def cases() -> list[HardCase]:
    """The cases of this family."""
    bristles = belt_oscillator.scene(LuGre(sigma0=1e5, sigma1=300.0, sigma2=0.4, Fc=5.0, Fs=8.0, vs=0.1))
    belts = coupled_belts.scene()
    sticky, grazing = _forced(0.05, 0.03, 0.06, 0.0), _forced(0.6168, 0.5, 0.5, 0.1)

    return [
        _found(
            "orbit_unstable",
            "A ball bounces once a period, though any disturbance doubles from bounce to bounce.",
            "A simulation leaves the orbit, however long it runs.",
            _unstable_multiplier,
            _exact_multiplier,
            "largest multiplier",
        ),
        _found(
            "orbit_period_two",
            "A ball bounces to two heights in turn, on a table beyond the doubling of its period.",
            "The orbit of one period is near, and solves the equations too.",
            _top_of_two_bounces,
            _exact_top,
            "highest position [m]",
        ),
        _found(
            "orbit_bristles",
            "Stick-slip of a belt with bristles of 1e5 N/m: multipliers of 1 and next to nothing.",
            "Shooting in the bristles' own small unit, or steps of microseconds.",
            partial(_period, bristles, 20.0),
            lambda: _period_by_settling(bristles, 40.0),
            "period [s]",
        ),
        _found(
            "orbit_two_belts",
            "Two coupled masses on a belt stick and slip in turns.",
            "The sequence of modes changes under the iteration.",
            partial(_period, belts, 60.0),
            lambda: _period_by_settling(belts, 120.0),
            "period [s]",
        ),
        _found(
            "orbit_many_sticks",
            "Slow forcing: sixteen phases of stick in a period.",
            "Each takes a direction away; differences of the return map see nothing.",
            partial(_by_forced_orbit, sticky),
            lambda: _by_settling(sticky, 40),
            "position at the start [m]",
        ),
        _found(
            "orbit_nearly_grazing",
            "A forced mass that has just ceased to stick at its turning points.",
            "The derivative of the return map jumps next to the orbit.",
            partial(_by_forced_orbit, grazing),
            lambda: _by_settling(grazing, 60),
            "position at the start [m]",
        ),
        *_without_return(),
        HardCase(
            "orbit_in_single_precision",
            "Shooting in float32.",
            "A residual that never falls, or an orbit that is none.",
            RefusedCalls({"float32": _single}, {"float32": "needs float64"}),
            asks="a sentence that asks for float64",
        ),
    ]
