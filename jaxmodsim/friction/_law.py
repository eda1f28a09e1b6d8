"""What a friction law is. Sign: the force is positive when it opposes positive slip."""

import abc
import dataclasses
import inspect
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from .._core.parameters import check_ranges, ranges_of
from .._core.readable import AbstractReadable
from .._core.shapes import PerDof, Scalar
from .._core.state_dependent import bind_state, is_state_dependent, nominal
from ._law_case import STANDARD, LawCase, steady_curve
from ._passivity import Passivity

if TYPE_CHECKING:
    from typing import ClassVar as AbstractClassVar
else:
    from equinox import AbstractClassVar


_Law = TypeVar("_Law", bound="AbstractLaw")

# Limitation of laws whose friction does not fall as slip begins.
# A fit looks for Fs up to this many times Fc. Beyond it the peak at zero velocity is so high and narrow that samples
# which pass through it in a moment trade it against vs, and what is fitted fails on the next record.
MOST_STICTION = 5.0
NO_STRIBECK_EFFECT = "Without a Stribeck effect friction does not depend on slip velocity but for the viscous part."
NO_STICTION_IN_MUJOCO = (
    " with Fs > Fc: its dry friction is one force, in stick and in slip. Export a LuGre with the same Fc and Fs, and"
    " sigma0 as stiff as the step allows, or leave the stiction out"
)
_NO_MEMORY = {
    "break-away": "The limit of stick is a number, whatever the load did before.",
    "lag": "The force is a function of velocity: no memory, no lag.",
}
_JUMPS = {"presliding": "The force is a function of velocity and jumps as the velocity reverses."}


