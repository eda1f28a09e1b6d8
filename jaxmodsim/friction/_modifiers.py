"""Modifiers: laws whose parameters depend on the direction of slip or on the state of the mechanism."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, TypeVar, cast

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._core.arguments import as_names
from .._core.arrays import Scalar
from .._core.functions import StateDependent, as_state_function
from .._core.parameters import check_ranges, modules_of, ranges_of
from ._law import AbstractDynamicLaw, AbstractForceLaw, AbstractLaw, AbstractSetValuedLaw, Passivity

_Law = TypeVar("_Law")
_Module = TypeVar("_Module", bound=eqx.Module)

# The feature that other programs lack, and the remedy.
_ONE_WAY = "friction that depends on the direction: export the law of one direction, or the mean of both"


def _toward(v: Scalar, law: "AbstractAsymmetric") -> PyTree:
    """The law for the direction of the velocity `v`."""
    names = tuple(law.backward)
    values = [jnp.where(v < 0, law.backward[name], getattr(law.forward, name)) for name in names]
    return eqx.tree_at(lambda x: [getattr(x, name) for name in names], law.forward, values)


def other_side(law: "AbstractAsymmetric") -> AbstractLaw:
    """The complete law for negative slip."""
    names = tuple(law.backward)
    values = [law.backward[name] for name in names]
    return eqx.tree_at(lambda x: [getattr(x, name) for name in names], law.forward, values, is_leaf=_is_varying)


def _is_varying(x: object) -> bool:
    return isinstance(x, StateDependent)


class AbstractAsymmetric(AbstractLaw):
    """A law with some parameters that differ for negative slip."""

    # The law for positive slip, and the parameters that differ, by name.
    forward: AbstractVar[PyTree]
    backward: AbstractVar[dict[str, PyTree]]

    @property
    def stiff(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the law for positive slip is stiff."""
        return self.forward.stiff

    valid_at_any_speed: ClassVar[bool] = True

    @property
    def implied(self) -> dict[str, AbstractLaw]:
        """The law for negative slip, whose ranges are checked with those of the fields."""
        return {"backward": other_side(self)}

    def formulas(self) -> tuple[str, ...]:
        """Equations of the law for positive slip, then the names of the parameters that differ."""
        return *self.forward.formulas(), f"{', '.join(self.backward)}: forward for v > 0, backward for v < 0"

    def known_limitations(self) -> dict[str, str]:
        """Limitations of the law for positive slip."""
        return self.forward.known_limitations()

    def mujoco(self) -> str:
        """MuJoCo's friction is the same in both directions."""
        return _ONE_WAY

    def modelica(self) -> str:
        """Modelica's friction is the same in both directions: where the law fits, its table shows whether it is."""
        return self.forward.modelica() and _ONE_WAY


class _AsymmetricForce(AbstractAsymmetric, AbstractForceLaw):  # pyright: ignore[reportIncompatibleVariableOverride]
    """A function of velocity with some parameters that differ for negative slip."""

    forward: AbstractForceLaw
    backward: dict[str, PyTree]

    def force(self, v: Scalar) -> Scalar:
        return _toward(v, self).force(v)


class _AsymmetricSetValued(AbstractAsymmetric, AbstractSetValuedLaw):  # pyright: ignore[reportIncompatibleVariableOverride]
    """A set-valued law with some parameters that differ for negative slip."""

    forward: AbstractSetValuedLaw
    backward: dict[str, PyTree]

    def sliding_force(self, v: Scalar) -> Scalar:
        return _toward(v, self).sliding_force(v)

    def viscous_force(self, v: Scalar) -> Scalar:
        return _toward(v, self).viscous_force(v)

    def static_limit(self, direction: Scalar) -> Scalar:
        return _toward(direction, self).static_limit(direction)


