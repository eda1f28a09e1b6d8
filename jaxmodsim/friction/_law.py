"""Base classes, registry and examples of friction laws. The force is positive when it opposes positive slip."""

import abc
import dataclasses
import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._core.arrays import PerDof, Scalar
from .._core.functions import bind_state, is_state_dependent, nominal
from .._core.parameters import AbstractRanged, ranges_of
from .._core.readable import AbstractReadable

if TYPE_CHECKING:
    from typing import ClassVar as AbstractClassVar
else:
    from equinox import AbstractClassVar


_Law = TypeVar("_Law", bound="AbstractLaw")

# A fit searches Fs up to this many times Fc. Above that, the peak at zero velocity is so narrow that few samples lie in
# it: the fit then trades its height against vs, and the result fails on the next record.
MOST_STICTION = 5.0
STRIBECK_CURVE = "g(v) = Fc + (Fs - Fc) exp(-(v/vs)^2)"
NO_STICTION_IN_MUJOCO = (
    " with Fs > Fc: its dry friction is one force, in stick and in slip. Export a LuGre with the same Fc and Fs, and"
    " sigma0 as stiff as the step allows, or leave the stiction out"
)
# Limitations, which tables show.
NO_STRIBECK_EFFECT = "Without a Stribeck effect, only the viscous part of the force depends on slip velocity."
_NO_MEMORY = {
    "break-away": "The limit of stick is constant and does not depend on the load history.",
    "lag": "The force is a function of velocity: no memory, no lag.",
}
_JUMPS = {"presliding": "The force is a function of velocity and jumps when the velocity reverses."}

# Parameters of Canudas de Wit and others 1995, IEEE TAC 40:419: forces [N], Stribeck velocity [m/s], stiffness [N/m],
# damping and viscous coefficients [N s/m]. The width of smooth laws [m/s] is a hundredth of the Stribeck velocity, so
# that it resolves the fall of the curve.
STANDARD = {
    "sigma0": 1e5, "sigma1": math.sqrt(1e5), "sigma2": 0.4, "Fc": 1.0, "Fs": 1.5, "vs": 1e-3, "Fv": 0.4, "width": 1e-5,
}  # fmt: skip


class LawCase(NamedTuple):
    """A law with numbers, which benches and tests run.

    - `name`: label in tables and figures.
    - `law`: the law.
    - `steady`: closed form of its force [N] in steady slip at the velocities v [m/s], v not zero.
    - `dt`: fixed step [s] that a simulation needs; None for adaptive steps.
    """

    name: str
    law: Any
    steady: Callable[[np.ndarray], np.ndarray]
    dt: float | None = None


def steady_curve(
    Fc: float, Fs: float, Fv: float, fall: Callable[[np.ndarray], np.ndarray] = lambda x: np.exp(-x * x)
) -> Callable[[np.ndarray], np.ndarray]:
    """Steady force that falls from Fs to Fc by `fall(|v|/vs)`, with a viscous part."""
    return lambda v: (Fc + (Fs - Fc) * fall(np.abs(v) / STANDARD["vs"])) * np.sign(v) + Fv * v


def stribeck_case(
    name: str, law: eqx.Module, fall: Callable[[np.ndarray], np.ndarray] = lambda x: np.exp(-x * x)
) -> LawCase:
    """An example whose force in steady slip is the standard Stribeck curve with its viscous part."""
    return LawCase(name, law, steady_curve(STANDARD["Fc"], STANDARD["Fs"], STANDARD["Fv"], fall))


@dataclass(frozen=True)
class Passivity:
    """Result of `check_passivity`. Its truth value is `ok`, and `print` shows it as a sentence.

    - `ok`: whether the law is passive.
    - `margin`: viscous coefficient [N s/m] that could be removed before the law stops being passive. A negative margin
      is the coefficient that must be added; -inf if no viscous coefficient helps.
    - `speed`: slip speed [m/s] up to which the law returns no more energy than it received; infinite if at all speeds.
    - `condition`: the condition for passivity, with the law's numbers.
    """

    ok: bool
    margin: float
    speed: float
    condition: str

    def __bool__(self) -> bool:
        return self.ok

    def __str__(self) -> str:
        """All fields in one or two sentences."""
        if self.ok:
            return f"Passive, with a margin of {self.margin:g} N s/m. {self.condition}"
        return f"Not passive from {self.speed:g} m/s on; margin {self.margin:g} N s/m. {self.condition}"


