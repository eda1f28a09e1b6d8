"""Geometry: places where coordinates, mass matrices or constraints fail."""

import math
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.integrate import solve_ivp

from jaxmodsim.friction import Coulomb
from jaxmodsim.mechanics import Constraint, Spherical
from jaxmodsim.problems import cartesian_pendulum, four_bar, spherical_pendulum
from jaxmodsim.scene import AppliedForce, Friction, Scene
from jaxmodsim.simulation import Trajectory

from ..problems import rod_on_rough_floor
from .case import Answer, FunctionTask, HardCase, SceneTask, end_time, motion, position

FAMILY = "geometry"
_G = 9.81


def _third(run: Trajectory) -> Array:
    return run.q[-1, 2]


def _second(run: Trajectory) -> Array:
    return run.q[-1, 1]


def _poles() -> list[HardCase]:
    phi, t1 = 1.8, 1.0
    # Angular momentum over the speed at the bottom is the distance of passage there.
    turn = 1e-8 * math.sqrt(2.0 * _G * (1.0 + math.cos(phi))) / math.sin(phi) ** 2

    def angle(turn: float) -> float:
        return float(spherical_pendulum.motion(t1, phi, turn))

    cartesian = motion(
        cartesian_pendulum.cartesian_spherical_pendulum(),
        [math.sin(phi), 0.0, math.cos(phi)],
        [0.0, turn * math.sin(phi), 0.0],
        t1,
        by="g",
        read=_third,
    )

    def by_gravity(g: float) -> float:
        return math.cos(float(spherical_pendulum.motion(t1, phi, turn, g=g)))

    return [
        HardCase(
            "pole_passed",
            "The pendulum passes 1e-8 rad beside the pole of its coordinates, theta turning by pi within 1e-8 s.",
            "Steps over the turn: the pendulum comes back on the wrong side, or with another angular momentum.",
            motion(spherical_pendulum.scene(), [phi, 0.0], [0.0, turn], t1, by="qd0[1]", read=position),
            angle,
            asks="angle phi at 1 s [rad]",
            single_ends="step limit was reached before t1|step size fell below what the time can resolve",
        ),
        HardCase(
            "pole_start",
            "A start at the pole, where the mass matrix is singular.",
            "NaN, or a division by 1e-33.",
            motion(spherical_pendulum.scene(), [0.0, 0.0], [0.1, 0.0], t1, by="g", read=position),
            asks="the sentence",
            ends=r"singular or indefinite at coordinate q\[1\]",
        ),
        HardCase(
            "pole_cartesian",
            "The same passage in coordinates without a pole, held on the sphere by a constraint.",
            "The length drifts.",
            cartesian,
            by_gravity,
            asks="height at 1 s [m]",
            tolerance=1e-5,
        ),
        HardCase(
            "chart_at_pole",
            "Acceleration in spherical components at the pole itself, where the basis has no direction of theta.",
            "0/0 in scale factors and Christoffel symbols.",
            FunctionTask(_at_pole, 0.5, "phi' [rad/s]"),
            lambda rate: 2.0 * 2.0 * rate * 0.7,
            asks="component along theta, 2 r phi' theta' [m/s^2]",
        ),
    ]


def _at_pole(rate: Array) -> Answer:
    q = jnp.asarray([2.0, 0.0, 0.3], rate.dtype)
    qd = jnp.stack([jnp.asarray(0.1, rate.dtype), rate, jnp.asarray(0.7, rate.dtype)])
    return Answer(jnp.asarray(0), Spherical().acceleration(q, qd, jnp.zeros_like(q))[2])


