"""A law under a prescribed slip velocity, without a mechanism: static characteristic and frictional lag."""

from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from bench.behaviour.experiment import DEFLECTION, FC, VS, Experiment, FigureLine, LawCase, LawMeasurement, Threshold
from jaxmodsim.friction import (
    AbstractDynamicLaw,
    AbstractForceLaw,
    AbstractKarnoppLaw,
    AbstractLaw,
    AbstractSetValuedLaw,
)

# Number of samples of every drive, the same for all, so that each law is compiled once.
SAMPLES = 8192


class Response(NamedTuple):
    """Response of a law to a drive, shape `[samples]` each.

    - `force`: at the end of the sample [N].
    - `work`: taken up by friction in the sample [J], by the trapezoidal rule.
    - `stored`: energy in the law's state at the end of the sample [J].
    """

    force: np.ndarray
    work: np.ndarray
    stored: np.ndarray


def respond(law: AbstractLaw, v: np.ndarray, dt: np.ndarray) -> Response:
    """Drive a law from rest, unloaded.

    **Arguments:**

    - `law`: of any kind.
    - `v`: slip velocity in each sample [m/s], not zero, shape `[SAMPLES]`.
    - `dt`: duration of each sample [s].

    **Returns:**

    A `Response`. The state of a dynamic law is advanced exactly over each sample.
    """
    assert v.shape == dt.shape == (SAMPLES,)
    return Response(*(np.asarray(x) for x in _respond(law, v, dt)))


@jax.jit
def _respond(law: AbstractLaw, v: Array, dt: Array) -> tuple[Array, Array, Array]:
    def over(carry: PyTree, sample: tuple[Array, Array]) -> tuple[PyTree, tuple[Array, Array, Array]]:
        (t, x, z), (v, dt) = carry, sample
        t, x = t + dt, x + v * dt
        here = law.bind_state(t, x[None], v[None], {})
        if not isinstance(here, AbstractDynamicLaw):
            force = _slip_force(here, v)
            return (t, x, z), (force, force * v * dt, jnp.zeros_like(v))
        before, z = here.force(v, z), here.step_exact(v, z, dt)
        after = here.force(v, z)
        return (t, x, z), (after, 0.5 * (before + after) * v * dt, here.stored_energy(z))

    rest = jnp.zeros_like(v[0])
    first = law.bind_state(rest, rest[None], rest[None], {})
    z = first.initial_state(rest) if isinstance(first, AbstractDynamicLaw) else None
    return jax.lax.scan(over, (rest, rest, z), (v, dt))[1]


def _slip_force(law: AbstractLaw, v: Float[Array, ""]) -> Float[Array, ""]:
    """Force [N] in slip of a law without a state."""
    if isinstance(law, AbstractSetValuedLaw):
        return law.sliding_force(v) * jnp.sign(v) + law.viscous_force(v)
    assert isinstance(law, AbstractForceLaw | AbstractKarnoppLaw)
    return law.force(v)


def needs_load(law: AbstractLaw, v: float) -> bool:
    """Whether the force at the slip velocity `v` [m/s] is the load, which a prescribed motion does not define."""
    return isinstance(law, AbstractKarnoppLaw) and bool(law.holds(jnp.asarray(v)))


NEEDS_LOAD = "In the Karnopp band the force is the load, which a prescribed motion does not define."


def path(*places: float, samples: int) -> np.ndarray:
    """Displacements [m] along legs between positions, with the same number of samples each, without the start."""
    legs = [np.linspace(a, b, samples + 1)[1:] for a, b in pairwise(places)]
    return np.concatenate(legs)


_SPEEDS, _HELD = 64, 32
# Every speed is held for many deflections, and for longer than any lag of the laws.
_WAY, _TIME = 40.0 * DEFLECTION, 1.0


