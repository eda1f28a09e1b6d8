"""The data of a scene."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree

from .._core.arrays import PerDof, Scalar
from .._core.functions import as_function
from .._core.parameters import as_real, is_weak
from .._core.readable import AbstractReadable
from .._core.safe import rounding_of
from ..friction import AbstractLaw
from ..mechanics import AbstractConstraint, AbstractEquations, BoundContact, Contact, Lagrangian, Poisson
from ._coordinates import as_coordinates, read_label
from ._signal import Signal, signals_at, signals_from, signals_of
from .forces._effect import AbstractEffect
from .forces._friction import Friction
from .forces._switch import Switch

# The test of uniqueness takes every corner of the box of slopes, two to this power; an impact tries stick, and slip in
# either direction, for each element, three to this power.
_MOST_LOADS = 4
# An impact tries every set of contacts that may push: two to this power.
_MOST_CONTACTS = 6

_Modes = TypeVar("_Modes", Array, range)


def _params(params: PyTree) -> PyTree:
    def convert(path: Any, leaf: Any) -> Any:
        within_module = bool(path) and isinstance(path[-1], jtu.GetAttrKey)  # an optional field
        if isinstance(leaf, Signal) or (leaf is None and within_module):
            return leaf
        name = f"params{jtu.keystr(path)}"
        if leaf is None:
            raise ValueError(
                f"{name} is None, but a real number, an array of real numbers or a Signal is needed: give it a value,"
                " or leave it out."
            )
        return as_real(leaf, name=name)

    return jtu.tree_map_with_path(convert, params, is_leaf=lambda x: x is None or isinstance(x, Signal))


class _Driven(eqx.Module):
    """A Lagrangian whose parameters change with time, so that its derivative by t contains their rates."""

    lagrangian: Lagrangian
    params: PyTree

    def __call__(self, t: Any, q: Any, qd: Any, params: PyTree) -> Any:
        """The Lagrangian with its own parameters at time `t`."""
        return self.lagrangian(t, q, qd, signals_at(self.params, t))


def _effects(effects: Any) -> tuple[AbstractEffect, ...]:
    if isinstance(effects, AbstractEffect) or not isinstance(effects, tuple | list):
        raise ValueError(f"effects must be a tuple of effects, as in effects=(effect,), but got {effects!r}.")
    for effect in effects:
        if not isinstance(effect, AbstractEffect):
            remedy = ""
            if isinstance(effect, AbstractConstraint):
                remedy = " It goes into constraints=(...)."
            elif isinstance(effect, AbstractLaw):
                remedy = " A friction law goes into Friction(law)."
            raise ValueError(
                f"effects must hold AppliedForce, Friction or Switch objects, but it holds {effect!r}.{remedy}"
            )
    return tuple(effects)


def _constraints(constraints: Any) -> tuple[AbstractConstraint, ...]:
    if isinstance(constraints, AbstractConstraint) or not isinstance(constraints, tuple | list):
        raise ValueError(f"constraints must be a tuple, as in constraints=(constraint,), but got {constraints!r}.")
    for constraint in constraints:
        if not isinstance(constraint, AbstractConstraint):
            raise ValueError(
                f"constraints must hold Constraint, VelocityConstraint or Contact objects, but it holds {constraint!r}."
            )
    return tuple(constraints)


def _names(things: Any, default: Callable[[Any], str]) -> tuple[str, ...]:
    """Name of each thing: its own, or that of its kind with a number from the second of the kind on."""
    taken = {each.name for each in things if each.name is not None}
    names: list[str] = []
    for each in things:
        kind = default(each)
        name, count = each.name or kind, 1
        while each.name is None and (name in taken or name in names):
            count += 1
            name = f"{kind}_{count}"
        names.append(name)
    return tuple(names)


class Scene(AbstractReadable, eqx.Module):
    """A mechanism, the effects on it, and its constraints.

    A scene is a pytree whose leaves are all its numbers. `jax.grad`, `jax.vmap` and `equinox.tree_at` work on it, and a
    change of a number never recompiles. Functions are compared by identity: define a Lagrangian once, not as a new
    lambda in every call.

    **Arguments:**

    - `lagrangian`: `L(t, q, qd, params)` -> energy [J], a scalar; a pure JAX function, q and qd of shape `[dof]`. The
      run raises an error for an index beyond that, here and in the functions of effects and constraints, if it is a
      number or an array of numbers. JAX silently uses another entry for an index out of range; that still holds for
      indices that are computed from q, qd or `params`, or that count a loop of `jax.lax`.
    - `params`: pytree of real numbers, arrays or `Signal`s for the Lagrangian and the applied forces, usually a
      mapping by names. Integers become floating; other values (sizes, options, None) belong in the functions.
    - `effects`: tuple of `AppliedForce`, `Friction` and `Switch`.
    - `constraints`: tuple of `Constraint` and `VelocityConstraint`, for dependent coordinates, and of `Contact`.
    - `coordinates`: names of the coordinates with their units, such as `("x [m]", "phi [rad]")`, for messages, tables
      and figures. A unit is a product or quotient of SI units or of mm, deg and the like; `-` means no unit. Functions
      and names of observed series use `q[0]`, `q[1]`.

    **Raises:**

    - `ValueError` for an entry of a wrong type, two entries of one name, an unknown unit, and friction whose load is an
      unknown constraint; at the run if the number of `coordinates` is not that of q0.

    **Example:**

    ```python
    def pendulum(t, q, qd, p):
        return 0.5 * p["m"] * (p["l"] * qd[0]) ** 2 + p["m"] * 9.81 * p["l"] * jnp.cos(q[0])

    hinge = jms.Friction(jms.Coulomb(Fc=0.1), name="hinge")
    print(jms.Scene(pendulum, {"m": 1.0, "l": 0.5}, (hinge,), coordinates=("phi [rad]",)))
    ```

    ```text
    Scene of pendulum in phi [rad]
      number [unit]                value
      l                            0.5
      m                            1
      hinge.Fc [N m]               0.1
      hinge.belt_velocity [rad/s]  0
    effects: hinge (Coulomb)
    ```
    """

    lagrangian: Lagrangian = eqx.field(converter=partial(as_function, name="Scene lagrangian"))
    params: PyTree[Array] = eqx.field(default_factory=dict, converter=_params)
    effects: tuple[AbstractEffect, ...] = eqx.field(default=(), converter=_effects)

    constraints: tuple[AbstractConstraint, ...] = eqx.field(default=(), converter=_constraints)
    coordinates: tuple[str, ...] = eqx.field(default=(), static=True, converter=as_coordinates)

    def __check_init__(self) -> None:
        """Refuse equal names and parts that exclude each other; give default numbers the type of the others."""
        self._settle_defaults()
        given = [each.name for each in self.effects if each.name is not None]
        for name in given:
            if given.count(name) > 1:
                raise ValueError(f"Two effects have the name {name!r}; names of effects must differ.")
        held = [each.name for each in self.constraints if each.name is not None]
        for name in held:
            if held.count(name) > 1:
                raise ValueError(f"Two constraints have the name {name!r}; names of constraints must differ.")
        for name in set(self.names) & set(self.constraint_names):
            raise ValueError(f"An effect and a constraint both have the name {name!r}; give one of them another name.")
        coordinates = [read_label(text).name for text in self.coordinates]
        owners = {"t": "the time", "time": "the time"}
        owners |= {f"{each}_dot": "a velocity" for each in coordinates} | dict.fromkeys(self.names, "an effect")
        if taken := [f"{name!r} is also that of {owners[name]}" for name in coordinates if name in owners]:
            raise ValueError(f"A coordinate needs a name of its own: {', '.join(taken)}. Rename one of each pair.")
        if self.event_driven and any(each.karnopp for each in self.friction.values()):
            raise ValueError(
                f"{', '.join(self.event_driven)}: set-valued laws of one scene run either all by events or all by"
                " DeadZone, as each must know the forces of the others. Wrap all of them in DeadZone, or none."
            )
        for name, effect in self.friction.items():
            if effect.load_constraint is None:
                continue
            if effect.load_constraint not in self.constraint_names:
                known = ", ".join(repr(x) for x in self.constraint_names) or "none"
                raise ValueError(
                    f"Friction {name!r}: {'torque' if effect.transmits else 'normal_force'}={effect.load_constraint!r}"
                    f" names no constraint of the scene; there are: {known}."
                )
            if effect.transmits and effect.load_constraint in self._all_contacts:
                raise ValueError(
                    f"Friction {name!r}: torque={effect.load_constraint!r} names a Contact, which only pushes; a gear"
                    " needs a Constraint."
                )
            if effect.karnopp:
                raise ValueError(
                    f"Friction {name!r}: under the load of a constraint DeadZone cannot run; let the law run by events,"
                    " or wrap it as Regularized(law, width)."
                )
        if len(self.loaded) > _MOST_LOADS:
            raise ValueError(
                f"Friction rests on {len(self.loaded)} constraints, but no more than {_MOST_LOADS} can be solved"
                " together; give the load of the others as functions."
            )
        if len(self.impact_friction) > _MOST_LOADS:
            raise ValueError(
                f"{', '.join(self.impact_friction)}: no more than {_MOST_LOADS} friction elements under contacts can be"
                " solved together with an impact; wrap the laws of the others as Regularized(law, width), which take"
                " no part in impacts."
            )
        if len({isinstance(each.restitution, Poisson) for each in self.contacts.values()}) > 1:
            raise ValueError(
                f"{', '.join(self.contacts)}: contacts of one scene obey one law of impact. Give restitution=Poisson(e)"
                " to all of them, or numbers."
            )
        if len(self.contacts) > _MOST_CONTACTS:
            raise ValueError(
                f"There are {len(self.contacts)} contacts, but impacts of no more than {_MOST_CONTACTS} can be solved"
                " together, as every set of them is tried: leave out those that never touch, or give the others a"
                " force of their own by AppliedForce."
            )

    def _settle_defaults(self) -> None:
        """Give numbers of weak type the floating type of the others, if there are others."""
        numbers = [x for x in jtu.tree_leaves(self) if eqx.is_inexact_array(x)]
        kinds = {x.dtype for x in numbers if not is_weak(x)}
        if not kinds or not any(is_weak(x) for x in numbers):
            return
        dtype = jnp.result_type(*kinds)

        def settled(x: Any) -> Any:
            return jnp.asarray(x, dtype) if eqx.is_inexact_array(x) and is_weak(x) else x

        for field in ("lagrangian", "effects", "constraints"):
            object.__setattr__(self, field, jtu.tree_map(settled, getattr(self, field)))

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each effect: its own, or that of its kind with a number from the second of the kind on."""
        return _names(self.effects, lambda effect: effect.default_name)

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """Name of each constraint, by the rule for effects."""
        return _names(self.constraints, lambda each: "contact" if isinstance(each, Contact) else "constraint")

    @property
    def part_names(self) -> tuple[str, ...]:
        """Names of the effects, then of the constraints, in the order of the indices in events."""
        return (*self.names, *self.constraint_names)

    @property
    def friction(self) -> dict[str, Friction]:
        """The friction elements by name."""
        return {name: each for name, each in zip(self.names, self.effects, strict=True) if isinstance(each, Friction)}

    @property
    def event_driven(self) -> dict[str, Friction]:
        """The friction elements that run by events, by name, in the order of their modes."""
        return {name: each for name, each in self.friction.items() if each.event_driven}

    @property
    def without_derivatives(self) -> str:
        """Why JAX cannot differentiate a run, with the remedy; empty if it can."""
        laws = [f"{name!r} ({type(each.law).__name__})" for name, each in self.friction.items() if each.law.jumps]
        if not laws:
            return ""
        return (
            f"No derivatives through friction {', '.join(laws)}: its force jumps with the velocity, which JAX ignores,"
            " so that they would be wrong. Run the law without this wrapper, by events, or as Regularized(law, width)."
        )

    @property
    def contacts(self) -> dict[str, Contact]:
        """The contacts that open and close, by name, in the order of their modes."""
        return {name: each for name, each in self._all_contacts.items() if each.compliant is None}

    @property
    def switches(self) -> dict[str, Switch]:
        """The effects that change at their own events, by name."""
        return {name: each for name, each in zip(self.names, self.effects, strict=True) if isinstance(each, Switch)}

    @property
    def compliant(self) -> dict[str, Contact]:
        """The compliant contacts, which have no modes, by name."""
        return {name: each for name, each in self._all_contacts.items() if each.compliant is not None}

    @property
    def _all_contacts(self) -> dict[str, Contact]:
        pairs = zip(self.constraint_names, self.constraints, strict=True)
        return {name: each for name, each in pairs if isinstance(each, Contact)}

    @property
    def impact_friction(self) -> dict[str, Friction]:
        """The friction elements that take part in impacts, event-driven ones loaded by a contact, by name."""
        return {name: each for name, each in self.event_driven.items() if each.load_constraint in self.contacts}

    @property
    def bilateral(self) -> tuple[AbstractConstraint, ...]:
        """The constraints that hold at all times."""
        return tuple(each for each in self.constraints if not isinstance(each, Contact))

    @property
    def mode_names(self) -> tuple[str, ...]:
        """Names of the things with a mode, in the order of the modes: event-driven friction, contacts, switches."""
        return (*self.event_driven, *self.contacts, *self.switches)

    @property
    def num_kinks(self) -> int:
        """Number of kinks, see `side_values`, whose signs follow the modes of `mode_names` in an array of modes."""
        return sum(each.num_kinks for each in self.event_driven.values()) + len(self.guides)

    def split_modes(self, modes: _Modes) -> tuple[_Modes, _Modes, _Modes]:
        """A sequence over the modes in three parts: friction elements, contacts, switches and kinks."""
        end = len(modes) - len(self.switches) - self.num_kinks
        start = end - len(self.contacts)
        return modes[:start], modes[start:end], modes[end:]

    def num_modes(self, dof: int) -> int:
        """Number of entries of all modes, those of kinks included."""
        return sum(self.mode_widths(dof)) + self.num_kinks

    def side_values(self, t: Scalar, q: PerDof, qd: PerDof) -> Float[Array, " sides"]:
        """Guards of the switches, then kinks of laws: zeros of these numbers end a step, too.

        The kinks of `guides` follow; their numbers are loads.
        """
        params = self.bind_time(t).params
        values = [*(each.value(t, q, qd, params) for each in self.switches.values()), *self._kinks(t, q, qd)]
        return jnp.stack(values) if values else jnp.zeros(0, q.dtype)

    def kink_rounding(self, t: Scalar, q: PerDof, qd: PerDof, rest: Scalar) -> Float[Array, " kinks"]:
        """Rounding errors of the kinks of laws, constant; at least those of the changes `rest` of q and qd."""
        held = jax.lax.stop_gradient(self)
        kinks = [lambda *at, i=i: held._kinks(*at)[i] for i in range(self.num_kinks - len(self.guides))]
        found = [rounding_of(kink, t, q, qd, least=(rest, rest)) for kink in kinks]
        return jnp.stack(found) if found else jnp.zeros(0, q.dtype)

    def _kinks(self, t: Scalar, q: PerDof, qd: PerDof) -> list[Scalar]:
        params = self.bind_time(t).params
        return [x for each in self.event_driven.values() for x in each.kinks(t, q, qd, params)]

    def mode_widths(self, dof: int) -> tuple[int, ...]:
        """Number of entries of each mode: one, or for friction in a plane that of the components of slip."""
        q = jnp.zeros(dof)  # only shapes matter
        params = self.bind_time(jnp.zeros(())).params
        shapes = [each.slip_shape(q, params) for each in self.event_driven.values()]
        return (*(math.prod(shape) for shape in shapes), *(1 for _ in (*self.contacts, *self.switches)))

    @property
    def stiff(self) -> bool:
        """Whether the equations of motion are stiff."""
        return any(effect.stiff for effect in self.effects) or bool(self.compliant)

    @property
    def stick_drifts(self) -> bool:
        """Whether stick drifts with the error of integration, unless it holds one coordinate at a constant speed."""
        return any(each.along is not None or callable(each.belt_velocity) for each in self.event_driven.values())

    @property
    def reaction_loaded(self) -> dict[str, Friction]:
        """The other friction elements whose load is the reaction of a constraint, by name."""
        others = {name: each for name, each in self.friction.items() if not each.event_driven}
        return {name: each for name, each in others.items() if each.load_constraint is not None}

    @property
    def loaded(self) -> tuple[str, ...]:
        """Names of the constraints whose reactions are loads of friction."""
        resting = {each.load_constraint for each in (*self.event_driven.values(), *self.reaction_loaded.values())}
        return tuple(name for name in self.constraint_names if name in resting)

    @property
    def guides(self) -> tuple[str, ...]:
        """Names of the constraints that load event-driven friction whether they push or pull: it has a kink at zero."""
        resting = {each.load_constraint for each in self.event_driven.values()}
        return tuple(name for name in self.loaded if name in resting and name not in self._all_contacts)

    @property
    def checks(self) -> tuple[str, ...]:
        """Sentences for a `Dynamics.uniqueness` that is not positive, which ends the equations of motion."""
        if not self.loaded:
            return ()
        return (
            f"Friction under the reaction of {', '.join(map(repr, self.loaded))} has lost its unique solution: it"
            " raises its own load without bound (Painleve's paradox, jamming). Lower the coefficient of friction,"
            " or model the contact as elastic.",
        )

    def bind_time(self, t: Scalar) -> "Scene":
        """The scene with the numbers of its signals at time `t`; itself where it has none."""
        if not signals_of(self.params):
            return self
        driven = signals_at(self.params, t, linear=False)
        lagrangian = _Driven(self.lagrangian, driven) if signals_of(driven) else self.lagrangian
        return dataclasses.replace(self, lagrangian=lagrangian, params=signals_at(driven, t))

    def constraints_in(self, mode: Array | None) -> tuple[AbstractEquations, ...]:
        """The constraints with each contact bound to its mode; `mode` holds the modes of `mode_names`.

        **Raises:**

        - `ValueError` if the scene has contacts and `mode` is None.
        """
        if not self._all_contacts:
            return self.constraints
        if self.contacts and mode is None:
            raise ValueError(
                f"{', '.join(self.contacts)}: contacts open and close by events, so that position and velocity do not"
                " tell the forces: run the scene by jaxmodsim.simulate."
            )
        modes = iter(() if mode is None else jax.lax.stop_gradient(self.split_modes(mode)[1]))

        def bound(x: Contact) -> BoundContact:
            return BoundContact(x, next(modes) if x.compliant is None else jnp.zeros_like(x.compliant.stiffness))

        return tuple(bound(x) if isinstance(x, Contact) else x for x in self.constraints)

    def step_from(self, t: Scalar) -> "Scene":
        """The scene for a step from `t` up to the next sample: signals are what they are there, without jumps."""
        return dataclasses.replace(self, params=signals_from(self.params, t)) if signals_of(self.params) else self

    def bind_state(self, t: Scalar, q: PerDof, qd: PerDof) -> "Scene":
        """The scene with its signals and laws as they are at this state; itself where nothing depends on that."""
        if (scene := self.bind_time(t)) is not self:
            return scene.bind_state(t, q, qd)
        effects = tuple(each.bind_state(t, q, qd, self.params) for each in self.effects)
        if all(a is b for a, b in zip(effects, self.effects, strict=True)):
            return self
        return eqx.tree_at(lambda scene: scene.effects, self, effects)

    def on_sides(self, sides: Float[Array, " sides"]) -> "Scene":
        """The scene with these signs of its kinks, the last of `sides`; itself without kinks."""
        if not self.num_kinks:
            return self
        effects, at = [], len(self.switches)
        for each in self.effects:
            if isinstance(each, Friction) and each.num_kinks:
                each, at = each.on_sides(sides[at : at + each.num_kinks]), at + each.num_kinks
            effects.append(each)
        return dataclasses.replace(self, effects=tuple(effects))

    def initial_state(self, q: PerDof) -> dict[str, PyTree]:
        """State of each effect with a state of its own, at rest, by name."""
        params = self.bind_time(q[0]).params  # only shapes matter
        states = {name: effect.initial_state(q, params) for name, effect in zip(self.names, self.effects, strict=True)}
        return {name: state for name, state in states.items() if state is not None}
