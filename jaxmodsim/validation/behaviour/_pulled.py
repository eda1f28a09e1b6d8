"""A mass with friction under a load: the one scene of all experiments that need inertia."""

from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ...friction import AbstractDynamicLaw, AbstractSetValuedLaw
from ...scene import AppliedForce, Friction, Scene
from ...simulation import simulate
from ...solvers import Rodas5P
from ._laws import SIGMA0, LawCase

MASS = 1.0
# Saved times of every run: of one length, so that each law is compiled once for all experiments.
TIMES = 4001
_MAX_STEPS = 2**19
_RTOL, _ATOL = 1e-6, 1e-10
_QUIET = {"k": 0.0, "pull": 0.0, "ramp": 0.0, "load": 0.0, "shake": 0.0, "frequency": 0.0}
# Time constant with which load and vibration come [s]: many periods of the mass on its contact.
_PUT_ON = 0.1
# Way [m] per sample and number of samples over which a contact that has slid is unloaded.
_BACK, _BACK_SAMPLES = 0.002 / SIGMA0, 2000


class PulledRun(NamedTuple):
    """A run of the mass, shape `[TIMES]` each: times [s], position [m], velocity [m/s], friction force [N]."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    friction: np.ndarray


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * qd[0] ** 2


def _load(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    spring = p["k"] * (p["pull"] * t - q[0])
    shaken = p["load"] + p["shake"] * jnp.sin(2.0 * jnp.pi * p["frequency"] * t)
    # Put on so gently that nothing swings beyond it.
    return jnp.reshape(spring + p["ramp"] * t + shaken * -jnp.expm1(-t / _PUT_ON), (1,))


def move(case: LawCase, t1: float, *, z0: object = None, dtmax: float = 1.0, **load: float) -> PulledRun:
    """Run the mass from rest.

    **Arguments:**

    - `case`: the law.
    - `t1`: end of the run [s].
    - `z0`: state of the law at the start; by default at rest and unloaded.
    - `dtmax`: longest adaptive step [s].
    - `load`: numbers of the load: `k` [N/m] of a spring whose end moves at `pull` [m/s], `ramp` [N/s], `load` [N],
      `shake` [N] at the `frequency` [Hz]; those left out are zero.
    """
    law, fixed = case.law, case.dt is not None
    effects = (AppliedForce(_load), Friction(law))
    scene = Scene(_lagrangian, params={"m": MASS} | _QUIET | load, effects=effects)
    if isinstance(law, AbstractDynamicLaw):
        start = {"friction": law.initial_state(jnp.zeros(())) if z0 is None else z0}
    else:
        start = None
    # Heun's method sees the jumps of the laws that need a fixed step twice in a step, and no more often.
    solver = dfx.Heun() if fixed else None if isinstance(law, AbstractSetValuedLaw) else Rodas5P()
    steps: dict[str, PyTree] = {"dt": case.dt} if fixed else {"dtmax": dtmax}
    run = simulate(
        scene,
        [0.0],
        [0.0],
        t1,
        ts=np.linspace(0.0, t1, TIMES),
        z0=start,
        rtol=_RTOL,
        atol=_ATOL,
        solver=solver,
        max_steps=_MAX_STEPS,
        adjoint=dfx.ForwardMode(),
        **steps,
    )
    return PulledRun(
        np.asarray(run.t), np.asarray(run.q)[:, 0], np.asarray(run.qd)[:, 0], np.asarray(run.forces["friction"])
    )


def after_slip(case: LawCase) -> PyTree:
    """State of a dynamic law that has just slid fast and was unloaded; None of laws without a state."""
    return _after_slip(case.law) if isinstance(case.law, AbstractDynamicLaw) else None


@jax.jit
def _after_slip(law: AbstractDynamicLaw) -> PyTree:
    """Slide for one second, then go back, and keep the state at which the force at rest is least."""
    rest = jnp.zeros(())
    here = law.bind_state(rest, rest[None], rest[None], {})
    assert isinstance(here, AbstractDynamicLaw)
    fast, dt = jnp.full_like(rest, 0.1), jnp.full_like(rest, 0.01)
    slid = jax.lax.fori_loop(0, 100, lambda _, z: here.step_exact(fast, z, dt), here.initial_state(rest))
    slow = -fast * 0.01

    def back(z: object, _: None) -> tuple[PyTree, tuple[PyTree, Array]]:
        z = here.step_exact(slow, z, _BACK / -slow)
        return z, (z, jnp.abs(here.force(rest, z)))

    _, (states, forces) = jax.lax.scan(back, slid, None, length=_BACK_SAMPLES)
    return jax.tree.map(lambda x: x[jnp.argmin(forces)], states)