def _shared(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    """A body at q[0] + q[1], and one of mass `light` at q[1], each on a spring."""
    kinetic = 0.5 * p["m"] * (qd[0] + qd[1]) ** 2 + 0.5 * p["light"] * qd[1] ** 2
    return kinetic - 0.5 * p["k"] * (q[0] + q[1]) ** 2 - 0.5 * p["light"] * q[1] ** 2


def _of_body(run: Trajectory) -> Array:
    return run.q[-1, 0] + run.q[-1, 1]


def _mass_matrices() -> list[HardCase]:
    def body(k: float) -> float:
        return math.cos(math.sqrt(k) * 5.0)

    def task(light: float) -> SceneTask:
        scene = Scene(_shared, params={"m": 1.0, "k": 1.0, "light": light})
        return motion(scene, [0.5, 0.5], [0.0, 0.0], 5.0, by="k", read=_of_body, numbers={"rtol": 1e-8, "atol": 1e-8})

    return [
        HardCase(
            "mass_nearly_singular",
            "A mass matrix of condition 4e14: two coordinates for one body and next to nothing.",
            "Inverted as it stands, the loss of 14 digits spreads to the body, too.",
            task(1e-14),
            body,
            asks="position of the body at 5 s [m]",
            single_ends="singular or indefinite at coordinate q",
        ),
        HardCase(
            "mass_singular",
            "Two coordinates for one body: no acceleration belongs to a force.",
            "Infinity, or a least-squares answer to a question that has none.",
            task(0.0),
            asks="the sentence",
            ends=r"singular or indefinite at coordinate q\[1\]",
        ),
    ]


def _gimbals(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    """A free sphere in angles of yaw, pitch and roll."""
    return 0.5 * p["J"] * (jnp.sum(qd**2) - 2.0 * qd[0] * qd[2] * jnp.sin(q[1]))


def _gimbal_lock() -> list[HardCase]:
    """It turns at a constant rate about an axis that is off the pitch axis by `off`: `sin(pitch) = sin(w t)/w`."""
    t1, off = 2.5, 1e-4

    def pitch(off: float) -> float:
        w = math.sqrt(1.0 + off**2)
        return math.asin(math.sin(w * t1) / w)

    scene = Scene(_gimbals, params={"J": 1.0})
    return [
        HardCase(
            "gimbal_passed",
            "Rotation passes gimbal lock at 1e-4 rad: yaw and roll each turn by pi in 1e-4 s.",
            "The turn is stepped over, energy jumps.",
            motion(scene, [0.0, 0.0, 0.0], [off, 1.0, 0.0], t1, by="qd0[0]", read=_second),
            pitch,
            asks="pitch at 2.5 s [rad]",
            # sin(pitch) comes as close to 1 as 5e-9; the turn of pi is resolved to the tolerance all the same.
            tolerance=1e-5,
            single=None,
        ),
        HardCase(
            "gimbal_start",
            "A start in gimbal lock.",
            "NaN, or rates of 1e16.",
            motion(scene, [0.0, 0.5 * math.pi, 0.0], [0.1, 0.0, 0.0], t1, by="J", read=_second),
            asks="the sentence",
            ends=r"singular or indefinite at coordinate q\[2\]",
        ),
    ]


@cache
def four_bar_by_scipy(angle: float, rate: float, t1: float) -> float:
    """Angle of the rocker [rad] after `t1` [s], from the equation of the crank angle alone, by DOP853 of scipy."""

    @jax.jit
    def acceleration(angle: Array, rate: Array) -> Array:
        return four_bar.acceleration(angle, rate)[0]

    def field(t: float, y: np.ndarray) -> list[float]:
        return [y[1], float(acceleration(y[0], y[1]))]

    solution = solve_ivp(field, (0.0, t1), [angle, rate], method="DOP853", rtol=1e-9, atol=1e-11)
    return float(four_bar.state(solution.y[0, -1], 0.0)[0][2])


def parallelogram_by_scipy(angle: float, rate: float, t1: float) -> float:
    """Angle [rad] of crank and rocker of a parallelogram after `t1` [s]: masses of `four_bar.PARAMS`, a crank of 0.3 m.

    The coupler does not turn, so it is a pendulum; by DOP853 of scipy.
    """
    m1, m2, m3, g = (four_bar.PARAMS[name] for name in ("m1", "m2", "m3", "g"))
    pace = g / 0.3 * (0.5 * m1 + m2 + 0.5 * m3) / (m1 / 3.0 + m2 + m3 / 3.0)

    def field(t: float, y: np.ndarray) -> list[float]:
        return [y[1], -pace * math.cos(y[0])]

    return float(solve_ivp(field, (0.0, t1), [angle, rate], method="DOP853", rtol=1e-11, atol=1e-12).y[0, -1])


def _linkages() -> list[HardCase]:
    q0, qd0 = (np.asarray(x) for x in four_bar.state(0.7, 8.0))
    once, t1 = four_bar.scene(), 0.5
    (closure,) = once.constraints
    assert isinstance(closure, Constraint)
    twice = Scene(
        once.lagrangian, params=once.params, constraints=(closure, Constraint(closure.phi, at=closure.at, name="again"))
    )
    flat = four_bar.scene(a=0.3, b=0.6, c=0.3, d=0.6)
    before, speed = (np.asarray(x) for x in four_bar.state(0.3, -8.0, a=0.3, b=0.6, c=0.3, d=0.6))
    return [
        HardCase(
            "redundant_constraints",
            "The loop of a four-bar closed twice: the equations for the multipliers are singular.",
            "LU without pivots gives NaN; the index of rank is found by luck.",
            motion(twice, q0, qd0, t1, by="g", read=_third, numbers={"rtol": 1e-8, "atol": 1e-10}),
            asks="angle of the rocker at 0.5 s [rad]",
            second=lambda: four_bar_by_scipy(0.7, 8.0, t1),
            single=None,
        ),
        HardCase(
            "dead_points",
            "A four-bar through the dead points of its rocker, where coupler and crank are in line.",
            "Equations in the rocker's angle divide by zero there.",
            motion(once, q0, qd0, t1, by="g", read=_third, numbers={"rtol": 1e-8, "atol": 1e-10}),
            asks="angle of the rocker at 0.5 s [rad]",
            second=lambda: four_bar_by_scipy(0.7, 8.0, t1),
        ),
        HardCase(
            "change_point",
            "A parallelogram folds flat: the constraints become dependent. Of the two ways to go on, only that of the"
            " parallelogram keeps the velocities.",
            "Multipliers without bound; or the other branch, with a kick.",
            motion(flat, before, speed, 0.1, by="g", read=_third),
            asks="angle of the rocker at 0.1 s [rad]",
            second=lambda: parallelogram_by_scipy(0.3, -8.0, 0.1),
            single_ends="step size fell below what the time can resolve|have become dependent",
        ),
    ]


def _lever(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    """Load of a drawer that is pulled `e` beside its middle: two reactions `F e/L` apart, for a pull of `F t`."""
    return 2.0 * p["F"] * t * p["e"] / p["L"]


def _pull(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.reshape(p["F"] * t, (1,))


def _drawer(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * qd[0] ** 2


def _jams() -> list[HardCase]:
    friction = Friction(Coulomb(0.3), normal_force=_lever)
    params = {"m": 1.0, "F": 1e6, "e": 0.4, "L": 0.2}
    drawer = Scene(_drawer, params=params, effects=(AppliedForce(_pull, name="pull"), friction))
    rod = rod_on_rough_floor.scene(mu=2.0)
    q0, qd0 = (np.asarray(x) for x in rod_on_rough_floor.state(1.1, 0.0, 1.0))
    return [
        HardCase(
            "jammed_slider",
            "A drawer pulled beside its middle: friction grows with the pull and is always 1.2 times it.",
            "Forces of 1e7 N cancel; what is left over moves the drawer.",
            motion(drawer, [0.0], [0.0], 10.0, by="F", read=position),
            lambda _: 0.0,
            scale=1.0,
        ),
        HardCase(
            "painleve_rod",
            "A rod slides on its tip at an angle where friction presses it ever harder into the floor.",
            "A negative normal force, or an acceleration through the floor.",
            motion(rod, q0, qd0, 1.0, by="g", read=end_time),
            asks="the sentence, at the start [s]",
            ends="Painleve's paradox",
        ),
    ]


def cases() -> list[HardCase]:
    """The cases of this family."""
    return [*_poles(), *_mass_matrices(), *_gimbal_lock(), *_linkages(), *_jams()]