class _AsymmetricDynamic(AbstractAsymmetric, AbstractDynamicLaw):  # pyright: ignore[reportIncompatibleVariableOverride]
    """A law with a state with some parameters that differ for negative slip."""

    forward: AbstractDynamicLaw
    backward: dict[str, PyTree]

    def initial_state(self, v: Float[Array, "..."]) -> PyTree:
        return self.forward.initial_state(v)

    def zdot(self, v: Scalar, z: PyTree) -> PyTree:
        return _toward(v, self).zdot(v, z)

    def force_given_zdot(self, v: Scalar, z: PyTree, rate: PyTree) -> Scalar:
        return _toward(v, self).force_given_zdot(v, z, rate)

    def stored_energy(self, z: PyTree) -> Scalar:
        """Energy [J] in the state: the stiffness is the same in both directions."""
        return self.forward.stored_energy(z)

    def step_exact(self, v: Scalar, z: PyTree, dt: Scalar) -> PyTree:
        return _toward(v, self).step_exact(v, z, dt)

    def passivity(self) -> Passivity | None:
        """The worse of both directions: slip in one direction causes the deflection in that direction."""
        sides = {"positive": self.forward.passivity(), "negative": other_side(self).passivity()}
        known = {side: result for side, result in sides.items() if result is not None}
        if not known:
            return None
        worse = min(known, key=lambda side: known[side].margin)
        speed = min(result.speed for result in known.values())
        condition = f"For {worse} slip, the worse direction: {known[worse].condition}"
        return Passivity(known[worse].ok, known[worse].margin, speed, condition)


_KINDS = (
    (AbstractSetValuedLaw, _AsymmetricSetValued),
    (AbstractForceLaw, _AsymmetricForce),
    (AbstractDynamicLaw, _AsymmetricDynamic),
)


def asymmetric(law: _Law, **backward: object) -> _Law:
    """A law with different parameters for negative slip velocities.

    **Arguments:**

    - `law`: the law for positive slip, with named parameters. For a wrapper, the parameters are those of the wrapped
      law: `asymmetric(Regularized(Coulomb(20.0), width=1e-3), Fc=24.0)`.
    - `backward`: the parameters that differ for negative slip, by name, in the units of the law. Not the stiffness of
      an elastic element, which returns in one direction the energy that it stored in the other.

    **Returns:**

    A law of the same kind, for slip along a line. `forward` is `law`; `backward` holds the parameters that differ, and
    those whose lower limit they are. All others share one value for both directions.

    **Raises:**

    - `ValueError` if the law lacks a parameter, a value is out of range, or `law` is not such a law.

    **Example:**

    ```python
    law = jms.asymmetric(jms.Coulomb(Fc=2.0), Fc=3.0)
    print(jax.vmap(law.sliding_force)(jnp.array([0.1, -0.1])), "N")
    ```

    ```text
    [2. 3.] N
    ```
    """
    inner = getattr(law, "law", None)
    if isinstance(inner, AbstractLaw):
        return eqx.tree_at(lambda x: x.law, cast(Any, law), asymmetric(inner, **backward))
    kinds = [wrapper for kind, wrapper in _KINDS if isinstance(law, kind)]
    if not kinds or isinstance(law, AbstractAsymmetric):
        remedy = f"{law!r} was given; convert a function of velocity by Curve(fn)"
        if isinstance(law, AbstractAsymmetric):
            remedy = "an asymmetric law was given: pass all parameters that differ in one call"
        raise ValueError(f"asymmetric needs a law with parameters of its own, but {remedy}.")
    module = cast(eqx.Module, law)
    allowed = ranges_of(module)
    unknown = sorted(set(backward) - set(allowed))
    if unknown or not backward:
        raise ValueError(
            f"asymmetric({type(law).__name__}) needs the parameters that differ for negative slip, among"
            f" {', '.join(allowed)} (pass optional ones to the law first); given: {', '.join(unknown) or 'none'}."
        )
    for name in backward:
        if allowed[name].unit == "N/m":
            raise ValueError(
                f"asymmetric({type(law).__name__}): {name} stores energy, so it must be the same in both directions."
            )
    converters = {f.name: f.metadata["converter"] for f in dataclasses.fields(module) if f.name in backward}
    numbers = {
        name: _with_number(getattr(law, name), converters[name](value), name) for name, value in backward.items()
    }
    # A parameter whose lower limit differs must differ, too, to stay above it.
    while above := [n for n, r in allowed.items() if r.lower in numbers and n not in numbers]:
        numbers |= {name: getattr(law, name) for name in above}
    both = kinds[0](cast(Any, law), numbers)
    check_ranges(other_side(both))
    return cast(_Law, both)


