"""What laws are known not to do."""

from collections.abc import Callable
from typing import Any, NamedTuple

from ..._core.state_dependent import nominal
from ...friction import (
    AbstractForceLaw,
    AbstractKarnoppLaw,
    AbstractLaw,
    AbstractSetValuedLaw,
    Armstrong,
    Coulomb,
    Dahl,
    ElastoPlastic,
    LuGre,
    MaxwellSlip,
    Viscous,
    check_passivity,
)


def _always(law: object) -> bool:
    del law
    return True


class KnownLimitation(NamedTuple):
    """That laws of some kinds miss the threshold of an experiment, and why.

    - `experiment`: its name.
    - `kinds`: abstract or final classes of laws.
    - `reason`: a sentence.
    - `when`: what else must be so of the law.
    """

    experiment: str
    kinds: tuple[type, ...]
    reason: str
    when: Callable[[Any], bool] = _always


_STATELESS = (AbstractForceLaw, AbstractSetValuedLaw, AbstractKarnoppLaw)
_FLAT = "Without a Stribeck effect friction does not depend on slip velocity but for the viscous part."


def _no_fall(law: Any) -> bool:
    """Whether friction does not fall as slip begins."""
    stiction = nominal(getattr(law, "Fs", None))
    return stiction is None or not bool((stiction > nominal(law.Fc)).any())


KNOWN_LIMITATIONS: tuple[KnownLimitation, ...] = (
    KnownLimitation(
        "presliding",
        (AbstractForceLaw, AbstractSetValuedLaw),
        "The force is a function of velocity and jumps as the velocity reverses.",
    ),
    KnownLimitation(
        "characteristic",
        (Armstrong,),
        "After a reversal there is as much Stribeck friction as the slip left and the rest brought back.",
    ),
    KnownLimitation("memory", (Dahl, LuGre, ElastoPlastic), "One state remembers one turning point."),
    KnownLimitation("break-away", _STATELESS, "The limit of stick is a number, whatever the load did before."),
    KnownLimitation("break-away", (Dahl, MaxwellSlip), "The force is a function of displacement alone.", _no_fall),
    KnownLimitation("lag", _STATELESS, "The force is a function of velocity: no memory, no lag."),
    KnownLimitation("lag", (Dahl, MaxwellSlip), _FLAT, _no_fall),
    KnownLimitation("stick-slip", (Viscous, Coulomb, Dahl, MaxwellSlip), _FLAT, _no_fall),
    KnownLimitation("creep", (AbstractForceLaw,), "A function of velocity holds a load only by moving."),
    KnownLimitation("creep", (Dahl, LuGre), "The bristle yields at any load, a little more forth than back."),
    KnownLimitation(
        "passivity",
        (LuGre, ElastoPlastic),
        "A constant sigma1 gives energy back unless sigma2 > sigma1 (Fs - Fc)/Fc.",
        lambda law: not check_passivity(law),
    ),
)


def known_limitation(experiment: str, law: AbstractLaw) -> str | None:
    """Why such a law misses the threshold of that experiment; None if it is not known to."""
    plain = getattr(law, "forward", law)
    for known in KNOWN_LIMITATIONS:
        if known.experiment == experiment and isinstance(plain, known.kinds) and known.when(plain):
            return known.reason
    return None
