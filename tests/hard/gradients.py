"""Gradients at places where differentiation likes to fail."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.integrate import solve_ivp

from jaxmodsim.friction import Coulomb, LuGre, Stribeck
from jaxmodsim.problems import braked_spring, ramped_box
from jaxmodsim.scene import AppliedForce, Friction, Scene

from .case import HardCase, motion, position, velocity

FAMILY = "gradients"


def _plate(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * jnp.sum(qd**2)


def _place(q: Array) -> Array:
    return q


def _sideways(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.stack([p["F"], 0.0 * p["F"]])


def _planar() -> HardCase:
    """At rest, unloaded: a force F moves the plate by F/sigma0 as the bristle settles, to first order in F."""
    law = LuGre(sigma0=100.0, sigma1=20.0, sigma2=0.0, Fc=1.5, Fs=1.75, vs=0.2)
    scene = Scene(
        _plate,
        params={"m": 1.0, "F": 0.0},
        effects=(AppliedForce(_sideways, name="pull"), Friction(law, along=_place)),
    )
    return HardCase(
        "plane_at_rest",
        "Friction in the plane at zero slip, unloaded: the direction of slip is 0/0.",
        "NaN from the norm of a zero vector.",
        motion(scene, [0.0, 0.0], [0.0, 0.0], 5.0, by="F", read=position, numbers={"dtmax": 0.05}),
        lambda F: F / 100.0,
        asks="position at 5 s [m], and its derivative by the force, 1/sigma0",
        scale=0.01,
        conserves=False,
    )


def _equilibrium() -> HardCase:
    return HardCase(
        "equilibrium",
        "A mass on a spring, at rest where it is relaxed: nothing moves, so nothing limits the steps.",
        "The derivative of one step of five seconds: a polynomial where a cosine should be.",
        motion(Scene(_held, params={"x0": 0.0}), [0.0], [0.0], 5.0, by="x0", read=position),
        lambda x0: x0 - x0 * math.cos(5.0),
        asks="position at 5 s [m], and its derivative by the place of rest",
        scale=1.0,
        conserves=False,
    )


def _held(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * qd[0] ** 2 - 0.5 * (q[0] - p["x0"]) ** 2


def _resting_place() -> HardCase:
    def exact(Fc: float) -> float:
        return float(braked_spring.rest(**(braked_spring.PARAMS | {"Fc": Fc})).x)

    return HardCase(
        "resting_place",
        "Where the mass stops depends on Fc through all twelve reversals: -(-1)^N 2 N/k.",
        "Differentiated sign functions have no derivative: zero, or that of the last half cycle.",
        motion(braked_spring.scene(braked_spring.coulomb()), [1.0], [0.0], 30.0, by="friction.Fc", read=position),
        exact,
        asks="resting place [m]",
    )


def cases() -> list[HardCase]:
    """The cases of this family."""
    box = ramped_box.scene(Coulomb(1.5))
    falling = ramped_box.scene(Stribeck(Fc=1.5, Fs=1.75, vs=0.2, exponent=1.0))
    return [
        _planar(),
        _equilibrium(),
        _resting_place(),
        HardCase(
            "event_at_the_end",
            "The run ends at the very instant of break-away.",
            "The event is handled in one run and not in the next: derivatives of either side, or NaN.",
            motion(box, [0.0], [0.0], 1.5, by="ramp", read=velocity),
            lambda _: 0.0,
            scale=1.0,
        ),
        HardCase(
            "start_at_rest",
            "The derivative by a velocity that stick takes away at once: x = m v0^2/(2 Fc), so zero.",
            "One second, as if nothing stuck.",
            motion(box, [0.0], [0.0], 1.0, by="qd0[0]", read=position),
            lambda _: 0.0,
            scale=1.0,
        ),
        HardCase(
            "cusp_of_stribeck",
            "A Stribeck curve with a cusp at v = 0, exp(-|v|/vs), from break-away on.",
            "NaN from |v|**a at zero, or the derivative of the wrong side.",
            motion(falling, [0.0], [0.0], 3.0, by="friction.Fs", read=velocity),
            second=cusp_by_scipy,
        ),
    ]


def cusp_by_scipy() -> float:
    """Velocity of the box at 3 s from its break-away at 1.75 s on, by LSODA of scipy."""

    def field(t: float, v: np.ndarray) -> list[float]:
        return [(t - 1.5 - 0.25 * math.exp(-abs(v[0]) / 0.2)) / 2.0]

    return float(solve_ivp(field, (1.75, 3.0), [0.0], method="LSODA", rtol=1e-11, atol=1e-13).y[0, -1])
