"""The laws of the bench: the examples of all registered laws, and of either modifier one."""

import numpy as np
from jaxtyping import Array

from ...friction import STANDARD, LawCase, LuGre, Stribeck, asymmetric, laws, scaled_by

FC, FS, VS, SIGMA0, WIDTH = (STANDARD[name] for name in ("Fc", "Fs", "vs", "sigma0", "width"))
# Deflection [m] at which a contact of this stiffness breaks away.
DEFLECTION = FS / SIGMA0
# Backward over forward friction of the asymmetric law.
BACKWARD = 1.3


def _double(t: Array, q: Array, qd: Array, p: object) -> float:
    return 2.0


def law_cases() -> tuple[LawCase, ...]:
    """Examples of all registered laws that have some, and of laws with modifiers."""
    stribeck, viscous = Stribeck.cases()[0].steady, STANDARD["Fv"]
    halved = Stribeck.standard(Fc=0.5 * FC, Fs=0.5 * FS, Fv=0.5 * viscous)
    worn = asymmetric(LuGre.standard(), Fc=BACKWARD * FC, Fs=BACKWARD * FS)

    def worn_curve(v: np.ndarray) -> np.ndarray:
        """The Stribeck curve, stronger backward."""
        return np.where(v < 0, BACKWARD, 1.0) * (stribeck(v) - viscous * v) + viscous * v

    return (
        *(case for law in laws().values() for case in law.cases()),
        LawCase("Stribeck, scaled", scaled_by(halved, _double), stribeck),
        LawCase("LuGre, asymmetric", worn, worn_curve),
    )
