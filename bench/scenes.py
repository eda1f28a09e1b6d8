"""Scenes whose equations are counted and whose first calls are timed, differentiated by their parameters.

Chains have links of one metre and one kilogram and friction in each joint; they start at rest, raised.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from bench.tasks import BELT, TESTBENCH
from jaxmodsim.problems import bouncing_ball, n_link_pendulum, named_problems, slider_crank, worm_drive

SAMPLES, BATCH, VISCOUS, SIX = 51, 4, "two viscous joints", "six LuGre joints"
WOODPECKER = "woodpecker"
JOINT = np.array([100.0, 1.0, 0.05, 0.2, 0.3, 0.1])  # sigma0, sigma1, sigma2, Fc, Fs in N m and rad, vs in rad/s


class Task(NamedTuple):
    """A run of a scene that is built from parameters, a pytree of arrays."""

    make: Callable[[Any], jms.Scene]
    numbers: Any
    q0: np.ndarray
    qd0: np.ndarray
    t1: float

    def total(self, p: Any, **options: Any) -> tuple[Any, Any]:
        """Sum of the saved positions of the run with the parameters `p`, and its number of steps."""
        ts = np.linspace(0.0, self.t1, SAMPLES)
        run = jms.simulate(self.make(p), self.q0, self.qd0, self.t1, ts=ts, throw=False, **options)
        return jnp.sum(run.q), run.stats["num_steps"]

    def ways(self) -> dict[str, Callable[[Any], Any]]:
        """The run, its derivatives and a batch of it, as functions of the parameters."""
        return {
            "run": self.total,
            "gradient": jax.grad(self.total, has_aux=True),
            "jacobian": jax.jacfwd(self.total, has_aux=True),
            "batch": lambda p: jax.vmap(self.total)(jax.tree.map(lambda x: jnp.stack([x] * BATCH), p)),
        }


def chain(n: int, law: Callable[[Any], Any]) -> Task:
    """A chain of `n` links with a law in each joint."""

    def make(p: Any) -> jms.Scene:
        base = n_link_pendulum.scene(n)
        joints = tuple(jms.Friction(law(p), along=lambda q, i=i: q[i]) for i in range(n))
        return jms.Scene(base.lagrangian, params=base.params, effects=joints)

    return Task(make, JOINT, 0.5 + 0.1 * np.arange(n), np.zeros(n), 5.0)


def fixed(scene: jms.Scene, q0: Any, qd0: Any, t1: float) -> Task:
    """A given scene, differentiated by all of its numbers."""
    return Task(lambda p: p, jax.tree.map(lambda x: jnp.asarray(x, float), scene), np.array(q0), np.array(qd0), t1)


def shaken_table() -> jms.Scene:
    """A ball that bounces on a vibrating table, with friction along it."""

    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t
        return 0.5 * jnp.sum(qd**2) - p["g"] * q[1]

    table = jms.Contact(lambda t, q, p: q[1] - p["A"] * jnp.sin(p["omega"] * t), restitution=0.6, name="table")
    friction = jms.Friction(jms.Coulomb(0.3), along=lambda q: q[0], normal_force="table")
    return jms.Scene(lagrangian, {"g": 9.81, "A": 1e-3, "omega": 120.0}, (friction,), (table,))


def woodpecker() -> jms.Scene:
    """The woodpecker toy: three rigid contacts with friction between a sleeve, a bird on a spring, and a pole.

    Model and numbers: R. I. Leine, D. H. van Campen, C. Glocker, Nonlinear dynamics and modeling of various wooden
    toys with impact and friction, J. Vibration and Control 9 (2003) 25-78.
    """
    params = {"m": 3e-4, "J": 5e-9, "mb": 4.5e-3, "Jb": 7e-7, "c": 5.6e-3, "g": 9.81, "l": 0.010, "lb": 0.015}
    radius, gap, h, beak = 0.0031, 0.0006, 0.0058, 0.02

    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t
        bird = qd[0] + p["l"] * qd[1] + p["lb"] * qd[2]
        kinetic = p["m"] * qd[0] ** 2 + p["J"] * qd[1] ** 2 + p["mb"] * bird**2 + p["Jb"] * qd[2] ** 2
        height = p["m"] * q[0] + p["mb"] * (q[0] + p["l"] * q[1] + p["lb"] * q[2])
        return 0.5 * (kinetic - p["c"] * (q[1] - q[2]) ** 2) - p["g"] * height

    def touch(name: str, distance: Callable[[Any], Any], along: Callable[[Any], Any], e: float) -> tuple[Any, Any]:
        contact = jms.Contact(lambda _t, q, _p: distance(q), restitution=e, name=name)
        return contact, jms.Friction(jms.Coulomb(0.3), along=along, normal_force=name, name=f"friction of the {name}")

    def sleeve(q: Any) -> Any:
        return q[0] + radius * q[1]

    pairs = (
        touch("beak", lambda q: 0.0024 - beak * q[2], lambda q: q[0] + 0.01 * q[1] - 0.0051 * q[2], 0.5),
        touch("lower edge", lambda q: gap + h * q[1], sleeve, 0.0),
        touch("upper edge", lambda q: gap - h * q[1], sleeve, 0.0),
    )
    contacts, frictions = zip(*pairs, strict=True)
    return jms.Scene(lagrangian, params, frictions, contacts)


def lugre(p: Any) -> jms.LuGre:
    """A LuGre law with six parameters."""
    return jms.LuGre(*(p[i] for i in range(6)))


def coulomb(p: Any) -> jms.Coulomb:
    """A law with one of these parameters."""
    return jms.Coulomb(p[3])


# Scenes whose first calls are timed, differentiated by a few parameters.
TIMED: dict[str, Callable[[], Task]] = {
    VISCOUS: lambda: chain(2, lambda p: jms.Viscous(p[2])),
    "LuGre box": lambda: Task(TESTBENCH.scene, np.array(TESTBENCH.numbers), np.zeros(1), np.zeros(1), TESTBENCH.t1),
    "Coulomb belt": lambda: Task(BELT.scene, np.array(BELT.numbers), np.zeros(1), np.zeros(1), BELT.t1),
    "two LuGre joints": lambda: chain(2, lugre),
    "two Coulomb joints": lambda: chain(2, coulomb),
    "three LuGre joints": lambda: chain(3, lugre),
    SIX: lambda: chain(6, lugre),
}


def _named(name: str) -> Task:
    case = named_problems()[name]()
    return fixed(case.scene, case.q0, case.qd0, case.t1)


# Scenes that are timed, too, differentiated by all of their numbers; that of the last one compiles for minutes.
LARGE: dict[str, Callable[[], Task]] = {
    "ball on a shaken table": lambda: fixed(shaken_table(), [0.0, 0.1], [0.5, 0.0], 2.0),
    "slider-crank": lambda: fixed(slider_crank.scene(torque=2.3), *slider_crank.state(0.7, 8.0), 1.0),
    WOODPECKER: lambda: fixed(woodpecker(), [0.0, -0.1034, -0.2788], [-0.3411, 0.0, -7.4583], 0.2),
}

SCENES: dict[str, Callable[[], Task]] = {
    **TIMED,
    **LARGE,
    "ball on a floor": lambda: fixed(bouncing_ball.scene(e=0.8), [1.0], [0.0], 2.0),
    "worm drive": lambda: fixed(worm_drive.scene(motor=0.9), *worm_drive.state(0.0), 0.05),
    **{name: partial(_named, name) for name in named_problems()},
}
