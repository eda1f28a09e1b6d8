"""Gear friction, which depends on the transmitted torque or on the torques of motor and load."""

import tomllib
from collections.abc import Callable
from functools import cache, partial
from importlib import resources
from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._core.arrays import Scalar
from .._core.parameters import Number, NumberOrState, as_number, optional_parameter, parameter, state_parameter
from ._law import AbstractSetValuedLaw, register_law, side_of
from ._static import Coulomb, exponential, stribeck_power
from ._wrappers import need_set_valued


def _per_torque(value: Any) -> AbstractSetValuedLaw:
    return value if isinstance(value, AbstractSetValuedLaw) else Coulomb(as_number(value, name="Geared drive and back"))


def _unless_none(value: Any) -> AbstractSetValuedLaw | None:
    return None if value is None else _per_torque(value)


@register_law
class Geared(AbstractSetValuedLaw):
    """Friction in a transmission: a load-independent part, and a part in proportion to the transmitted torque.

    With the transmitted torque tau and the slip velocity w, `F = law(w) + |tau| drive(|w|) sign(w)` for tau w > 0,
    where power flows from the motor to the load. Otherwise, in back-driving, `F = law(w) + |tau| back(|w|) sign(w)`. In
    stick F is anything up to the limits of either direction: events lock the gear, drive it and back-drive it. F and
    tau act on the motor side. With coefficients mu of `drive` and `back` and without the load-independent part, the
    efficiencies in steady motion are `1/(1 + mu_drive)` and `1 - mu_back`. A gear with mu_back >= 1 is self-locking.

    **Arguments:**

    - `law`: set-valued law of the load-independent part [N or N m].
    - `drive`: friction per transmitted torque: a coefficient, >= 0, or a set-valued law, such as a `Stribeck` whose Fc
      and Fs are coefficients. It is evaluated at positive slip only.
    - `torque`: transmitted torque, `torque(t, q, qd, params)` -> one number [N m], positive if it drives the load
      towards positive slip, such as that of the spring in an elastic joint; or a number. Numbers to differentiate or
      fit belong in `params`. Or the name of a `Constraint` that is a rigid gear, whose reaction is the torque;
      friction and reaction are then solved together. The gear drives where the reaction opposes slip.
    - `back`: as `drive`, for back-driving; by default the same.

    **Raises:**

    - `ValueError` if a law is not set-valued, a coefficient is out of range, or `torque` is no function, number or
      name.

    **Example:**

    ```python
    def torque(t, q, qd, p):
        return p["load"]

    gear = jms.Geared(jms.Coulomb(Fc=0.1), drive=0.2, back=0.3, torque=torque)
    law = gear.bind_state(jnp.array(0.0), jnp.zeros(1), jnp.zeros(1), {"load": jnp.array(2.0)})
    print(jax.vmap(law.sliding_force)(jnp.array([1.0, -1.0])), "N m, driving and back-driving")
    ```

    ```text
    [0.5 0.7] N m, driving and back-driving
    ```
    """

    law: AbstractSetValuedLaw = eqx.field(converter=partial(need_set_valued, owner="Geared"))
    drive: AbstractSetValuedLaw = eqx.field(converter=_per_torque)
    torque: NumberOrState = state_parameter("Geared torque", reaction=True)
    back: AbstractSetValuedLaw | None = eqx.field(default=None, converter=_unless_none)
    sides: Float[Array, " 1"] | None = eqx.field(default_factory=lambda: None, init=False, repr=False)
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "a load-independent law, and one per transmitted torque, for driving and back-driving"
    equations: ClassVar[tuple[str, ...]] = (
        "law + |torque| drive(|v|) sign(v) for torque v > 0",
        "law + |torque| back(|v|) sign(v) for torque v < 0",
    )
    mujoco_lacks: ClassVar[str] = ": the friction of its joints does not depend on the transmitted torque"
    kinks: ClassVar[tuple[Callable[[Any], Scalar], ...]] = (lambda law: law.torque,)

    def at_torque(self, torque: Scalar) -> "Geared":
        """The part that depends on the torque, at this torque [N m]."""
        return Geared(Coulomb(jnp.zeros_like(torque)), self.drive, torque, self.back)

    def _per_torque(self, side: Scalar, of: Callable[[AbstractSetValuedLaw], Scalar]) -> Scalar:
        """`|tau|` times `of(drive)` or `of(back)`, for slip towards `side` (+1 or -1)."""
        power, drive = side * self.torque, of(self.drive)
        back = drive if self.back is None else of(self.back)
        drives = side * side_of(self.torque, self.sides, 0) >= 0
        return jnp.where(drives, power * drive, -power * back)

    def sliding_force(self, v: Scalar) -> Scalar:
        """Magnitude [N] of the dry part in slip."""
        side, speed = jnp.where(v < 0, -1.0, 1.0).astype(v.dtype), jnp.abs(v)
        return self.law.sliding_force(v) + self._per_torque(side, lambda law: law.sliding_force(speed))

    def viscous_force(self, v: Scalar) -> Scalar:
        """Viscous part [N]."""
        side, speed = jnp.where(v < 0, -1.0, 1.0).astype(v.dtype), jnp.abs(v)
        return self.law.viscous_force(v) + side * self._per_torque(side, lambda law: law.viscous_force(speed))

    def static_limit(self, direction: Scalar) -> Scalar:
        """Largest force in stick [N]."""
        one = jnp.ones_like(direction)
        return self.law.static_limit(direction) + self._per_torque(direction, lambda law: law.static_limit(one))

    def formulas(self) -> tuple[str, ...]:
        """Equations of this law, then of its load-independent part."""
        return *self.equations, *self.law.formulas()

    def known_limitations(self) -> dict[str, str]:
        """Limitations of the load-independent part."""
        return self.law.known_limitations()

    def modelica(self) -> str:
        """`LossyGear` has the same friction, as a table of efficiencies over speed."""
        return ""