def _characteristic(case: LawCase) -> LawMeasurement:
    """Slide with stepwise rising and falling speeds, forward and then backward."""
    speeds = np.geomspace(0.2 * VS, 100.0 * VS, _SPEEDS)
    sweep = np.concatenate([speeds, speeds[::-1]])
    held = np.concatenate([sweep, -sweep])
    v = np.repeat(held, _HELD)
    force = respond(case.law, v, (_WAY / np.abs(v) + _TIME) / _HELD).force
    assert v.size == SAMPLES
    steady = force.reshape(-1, _HELD)[:, -1]
    expected = case.steady(held)
    up, down, forth, back = steady.reshape(4, _SPEEDS)
    lines = (
        FigureLine("steady curve", speeds, expected[:_SPEEDS], reference=True),
        FigureLine("", speeds, expected[2 * _SPEEDS : 3 * _SPEEDS], reference=True),
        FigureLine("rising speed", speeds, up),
        FigureLine("falling speed", speeds[::-1], down),
        FigureLine("rising speed", speeds, forth),
        FigureLine("falling speed", speeds[::-1], back),
    )
    fall = up[0] - up.min()
    dip = f"falls by {fall:.2g} N and" if fall > 0.05 * FC else "does not fall and"
    return LawMeasurement(
        float(np.max(np.abs(steady - expected)) / FC),
        f"Steady friction {dip} lies within this part of Fc about the closed form, whether speed rises or falls.",
        lines,
    )


# The threshold is a hundredth of the Coulomb force, a fiftieth of the fall from stiction. It exceeds the effect of any
# width or corner.
CHARACTERISTIC = Experiment(
    "characteristic",
    "Static characteristic: steady friction at rising and falling speed, forward and backward",
    "largest deviation from the steady curve over Fc",
    "1",
    Threshold(0.01, at_most=True),
    ("speed [m/s]", "friction force [N]"),
    (-2.1, 2.1),
    _characteristic,
    log_x=True,
)

# Mean and amplitude of the velocity in Stribeck velocities, without a change of sign; angular frequencies [1/s].
_MEAN, _SWING = 1.5, 1.2
_FREQUENCIES = (1.0, 10.0, 25.0)
_PERIODS = 4


def _loop(case: LawCase, frequency: float) -> tuple[np.ndarray, np.ndarray]:
    """Velocity [m/s] and force [N] over the last period."""
    n = SAMPLES // _PERIODS
    dt = 2.0 * np.pi / frequency / n
    v = VS * (_MEAN - _SWING * np.cos(frequency * dt * (np.arange(SAMPLES) + 0.5)))
    return v[-n:], respond(case.law, v, np.full(SAMPLES, dt)).force[-n:]


def _lag(case: LawCase) -> LawMeasurement:
    """Oscillate the velocity, and compare friction at rising and falling velocity."""
    loops = {frequency: _loop(case, frequency) for frequency in _FREQUENCIES}
    v, force = loops[_FREQUENCIES[-1]]
    half = v.size // 2
    # Samples are symmetric about the turning points, so those at falling velocity mirror those at rising velocity.
    difference = float(np.mean(force[:half] - force[half:][::-1]))
    lines = [FigureLine(f"{frequency:g} rad/s", 1e3 * v, force) for frequency, (v, force) in loops.items()]
    steady = FigureLine("steady curve", 1e3 * v[:half], case.steady(v[:half]), reference=True)
    return LawMeasurement(
        difference / FC,
        f"At {_FREQUENCIES[-1]:g} rad/s friction is larger by this part of Fc while the velocity rises than while it"
        " falls.",
        (steady, *lines),
    )


# The threshold is a hundredth of the Coulomb force, the width of a line in the figure.
LAG = Experiment(
    "lag",
    "Frictional lag: friction against a velocity that oscillates without changing sign",
    "friction at rising less at falling velocity over Fc",
    "1",
    Threshold(0.01, at_most=False),
    ("slip velocity [mm/s]", "friction force [N]"),
    (0.9, 1.6),
    _lag,
)
