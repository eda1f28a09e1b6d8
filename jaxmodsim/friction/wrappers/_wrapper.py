"""What the wrappers of set-valued laws share."""

from functools import partial
from typing import Any, ClassVar

import equinox as eqx
from equinox import AbstractVar

from .._law import AbstractLaw, AbstractSetValuedLaw
from .._law_case import LawCase, stribeck_case
from .._stribeck import Stribeck


class AbstractWrapper(AbstractLaw):
    """A set-valued law, run in another way than by events."""

    law: AbstractVar[AbstractSetValuedLaw]
    mujoco_lacks: ClassVar[str] = ", for it runs dry friction in its own way, by a constraint: export the law inside"

    def formulas(self) -> tuple[str, ...]:
        """Of the law inside."""
        return self.law.formulas()

    def known_limitations(self) -> dict[str, str]:
        """Those of the law inside, and of this way to run it."""
        return self.law.known_limitations() | dict(self.limitations)

    def modelica(self) -> str:
        """Modelica has events."""
        return f"{type(self).__name__}: they run the law inside exactly, by events, so export that"

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """On a Stribeck law."""
        case = stribeck_case(cls.__name__, cls.standard(law=Stribeck.standard()))
        return (case._replace(dt=cls.example_step),)


def set_valued_law(wrapper: str) -> Any:
    """Field that takes a set-valued law, for the wrappers that execute such laws."""
    return eqx.field(converter=partial(_need_set_valued, wrapper=wrapper))


def _need_set_valued(law: object, wrapper: str) -> AbstractSetValuedLaw:
    if not isinstance(law, AbstractSetValuedLaw):
        given = law if isinstance(law, str) else type(law).__name__
        raise ValueError(
            f"{wrapper} executes a set-valued law such as Coulomb or Stribeck, but {given!r} is none. A law that"
            " is a function of velocity or has a state of its own goes into Friction without a wrapper."
        )
    return law
