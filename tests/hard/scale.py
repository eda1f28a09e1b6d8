"""Scale and time: very small, very large, very long, very late, and next to nothing."""

import math
from collections.abc import Callable

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from jaxmodsim.friction import Coulomb
from jaxmodsim.problems import braked_spring, ramped_box
from jaxmodsim.scene import Scene
from jaxmodsim.simulation import Trajectory, simulate
from jaxmodsim.solvers import Gauss

from .case import HardCase, MeasuredNumber, RefusedCalls, motion, position, velocity

FAMILY = "scale and time"
_LATE = 1e9


def _at(t: float, x0: float) -> float:
    return float(braked_spring.motion(jnp.asarray(t), **(braked_spring.PARAMS | {"x0": x0}))[0])


def in_other_units(length: float, time: float, mass: float) -> float:
    """Largest difference between a run and the same one in other units, after conversion, in the first one's.

    Units that are powers of two change no digit, if nothing in the program is of a size of its own.
    """
    p, ts = braked_spring.PARAMS, np.linspace(0.0, 26.0, 53)
    force = mass * length / time**2
    runs = []
    for scale, pace, kilo, newton in ((1.0, 1.0, 1.0, 1.0), (length, time, mass, force)):
        law = Coulomb(p["Fc"] * newton, p["Fs"] * newton)
        scene = braked_spring.scene(law, m=p["m"] * kilo, k=p["k"] * kilo / pace**2)
        # One number for lengths and velocities: the tolerance can only be none. Until shortly before rest, whose
        # velocities are rounding, which has no scale of its own.
        run = simulate(scene, [p["x0"] * scale], [0.0], 26.0 * pace, ts=ts * pace, rtol=1e-8, atol=0.0)
        runs.append((np.asarray(run.q) / scale, np.asarray(run.qd) / scale * pace))
    return max(float(np.max(np.abs(a - b))) for a, b in zip(*runs, strict=True))


def _units() -> list[HardCase]:
    units = {
        "nanometres": (2.0**-30, 1.0, 1.0, "a length of 1e-9 m"),
        "kilometres": (2.0**10, 1.0, 2.0**20, "1 km and 1000 t"),
        "microseconds": (2.0**-20, 2.0**-20, 2.0**-30, "micrometres, microseconds and micrograms"),
    }
    return [
        HardCase(
            f"units_{name}",
            f"The mass on a spring with friction, 11 reversals, on the scale of {words}.",
            "Tolerances, smoothing widths and thresholds in SI units: nothing moves, or nothing stops.",
            MeasuredNumber(lambda scales=(length, time, mass): in_other_units(*scales)),
            lambda _: 0.0,
            asks="difference to the run in metres, after conversion [m, m/s]",
            scale=1.0,
            # Not one digit may differ.
            tolerance=1e-15,
        )
        for name, (length, time, mass, words) in units.items()
    ]


def _sampled_at(i: int) -> Callable[[Trajectory], Array]:
    def read(run: Trajectory) -> Array:
        return run.q[i, 0]

    return read


_middle = _sampled_at(50)


def _single(scene: Scene) -> Scene:
    return jtu.tree_map(lambda x: x.astype(np.float32), scene)


def _late() -> list[HardCase]:
    spring = braked_spring.scene(braked_spring.coulomb())
    return [
        HardCase(
            "late_start",
            "The clock shows 1e9 s at the start: times are known to 1e-7 s.",
            "Steps below the resolution of time: an endless loop, or events that are never met.",
            motion(
                spring,
                [1.0],
                [0.0],
                _LATE + 30.0,
                by="q0[0]",
                read=position,
                numbers={"t0": _LATE, "rtol": 1e-8, "atol": 1e-9},
            ),
            lambda x0: _at(30.0, x0),
            asks="position 30 s later [m]",
            tolerance=1e-5,
            # RefusedCalls: see the next.
            single=None,
        ),
        HardCase(
            "late_start_single",
            "The same in float32, where the next number after 1e9 is 1e9 + 64.",
            "A run of no length: the initial state, under a success code.",
            RefusedCalls(
                {"clock": lambda: simulate(_single(spring), np.ones(1, np.float32), [0.0], _LATE + 30.0, t0=_LATE)},
                {"clock": "are the same number in float32"},
            ),
            asks="an error that names it",
        ),
    ]


