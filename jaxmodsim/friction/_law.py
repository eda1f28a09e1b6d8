"""What a friction law is. Sign: the force is positive when it opposes positive slip."""

import abc
from typing import TYPE_CHECKING, Any

import equinox as eqx
from jaxtyping import Array, Bool, Float, PyTree

from .._core.parameters import check_ranges
from .._core.state_dependent import bind_state, is_state_dependent

if TYPE_CHECKING:
    from typing import ClassVar as AbstractClassVar
else:
    from equinox import AbstractClassVar


class AbstractLaw(eqx.Module):
    """A friction law: knows its slip velocity [m/s or rad/s] and its own state, nothing of the mechanism."""

    # Whether the law makes the equations of motion stiff, which decides the default solver.
    stiff: AbstractClassVar[bool]

    def __check_init__(self) -> None:
        """Refuse parameters out of range."""
        check_ranges(self)

    def bind_state(
        self, t: Float[Array, ""], q: Float[Array, " dof"], qd: Float[Array, " dof"], params: PyTree
    ) -> "AbstractLaw":
        """The law as it is at a state of the mechanism; another one only where `scaled_by` made it depend on that."""
        return bind_state(self, t, q, qd, params) if is_state_dependent(self) else self


class AbstractForceLaw(AbstractLaw):
    """A law whose force is a function of slip velocity."""

    @abc.abstractmethod
    def force(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Friction force [N] at slip velocity `v` [m/s]."""


class AbstractSetValuedLaw(AbstractLaw):
    """A law whose force at rest may be anything up to a limit: a rule for slip and a limit of stick.

    By itself it runs exactly, by events; `Regularized`, `DeadZone` and `Sign` run it in other ways.
    """

    @abc.abstractmethod
    def sliding_force(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Magnitude [N] of the dry part of the force in slip at velocity `v` [m/s], never negative.

        At `v = 0` its limit from above.
        """

    @abc.abstractmethod
    def viscous_force(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Part of the force [N] that is a smooth function of `v` [m/s], zero at rest."""

    @abc.abstractmethod
    def static_limit(self, direction: Float[Array, ""]) -> Float[Array, ""]:
        """Largest force [N] in stick against a load that pulls towards `direction` (+1 or -1)."""


class AbstractKarnoppLaw(AbstractLaw):
    """A law that balances the load in a band about rest: its force there depends on the other forces."""

    @abc.abstractmethod
    def holds(self, v: Float[Array, ""]) -> Bool[Array, ""]:
        """Whether velocity `v` [m/s] counts as rest."""

    @abc.abstractmethod
    def static_limit(self, direction: Float[Array, ""]) -> Float[Array, ""]:
        """Largest holding force [N] against a load that pulls towards `direction` (+1 or -1)."""

    @abc.abstractmethod
    def force(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Friction force [N] at velocity `v` [m/s] outside the band."""


class AbstractDynamicLaw(AbstractLaw):
    """A law with a state of its own."""

    @abc.abstractmethod
    def initial_state(self, v: Float[Array, "..."]) -> Any:
        """State at rest and unloaded, for slip of the shape of `v`."""

    @abc.abstractmethod
    def zdot(self, v: Float[Array, "..."], z: Any) -> Any:
        """Time derivative of the state `z` at slip velocity `v` [m/s]."""

    @abc.abstractmethod
    def force_given_zdot(self, v: Float[Array, "..."], z: Any, rate: Any) -> Float[Array, "..."]:
        """Friction force [N] at slip velocity `v` [m/s], the state `z`, and a rate of that: damping in the bristle."""

    def force(self, v: Float[Array, "..."], z: Any) -> Float[Array, "..."]:
        """Friction force [N] at slip velocity `v` [m/s] and state `z`."""
        return self.force_given_zdot(v, z, self.zdot(v, z))

    @abc.abstractmethod
    def stored_energy(self, z: Any) -> Float[Array, ""]:
        """Energy [J] held in the state `z`."""

    @abc.abstractmethod
    def step_exact(self, v: Float[Array, "..."], z: Any, dt: Float[Array, ""]) -> Any:
        """State after the time `dt` [s] at constant slip velocity `v` [m/s]: bounded at any step, however stiff."""


class AbstractPlanarLaw(AbstractDynamicLaw):
    """A dynamic law whose slip may also be a vector, shape `[2]` or `[3]`; its state then has as many components.

    What depends on speed depends on the magnitude of slip, so that the components are coupled.
    """
