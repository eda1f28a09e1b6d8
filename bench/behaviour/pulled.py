"""A mass with friction under a load: the scene of the experiments with inertia."""

from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from bench.behaviour.experiment import (
    DEFLECTION,
    FC,
    FS,
    SIGMA0,
    VS,
    Experiment,
    FigureLine,
    LawCase,
    LawMeasurement,
    Threshold,
)
from jaxmodsim.friction import AbstractDynamicLaw, AbstractSetValuedLaw
from jaxmodsim.scene import AppliedForce, Friction, Scene
from jaxmodsim.simulation import simulate
from jaxmodsim.solvers import Rodas5P

MASS = 1.0
# Number of saved times of every run, the same for all, so that each law is compiled once.
TIMES = 4001
_MAX_STEPS = 2**19
_RTOL, _ATOL = 1e-6, 1e-10
_QUIET = {"k": 0.0, "pull": 0.0, "ramp": 0.0, "load": 0.0, "shake": 0.0, "frequency": 0.0}
# Time constant of the rise of load and vibration [s]: many periods of the mass on its contact.
_PUT_ON = 0.1
# Distance [m] per sample and number of samples of the unloading of a contact after slip.
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
    # The load rises so slowly that there is no overshoot.
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
    # Laws with jumps need a fixed step; Heun's method evaluates them only twice per step.
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
    """State of a dynamic law after fast slip and unloading; None for laws without a state."""
    return _after_slip(case.law) if isinstance(case.law, AbstractDynamicLaw) else None


@jax.jit
def _after_slip(law: AbstractDynamicLaw) -> PyTree:
    """Slide for one second, then return; gives the state with the smallest force at rest."""
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


# Rates of the load [N/s].
RATES = np.geomspace(0.1, 100.0, 7)
# Largest load [N], and the smallest velocity [m/s] of sliding.
_MOST, _SLIDES = 1.7 * FS, 10.0 * VS


def _break_away(case: LawCase) -> LawMeasurement:
    """Pull a mass with a rising force; measure the largest friction before it slides, at slow and fast rates."""
    z0 = after_slip(case)
    forces = []
    for rate in RATES:
        run = move(case, _MOST / rate, z0=z0, ramp=float(rate), dtmax=0.01 * _MOST / rate)
        slides = run.v > _SLIDES
        end = int(np.argmax(slides)) if slides.any() else run.v.size
        forces.append(float(np.max(run.friction[: max(end, 1)])))
    lines = (FigureLine("", RATES, np.asarray(forces)),)
    if forces[0] < 0.1 * FC:
        return LawMeasurement(float("nan"), "Nothing sticks, so nothing breaks away.", lines)
    return LawMeasurement(
        (forces[0] - forces[-1]) / forces[0],
        f"Breaks away at {forces[0]:.3g} N under {RATES[0]:g} N/s and at {forces[-1]:.3g} N under {RATES[-1]:g} N/s.",
        lines,
    )


# The threshold is 5 %, the resolution of measured break-away forces.
BREAK_AWAY = Experiment(
    "break-away",
    "Break-away force against the rate of the load, shortly after a slip",
    "fall of the break-away force from 0.1 N/s to 100 N/s, relative",
    "1",
    Threshold(0.05, at_most=False),
    ("force rate [N/s]", "break-away force [N]"),
    (0.9, 1.6),
    _break_away,
    log_x=True,
)

# Mean load [N], vibration [N] at the frequency [Hz], duration [s]; the load stays below the Coulomb force of 1 N.
_LOAD, _SHAKE, _FREQUENCY, _CREEPS = 0.4, 0.2, 5.0, 10.0
# Time spans [s] of whole periods, between whose mean positions the drift is measured.
_EARLY, _LATE = (1.0, 2.0), (9.0, 10.0)


def _creep(case: LawCase) -> LawMeasurement:
    """Load a mass at rest, and measure its drift under the constant load."""
    run = move(case, _CREEPS, load=_LOAD, shake=_SHAKE, frequency=_FREQUENCY, dtmax=0.1 / _FREQUENCY)
    early, late = (run.q[(run.t > start) & (run.t <= end)].mean() for start, end in (_EARLY, _LATE))
    drift = 1e6 * float(abs(late - early))
    return LawMeasurement(
        drift,
        f"Drifts by this way in {_LATE[0] - _EARLY[0]:g} s under {_LOAD:g} N and a vibration of {_SHAKE:g} N.",
        (FigureLine("", run.t, 1e6 * run.q),),
    )


# The threshold is a hundredth of the break-away deflection.
CREEP = Experiment(
    "creep",
    "Creep: a mass under 0.4 N and a vibration of 0.2 N at 5 Hz, below break-away",
    "drift",
    "um",
    Threshold(1e4 * DEFLECTION, at_most=True),
    ("time [s]", "displacement [um]"),
    (-5.0, 225.0),
    _creep,
)

# Stiffness [N/m], velocity of the spring's end [m/s] and duration [s].
_K, _PULL, _T1 = 2.0, 0.1, 40.0
# Largest velocity of rest, relative to the pull: above the creep of smooth laws and the Karnopp band. An undamped
# oscillation that touches zero is below it for 2 % of its period. The velocity is averaged over this number of samples
# to either side, 10 ms, to suppress the vibration of the mass on its contact.
_REST, _SPAN = 2e-3, 5


def _stick_slip(case: LawCase) -> LawMeasurement:
    """Pull the mass, and measure the time at rest in the second half of the run."""
    run = move(case, _T1, k=_K, pull=_PULL, dtmax=0.1)
    late = run.t >= 0.5 * _T1
    ahead, behind = np.roll(run.q, -_SPAN), np.roll(run.q, _SPAN)
    rests = np.abs(ahead - behind) < _REST * _PULL * 2 * _SPAN * (run.t[1] - run.t[0])
    late &= run.t <= run.t[-_SPAN - 1]
    share = float(np.mean(rests[late]))
    spring = _K * (_PULL * run.t - run.q)
    starts = run.t[1:][~rests[1:] & rests[:-1] & late[1:]]
    period = f"period {np.mean(np.diff(starts)):.3g} s, " if starts.size > 1 else ""
    return LawMeasurement(
        share,
        f"In the second half of the run the mass rests for this part of the time: {period}spring force from"
        f" {spring[late].min():.3g} N to {spring[late].max():.3g} N.",
        (FigureLine("end of the spring", run.t, _PULL * run.t, reference=True), FigureLine("mass", run.t, run.q)),
    )


# The threshold is a tenth of the time at rest, five times that of an oscillation without stick.
STICK_SLIP = Experiment(
    "stick-slip",
    "Stick-slip: a mass of 1 kg pulled through a spring of 2 N/m at 0.1 m/s",
    "time at rest over time",
    "1",
    Threshold(0.1, at_most=False),
    ("time [s]", "position [m]"),
    (0.0, 4.2),
    _stick_slip,
)