class AbstractLaw(AbstractReadable, AbstractRanged):
    """A friction law: a function of slip velocity [m/s or rad/s] and its own state, independent of the mechanism.

    The class holds all information about the law; `register_law` makes it available to the command line, the benches
    and the tables. Besides the parameters and methods of its kind it may define:

    - `description`, `equations`: a short description, and plain formulas: first the force, then its terms.
    - `execution`: how `simulate` runs it.
    - `valid_at_any_speed`: whether the force is valid up to the largest floating-point number.
    - `limitations`: experiments of the behaviour bench that the law fails for all parameters, with reasons.
    - `mujoco_lacks`: why MuJoCo has no such law, and the remedy; the name of the law precedes it.
    - `example`, `example_step`: parameters that are not in `STANDARD`, and the fixed step [s] if the law needs one.
    """

    # Whether the law makes the equations of motion stiff: it selects the default solver.
    stiff: AbstractClassVar[bool]
    # Whether the force jumps with the velocity and no event marks it, so that JAX cannot differentiate a run.
    jumps: ClassVar[bool] = False
    description: ClassVar[str] = ""
    equations: ClassVar[tuple[str, ...]] = ()
    execution: ClassVar[str] = "integrated directly"
    valid_at_any_speed: ClassVar[bool] = False
    limitations: ClassVar[Mapping[str, str]] = {}
    mujoco_lacks: ClassVar[str] = (
        ": its joints have friction that is constant, viscous, or LuGre. Fit one of these, with fit_law, and export it"
    )
    example: ClassVar[Mapping[str, PyTree]] = {}
    example_step: ClassVar[float | None] = None

    def bind_state(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> "AbstractLaw":
        """The law with its parameters at a state of the mechanism; itself if none of them depends on the state."""
        return bind_state(self, t, q, qd, params) if is_state_dependent(self) else self

    def formulas(self) -> tuple[str, ...]:
        """The equations of this law; the names of its parameters if it defines none."""
        return self.equations or (f"{type(self).__name__}({', '.join(ranges_of(self))})",)

    def known_limitations(self) -> dict[str, str]:
        """Experiments that the law fails with these numbers, with reasons."""
        limitations = dict(self.limitations)
        Fc, Fs = (nominal(getattr(self, name, None)) for name in ("Fc", "Fs"))
        if Fc is not None and (Fs is None or not bool((Fs > Fc).any())):
            limitations = dict.fromkeys(("break-away", "lag", "stick-slip"), NO_STRIBECK_EFFECT) | limitations
        passivity = self.passivity()
        return limitations if passivity is None or passivity.ok else limitations | {"passivity": passivity.condition}

    def passivity(self) -> Passivity | None:
        """Passivity from a closed form; with None `check_passivity` searches instead."""
        return None

    def mujoco(self) -> dict[str, PyTree] | str:
        """The law in MuJoCo: attributes with their values, or a sentence on the feature that MuJoCo lacks.

        A `joint` has `frictionloss` [N] and `damping` [N s/m]; a motor has `damping` and `lugre`, the values of sigma0,
        sigma1, Fc, Fs and vs.
        """
        return f"{type(self).__name__}{self.mujoco_lacks}"

    def modelica(self) -> str:
        """The feature that Modelica's friction components lack, and the remedy; empty if they can represent the law.

        They have a range of forces at rest, and any function of slip velocity that continues it.
        """
        return (
            f"{type(self).__name__}: they take set-valued laws and Viscous. Write the force as a Stribeck, with"
            " fit_law, and export that"
        )

    @classmethod
    def standard(cls: type[_Law], **others: object) -> _Law:
        """The law with the standard values of its parameters, overridden by `others`."""
        names = [field.name for field in dataclasses.fields(cls)]
        return cls(**{name: STANDARD[name] for name in names if name in STANDARD} | dict(cls.example) | others)

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """Examples of the law that benches and tests run; they skip a law without examples.

        By default the standard law, with the Stribeck curve as its force in steady slip; none if `STANDARD` and
        `example` lack a parameter that it requires.
        """
        needed = {field.name for field in dataclasses.fields(cls) if field.default is dataclasses.MISSING}
        if not needed <= {*STANDARD, *cls.example}:
            return ()
        law = cls.standard()
        parts = {name: STANDARD[name] if hasattr(law, name) else 0.0 for name in ("Fc", "Fs", "sigma2", "Fv")}
        steady = steady_curve(parts["Fc"], max(parts["Fc"], parts["Fs"]), max(parts["sigma2"], parts["Fv"]))
        return (LawCase(cls.__name__, law, steady, cls.example_step),)

    @classmethod
    def fit_start(cls, m: float, Fc: float, Fv: float, v_max: float) -> "AbstractLaw | None":
        """The law with which a fit of an axis starts; None excludes it from the candidates.

        **Arguments:**

        - `m`: mass [kg], `Fc`, `Fv`: Coulomb force [N] and viscous coefficient [N s/m] from a linear regression.
        - `v_max`: largest speed of the record [m/s].
        """
        return None


class AbstractForceLaw(AbstractLaw):
    """A law whose force is a function of slip velocity."""

    limitations: ClassVar[Mapping[str, str]] = {
        **_JUMPS,
        **_NO_MEMORY,
        "creep": "A function of velocity carries a load only while it moves.",
    }

    @abc.abstractmethod
    def force(self, v: Scalar) -> Scalar:
        """Friction force [N] at slip velocity `v` [m/s]."""


class AbstractSetValuedLaw(AbstractLaw):
    """A law with a force in slip, and any force up to a limit in stick.

    `simulate` runs it exactly, by events; `Regularized`, `DeadZone`, `Sign` and `Bristle` run it in other ways.
    """

    execution: ClassVar[str] = "exactly, by events; or in a wrapper"
    limitations: ClassVar[Mapping[str, str]] = {**_JUMPS, **_NO_MEMORY}
    # Numbers of a law at a state at whose zeros its force has a kink. A law with kinks has a field `sides`: the signs
    # of these numbers in a step; None, or zeros, for their own.
    kinks: ClassVar[tuple[Callable[[Any], Scalar], ...]] = ()

    @abc.abstractmethod
    def sliding_force(self, v: Scalar) -> Scalar:
        """Magnitude [N] of the dry part of the force in slip at velocity `v` [m/s], never negative.

        At `v = 0` it is the limit from positive velocities.
        """

    @abc.abstractmethod
    def viscous_force(self, v: Scalar) -> Scalar:
        """Smooth part of the force [N] at velocity `v` [m/s], zero at rest."""

    @abc.abstractmethod
    def static_limit(self, direction: Scalar) -> Scalar:
        """Largest force [N] in stick against a load in `direction` (+1 or -1)."""

    def modelica(self) -> str:
        """Modelica's friction components are set-valued laws."""
        return ""

    def lugre_numbers(self, vs: float) -> dict[str, PyTree] | None:
        """Parameters of LuGre, without sigma0 and sigma1, that give the same steady force; None if there are none.

        **Arguments:**

        - `vs`: Stribeck velocity [m/s] for a law whose force jumps from stick to slip.
        """
        return None


def side_of(number: Scalar, sides: Float[Array, " kinks"] | None, kink: int) -> Scalar:
    """A number with the sign of the kink at `number`: that of `sides`, or its own."""
    return number if sides is None else jnp.where(sides[kink] == 0, number, sides[kink])


class AbstractKarnoppLaw(AbstractLaw):
    """A law whose force balances the load in a band of velocities about rest."""

    jumps: ClassVar[bool] = True
    limitations: ClassVar[Mapping[str, str]] = _NO_MEMORY

    @abc.abstractmethod
    def holds(self, v: Scalar) -> Bool[Array, ""]:
        """Whether velocity `v` [m/s] counts as rest."""

    @abc.abstractmethod
    def static_limit(self, direction: Scalar) -> Scalar:
        """Largest holding force [N] against a load in `direction` (+1 or -1)."""

    @abc.abstractmethod
    def force(self, v: Scalar) -> Scalar:
        """Friction force [N] at velocity `v` [m/s] outside the band."""

    def passivity(self) -> Passivity:
        """Not passive: in the band the force equals the load, whatever the direction of motion."""
        worst = max(float(self.static_limit(jnp.asarray(side))) for side in (1.0, -1.0))
        condition = (
            f"In the band about rest the force of {type(self).__name__} equals the load, up to {worst:g} N in either"
            " direction: against a braking load it pushes along the motion. The wrapped law, run by events, does not."
        )
        return Passivity(worst == 0, -math.inf if worst > 0 else 0.0, 0.0 if worst > 0 else math.inf, condition)


class AbstractDynamicLaw(AbstractLaw):
    """A law with an internal state."""

    @abc.abstractmethod
    def initial_state(self, v: Float[Array, "..."]) -> PyTree:
        """Unloaded state at rest, for slip velocities with the shape of `v`."""

    @abc.abstractmethod
    def zdot(self, v: Float[Array, "..."], z: PyTree) -> PyTree:
        """Time derivative of the state `z` at slip velocity `v` [m/s]."""

    @abc.abstractmethod
    def force_given_zdot(self, v: Float[Array, "..."], z: PyTree, rate: PyTree) -> Float[Array, "..."]:
        """Friction force [N] at slip velocity `v` [m/s], state `z` and its rate, on which bristle damping acts."""

    def force(self, v: Float[Array, "..."], z: PyTree) -> Float[Array, "..."]:
        """Friction force [N] at slip velocity `v` [m/s] and state `z`."""
        return self.force_given_zdot(v, z, self.zdot(v, z))

    @abc.abstractmethod
    def stored_energy(self, z: PyTree) -> Scalar:
        """Energy [J] stored in the state `z`."""

    @abc.abstractmethod
    def step_exact(self, v: Float[Array, "..."], z: PyTree, dt: Scalar) -> PyTree:
        """State after the time `dt` [s] at constant slip velocity `v` [m/s], bounded for any step and stiffness."""

    def modelica(self) -> str:
        """Modelica's friction components have no state of their own."""
        return (
            f"state of their own, which {type(self).__name__} has. Export its force in steady slip, as a Stribeck, or"
            " write its equations in a custom model"
        )


class AbstractPlanarLaw(AbstractDynamicLaw):
    """A dynamic law whose slip may also be a vector, shape `[2]` or `[3]`; its state then has the same shape.

    The magnitude of the slip velocity is its speed, which couples the components.
    """

    execution: ClassVar[str] = "integrated directly, also in the plane"


# Registered laws by name.
_LAWS: dict[str, type[AbstractLaw]] = {}


def register_law(law: type[_Law]) -> type[_Law]:
    """Class decorator that registers a law under the name of its class.

    A registered law is a `kind` in the files of `jaxmodsim sweep` and a row in the table of laws. With `cases()` the
    behaviour bench of the repository runs it (`python -m bench behaviour`); with `fit_start()` it is a model of
    `jaxmodsim fit`.

    **Arguments:**

    - `law`: a final class that derives from a kind of law, such as `AbstractForceLaw`.

    **Returns:**

    The same class.

    **Raises:**

    - `ValueError` if `law` is not such a class, or its name is taken.
    """
    if not (isinstance(law, type) and issubclass(law, AbstractLaw)) or inspect.isabstract(law):
        raise ValueError(
            f"register_law needs a final class of laws, derived from one such as AbstractForceLaw; given: {law!r}."
        )
    if law.__name__ in _LAWS:
        raise ValueError(f"register_law: there is a law {law.__name__} already; rename the class.")
    _LAWS[law.__name__] = law
    return law


def laws() -> Mapping[str, type[AbstractLaw]]:
    """The registered laws by name, those of the package first.

    **Returns:**

    A read-only mapping from the name of each class to the class.
    """
    return MappingProxyType(_LAWS)
