"""Base class of effects, which are forces on the mechanism."""

import abc
from typing import TYPE_CHECKING, NamedTuple, cast

import equinox as eqx
from equinox import AbstractVar
from jaxtyping import Array, Float, PyTree

from ..._core.arrays import PerDof, Scalar


class Action(NamedTuple):
    """Forces of an effect at one state.

    - `generalised`: generalised force on each coordinate, shape `[dof]` [N or N m].
    - `force`: the force in the effect's own terms, as reported along a run.
    - `rate`: time derivative of the effect's own state; None without one.
    """

    generalised: PerDof
    force: Float[Array, "..."]
    rate: PyTree = None


class Power(NamedTuple):
    """Power [W] that an effect supplies from outside, and power that it absorbs (loses or stores).

    `absorbed` is None for an effect that never absorbs power: a constant zero is not integrated.
    """

    supplied: Scalar
    absorbed: Scalar | None = None


class AbstractEffect(eqx.Module):
    """A force on the mechanism, with or without a state of its own.

    A subclass has the field `name` and the methods below; its numbers are fields, too.

    **Example:**

    ```python
    class Drag(jms.AbstractEffect):
        c: float  # N s^2/m^2
        name: str | None = None
        default_name = "drag"
        stiff = False

        def check(self, q, qd, params, name):
            pass

        def initial_state(self, q, params):
            return None

        def act(self, t, q, qd, z, params):
            force = self.c * jnp.abs(qd) * qd
            return jms.scene.Action(-force, force)

        def power(self, t, q, qd, params, action):
            return jms.scene.Power(0.0 * t, jnp.sum(action.force * qd))

        def stored_energy(self, z):
            return 0.0

    scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, {}, (Drag(c=1.0),))
    print(f"{jms.simulate(scene, [0.0], [1.0], 1.0).qd[-1, 0]:.4f} m/s")  # 1/(1 + c t)
    ```

    ```text
    0.5000 m/s
    ```
    """

    # Name of the effect in the results; None for that of the class.
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
        """Name in the results without a name from the user."""

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
        """Forces, and the rate of the effect's state `z`."""

    @abc.abstractmethod
    def power(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree, action: Action) -> Power:
        """Power of an action of this effect."""

    @abc.abstractmethod
    def stored_energy(self, z: PyTree) -> Scalar | float:
        """Energy [J] in the effect's state."""
