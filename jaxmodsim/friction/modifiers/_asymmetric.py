"""Laws whose parameters depend on the direction of slip."""

import dataclasses
from typing import Any, ClassVar, TypeVar, cast

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Float, PyTree

from ..._core.parameters import check_ranges, ranges_of
from ..._core.shapes import Scalar
from ..._core.state_dependent import StateDependent
from .._law import AbstractDynamicLaw, AbstractForceLaw, AbstractLaw, AbstractSetValuedLaw
from .._passivity import Passivity

_Law = TypeVar("_Law")

# What other programs lack of an asymmetric law, and what to do.
_ONE_WAY = "friction that depends on the direction: export the law of one direction, or the mean of both"


def _toward(v: Scalar, law: "AbstractAsymmetric") -> PyTree:
    """The law that holds at velocity `v`."""
    names = tuple(law.backward)
    values = [jnp.where(v < 0, law.backward[name], getattr(law.forward, name)) for name in names]
    return eqx.tree_at(lambda x: [getattr(x, name) for name in names], law.forward, values)


def other_side(law: "AbstractAsymmetric") -> AbstractLaw:
    """The whole law for negative slip of an asymmetric one."""
    names = tuple(law.backward)
    values = [law.backward[name] for name in names]
    return eqx.tree_at(lambda x: [getattr(x, name) for name in names], law.forward, values, is_leaf=_is_varying)


def _is_varying(x: object) -> bool:
    return isinstance(x, StateDependent)


