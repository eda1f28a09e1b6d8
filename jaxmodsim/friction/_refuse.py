"""Errors about the kind of a law."""

from functools import partial
from typing import Any

import equinox as eqx

from ._law import AbstractSetValuedLaw


def set_valued_law(wrapper: str) -> Any:
    """Field that takes a set-valued law, for the wrappers that execute such laws."""
    return eqx.field(converter=partial(_need_set_valued, wrapper=wrapper))


def _need_set_valued(law: Any, wrapper: str) -> AbstractSetValuedLaw:
    if not isinstance(law, AbstractSetValuedLaw):
        given = law if isinstance(law, str) else type(law).__name__
        raise ValueError(
            f"{wrapper} executes a set-valued law such as Coulomb or Stribeck, but {given!r} is none. A law that"
            " is a function of velocity or has a state of its own goes into Friction without a wrapper."
        )
    return law
