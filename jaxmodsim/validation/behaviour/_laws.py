"""The laws of the bench, all with the same parameters as far as they have them."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...friction import (
    AbstractLaw,
    Armstrong,
    Coulomb,
    Curve,
    Dahl,
    DeadZone,
    ElastoPlastic,
    LuGre,
    MaxwellSlip,
    Regularized,
    Sign,
    Stribeck,
    Viscous,
    asymmetric,
    lorentzian,
    scaled_by,
)

# The set of Canudas de Wit and others 1995, IEEE TAC 40:419: forces [N], Stribeck velocity [m/s], stiffness [N/m],
# damping and viscous coefficient [N s/m].
FC, FS, VS, SIGMA0, SIGMA1, FV = 1.0, 1.5, 1e-3, 1e5, float(np.sqrt(1e5)), 0.4
# Deflection [m] at which a contact of this stiffness breaks away.
DEFLECTION = FS / SIGMA0
# Backward over forward friction of the asymmetric law.
BACKWARD = 1.3
# Width of the smooth laws [m/s]: a hundredth of the Stribeck velocity, so that the fall is seen.
WIDTH = 0.01 * VS
# Karnopp's band [m/s] and the fixed step [s] of the laws that need one: one step changes the velocity of 1 kg under
# 1 N by half of the band.
BAND, STEP = 1e-4, 1e-4
# Elements of Maxwell slip: shares of stiffness and of force. The first gives way at a sixth of `DEFLECTION`.
STIFFNESS_SHARES, FORCE_SHARES = np.array([0.4, 0.3, 0.2, 0.1]), np.array([0.1, 0.2, 0.3, 0.4])


class LawCase(NamedTuple):
    """A law on the bench.

    - `name`: in tables and figures.
    - `law`: the law.
    - `steady`: its force [N] in steady slip at the velocities v [m/s], v not zero, in closed form.
    - `dt`: fixed step [s] that it needs in a simulation; None for adaptive steps.
    """

    name: str
    law: AbstractLaw
    steady: Callable[[np.ndarray], np.ndarray]
    dt: float | None = None


def _curve(
    Fs: float = FS, Fv: float = FV, fall: Callable[[np.ndarray], np.ndarray] = lambda x: np.exp(-x * x)
) -> Callable[[np.ndarray], np.ndarray]:
    """Steady force that falls from Fs to Fc by `fall(|v|/vs)`, with a viscous part."""

    def steady(v: np.ndarray) -> np.ndarray:
        return (FC + (Fs - FC) * fall(np.abs(v) / VS)) * np.sign(v) + Fv * v

    return steady


def _lorentzian(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + x * x)


def _worn(v: np.ndarray) -> np.ndarray:
    """The Gaussian curve, stronger backward."""
    return np.where(v < 0, BACKWARD, 1.0) * _curve(Fv=0.0)(v) + FV * v


def _smooth(v: Array) -> Array:
    return (FC + (FS - FC) * jnp.exp(-((v / VS) ** 2))) * jnp.tanh(v / WIDTH) + FV * v


def _double(t: Array, q: Array, qd: Array, p: object) -> float:
    del t, q, qd, p
    return 2.0


def law_cases() -> tuple[LawCase, ...]:
    """All laws and wrappers of `jaxmodsim.friction`, in families."""
    gauss, flat = _curve(), _curve(Fs=FC, Fv=0.0)
    stribeck = Stribeck(FC, FS, VS, FV)
    bristle = {"sigma0": SIGMA0, "sigma1": SIGMA1, "sigma2": FV, "Fc": FC, "Fs": FS, "vs": VS}
    elements = {"k": SIGMA0 * STIFFNESS_SHARES, "Fc": FC * FORCE_SHARES, "sigma2": FV}
    return (
        LawCase("Viscous", Viscous(FV), lambda v: FV * v),
        LawCase("Curve", Curve(_smooth), gauss),
        LawCase("Coulomb", Coulomb(FC, FC), flat),
        LawCase("Coulomb, stiction", Coulomb(FC, FS), flat),
        LawCase("Stribeck, Gauss", stribeck, gauss),
        LawCase("Stribeck, exp", Stribeck(FC, FS, VS, FV, exponent=1.0), _curve(fall=lambda x: np.exp(-x))),
        LawCase("Stribeck, Lorentz", Stribeck(FC, FS, VS, FV, fall=lorentzian), _curve(fall=_lorentzian)),
        LawCase("Stribeck, scaled", scaled_by(Stribeck(0.5 * FC, 0.5 * FS, VS, 0.5 * FV), _double), gauss),
        LawCase("Regularized", Regularized(stribeck, WIDTH), gauss),
        LawCase("DeadZone", DeadZone(stribeck, BAND), gauss, STEP),
        LawCase("Sign", Sign(stribeck), gauss, STEP),
        LawCase("Dahl", Dahl(SIGMA0, FC), flat),
        LawCase("LuGre", LuGre(**bristle), gauss),
        LawCase("LuGre, vd", LuGre(**bristle, vd=VS), gauss),
        LawCase("LuGre, asymmetric", asymmetric(LuGre(**bristle), Fc=BACKWARD * FC, Fs=BACKWARD * FS), _worn),
        LawCase("ElastoPlastic", ElastoPlastic(**bristle, Fba=0.7 * FC), gauss),
        LawCase("MaxwellSlip, 1", MaxwellSlip(k=[SIGMA0], Fc=[FC], sigma2=FV), _curve(Fs=FC)),
        LawCase("MaxwellSlip, 4", MaxwellSlip(**elements), _curve(Fs=FC)),
        LawCase("MaxwellSlip, 4, C", MaxwellSlip(**elements, Fs=FS * FORCE_SHARES, vs=VS, C=50.0), gauss),
        LawCase("Armstrong", Armstrong(SIGMA0, FC, FS, VS, FV, tau=0.01, gamma=1.0), _curve(fall=_lorentzian)),
    )
