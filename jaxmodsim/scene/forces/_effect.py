"""Base class of effects, which are forces on the mechanism."""

import abc
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Float, PyTree

from ..._core.arguments import nearest
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

    A subclass has the field `name` and the method `act`; its numbers are fields, too. The other methods have defaults:
    an effect that is not stiff, has no state, and supplies all its power from outside.

    **Example:**

    ```python
    class Drag(jms.AbstractEffect):
        c: float  # N s^2/m^2
        name: str | None = None

        def act(self, t, q, qd, z, params):
            force = self.c * jnp.abs(qd) * qd
            return jms.scene.Action(-force, force)

        def power(self, t, q, qd, params, action):
            return jms.scene.Power(0.0 * t, jnp.sum(action.force * qd))

    scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, {}, (Drag(c=1.0),))
    print(f"{jms.simulate(scene, [0.0], [1.0], 1.0).qd[-1, 0]:.4f} m/s")  # 1/(1 + c t)
    ```

    ```text
    0.5000 m/s
    ```
    """

    # Name of the effect in the results; None for `default_name`.
    if TYPE_CHECKING:
        name = cast("str | None", None)  # not a field, which would come before those of the effects
    else:
        name: AbstractVar[str | None]

    def __init_subclass__(cls, **options: Any) -> None:
        """Refuse methods whose names are misspelled: the default would be called instead."""
        super().__init_subclass__(**options)
        known = [name for name in vars(AbstractEffect) if not name.startswith("_")]
        for name, value in vars(cls).items():
            near = nearest(name.lower(), known, 0.85)
            if near and name not in known and (callable(value) or isinstance(value, property)):
                raise TypeError(f"{cls.__name__}.{name} is no method of AbstractEffect. Did you mean {near!r}?")

    def bind_state(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> "AbstractEffect":
        """The effect with its parameters at a state of the mechanism; itself if none of them depends on the state."""
        return self

    @property
    def default_name(self) -> str:
        """Name in the results without a name from the user; by default that of the class in lower case."""
        return type(self).__name__.lower()

    @property
    def stiff(self) -> bool:
        """Whether the effect makes the equations of motion stiff."""
        return False

    def check(self, q: PerDof, qd: PerDof, params: PyTree, name: str) -> None:
        """Check shapes against the mechanism while tracing; raises `ValueError` naming the effect."""
        return

    def initial_state(self, q: PerDof, params: PyTree) -> PyTree:
        """State at rest and unloaded, at the coordinates `q`; None for an effect without one."""
        return None

    @abc.abstractmethod
    def act(self, t: Scalar, q: PerDof, qd: PerDof, z: PyTree, params: PyTree) -> Action:
        """Forces, and the rate of the effect's state `z`."""

    def power(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree, action: Action) -> Power:
        """Power of an action of this effect; by default all of it comes from outside."""
        return Power(jnp.sum(action.generalised * qd))

    def stored_energy(self, z: PyTree) -> Scalar | float:
        """Energy [J] in the effect's state."""
        return 0.0
