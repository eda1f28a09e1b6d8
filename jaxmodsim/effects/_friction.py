"""Where a friction law acts."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..friction import (
    AbstractDynamicLaw,
    AbstractForceLaw,
    AbstractHoldingLaw,
    AbstractLaw,
    AbstractSetValuedLaw,
)
from ..numerics import Number, as_function, as_number
from ._effect import AbstractEffect, Action, Power, result_shape


def _law(law: Any) -> AbstractLaw:
    if not isinstance(law, AbstractLaw):
        given = repr(law) if isinstance(law, str) else f"a {type(law).__name__}"
        raise ValueError(
            f"Friction needs a law object, but {given} was given. Known laws: Viscous, Coulomb, Stribeck, LuGre;"
            " wrappers: Regularized, DeadZone, Sign."
        )
    return law


def _along(value: Any) -> Callable[..., Any] | None:
    return None if value is None else as_function(value, name="Friction along")


def _belt(value: Any) -> Any:
    if callable(value):
        return as_function(value, name="Friction belt_velocity")
    return as_number(value, name="Friction belt_velocity")


def _load(value: Any) -> Any:
    if value is None or callable(value):
        return None if value is None else as_function(value, name="Friction normal_force")
    return as_number(value, name="Friction normal_force")


class Friction(AbstractEffect):
    """A friction law acting along a scalar displacement of the mechanism.

    The slip velocity is `v = d/dt along(q) - belt_velocity`, and the friction force F, positive when it opposes
    positive slip, enters the equations of motion as `-F d along/dq`.

    **Arguments:**

    - `law`: how friction depends on slip. A set-valued law (`Coulomb`, `Stribeck`) runs exactly, by events: in stick
      the slip velocity is zero and the force is what that takes, up to the law's limit. `Regularized`, `DeadZone` and
      `Sign` run it in other ways.
    - `along`: `along(q)`, the displacement [m or rad], a scalar. By default the one coordinate.
    - `belt_velocity`: velocity [m/s or rad/s] of the surface, a number or a continuous function of t; a jump would
      carry with it what sticks.
    - `normal_force`: load [N], a number or `normal_force(t, q, qd, params)`. Then the law's forces are per newton of
      load (`Fc` is the coefficient of friction), and a negative load, which is lift-off, gives no friction. By
      default the law's forces are in newtons.
    - `name`: name in `run.forces`.

    **Raises:**

    - `ValueError` for a law that is none, and (at the run) for wrong shapes or for `along` missing where there are
      several coordinates.
    """

    law: AbstractLaw = eqx.field(converter=_law)
    along: Callable[..., Any] | None = eqx.field(default=None, converter=_along)
    belt_velocity: Number | Callable[..., Any] = eqx.field(default=0.0, converter=_belt)
    normal_force: Number | Callable[..., Any] | None = eqx.field(default=None, converter=_load)
    name: str | None = eqx.field(default=None, static=True)

    @property
    def default_name(self) -> str:
        """Name in the results."""
        return "friction"

    @property
    def stiff(self) -> bool:
        """As the law says."""
        return self.law.stiff

    @property
    def holding(self) -> bool:
        """Whether the law needs to know the other forces (`DeadZone`)."""
        return isinstance(self.law, AbstractHoldingLaw)

    @property
    def exact(self) -> bool:
        """Whether the law runs by events: its force depends on a mode, and in stick on the other forces."""
        return isinstance(self.law, AbstractSetValuedLaw)

    def check(self, q: Float[Array, " dof"], qd: Float[Array, " dof"], params: PyTree, name: str) -> None:
        """Check that there is one displacement, one belt velocity and one load."""
        if self.along is None:
            if q.shape != (1,):
                raise ValueError(
                    f"Friction {name!r} acts on a mechanism with {q.shape[0]} coordinates: say along which"
                    " displacement, as in Friction(law, along=lambda q: q[0])."
                )
        elif result_shape(self.along, q) != ():
            raise ValueError(
                f"Friction {name!r}: along(q) returned the shape {result_shape(self.along, q)}, but one number,"
                " shape (), is needed."
            )
        for label, fn, args in (
            ("belt_velocity(t)", self.belt_velocity, (q[0],)),
            ("normal_force(t, q, qd, params)", self.normal_force, (q[0], q, qd, params)),
        ):
            if callable(fn) and result_shape(fn, *args) != ():
                raise ValueError(
                    f"Friction {name!r}: {label} returned the shape {result_shape(fn, *args)}, but one number,"
                    " shape (), is needed."
                )

    def state0(self) -> PyTree:
        """State of the law; None where it has none."""
        return self.law.state0() if isinstance(self.law, AbstractDynamicLaw) else None

    def direction(self, q: Float[Array, " dof"]) -> Float[Array, " dof"]:
        """Gradient d along/dq: the generalised force of a unit force along the displacement."""
        return jnp.ones_like(q) if self.along is None else jax.grad(self.along)(q)

    def belt(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """Velocity [m/s or rad/s] of the surface."""
        fn = self.belt_velocity
        return jnp.asarray(fn(t), t.dtype) if callable(fn) else fn

    def slip(self, t: Float[Array, ""], q: Float[Array, " dof"], qd: Float[Array, " dof"]) -> Float[Array, ""]:
        """Slip velocity [m/s or rad/s]."""
        speed = qd[0] if self.along is None else jax.jvp(self.along, (q,), (qd,))[1]
        return speed - self.belt(t)

    def load(
        self, t: Float[Array, ""], q: Float[Array, " dof"], qd: Float[Array, " dof"], params: PyTree
    ) -> Float[Array, ""] | None:
        """Normal load [N], never negative; None where the law's forces are in newtons."""
        if self.normal_force is None:
            return None
        fn = self.normal_force
        return jnp.maximum(jnp.asarray(fn(t, q, qd, params) if callable(fn) else fn), 0.0)

    def push(self, q: Float[Array, " dof"], force: Float[Array, ""]) -> Float[Array, " dof"]:
        """Generalised force of the friction force `force`."""
        return jnp.reshape(-force, (1,)) if self.along is None else -force * self.direction(q)

    def limit(self, direction: float, load: Float[Array, ""] | None) -> Float[Array, ""]:
        """Largest force [N] of a set-valued law in stick against a load towards `direction` (+1 or -1)."""
        assert isinstance(self.law, AbstractSetValuedLaw)
        limit = self.law.limit(jnp.asarray(direction, jnp.result_type(self.law.limit(jnp.asarray(1.0)))))
        return limit if load is None else load * limit

    def slip_force(
        self, v: Float[Array, ""], direction: Float[Array, ""], load: Float[Array, ""] | None
    ) -> Float[Array, ""]:
        """Force [N] of a set-valued law in slip at velocity `v` towards `direction` (+1 or -1).

        A trial step may run past the end of the slip. There the law goes on as a straight line, so that the field is
        smooth in the step.
        """
        assert isinstance(self.law, AbstractSetValuedLaw)
        law, speed = self.law, direction * v
        # On the side of the slip even at zero: a law may have other parameters for either direction.
        rest = direction * float(jnp.finfo(v.dtype).tiny)
        _, slope = jax.jvp(law.dry, (rest,), (direction,))
        slope = jnp.where(jnp.isfinite(slope), slope, 0.0)
        level = law.dry(direction * jnp.where(speed >= 0, speed, 0.0) + rest)
        level = level + slope * jnp.where(speed >= 0, 0.0, speed)
        force = direction * level + law.wet(v)
        return force if load is None else load * force

    def act(
        self, t: Float[Array, ""], q: Float[Array, " dof"], qd: Float[Array, " dof"], z: PyTree, params: PyTree
    ) -> Action:
        """Friction force, its generalised force and the rate of the law's state."""
        v, rate = self.slip(t, q, qd), None
        if isinstance(self.law, AbstractDynamicLaw):
            force, rate = self.law.force(v, z), self.law.rate(v, z)
        elif isinstance(self.law, AbstractForceLaw | AbstractHoldingLaw):
            force = self.law.force(v)
        else:
            raise TypeError(f"{type(self.law).__name__} acts by a mode, or is of no known kind of law.")
        load = self.load(t, q, qd, params)
        force = force if load is None else load * force
        return Action(self.push(q, force), force, rate)

    def power(self, t: Float[Array, ""], q: Float[Array, " dof"], qd: Float[Array, " dof"], action: Action) -> Power:
        """The belt brings in -F times its velocity; slip absorbs F times the slip velocity."""
        return Power(-action.force * self.belt(t), action.force * self.slip(t, q, qd))

    def stored(self, z: PyTree) -> Float[Array, ""] | float:
        """Energy [J] in the law's state, for laws in newtons; under a load of its own it has no fixed energy."""
        if isinstance(self.law, AbstractDynamicLaw) and self.normal_force is None:
            return self.law.stored(z)
        return 0.0
