"""What an effect is: something that puts a force on the mechanism."""

import abc
from typing import TYPE_CHECKING, NamedTuple, cast

import equinox as eqx
from equinox import AbstractVar
from jaxtyping import Array, Float, PyTree

from ..._core.arrays import PerDof, Scalar


class Action(NamedTuple):
    """What an effect does at one state.

    - `generalised`: generalised force on each coordinate, shape `[dof]` [N or N m].
    - `force`: the force in the effect's own terms, as reported along a run.
    - `rate`: time derivative of the effect's own state; None where it has none.
    """

    generalised: PerDof
    force: Float[Array, "..."]
    rate: PyTree = None


class Power(NamedTuple):
    """Power [W] that an effect brings in from outside, and that it absorbs (loses or stores).

    None for an effect that never absorbs any: what is zero by nature is not integrated.
    """

    supplied: Scalar
    absorbed: Scalar | None = None


class AbstractEffect(eqx.Module):
    """A force on the mechanism, with or without a state of its own."""

    # By which the effect is known in the results; None for the class's own.
    if TYPE_CHECKING:
        name = cast("str | None", None)  # not a field, which would come before those of the effects
    else:
        name: AbstractVar[str | None]

    def bind_state(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> "AbstractEffect":
        """The effect with its parameters at a state of the mechanism; itself if none of them depends on the state."""
        return self

    @property
    @abc.abstractmethod
    def default_name(self) -> str:
        """Name in the results where the user gave none."""

    @property
    @abc.abstractmethod
    def stiff(self) -> bool:
        """Whether the effect makes the equations of motion stiff."""

    @abc.abstractmethod
    def check(self, q: PerDof, qd: PerDof, params: PyTree, name: str) -> None:
        """Check shapes against the mechanism while tracing; raises `ValueError` naming the effect."""

    @abc.abstractmethod
    def initial_state(self, q: PerDof, params: PyTree) -> PyTree:
        """State at rest and unloaded, at the coordinates `q`; None for an effect without one."""

    @abc.abstractmethod
    def act(self, t: Scalar, q: PerDof, qd: PerDof, z: PyTree, params: PyTree) -> Action:
        """Forces and the rate of the own state `z`."""

    @abc.abstractmethod
    def power(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree, action: Action) -> Power:
        """Power of an action of this effect."""

    @abc.abstractmethod
    def stored_energy(self, z: PyTree) -> Scalar | float:
        """Energy [J] held in the own state."""