Torque: TypeAlias = Callable[..., ArrayLike] | ArrayLike


@cache
def published_servo_gears() -> dict[str, dict[str, dict[str, float]]]:
    """Published parameters of `ServoGear` by actuator and model; the file `servo_gears.toml` names their source."""
    return tomllib.loads(resources.files("jaxmodsim.friction").joinpath("servo_gears.toml").read_text("utf-8"))


def _load_term(name: str, unit: str) -> Any:
    return parameter(name, unit, lower=0.0, default=0.0)


@register_law
class ServoGear(AbstractSetValuedLaw):
    """Friction of a servo gear under the torques of motor and load: the models M1 to M6 of Duclusaud and others.

    The motor and the load act on the joint with the torques tau_m and tau_e, `J q'' = tau_m + tau_e - F`. In slip
    `F = (Kc + |Km tau_m - Ke tau_e| + (Kcs + |Kms tau_m - Kes tau_e| + Q) exp(-|v/vs|^alpha)) sign(v) + Kv v`; in stick
    F is anything up to the dry part at v = 0. If the torques oppose each other, `Q = Keq tau_e^2` for
    `|tau_m| > |tau_e|` and `Q = Kmq tau_m^2` otherwise. If they do not, Q = 0.

    | model | parameters |
    |---|---|
    | M1 Coulomb-viscous | Kc, Kv |
    | M2 Stribeck | M1 and Kcs, vs, alpha |
    | M3 load | M1 and Km |
    | M4 Stribeck, load | M2 and Km, Kms |
    | M5 directions | M4 and Ke, Kes |
    | M6 quadratic | M5 and Kmq, Keq |

    Let Km and Ke include their Stribeck parts at the speed of a steady motion, and let all other terms be zero. Then
    the efficiency is `(1 - Km)/(1 + Ke)` if the motor drives, and `(1 - Ke)/(1 + Km)` in back-driving. A gear with
    Ke + Kes >= 1 is self-locking.

    **Arguments:**

    - `motor`, `external`: the torques tau_m and tau_e [N m] as functions `fn(t, q, qd, params)`, or numbers. Numbers
      to differentiate or fit belong in `params`.
    - `Kc`: load-independent friction [N m], >= 0. `Kv`: viscous coefficient [N m s/rad], >= 0.
    - `Kcs`: increase of Kc at rest [N m], >= 0; falls with speed.
    - `vs`: Stribeck velocity [rad/s], > 0; without it F has no Stribeck part. `alpha`: exponent, > 0; by default 2.
    - `Km`, `Ke`: friction per torque of the motor and of the load, >= 0; `Kms`, `Kes`: their increase at rest. By
      default Ke = Km and Kes = Kms.
    - `Kmq`, `Keq`: friction per squared torque [1/(N m)], >= 0; by default Keq = Kmq. If they differ, F jumps where
      opposing torques become equal in magnitude.

    **Raises:**

    - `ValueError` if a parameter is out of range, or a torque is neither a function nor a number.

    **Example:**

    ```python
    gear = jms.ServoGear(motor=lambda t, q, qd, p: p["u"], external=-0.5, Kc=0.1, Kv=0.05, Km=0.2)
    law = gear.bind_state(jnp.array(0.0), jnp.zeros(1), jnp.zeros(1), {"u": jnp.array(1.0)})
    print(law.sliding_force(jnp.array(1.0)), "N m")  # Kc + |Km tau_m - Ke tau_e|
    ```

    ```text
    0.4 N m
    ```

    ??? cite "Reference"

        ```bibtex
        @inproceedings{duclusaud2025extended,
            author={Duclusaud, Marc and Passault, Gregoire and Padois, Vincent and Ly, Olivier},
            title={Extended friction models for the physics simulation of servo actuators},
            booktitle={IEEE International Conference on Robotics and Automation},
            note={arXiv 2410.08650}, year={2025},
        }
        ```
    """

    motor: NumberOrState = state_parameter("ServoGear motor")
    external: NumberOrState = state_parameter("ServoGear external")
    Kc: Number = parameter("Kc", "N", lower=0.0)
    Kv: Number = parameter("Kv", "N s/m", lower=0.0)
    Kcs: Number = _load_term("Kcs", "N")
    vs: Number | None = optional_parameter("vs", "m/s", lower=0.0, strict=True)
    alpha: Number | None = optional_parameter("alpha", "1", lower=0.0, strict=True)
    Km: Number = _load_term("Km", "N/N")
    Ke: Number | None = optional_parameter("Ke", "N/N", lower=0.0)
    Kms: Number = _load_term("Kms", "N/N")
    Kes: Number | None = optional_parameter("Kes", "N/N", lower=0.0)
    Kmq: Number = _load_term("Kmq", "N/N^2")
    Keq: Number | None = optional_parameter("Keq", "N/N^2", lower=0.0)
    sides: Float[Array, " 3"] | None = eqx.field(default_factory=lambda: None, init=False, repr=False)
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "servo gear under the torques of motor and load: models M1 to M6"
    equations: ClassVar[tuple[str, ...]] = (
        "(Kc + |Km motor - Ke external| + s(v) exp(-|v/vs|^alpha)) sign(v) + Kv v",
        "s = Kcs + |Kms motor - Kes external| + Kmq motor^2 or Keq external^2",
    )
    mujoco_lacks: ClassVar[str] = ": the friction of its joints does not depend on torques"
    kinks: ClassVar[tuple[Callable[[Any], Scalar], ...]] = (
        lambda law: law.Km * law.motor - _or(law.Ke, law.Km) * law.external,
        lambda law: law.Kms * law.motor - _or(law.Kes, law.Kms) * law.external,
        lambda law: jnp.where((law.Kmq == 0) & (_or(law.Keq, law.Kmq) == 0), 0.0, law._larger),
    )

    @classmethod
    def published(cls, actuator: str, model: str, motor: Torque, external: Torque) -> "ServoGear":
        """The law with the published parameters of an actuator.

        **Arguments:**

        - `actuator`: `mx64`, `mx106` (Dynamixel), `erob80_50`, `erob80_100` (eRob80, reduction 50 and 100).
        - `model`: `M1` to `M6`.
        - `motor`, `external`: as for the law.

        **Raises:**

        - `ValueError` for an unknown actuator or model.

        The parameters are those of the files `bam/params` of github.com/Rhoban/bam, to six digits.
        """
        sets = published_servo_gears()
        if model not in sets.get(actuator, {}):
            models = next(iter(sets.values()))
            raise ValueError(
                f"ServoGear.published has the actuators {', '.join(sets)} and the models {', '.join(models)}, but"
                f" {actuator!r} and {model!r} were given."
            )
        return cls(motor, external, **sets[actuator][model])

    def _difference(self, by_motor: Scalar, by_external: Scalar, kink: int) -> Scalar:
        """`|by_motor tau_m - by_external tau_e|`, at zero with derivatives of one side: of growing coefficients."""
        torque = by_motor * self.motor - by_external * self.external
        side = jnp.where(torque == 0, self.motor - self.external, side_of(torque, self.sides, kink))
        return jnp.where(side >= 0, torque, -torque)

    def _constant(self) -> Scalar:
        """Dry part at any speed [N m]."""
        return self.Kc + self._difference(self.Km, _or(self.Ke, self.Km), 0)

    def _falling(self) -> Scalar:
        """Stribeck part at rest [N m], which falls with speed."""
        motor, external, Keq = self.motor, self.external, _or(self.Keq, self.Kmq)
        larger = jnp.where((self.Kmq == 0) & (Keq == 0), self._larger, side_of(self._larger, self.sides, 2))
        quadratic = jnp.where(larger > 0, Keq * external**2, self.Kmq * motor**2)
        linear = self.Kcs + self._difference(self.Kms, _or(self.Kes, self.Kms), 1)
        return linear + jnp.where(motor * external < 0, quadratic, 0.0)

    @property
    def _larger(self) -> Scalar:
        """Excess of the motor's torque over that of the load [N m], in magnitude."""
        return jnp.abs(self.motor) - jnp.abs(self.external)

    def sliding_force(self, v: Scalar) -> Scalar:
        """Magnitude [N m] of the dry part in slip."""
        if self.vs is None:
            return jnp.broadcast_to(self._constant(), jnp.shape(v))
        return self._constant() + self._falling() * exponential(stribeck_power(v, self.vs, self.alpha))

    def viscous_force(self, v: Scalar) -> Scalar:
        """Viscous part [N m]."""
        return self.Kv * v

    def static_limit(self, direction: Scalar) -> Scalar:
        """Largest friction torque in stick [N m]."""
        return self.sliding_force(jnp.zeros_like(direction))

    def modelica(self) -> str:
        """Modelica's friction components depend on no torques."""
        return "friction that depends on the torques of motor and load: write its equation in a custom model"


def _or(value: Number | None, other: Number) -> Number:
    return other if value is None else value
