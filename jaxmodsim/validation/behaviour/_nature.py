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


def _always(law: Any) -> bool:
    del law
    return True


class Nature(NamedTuple):
    """That laws of some kinds miss the limit of an experiment, and why.

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


BY_NATURE: tuple[Nature, ...] = (
    Nature(
        "presliding",
        (AbstractForceLaw, AbstractSetValuedLaw),
        "The force is a function of velocity and jumps as the velocity reverses.",
    ),
    Nature(
        "characteristic",
        (Armstrong,),
        "After a reversal there is as much Stribeck friction as the slip left and the rest brought back.",
    ),
    Nature("memory", (Dahl, LuGre, ElastoPlastic), "One state remembers one turning point."),
    Nature("break-away", _STATELESS, "The limit of stick is a number, whatever the load did before."),
    Nature("break-away", (Dahl, MaxwellSlip), "The force is a function of displacement alone.", _no_fall),
    Nature("lag", _STATELESS, "The force is a function of velocity: no memory, no lag."),
    Nature("lag", (Dahl, MaxwellSlip), _FLAT, _no_fall),
    Nature("stick-slip", (Viscous, Coulomb, Dahl, MaxwellSlip), _FLAT, _no_fall),
    Nature("creep", (AbstractForceLaw,), "A function of velocity holds a load only by moving."),
    Nature("creep", (Dahl, LuGre), "The bristle yields at any load, a little more forth than back."),
    Nature(
        "passivity",
        (LuGre, ElastoPlastic),
        "A constant sigma1 gives energy back unless sigma2 > sigma1 (Fs - Fc)/Fc.",
        lambda law: not check_passivity(law),
    ),
)


def by_nature(experiment: str, law: AbstractLaw) -> str | None:
    """Why such a law misses the limit of that experiment; None if it is not known to."""
    plain = getattr(law, "forward", law)
    for nature in BY_NATURE:
        if nature.experiment == experiment and isinstance(plain, nature.kinds) and nature.when(plain):
            return nature.reason
    return None
