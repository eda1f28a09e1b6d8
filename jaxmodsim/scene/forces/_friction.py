"""Friction elements: a law along a displacement of the mechanism."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..._core.arguments import as_label
from ..._core.arrays import PerDof, Scalar, is_known
from ..._core.functions import Reaction, StateDependent, as_function, depends_on, is_state_dependent, result_shape
from ..._core.parameters import AbstractRanged, Default, Number, Range, as_number, modules_of, optional_parameter
from ..._core.position import PositionFn, as_optional_position_fn
from ..._core.safe import safe_norm
from ..._core.trace_checks import traced
from ...friction import (
    AbstractAsymmetric,
    AbstractDynamicLaw,
    AbstractForceLaw,
    AbstractKarnoppLaw,
    AbstractLaw,
    AbstractPlanarLaw,
    AbstractSetValuedLaw,
    Curve,
    Geared,
    laws,
)
from ._effect import AbstractEffect, Action, Power

# Part of the reference velocity below which the direction of slip in the plane is rounded off.
_FLOOR = 1e-2


def _law(law: Any) -> AbstractLaw:
    if isinstance(law, AbstractLaw):
        return law
    if callable(law) and not isinstance(law, type):
        return Curve(law)
    given = repr(law) if isinstance(law, str) else f"the class {law.__name__}" if isinstance(law, type) else repr(law)
    raise ValueError(
        f"Friction needs a law or a function of slip velocity, but {given} was given. Known laws: {', '.join(laws())}."
    )


def _belt(value: Any) -> Any:
    if callable(value):
        return as_function(value, name="Friction belt_velocity")
    return as_number(value, name="Friction belt_velocity")


def _load(value: Any) -> Any:
    if value is None or isinstance(value, Reaction):
        return value
    if isinstance(value, str):
        return Reaction(value)
    if callable(value):
        return as_function(value, name="Friction normal_force")
    return as_number(value, name="Friction normal_force")


def _role(x: StateDependent) -> str:
    """Role of a function of the state in its law."""
    return "the torque" if x.number is None else "scaled_by's fn"


class Friction(AbstractEffect, AbstractRanged):
    """A friction law acting along a displacement of the mechanism.

    The slip velocity is `v = d/dt along(q) - belt_velocity`, and the friction force F, positive when it opposes
    positive slip, enters the equations of motion as `-F d along/dq`.

    **Arguments:**

    - `law`: friction as a function of slip, a law or a plain function of slip velocity. A set-valued law (`Coulomb`,
      `Stribeck`) runs exactly, by events: in stick the slip velocity is zero, and the force is the one that keeps it
      zero, up to the law's limit. `Regularized`, `DeadZone` and `Sign` run it in other ways.
    - `along`: `along(q)` or `along(q, params)`. A scalar displacement [m or rad]; by default the one coordinate. Or the
      position of the contact [m], shape `[2]` or `[3]`. With one coordinate slip is the velocity along its path,
      positive for a rising coordinate. With several, slip and friction force are vectors. The force of a law that is a
      function of slip is opposite to slip, with the law's value at the magnitude of slip; `LuGre` and `Dahl` have a
      vector bristle; a set-valued law in stick has any vector up to the limit.
    - `belt_velocity`: velocity [m/s or rad/s] of the surface, a number or a continuous function of t (sticking parts
      would follow a jump); for slip that is a vector, a function that returns one.
    - `normal_force`: load [N]: a number >= 0, `normal_force(t, q, qd, params)`, or the name of a `Constraint`, whose
      reaction is the load; friction and reaction are then solved together. The law's forces are per newton of
      load (`Fc` is the coefficient of friction). If a function of t, q or qd is negative, the parts have lifted
      off, and there is no friction; a function of `params` alone must be >= 0. By default the law's
      forces are in newtons.
    - `name`: name in `run.forces`.
    - `ellipse`: for slip of two components, the ratio of friction across to friction along the first component, > 0:
      the limit of friction is an ellipse with these half-axes, and its direction is that of greatest dissipation. By
      default 1, a circle. The law receives the slip (v_1, ellipse v_2).

    **Raises:**

    - `ValueError` for an unknown law, numbers out of range, and (at the run) for wrong shapes, or without `along` if
      there are several coordinates.

    **Example:**

    ```python
    belt = jms.Friction(jms.Coulomb(Fc=5.0, Fs=8.0), belt_velocity=0.1)
    spring = jms.problems.braked_spring.scene(m=1.0, k=100.0)
    scene = jms.Scene(spring.lagrangian, spring.params, (belt,), coordinates=spring.coordinates)
    print(jms.simulate(scene, [0.0], [0.1], 2.0, ts=jnp.linspace(0.0, 2.0, 301)).events)
    ```

    ```text
    3 mode changes
      t [s]    effect    before    after
      0.8      friction  stick     backward
      1.17851  friction  backward  stick
      1.77851  friction  stick     backward
    ```
    """

    law: AbstractLaw = eqx.field(converter=_law)
    along: PositionFn | None = eqx.field(
        default=None, converter=partial(as_optional_position_fn, name="Friction along")
    )
    belt_velocity: Number | Callable[..., Any] = eqx.field(
        default=Default(0.0), converter=_belt, metadata={"range": Range("")}
    )
    normal_force: Number | Callable[..., Any] | Reaction | None = eqx.field(
        default=None, converter=_load, metadata={"range": Range("N", 0.0)}
    )
    name: str | None = eqx.field(default=None, static=True, converter=partial(as_label, name="Friction name"))
    ellipse: Number | None = optional_parameter("ellipse", "1", lower=0.0, strict=True)

    def bind_state(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> "Friction":
        """The element with its law at this state; itself if the law does not depend on the state."""
        if not is_state_dependent(self.law):
            return self
        return eqx.tree_at(lambda x: x.law, self, self.law.bind_state(t, q, qd, params))

    @property
    def stiff(self) -> bool:
        """Whether the law is stiff."""
        return self.law.stiff

    @property
    def karnopp(self) -> bool:
        """Whether the law needs the other forces (`DeadZone`)."""
        return isinstance(self.law, AbstractKarnoppLaw)

    @property
    def event_driven(self) -> bool:
        """Whether the law runs by events: its force depends on a mode, and in stick on the other forces."""
        return isinstance(self.law, AbstractSetValuedLaw)

    @property
    def load_constraint(self) -> str | None:
        """Name of the constraint whose reaction is the load, or the torque of a gear; None for others."""
        reaction = getattr(self.law, "torque", None) if self.transmits else self.normal_force
        return reaction.constraint if isinstance(reaction, Reaction) else None

    @property
    def transmits(self) -> bool:
        """Whether the law is that of a gear whose torque is the reaction of a constraint."""
        return isinstance(self.law, Geared) and isinstance(self.law.torque, Reaction)

    def gear_parts(self, torque: Scalar) -> tuple["Friction", "Friction", "Friction"]:
        """Elements with parts of the law of a gear: without torque, and the rest at `torque` and at `-torque`."""
        law = self.law
        assert isinstance(law, Geared)
        parts = law.law, law.at_torque(torque), law.at_torque(-torque)
        alone, drives, returns = (eqx.tree_at(lambda x: x.law, self, part) for part in parts)
        return alone, drives, returns

    def check(self, q: PerDof, qd: PerDof, params: PyTree, name: str) -> None:
        """Check the shapes of displacement, belt velocity and load."""
        shape = self._shape(q, params, name)
        if self.along is None and q.shape != (1,):
            raise ValueError(
                f"Friction {name!r} acts on a mechanism with {q.shape[0]} coordinates: say along which"
                " displacement, as in Friction(law, along=lambda q: q[0])."
            )
        if shape not in ((), (2,), (3,)):
            raise ValueError(
                f"Friction {name!r}: along(q) returned the shape {shape}, but one number, shape (), or a position,"
                " shape (2,) or (3,), is needed."
            )
        slip = () if q.shape == (1,) else shape
        sided = any(isinstance(module, AbstractAsymmetric | Geared) for _, module in modules_of(self.law))
        if slip != () and (
            sided or not isinstance(self.law, AbstractForceLaw | AbstractPlanarLaw | AbstractSetValuedLaw)
        ):
            raise ValueError(
                f"Friction {name!r}: along(q) is a position that moves in several directions, and there"
                f" {type(self.law).__name__} cannot act. Needed is a law that is the same in all directions: Coulomb,"
                " Stribeck or another set-valued one, LuGre, Dahl, a function of slip; or give a scalar displacement."
            )
        if self.ellipse is not None and slip != (2,):
            raise ValueError(
                f"Friction {name!r}: ellipse needs slip that is a vector of two components, but slip has the shape"
                f" {slip}: return a position of shape (2,) from along."
            )
        if sum(isinstance(module, Reaction) for _, module in modules_of(self.law)) > self.transmits:
            raise ValueError(
                f"Friction {name!r}: the torque of Geared is the reaction of a constraint, so the law must be Geared"
                f" itself, run by events, and not part of {type(self.law).__name__}."
            )
        if self.transmits and self.normal_force is not None:
            raise ValueError(
                f"Friction {name!r}: the torque of its gear is the reaction of {self.load_constraint!r}; leave out"
                " normal_force."
            )
        self._check_direction(q, params, name)
        load = None if self.load_constraint is not None else self.normal_force
        varying = [x for _, x in modules_of(self.law) if isinstance(x, StateDependent)]
        state = {"t": q[0], "q": q, "qd": qd, "params": params}
        for label, fn, args, wanted in (
            ("belt_velocity(t)", self.belt_velocity, {"t": q[0]}, slip),
            ("normal_force(t, q, qd, params)", load, state, ()),
            *((f"{_role(x)}(t, q, qd, params)", x.fn, state, ()) for x in varying),
        ):
            given = result_shape(fn, **args, name=f"{label} of Friction {name!r}") if callable(fn) else wanted
            if given != wanted:
                raise ValueError(f"Friction {name!r}: {label} returned the shape {given}, but {wanted} is needed.")

    def _check_direction(self, q: PerDof, params: PyTree, name: str) -> None:
        """Refuse a displacement whose gradient is zero for all q and params; one that vanishes at some is allowed."""
        if self.along is None or depends_on(lambda q: self.direction(q, params), q):
            return
        with jax.ensure_compile_time_eval():  # one program: each operation alone would compile as well
            direction = jax.jit(lambda q: self.direction(q, params))(np.ones(q.shape, q.dtype))
        if is_known(direction) and not np.asarray(direction).any():
            raise ValueError(
                f"Friction {name!r}: the displacement along(q) never changes with q, so the friction would have no"
                " effect. Return a displacement that moves, as in along=lambda q: q[0]."
            )

    def _shape(self, q: Any, params: PyTree, name: str) -> tuple[int, ...] | None:
        """Shape of the displacement."""
        if self.along is None:
            return ()
        return result_shape(self.along, q=q, params=params, name=f"along of Friction {name!r}")

    def check_belt(self, q: Any, params: PyTree, name: str) -> None:
        """Refuse a belt velocity that is a nonzero number if slip is a vector.

        **Raises:**

        - `ValueError` naming the element and the shape of its slip.
        """
        assert self.along is not None
        slip = self._shape(q, params, name)
        if slip != ():
            raise ValueError(
                f"Friction {name!r}: slip is a vector of shape {slip}, so belt_velocity must be a function of t that"
                f" returns one, but {self.belt_velocity} was given."
            )

    def initial_state(self, q: PerDof, params: PyTree) -> PyTree:
        """State of the law; None without one."""
        if not isinstance(self.law, AbstractDynamicLaw):
            return None
        return self.law.initial_state(jnp.zeros(self.slip_shape(q, params), q.dtype))

    def slip_shape(self, q: PerDof, params: PyTree) -> tuple[int, ...]:
        """Shape of the slip: (), or that of a vector if `along` is a position that moves in several directions."""
        if self.along is None or q.shape == (1,):
            return ()
        return traced(
            self.along, q=q, params=params, name=f"along of Friction {self.name or self.default_name!r}"
        ).shape

    def direction(self, q: PerDof, params: PyTree) -> Float[Array, "*components dof"]:
        """Gradient d along/dq of the slip: the generalised force of a unit force along the displacement.

        A vector has one for each component, scaled by `ellipse`.
        """
        if self.along is None:
            return jnp.ones_like(q)
        if q.shape == (1,):
            return jnp.reshape(self._pace(q, params), (1,))
        if self.slip_shape(q, params) == ():
            return jax.grad(self.along)(q, params)
        return jax.vmap(self.stretch, in_axes=1, out_axes=1)(jax.jacrev(self.along)(q, params))

    def _pace(self, q: Float[Array, "1"], params: PyTree) -> Scalar:
        """Displacement per unit of the one coordinate; for a position the length of its tangent."""
        tangent = self._moves(q, jnp.ones_like(q), params)
        return tangent if tangent.ndim == 0 else safe_norm(tangent)

    def _moves(self, q: PerDof, qd: PerDof, params: PyTree) -> Float[Array, "..."]:
        """Rate of the displacement."""
        along = self.along
        assert along is not None
        return jax.jvp(lambda q: along(q, params), (q,), (qd,))[1]

    def belt(self, t: Scalar) -> Float[Array, "..."]:
        """Velocity [m/s or rad/s] of the surface."""
        fn = self.belt_velocity
        return jnp.asarray(fn(t), t.dtype) if callable(fn) else fn

    def slip(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Float[Array, "..."]:
        """Slip velocity [m/s or rad/s], a scalar, or a vector if `along` is a position in several directions."""
        if self.along is None:
            return qd[0] - self.belt(t)
        if q.shape == (1,):
            return self._pace(q, params) * qd[0] - self.belt(t)
        return self._moves(q, qd, params) - self.belt(t)

    def slip_and_rate(
        self, t: Scalar, q: PerDof, qd: PerDof, qdd: PerDof, params: PyTree
    ) -> tuple[Float[Array, "*components"], Float[Array, "*components"]]:
        """Slip velocity, and its rate for the accelerations `qdd`."""
        return jax.jvp(lambda t, q, qd: self.slip(t, q, qd, params), (t, q, qd), (jnp.ones_like(t), qd, qdd))

    def load(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Scalar | None:
        """Normal load [N], never negative; None if the law's forces are in newtons, or per newton of a reaction."""
        fn = self.normal_force
        if fn is None or isinstance(fn, Reaction):
            return None
        load = jnp.asarray(fn(t, q, qd, params) if callable(fn) else fn)
        return jnp.where(load < 0, 0.0, load)  # the derivative of `maximum` at zero is a half

    @property
    def num_kinks(self) -> int:
        """Number of `kinks`; zero if the law does not run by events."""
        return sum(len(law.kinks) for law in self._kinked) if self.event_driven else 0

    def kinks(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> list[Scalar]:
        """Numbers at whose zeros the force has a kink, such as the torques of gears [N m]."""
        laws = self.bind_state(t, q, qd, params)._kinked
        return [jnp.asarray(kink(law), q.dtype) for law in laws for kink in law.kinks]

    def on_sides(self, sides: Float[Array, " kinks"]) -> "Friction":
        """The element with these signs of its kinks, so that its force is smooth where they change."""
        stops = np.cumsum([len(law.kinks) for law in self._kinked])[:-1]
        parts = jnp.split(sides, stops)
        return eqx.tree_at(lambda x: [law.sides for law in x._kinked], self, parts, is_leaf=lambda x: x is None)

    @property
    def _kinked(self) -> list[Any]:
        """The laws with kinks, within others, too. A kink at a reaction of zero is that of `Scene.guides`."""
        laws = [x for _, x in modules_of(self.law) if isinstance(x, AbstractSetValuedLaw) and x.kinks]
        return [x for x in laws if not (self.transmits and x is self.law)]

    def apply_force(self, q: PerDof, force: Float[Array, "..."], params: PyTree) -> PerDof:
        """Generalised force of the friction force `force`."""
        if self.along is None:
            return jnp.reshape(-force, (1,))
        if force.ndim == 0:
            return -force * self.direction(q, params)
        along = self.along
        _, pull = jax.vjp(lambda q: along(q, params), q)
        return pull(-force)[0]

    def static_limit(self, direction: Scalar, load: Scalar | None) -> Scalar:
        """Largest force [N] in stick against a load towards `direction` (+1 or -1)."""
        assert isinstance(self.law, AbstractSetValuedLaw | AbstractKarnoppLaw)
        limit = self.law.static_limit(direction)
        return limit if load is None else load * limit

    def slip_force(self, v: Scalar, direction: Scalar, load: Scalar | None) -> Scalar:
        """Force [N] of a set-valued law in slip at velocity `v` towards `direction` (+1 or -1).

        A trial step may run past the end of the slip. The law continues there as a straight line, so that the field is
        smooth in the step.
        """
        assert isinstance(self.law, AbstractSetValuedLaw)
        law, speed = self.law, direction * v
        # On the side of the slip even at zero: a law may have other parameters for each direction.
        rest = direction * float(jnp.finfo(v.dtype).tiny)
        _, slope = jax.jvp(law.sliding_force, (rest,), (direction,))
        slope = jnp.where(jnp.isfinite(slope), slope, 0.0)
        level = law.sliding_force(direction * jnp.where(speed >= 0, speed, 0.0) + rest)
        level = level + slope * jnp.where(speed >= 0, 0.0, speed)
        force = direction * level + law.viscous_force(v)
        return force if load is None else load * force

    def slip_force_in_plane(
        self, v: Float[Array, " d"], reference: Float[Array, " d"], load: Scalar | None
    ) -> Float[Array, " d"]:
        """Force [N] of a set-valued law in slip at the velocity `v`, a vector, in its direction.

        A trial step may run past the end of the slip. On a line through rest slip and force continue as those of a
        scalar slip, with the sign of the component of `v` along `reference`, an earlier velocity. If that component is
        below 1e-2 of `reference`, the direction of the force changes smoothly to that of `reference`: the force has two
        continuous derivatives, as the error of the first one limits the steps of a run with derivatives.
        """
        speed = safe_norm(reference)
        direction = reference / jnp.where(speed > 0, speed, 1.0)
        none = _FLOOR * jnp.where(speed > 0, speed, 1.0)
        along = jnp.sum(v * direction)
        part = along / none
        slips = jnp.abs(part) > 1.0
        far, near = jnp.where(slips, part, 1.0), jnp.where(slips, 0.0, part)
        inverse = jnp.where(slips, 1.0 / far, near * (3.0 - near * near * (3.0 - near * near))) / none
        tangent = (v - along * direction) * inverse
        slant = jnp.sqrt(1.0 + jnp.sum(tangent * tangent))
        return self.slip_force(along * slant, jnp.ones_like(along), load) / slant * (direction + tangent)

    def force_per_load(
        self, t: Scalar, q: PerDof, qd: PerDof, z: PyTree, params: PyTree
    ) -> tuple[Float[Array, "..."], PyTree]:
        """The law's force, in newtons or per newton of load, and the rate of its state.

        **Raises:**

        - `TypeError` for a set-valued law, whose force depends on a mode.
        """
        v = self.stretch(self.slip(t, q, qd, params))
        if isinstance(self.law, AbstractDynamicLaw):
            return self.stretch(self.law.force(v, z)), self.law.zdot(v, z)
        if not isinstance(self.law, AbstractForceLaw | AbstractKarnoppLaw):
            raise TypeError(f"{type(self.law).__name__} acts by a mode, or is of no known kind of law.")
        return self.stretch(_of_slip(self.law.force, v)), None

    def step_exact(
        self, v: Float[Array, "..."], z: PyTree, dt: Scalar, load: Scalar | None
    ) -> tuple[Float[Array, "..."], PyTree]:
        """Friction force over, and state of the law after, the time `dt` [s] at constant slip velocity `v`.

        Damping in a bristle is that of its mean rate, so that its impulse is exact for any change of the bristle.
        """
        v = self.stretch(v)
        if isinstance(self.law, AbstractDynamicLaw):
            after = self.law.step_exact(v, z, dt)
            force = self.law.force_given_zdot(v, after, _mean_rate(self.law, v, z, after, dt))
            z = after
        else:
            assert isinstance(self.law, AbstractForceLaw)
            force = _of_slip(self.law.force, v)
        force = self.stretch(force)
        return (force if load is None else load * force), z

    def stretch(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """A slip, or a force, scaled by `ellipse`: from the mechanism to the law, and back."""
        return x if self.ellipse is None else x * jnp.stack([jnp.ones_like(self.ellipse), self.ellipse])

    def act(self, t: Scalar, q: PerDof, qd: PerDof, z: PyTree, params: PyTree) -> Action:
        """Friction force, its generalised force and the rate of the law's state."""
        force, rate = self.force_per_load(t, q, qd, z, params)
        load = self.load(t, q, qd, params)
        force = force if load is None else load * force
        return Action(self.apply_force(q, force, params), force, rate)

    def power(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree, action: Action) -> Power:
        """The belt supplies -F times its velocity; slip absorbs F times the slip velocity."""
        return Power(-jnp.sum(action.force * self.belt(t)), jnp.sum(action.force * self.slip(t, q, qd, params)))

    def stored_energy(self, z: PyTree) -> Scalar | float:
        """Energy [J] in the law's state, for laws in newtons; 0 with a load, or parameters that vary."""
        if isinstance(self.law, AbstractDynamicLaw) and self.normal_force is None and not is_state_dependent(self.law):
            return self.law.stored_energy(z)
        return 0.0


def _mean_rate(law: AbstractDynamicLaw, v: Float[Array, "..."], z: PyTree, after: PyTree, dt: Array) -> PyTree:
    """Mean rate of a state that changes from `z` to `after` in `dt` [s] at constant slip velocity.

    It lies between the rates at both ends, which are more accurate than the quotient if that is dominated by rounding,
    as in steady slip. The derivative is that of the quotient there, too.
    """

    def mean(before: Array, after: Array, first: Array, last: Array) -> Array:
        quotient = jnp.where(dt == 0, first, (after - before) / jnp.where(dt == 0, 1.0, dt))
        inside = jnp.clip(quotient, jnp.minimum(first, last), jnp.maximum(first, last))
        return jax.lax.stop_gradient(inside) + (quotient - jax.lax.stop_gradient(quotient))

    return jtu.tree_map(mean, z, after, law.zdot(v, z), law.zdot(v, after))


def _of_slip(force: Callable[..., Any], v: Float[Array, "..."]) -> Float[Array, "..."]:
    """Force of a function of slip; for a vector in its direction, with the function's value at its magnitude."""
    if v.ndim == 0:
        return force(v)
    speed = safe_norm(v)
    # At rest the force is a linear function of slip; the quotient would be 0/0.
    rest = jnp.zeros_like(speed)
    _, slope = jax.jvp(force, (rest,), (jnp.ones_like(speed),))
    moves = speed > 0
    return jnp.where(moves, force(speed) / jnp.where(moves, speed, 1.0), slope) * v
