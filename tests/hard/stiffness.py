"""Stiffness: rates of friction that are many orders above those of the motion."""

import math

import diffrax as dfx
import numpy as np
from jaxtyping import Array
from scipy.integrate import solve_ivp

from jaxmodsim.friction import LuGre, Regularized, Viscous
from jaxmodsim.problems import bristles, ramped_box
from jaxmodsim.scene import Scene
from jaxmodsim.simulation import Trajectory
from jaxmodsim.solvers import ImplicitFriction, Rodas5P

from .case import HardCase, motion, position, velocity
from .steps import step_limits

FAMILY = "stiffness"
_T1 = 10.0


def box_by_scipy(*, m: float = 2.0, ramp: float = 1.0, **changes: float) -> float:
    """Velocity of `ramped_box` under LuGre friction at 10 s, from equations by hand, by LSODA of scipy.

    Its relative tolerance is 1e-10. On the six sets below Radau at 1e-11 gives the same to 3e-9.
    """
    law = ramped_box.LUGRE | changes

    def rate(t: float, y: np.ndarray) -> list[float]:
        v, z = y
        level = law["Fc"] + (law["Fs"] - law["Fc"]) * math.exp(-min((v / law["vs"]) ** 2, 700.0))
        slide = v - law["sigma0"] * abs(v) * z / level
        return [(ramp * t - law["sigma0"] * z - law["sigma1"] * slide - law["sigma2"] * v) / m, slide]

    small = [1e-13, 1e-13 * law["Fc"] / law["sigma0"]]
    solution = solve_ivp(rate, (0.0, _T1), [0.0, 0.0], method="LSODA", rtol=1e-10, atol=small)
    return float(solution.y[0, -1])


# What rates of more than one over the resolution of time end with, in float32 first.
_TOO_FAST = "step size fell below what the time can resolve"


def _box(
    name: str,
    why: str,
    naive: str,
    single_ends: str = "",
    skips: dict[str, str] | None = None,
    **changes: float,
) -> HardCase:
    m = changes.pop("m", 2.0)
    scene = ramped_box.scene(ramped_box.lugre(**changes), m=m)
    return HardCase(
        name,
        why,
        naive,
        motion(scene, [0.0], [0.0], _T1, by="friction.Fc", read=velocity, max_steps=65536),
        second=lambda: box_by_scipy(m=m, **changes),
        single_ends=single_ends,
        skips=skips or {},
    )


def _boxes() -> list[HardCase]:
    return [
        _box(
            "bristle_soft",
            "The bristle is so soft (sigma0 = 1e2 N/m, no sigma1) that it rings for as long as the box sticks.",
            "Explicit methods get through; their damping eats the ringing.",
            sigma0=1e2,
        ),
        _box(
            "bristle_stiff",
            "Rates of 1e9 v/Fc for sigma0 = 1e9 N/m, seven orders above those of the box, and no damping.",
            "Explicit steps of 1e-9 s: no end.",
            sigma0=1e9,
        ),
        _box(
            "bristle_overdamped",
            "sigma1 = 1e6 N s/m on 2 kg: a rate of 5e5/s beside one of 0.1/s that decides the motion.",
            "Explicit steps of 4e-6 s; LuGre is not passive there, so that a wrong step also feeds energy in.",
            skips=dict.fromkeys(("forward float32", "reverse float32"), "keeps a digit: 0.1 to 9 % off"),
            sigma0=1e5,
            sigma1=1e6,
        ),
        _box(
            "stribeck_narrow",
            "vs = 1e-6 m/s: the friction curve falls within a velocity that is passed in microseconds.",
            "Steps jump over the curve; Newton's iterations of implicit methods diverge on its flank.",
            sigma0=1e6,
            vs=1e-6,
        ),
        _box(
            "mass_tiny",
            "1e-6 kg: inertia is nothing, the velocity follows the forces with a rate of 1e5/s.",
            "Explicit steps of 1e-5 s at best.",
            single_ends=_TOO_FAST,
            m=1e-6,
        ),
        _box(
            "mass_huge",
            "1e6 kg: velocities of 1e-5 m/s, so that absolute tolerances meant for 1 m/s see none of it.",
            "An answer of the size of the tolerance.",
            m=1e6,
        ),
    ]


