"""Examples of laws, all with the same parameters as far as they have them."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

# The set of Canudas de Wit and others 1995, IEEE TAC 40:419: forces [N], Stribeck velocity [m/s], stiffness [N/m],
# damping and viscous coefficients [N s/m]; and the width of smooth laws [m/s], a hundredth of the Stribeck velocity, so
# that the fall is seen.
STANDARD = {
    "sigma0": 1e5, "sigma1": math.sqrt(1e5), "sigma2": 0.4, "Fc": 1.0, "Fs": 1.5, "vs": 1e-3, "Fv": 0.4, "width": 1e-5,
}  # fmt: skip


class LawCase(NamedTuple):
    """A law with numbers, as benches and tests run it.

    - `name`: in tables and figures.
    - `law`: the law.
    - `steady`: its force [N] in steady slip at the velocities v [m/s], v not zero, in closed form.
    - `dt`: fixed step [s] that it needs in a simulation; None for adaptive steps.
    """

    name: str
    law: Any
    steady: Callable[[np.ndarray], np.ndarray]
    dt: float | None = None


def steady_curve(
    Fc: float, Fs: float, Fv: float, fall: Callable[[np.ndarray], np.ndarray] = lambda x: np.exp(-x * x)
) -> Callable[[np.ndarray], np.ndarray]:
    """Steady force that falls from Fs to Fc by `fall(|v|/vs)`, with a viscous part."""
    return lambda v: (Fc + (Fs - Fc) * fall(np.abs(v) / STANDARD["vs"])) * np.sign(v) + Fv * v


def stribeck_case(
    name: str, law: eqx.Module, fall: Callable[[np.ndarray], np.ndarray] = lambda x: np.exp(-x * x)
) -> LawCase:
    """An example whose force in steady slip is the standard Stribeck curve with its viscous part."""
    return LawCase(name, law, steady_curve(STANDARD["Fc"], STANDARD["Fs"], STANDARD["Fv"], fall))