def _times() -> list[HardCase]:
    spring = braked_spring.scene(braked_spring.coulomb())
    fine = 1.0 + np.arange(101) * 2.0**-54
    return [
        HardCase(
            "no_absolute_tolerance",
            "atol = 0, from rest at zero: errors relative to nothing.",
            "0/0 in the error norm: NaN, or the smallest steps there are.",
            motion(ramped_box.scene(Coulomb(1.5)), [0.0], [0.0], 10.0, by="ramp", read=velocity, numbers={"atol": 0.0}),
            lambda ramp: ramp * (10.0 - 1.5 / ramp) ** 2 / 4.0,
            # At break-away the net force is rounding, and so is all of a velocity that comes from it.
            single_ends="step size fell below what the time can resolve",
        ),
        HardCase(
            "sampled_below_rounding",
            "101 samples within 6e-15 s, four to each number that there is.",
            "Interpolation over a step of no length: 0/0.",
            motion(spring, [1.0], [0.0], float(fine[-1]), by="q0[0]", read=_middle, numbers={"ts": fine}),
            lambda x0: _at(1.0, x0),
            asks="position at the middle one [m]",
        ),
        HardCase(
            "step_longer_than_run",
            "A fixed step of 100 s for a run of one.",
            "The run ends at 100 s.",
            motion(ramped_box.scene(), [0.0], [0.0], 1.0, by="ramp", read=velocity, numbers={"dt": 100.0}),
            lambda ramp: ramp / 4.0,
        ),
        HardCase(
            "run_of_no_length",
            "t1 = t0.",
            "A step of zero length: 0/0, or an error from the depths of the solver.",
            motion(spring, [1.0], [0.0], 0.0, by="q0[0]", read=position),
            lambda x0: x0,
            asks="position [m]",
        ),
        HardCase(
            "step_limit",
            "Ten steps are allowed, a thousand are needed.",
            "The last state is handed out as that of the end.",
            motion(spring, [1.0], [0.0], 1000.0, by="k", read=position, max_steps=10),
            asks="the sentence",
            ends="step limit was reached before t1",
        ),
    ]


def _periods() -> HardCase:
    """A harmonic oscillator with sixteen steps of Gauss a period, whose numerical frequency is known in closed form.

    Three stages multiply by the Pade approximant (3, 3) of exp(i w h): its angle is twice that of its numerator.
    """
    steps, periods = 16, 1_000_000

    def exact(k: float) -> float:
        z = 2.0 * math.pi / steps * math.sqrt(k)
        angle = 2.0 * math.atan2(0.5 * z - z**3 / 120.0, 1.0 - z**2 / 10.0)
        # Whole turns off, which at 1e7 steps would cost the last digits.
        return math.cos(steps * periods * (angle - 2.0 * math.pi / steps))

    task = motion(
        braked_spring.scene(m=1.0, k=1.0),
        [1.0],
        [0.0],
        2.0 * math.pi * periods,
        by="k",
        read=position,
        numbers={"dt": 2.0 * math.pi / steps},
        solver=Gauss(),
        max_steps=steps * periods + 2,
    )
    return HardCase(
        "periods_1000000",
        "A million periods: rounding of 1.6e7 steps adds up, and any damping of the method.",
        "Energy gone, or grown by orders.",
        task,
        exact,
        asks="position after 1e6 periods, the method's own phase counted [m]",
        scale=1.0,
        tolerance=1e-6,
        single=None,
        skips={
            "vmap": "as alone",
            "forward": "minutes; the derivative after few periods is that of `reversals`",
            "reverse": "checkpoints of 1.6e7 steps take an hour",
        },
    )


def cases() -> list[HardCase]:
    """The cases of this family."""
    return [*_units(), *_late(), *_times(), _periods()]