class AbstractAsymmetric(AbstractLaw):
    """What laws share some of whose parameters differ for negative slip."""

    # The law for positive slip, and the numbers that differ, by name.
    forward: AbstractVar[PyTree]
    backward: AbstractVar[dict[str, PyTree]]

    @property
    def stiff(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """As the law for positive slip is."""
        return self.forward.stiff

    valid_at_any_speed: ClassVar[bool] = True

    @property
    def implied(self) -> dict[str, AbstractLaw]:
        """The law for negative slip, to be checked beside the fields."""
        return {"backward": other_side(self)}

    def formulas(self) -> tuple[str, ...]:
        """Of the law for positive slip, and what differs for negative slip."""
        return *self.forward.formulas(), f"{', '.join(self.backward)}: forward for v > 0, backward for v < 0"

    def known_limitations(self) -> dict[str, str]:
        """Those of the law for positive slip."""
        return self.forward.known_limitations()

    def mujoco(self) -> str:
        """MuJoCo's friction is the same in both directions."""
        return _ONE_WAY

    def modelica(self) -> str:
        """Modelica's friction is the same in both directions: where the law fits, its table shows whether it is."""
        return self.forward.modelica() and _ONE_WAY


class _AsymmetricForce(AbstractAsymmetric, AbstractForceLaw):  # pyright: ignore[reportIncompatibleVariableOverride]
    """A function of velocity, some of whose parameters differ for negative slip."""

    forward: AbstractForceLaw
    backward: dict[str, PyTree]

    def force(self, v: Scalar) -> Scalar:
        return _toward(v, self).force(v)


class _AsymmetricSetValued(AbstractAsymmetric, AbstractSetValuedLaw):  # pyright: ignore[reportIncompatibleVariableOverride]
    """A set-valued law, some of whose parameters differ for negative slip."""

    forward: AbstractSetValuedLaw
    backward: dict[str, PyTree]

    def sliding_force(self, v: Scalar) -> Scalar:
        return _toward(v, self).sliding_force(v)

    def viscous_force(self, v: Scalar) -> Scalar:
        return _toward(v, self).viscous_force(v)

    def static_limit(self, direction: Scalar) -> Scalar:
        return _toward(direction, self).static_limit(direction)


class _AsymmetricDynamic(AbstractAsymmetric, AbstractDynamicLaw):  # pyright: ignore[reportIncompatibleVariableOverride]
    """A law with a state, some of whose parameters differ for negative slip."""

    forward: AbstractDynamicLaw
    backward: dict[str, PyTree]

    def initial_state(self, v: Float[Array, "..."]) -> PyTree:
        return self.forward.initial_state(v)

    def zdot(self, v: Scalar, z: PyTree) -> PyTree:
        return _toward(v, self).zdot(v, z)

    def force_given_zdot(self, v: Scalar, z: PyTree, rate: PyTree) -> Scalar:
        return _toward(v, self).force_given_zdot(v, z, rate)

    def stored_energy(self, z: PyTree) -> Scalar:
        """Energy [J] in the state: stiffness is one for both directions."""
        return self.forward.stored_energy(z)

    def step_exact(self, v: Scalar, z: PyTree, dt: Scalar) -> PyTree:
        return _toward(v, self).step_exact(v, z, dt)

    def passivity(self) -> Passivity | None:
        """Each direction by itself, since a deflection towards one side was reached in that direction."""
        sides = {"positive": self.forward.passivity(), "negative": other_side(self).passivity()}
        known = {side: answer for side, answer in sides.items() if answer is not None}
        if not known:
            return None
        worse = min(known, key=lambda side: known[side].margin)
        speed = min(answer.speed for answer in known.values())
        condition = f"For {worse} slip, the worse direction: {known[worse].condition}"
        return Passivity(known[worse].ok, known[worse].margin, speed, condition)


_KINDS = (
    (AbstractSetValuedLaw, _AsymmetricSetValued),
    (AbstractForceLaw, _AsymmetricForce),
    (AbstractDynamicLaw, _AsymmetricDynamic),
)


def asymmetric(law: _Law, **backward: object) -> _Law:
    """A law with other parameters for negative slip velocities.

    **Arguments:**

    - `law`: the law for positive slip, any one with named parameters. Of a wrapped law the law inside is meant:
      `asymmetric(Regularized(Coulomb(20.0), width=1e-3), Fc=24.0)`.
    - `backward`: the parameters that differ for negative slip, by name, in the law's own units. Not the stiffness of
      an elastic element: what is stored in one direction comes back in the other.

    **Returns:**

    A law of the same kind, for slip along a line: `forward` is the law given, `backward` holds the numbers that differ,
    and those whose limit they are. All others are the same number in both directions.

    **Raises:**

    - `ValueError` for a name that the law has not, a value out of range, or what is no such law.
    """
    inner = getattr(law, "law", None)
    if isinstance(inner, AbstractLaw):
        return eqx.tree_at(lambda x: x.law, cast(Any, law), asymmetric(inner, **backward))
    kinds = [wrapper for kind, wrapper in _KINDS if isinstance(law, kind)]
    if not kinds or isinstance(law, AbstractAsymmetric):
        mend = f"{law!r} was given; of a function of velocity make a Curve(fn)"
        if isinstance(law, AbstractAsymmetric):
            mend = "a law that is asymmetric already was given: name all parameters that differ in one call"
        raise ValueError(f"asymmetric needs a law with parameters of its own, but {mend}.")
    module = cast(eqx.Module, law)
    allowed = ranges_of(module)
    unknown = sorted(set(backward) - set(allowed))
    if unknown or not backward:
        raise ValueError(
            f"asymmetric({type(law).__name__}) needs the parameters that differ for negative slip, among"
            f" {', '.join(allowed)} (one that was left out must be given to the law first); given:"
            f" {', '.join(unknown) or 'none'}."
        )
    for name in backward:
        if allowed[name].unit == "N/m":
            raise ValueError(
                f"asymmetric({type(law).__name__}): {name} stores energy, so it must be the same in both directions."
            )
    converters = {f.name: f.metadata["converter"] for f in dataclasses.fields(module) if f.name in backward}
    numbers = {name: _like(getattr(law, name), converters[name](value), name) for name, value in backward.items()}
    # A parameter that is limited by one that differs must differ, too, to stay above it.
    while above := [n for n, r in allowed.items() if r.lower in numbers and n not in numbers]:
        numbers |= {name: getattr(law, name) for name in above}
    both = kinds[0](cast(Any, law), numbers)
    check_ranges(other_side(both))
    return cast(_Law, both)


def _like(old: Array | StateDependent, number: Array | None, name: str) -> Array | StateDependent:
    """The new number, varying as the old one does.

    **Raises:**

    - `ValueError` if it is none, or not of the old one's shape.
    """
    if isinstance(old, StateDependent):
        return StateDependent(_like(old.number, number, name), old.fn)
    if number is None or jnp.shape(number) != jnp.shape(old):
        given = "None" if number is None else f"the shape {jnp.shape(number)}"
        raise ValueError(f"asymmetric: {name} must have the shape {jnp.shape(old)} for negative slip, but got {given}.")
    return number