def _two_masses(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    kinetic = 0.5 * p["m"] * (qd[0] ** 2 + qd[1] ** 2)
    return kinetic - 0.5 * p["k"] * q[0] ** 2 - 0.5 * p["link"] * (q[1] - q[0]) ** 2


def _ratio() -> HardCase:
    """Two masses of `m` on a spring `k`, joined by one of 1e12 k: with no stretch of the link they swing as one.

    The soft mode of the mass and stiffness matrices, to first order in k/link, is that of 2 m on k.
    """

    def exact(k: float) -> float:
        link, m = 1e12, 1.0
        # The smaller root of (k + link - m w2)(link - m w2) = link^2, without cancellation.
        total = k + 2.0 * link
        w2 = 2.0 * k * link / m / (total + math.sqrt(total**2 - 4.0 * k * link))
        # The larger amplitude is that of the free mass; both start at 1 in position, the link takes up the rest.
        return math.cos(math.sqrt(w2) * 5.0)

    scene = Scene(_two_masses, params={"m": 1.0, "k": 1.0, "link": 1e12})
    task = motion(
        scene,
        [1.0, 1.0],
        [0.0, 0.0],
        5.0,
        by="k",
        read=position,
        numbers={"rtol": 1e-7, "atol": 1e-8},
        solver=Rodas5P(),
    )
    return HardCase(
        "stiffness_ratio",
        "Two springs whose stiffnesses differ by 1e12: frequencies by 1e6.",
        "Explicit methods follow the fast one: 1e7 steps for a second of which nothing is seen.",
        task,
        exact,
        tolerance=1e-5,
        single_ends=_TOO_FAST,
    )


def _regularized() -> list[HardCase]:
    def exact(Fc: float) -> float:
        return (_T1 - Fc) ** 2 / 4.0

    scene = ramped_box.scene(Regularized(ramped_box.coulomb(), width=1e-9))
    return [
        HardCase(
            "regularized_narrow",
            "Coulomb friction smoothed over 1e-9 m/s: a slope of 1.5e9 N s/m in stick.",
            "Explicit steps of 1e-9 s in stick; wide steps of other methods jump from one side to the other.",
            motion(scene, [0.0], [0.0], _T1, by="friction.Fc", read=velocity),
            exact,
            asks="velocity at 10 s [m/s], against the exact law",
        ),
        HardCase(
            "regularized_unresolved",
            "The same with an absolute tolerance of 1e-6 m/s: stick lies within it as a whole.",
            "Break-away comes late, the velocity is 3 % low, and the error control sees nothing of it.",
            motion(scene, [0.0], [0.0], _T1, by="friction.Fc", read=velocity, numbers={"atol": 1e-6}),
            asks="the sentence",
            ends="above the width",
        ),
    ]


def _bristle_steady() -> HardCase:
    """A bristle that is at its steady deflection within the first 1e-9 of the run."""
    v, t1 = 0.1, 1.0

    def exact(sigma0: float) -> float:
        level = 1.5 + 0.25 * math.exp(-((v / 0.2) ** 2))
        return level / sigma0

    law = LuGre(sigma0=1e9, sigma1=0.0, sigma2=0.1, Fc=1.5, Fs=1.75, vs=0.2)
    task = motion(bristles.slipping_bristle(law, v), [0.0], [0.0], t1, by="friction.sigma0", read=_deflection)
    return HardCase(
        "bristle_at_speed",
        "sigma0 = 1e9 N/m at 0.1 m/s: the bristle settles at a rate of 6e7/s and stays for a second.",
        "Explicit Euler beyond 2 g/(sigma0 v) = 3.4e-8 s: the deflection grows without bound.",
        task,
        exact,
        asks="deflection of the bristle at 1 s [m]",
    )


def _deflection(run: Trajectory) -> Array:
    return run.z["friction"][-1]


def _implicit_long_step() -> HardCase:
    """Fixed steps 1e6 times as long as an explicit method could take."""
    v, t1 = 0.1, 1.0

    def exact(Fc: float) -> float:
        return (Fc + (1.75 - Fc) * math.exp(-((v / 0.2) ** 2))) / 1e9

    law = LuGre(sigma0=1e9, sigma1=0.0, sigma2=0.1, Fc=1.5, Fs=1.75, vs=0.2)
    task = motion(
        bristles.slipping_bristle(law, v),
        [0.0],
        [0.0],
        t1,
        by="friction.Fc",
        read=_deflection,
        numbers={"dt": 0.05},
        solver=ImplicitFriction(),
    )
    return HardCase(
        "implicit_long_step",
        "A fixed step of 0.05 s where an explicit one is stable below 3.4e-8 s.",
        "Infinity after a dozen steps.",
        task,
        exact,
        asks="deflection of the bristle at 1 s [m]",
        conserves=False,
    )


def _viscous_explicit() -> HardCase:
    scene = ramped_box.scene(Viscous(1e7))
    task = motion(scene, [0.0], [0.0], _T1, by="friction.Fv", read=velocity, solver=dfx.Tsit5(), max_steps=4096)
    return HardCase(
        "explicit_is_named",
        "An explicit method that a user insists on, at a rate of 5e6/s.",
        "Hours, or a step limit that is taken for a result.",
        task,
        asks="the sentence",
        ends="step limit was reached before t1",
        single_ends=_TOO_FAST,
    )


def cases() -> list[HardCase]:
    """The cases of this family."""
    return [
        *_boxes(),
        _bristle_steady(),
        _ratio(),
        *_regularized(),
        _implicit_long_step(),
        _viscous_explicit(),
        *step_limits(),
    ]
