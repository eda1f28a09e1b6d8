"""The largest step at which a method is stable on a law: found by running it, and held against theory."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jaxmodsim.friction import AbstractLaw, LuGre, Regularized, Viscous, max_stable_step
from jaxmodsim.problems import bristles, ramped_box
from jaxmodsim.scene import Scene
from jaxmodsim.simulation import Trajectory, simulate
from jaxmodsim.solvers import ImplicitFriction, Rodas5P

from .case import HardCase, MeasuredNumber

# Steps of a trial: at half a percent beyond the limit a disturbance grows thousandfold in them.
_STEPS = 3000
# A disturbance that grows by this much grows.
_GROWS = 10.0
# The limit is looked for from half of what theory says to twice that.
_BISECTIONS = 12
# A method without a limit must hold at this many times the limit of Euler's.
_FAR = 1e6

_V = 0.1
_BRISTLE = {"sigma0": 1e5, "sigma2": 0.1, "Fc": 1.5, "Fs": 1.75, "vs": 0.2}
_M = 2.0


@dataclass(frozen=True)
class Formulation:
    """A law in the state at which it is the stiffest, disturbed a little.

    - `scene`, `z0`, `qd0`: the motion.
    - `law`, `m`, `v`: for `max_stable_step`.
    - `off`: how far from rest a run ended, relative to the disturbance.
    """

    name: str
    scene: Scene
    z0: dict[str, PyTree] | None
    qd0: float
    law: AbstractLaw
    m: float | None
    v: float
    off: Callable[[Trajectory], Array]


def formulations() -> dict[str, Formulation]:
    """A bristle in slip and in stick, friction smoothed over 1e-6 m/s, viscous friction."""
    bristle, damped = LuGre(**_BRISTLE, sigma1=0.0), LuGre(**_BRISTLE, sigma1=300.0)
    steady = (1.5 + 0.25 * math.exp(-((_V / 0.2) ** 2))) / 1e5
    smooth = Regularized(ramped_box.coulomb(), width=1e-6)
    each = [
        Formulation(
            "bristle in slip",
            bristles.slipping_bristle(bristle, _V),
            {"friction": jnp.asarray(steady * (1.0 + 1e-6))},
            0.0,
            bristle,
            None,
            _V,
            lambda run: (run.z["friction"][-1] - steady) / (1e-6 * steady),
        ),
        Formulation(
            "bristle in stick",
            ramped_box.scene(damped, ramp=0.0, m=_M),
            {"friction": jnp.asarray(1e-12)},
            0.0,
            damped,
            _M,
            0.0,
            lambda run: run.z["friction"][-1] / 1e-12,
        ),
        Formulation(
            "regularised",
            ramped_box.scene(smooth, ramp=0.0, m=_M),
            None,
            1e-12,
            smooth,
            _M,
            0.0,
            lambda run: run.qd[-1, 0] / 1e-12,
        ),
        Formulation(
            "viscous",
            ramped_box.scene(Viscous(1e3), ramp=0.0, m=_M),
            None,
            1.0,
            Viscous(1e3),
            _M,
            0.0,
            lambda run: run.qd[-1, 0],
        ),
    ]
    return {formulation.name: formulation for formulation in each}


EXPLICIT = {
    "Euler": dfx.Euler(),
    "Heun": dfx.Heun(),
    "Bosh3": dfx.Bosh3(),
    "Tsit5": dfx.Tsit5(),
    "Dopri8": dfx.Dopri8(),
}
IMPLICIT = {"Rodas5P": Rodas5P(pivot=True), "ImplicitFriction": ImplicitFriction()}


def theory(formulation: Formulation, solver: dfx.AbstractSolver) -> float:
    """Largest stable step [s] by `max_stable_step`: the stability function at the eigenvalues."""
    return max_stable_step(formulation.law, formulation.m, v=formulation.v, solver=solver)


def grows(formulation: Formulation, solver: dfx.AbstractSolver, h: float) -> bool:
    """Whether the disturbance has grown after so many steps of `h` [s]."""
    run = simulate(
        formulation.scene,
        [0.0],
        [formulation.qd0],
        _STEPS * h,
        z0=formulation.z0,
        dt=h,
        solver=solver,
        max_steps=_STEPS + 2,
        throw=False,
    )
    return not (bool(run.result.ok) and abs(float(formulation.off(run))) < _GROWS)


def largest_step(formulation: Formulation, solver: dfx.AbstractSolver) -> float:
    """Largest stable step [s], by bisection."""
    low, high = 0.5 * theory(formulation, solver), 2.0 * theory(formulation, solver)
    if grows(formulation, solver, low) or not grows(formulation, solver, high):
        return math.nan
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if grows(formulation, solver, middle) else (middle, high)
    return math.sqrt(low * high)


def _ratio(name: str, solvers: dict[str, dfx.AbstractSolver]) -> float:
    """The measured limit over that of theory, of the solver where they are farthest apart."""
    formulation = formulations()[name]
    ratios = [largest_step(formulation, solver) / theory(formulation, solver) for solver in solvers.values()]
    return ratios[int(np.argmax(np.abs(np.log(ratios))))]


def _unlimited() -> float:
    """How many of the implicit runs at steps far beyond the explicit limit are stable."""
    runs = [(each, solver) for each in formulations().values() for solver in IMPLICIT.values()]
    return float(sum(not grows(each, solver, _FAR * theory(each, dfx.Heun())) for each, solver in runs))


def step_limits() -> list[HardCase]:
    """Cases: the largest stable steps."""
    # Euler's method has none at all on an undamped vibration; this one is damped.
    names = {
        "step_limit_slip": ("bristle in slip", "sigma0 |v|/g = 6e3/s real"),
        "step_limit_stick": ("bristle in stick", "a damped vibration of 220 rad/s"),
        "step_limit_regularised": ("regularised", "Fc/(width m) = 8e5/s real"),
    }
    made = [
        HardCase(
            name,
            f"Explicit steps end at the edge of the stability region; the eigenvalue is {value}.",
            "Below the limit all is well, just above it the bristle swings up within a thousand steps.",
            MeasuredNumber(partial(_ratio, formulation, EXPLICIT)),
            lambda _: 1.0,
            asks="largest stable step over that of theory, the farthest of Euler, Heun, Bosh3, Tsit5, Dopri8 [1]",
            tolerance=1e-2,
            single=None,
        )
        for name, (formulation, value) in names.items()
    ]
    unlimited = HardCase(
        "step_limit_none",
        "Fixed steps of 1e6 times what explicit methods can take, on all four formulations.",
        "Overflow within ten steps.",
        MeasuredNumber(_unlimited),
        lambda _: 8.0,
        asks="runs of Rodas5P and ImplicitFriction in which a disturbance does not grow, of 8 [1]",
        tolerance=1e-2,
        single=None,
    )
    return [*made, unlimited]