class AbstractLaw(AbstractReadable, eqx.Module):
    """A friction law: knows its slip velocity [m/s or rad/s] and its own state, nothing of the mechanism.

    Its class says all that is known of it; `register_law` makes it known to the command line, the benches and tables.
    Besides the parameters and methods of its kind it may say:

    - `description`, `equations`: in a few words, and as plain formulas: the force, then what that is made of.
    - `execution`: how `simulate` runs it.
    - `valid_at_any_speed`: whether the force may be evaluated up to the largest number there is.
    - `limitations`: experiments of the behaviour bench that the law misses whatever its numbers, and why.
    - `mujoco_lacks`: why MuJoCo has not such a law, and what to do; read after its name.
    - `example`, `example_step`: numbers that `STANDARD` has not, and the fixed step [s] that the law needs if it does.
    """

    # Whether the law makes the equations of motion stiff, which decides the default solver.
    stiff: AbstractClassVar[bool]
    description: ClassVar[str] = ""
    equations: ClassVar[tuple[str, ...]] = ()
    execution: ClassVar[str] = "as it is"
    valid_at_any_speed: ClassVar[bool] = False
    limitations: ClassVar[Mapping[str, str]] = {}
    mujoco_lacks: ClassVar[str] = (
        ": its joints have friction that is constant, viscous, or LuGre. Fit one of these, with fit_law, and export it"
    )
    example: ClassVar[Mapping[str, PyTree]] = {}
    example_step: ClassVar[float | None] = None

    def __check_init__(self) -> None:
        """Refuse parameters out of range."""
        check_ranges(self)

    def bind_state(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> "AbstractLaw":
        """The law as it is at a state of the mechanism; another one only where `scaled_by` made it depend on that."""
        return bind_state(self, t, q, qd, params) if is_state_dependent(self) else self

    def formulas(self) -> tuple[str, ...]:
        """The equations of this law; of one that says none the names of its parameters."""
        return self.equations or (f"{type(self).__name__}({', '.join(ranges_of(self))})",)

    def known_limitations(self) -> dict[str, str]:
        """Experiments that the law misses with these numbers, and why."""
        limitations = dict(self.limitations)
        Fc, Fs = (nominal(getattr(self, name, None)) for name in ("Fc", "Fs"))
        if Fc is not None and (Fs is None or not bool((Fs > Fc).any())):
            limitations = dict.fromkeys(("break-away", "lag", "stick-slip"), NO_STRIBECK_EFFECT) | limitations
        passivity = self.passivity()
        return limitations if passivity is None or passivity.ok else limitations | {"passivity": passivity.condition}

    def passivity(self) -> Passivity | None:
        """Whether the law is passive, from a closed form; None to have `check_passivity` search."""
        return None

    def mujoco(self) -> dict[str, PyTree] | str:
        """The law in MuJoCo: attributes with their numbers; or what MuJoCo lacks, and what to do.

        Of a `joint`, `frictionloss` [N] and `damping` [N s/m]; of a motor, `damping` and `lugre`, the numbers sigma0,
        sigma1, Fc, Fs and vs.
        """
        return f"{type(self).__name__}{self.mujoco_lacks}"

    def modelica(self) -> str:
        """What Modelica's friction components lack of the law, and what to do; empty where they have it.

        They have a range of forces at rest, and any function of slip velocity that goes on from there.
        """
        return (
            f"{type(self).__name__}: they take set-valued laws and Viscous. Write the force as a Stribeck, with"
            " fit_law, and export that"
        )

    @classmethod
    def standard(cls: type[_Law], **others: object) -> _Law:
        """The law with the standard parameters, as far as it has them, and others."""
        names = [field.name for field in dataclasses.fields(cls)]
        return cls(**{name: STANDARD[name] for name in names if name in STANDARD} | dict(cls.example) | others)

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """Examples of the law that benches and tests run; none, and they leave it out.

        By default the standard law, with the Stribeck curve for its force in steady slip; none if `STANDARD` and
        `example` have not all that it needs.
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
        """The law with which a fit of an axis starts; None, and it is no candidate.

        **Arguments:**

        - `m`: mass [kg], `Fc`, `Fv`: Coulomb force [N] and viscous coefficient [N s/m], of a linear regression.
        - `v_max`: largest speed of the record [m/s].
        """
        return None


class AbstractForceLaw(AbstractLaw):
    """A law whose force is a function of slip velocity."""

    # Whether the force jumps at rest.
    jumps: ClassVar[bool] = False
    limitations: ClassVar[Mapping[str, str]] = {
        **_JUMPS,
        **_NO_MEMORY,
        "creep": "A function of velocity holds a load only by moving.",
    }

    @abc.abstractmethod
    def force(self, v: Scalar) -> Scalar:
        """Friction force [N] at slip velocity `v` [m/s]."""


class AbstractSetValuedLaw(AbstractLaw):
    """A law whose force at rest may be anything up to a limit: a rule for slip and a limit of stick.

    By itself it runs exactly, by events; `Regularized`, `DeadZone` and `Sign` run it in other ways.
    """

    execution: ClassVar[str] = "exactly, by events; or in a wrapper"
    limitations: ClassVar[Mapping[str, str]] = {**_JUMPS, **_NO_MEMORY}

    @abc.abstractmethod
    def sliding_force(self, v: Scalar) -> Scalar:
        """Magnitude [N] of the dry part of the force in slip at velocity `v` [m/s], never negative.

        At `v = 0` its limit from above.
        """

    @abc.abstractmethod
    def viscous_force(self, v: Scalar) -> Scalar:
        """Part of the force [N] that is a smooth function of `v` [m/s], zero at rest."""

    @abc.abstractmethod
    def static_limit(self, direction: Scalar) -> Scalar:
        """Largest force [N] in stick against a load that pulls towards `direction` (+1 or -1)."""

    def modelica(self) -> str:
        """Modelica's friction components are such laws."""
        return ""

    def lugre_numbers(self, vs: float) -> dict[str, PyTree] | None:
        """Parameters of LuGre but sigma0 and sigma1 that give its steady force; None where it has no such force.

        **Arguments:**

        - `vs`: Stribeck velocity [m/s] for a law whose force jumps from stick to slip.
        """
        return None


class AbstractKarnoppLaw(AbstractLaw):
    """A law that balances the load in a band about rest: its force there depends on the other forces."""

    limitations: ClassVar[Mapping[str, str]] = _NO_MEMORY

    @abc.abstractmethod
    def holds(self, v: Scalar) -> Bool[Array, ""]:
        """Whether velocity `v` [m/s] counts as rest."""

    @abc.abstractmethod
    def static_limit(self, direction: Scalar) -> Scalar:
        """Largest holding force [N] against a load that pulls towards `direction` (+1 or -1)."""

    @abc.abstractmethod
    def force(self, v: Scalar) -> Scalar:
        """Friction force [N] at velocity `v` [m/s] outside the band."""

    def passivity(self) -> Passivity:
        """Not passive: in the band the force is the load, whatever direction the band is crossed in."""
        worst = max(float(self.static_limit(jnp.asarray(side))) for side in (1.0, -1.0))
        words = (
            f"In the band about rest the force of {type(self).__name__} is the load, up to {worst:g} N in either"
            " direction: a load that brakes is cancelled, by a force that pushes along the motion. The law inside, run"
            " by events, does not do that."
        )
        return Passivity(worst == 0, -math.inf if worst > 0 else 0.0, 0.0 if worst > 0 else math.inf, words)


class AbstractDynamicLaw(AbstractLaw):
    """A law with a state of its own."""

    @abc.abstractmethod
    def initial_state(self, v: Float[Array, "..."]) -> PyTree:
        """State at rest and unloaded, for slip of the shape of `v`."""

    @abc.abstractmethod
    def zdot(self, v: Float[Array, "..."], z: PyTree) -> PyTree:
        """Time derivative of the state `z` at slip velocity `v` [m/s]."""

    @abc.abstractmethod
    def force_given_zdot(self, v: Float[Array, "..."], z: PyTree, rate: PyTree) -> Float[Array, "..."]:
        """Friction force [N] at slip velocity `v` [m/s], the state `z`, and a rate of that: damping in the bristle."""

    def force(self, v: Float[Array, "..."], z: PyTree) -> Float[Array, "..."]:
        """Friction force [N] at slip velocity `v` [m/s] and state `z`."""
        return self.force_given_zdot(v, z, self.zdot(v, z))

    @abc.abstractmethod
    def stored_energy(self, z: PyTree) -> Scalar:
        """Energy [J] held in the state `z`."""

    @abc.abstractmethod
    def step_exact(self, v: Float[Array, "..."], z: PyTree, dt: Scalar) -> PyTree:
        """State after the time `dt` [s] at constant slip velocity `v` [m/s]: bounded at any step, however stiff."""

    def modelica(self) -> str:
        """Modelica's friction components have no state of their own."""
        return (
            f"state of their own, which {type(self).__name__} has. Export its force in steady slip, as a Stribeck, or"
            " write its equations in a model of your own"
        )


class AbstractPlanarLaw(AbstractDynamicLaw):
    """A dynamic law whose slip may also be a vector, shape `[2]` or `[3]`; its state then has as many components.

    What depends on speed depends on the magnitude of slip, so that the components are coupled.
    """

    execution: ClassVar[str] = "as it is, in the plane too"


# Registered laws by name.
_LAWS: dict[str, type[AbstractLaw]] = {}


def register_law(law: type[_Law]) -> type[_Law]:
    """Make a law known by the name of its class: a decorator of final classes.

    From then on it is a `kind` in the files of `jaxmodsim sweep`, and stands in the table of laws. With `cases()` the
    behaviour bench of the repository runs it (`python -m bench behaviour`), with `fit_start()` it is a model of
    `jaxmodsim fit`.

    **Arguments:**

    - `law`: a final class derived from one of the kinds of law, such as `AbstractForceLaw`.

    **Returns:**

    The same class.

    **Raises:**

    - `ValueError` for what is no such class, and for a name that another class has.
    """
    if not (isinstance(law, type) and issubclass(law, AbstractLaw)) or inspect.isabstract(law):
        raise ValueError(f"register_law needs a final class of laws, as of AbstractForceLaw, but {law!r} was given.")
    if law.__name__ in _LAWS:
        raise ValueError(f"register_law: there is a law {law.__name__} already; give the class another name.")
    _LAWS[law.__name__] = law
    return law


def laws() -> Mapping[str, type[AbstractLaw]]:
    """The registered laws by name, those of the package first."""
    return MappingProxyType(_LAWS)