def _with_number(old: Array | StateDependent, number: Array | None, name: str) -> Array | StateDependent:
    """The new number, with the factors of the old one.

    **Raises:**

    - `ValueError` if the number is None, or its shape is not that of the old one.
    """
    if isinstance(old, StateDependent):
        return StateDependent(_with_number(old.number, number, name), old.fn)
    if number is None or jnp.shape(number) != jnp.shape(old):
        got = "None" if number is None else f"the shape {jnp.shape(number)}"
        raise ValueError(f"asymmetric: {name} must have the shape {jnp.shape(old)} for negative slip, but got {got}.")
    return number


def scaled_by(law: _Law, fn: object, parameters: Sequence[str] | None = None) -> _Law:
    """A law whose force, or chosen parameters, are multiplied by a function of the mechanism's state.

    Use it for friction that depends on position (`lambda t, q, qd, p: 1 + 0.2 * jnp.sin(q[0] / p["pitch"])`), on time,
    or on load or temperature (entries of `params`). It applies to any law, wrapped or not, also repeatedly.

    **Arguments:**

    - `law`: any law.
    - `fn`: `fn(t, q, qd, params)` returns the factor, one number; factors below 1e-30 count as 1e-30. Numbers to
      differentiate or fit belong in `params`, not in `fn`. In `fit_law`, q and qd are the slip and its velocity, shape
      `[1]`, and `params` holds the record's inputs.
    - `parameters`: names of the parameters to multiply, in all parts of the law; by default all with a unit of force
      (`Fc`, `sigma0`, ...), which multiplies the force.

    **Returns:**

    A law of the same kind. It has numbers only at a state: `law.bind_state(t, q, qd, params)`.

    **Raises:**

    - `ValueError` if `law` is not a law, `fn` is not a function, or the law lacks a parameter.

    The factor must keep the parameters in their ranges (Fs >= Fc); runs do not check that.

    **Example:**

    ```python
    law = jms.scaled_by(jms.Coulomb(Fc=2.0), lambda t, q, qd, p: 1.0 + 0.1 * q[0])
    here = law.bind_state(jnp.array(0.0), jnp.array([5.0]), jnp.zeros(1), {})
    print(here.sliding_force(jnp.array(0.1)), "N")
    ```

    ```text
    3.0 N
    ```
    """
    if not isinstance(law, AbstractLaw):
        raise ValueError(f"scaled_by needs a law, but {law!r} was given; convert a function of velocity by Curve(fn).")
    factor = as_state_function(fn, name="scaled_by fn")
    known = {name: r.unit for _, module in modules_of(law) for name, r in ranges_of(module).items()}
    chosen = (
        [name for name, unit in known.items() if unit.startswith("N")]
        if parameters is None
        else list(as_names(parameters, name="scaled_by parameters"))
    )
    unknown = [name for name in chosen if name not in known]
    if unknown or not chosen or isinstance(parameters, str):
        raise ValueError(
            f"scaled_by needs a list of parameters of {type(law).__name__}, among {', '.join(known) or 'none'}"
            f" (by default those with a unit of force; pass optional ones to the law first); given: {parameters!r}."
        )
    return _scaled(law, factor, chosen)


def _scaled(module: _Module, factor: Callable[..., ArrayLike], chosen: list[str]) -> _Module:
    """`module` in which the chosen parameters, also those of nested laws, depend on the state by `factor`."""
    names, values = [], []
    for field in dataclasses.fields(module):
        value = getattr(module, field.name)
        if field.name in ranges_of(module):
            if field.name in chosen:
                names.append(field.name)
                values.append(StateDependent(value, factor))
        elif isinstance(value, AbstractLaw):
            names.append(field.name)
            values.append(_scaled(value, factor, chosen))
        elif field.name == "backward":  # of an asymmetric law
            names.append(field.name)
            values.append({n: StateDependent(x, factor) if n in chosen else x for n, x in value.items()})
    if not names:
        return module
    return eqx.tree_at(lambda m: [getattr(m, name) for name in names], module, values, is_leaf=_is_whole)


def _is_whole(x: object) -> bool:
    return isinstance(x, StateDependent | dict)
