"""Friction of servo gears, as a function of the torques on either side."""

from collections.abc import Callable
from typing import Any, ClassVar, TypeAlias

import jax.numpy as jnp
from jaxtyping import ArrayLike

from .._core.parameters import Number, NumberOrState, optional_parameter, parameter, state_parameter
from .._core.shapes import Scalar
from ._law import AbstractSetValuedLaw, register_law
from ._servo_sets import PUBLISHED
from ._stribeck import exponential, stribeck_power

Torque: TypeAlias = Callable[..., ArrayLike] | ArrayLike


def _load_term(name: str, unit: str) -> Any:
    return parameter(name, unit, lower=0.0, default=0.0)


@register_law
class ServoGear(AbstractSetValuedLaw):
    """Friction of a servo's gear under the torques of motor and load: the models M1 to M6 of Duclusaud and others.

    With the torques tau_m and tau_e with which the motor and the load push the joint (`J q'' = tau_m + tau_e - F`):
    `F = (Kc + |Km tau_m - Ke tau_e| + (Kcs + |Kms tau_m - Kes tau_e| + Q) exp(-|v/vs|^alpha)) sign(v) + Kv v`, in stick
    anything up to the dry part at v = 0. Where the torques oppose each other, `Q = Keq tau_e^2` while the motor's is
    the larger one, and `Kmq tau_m^2` otherwise; Q is 0 where they do not.

    | model | needs |
    |---|---|
    | M1 Coulomb-viscous | Kc, Kv |
    | M2 Stribeck | and Kcs, vs, alpha |
    | M3 load | M1 and Km |
    | M4 Stribeck, load | M2 and Km, Kms |
    | M5 and directions | and Ke, Kes |
    | M6 and quadratic | and Kmq, Keq |

    Steady motion at a speed at which Km and Ke hold with their Stribeck parts added, without the other terms, has the
    efficiencies `(1 - Km)/(1 + Ke)` for the motor driving and `(1 - Ke)/(1 + Km)` for the load driving it back; a gear
    with Ke + Kes >= 1 locks itself.

    **Arguments:**

    - `motor`, `external`: the torques tau_m and tau_e [N m] as functions `fn(t, q, qd, params)`, or numbers. Numbers
      in them that are to be differentiated or fitted belong into `params`.
    - `Kc`: without load [N m], >= 0. `Kv`: viscous coefficient [N m s/rad], >= 0.
    - `Kcs`: added to Kc at rest [N m], >= 0; falls with speed.
    - `vs`: Stribeck velocity [rad/s], > 0; without it what falls with speed is not there. `alpha`: exponent, > 0; by
      default 2.
    - `Km`, `Ke`: per torque of the motor and of the load, >= 0; `Kms`, `Kes`: added at rest. Ke is by default Km, and
      Kes is Kms.
    - `Kmq`, `Keq`: per square of a torque [1/(N m)], >= 0; Keq is by default Kmq. Where they differ, and the
      torques are of opposite sign and pass through the same magnitude, F jumps.

    **Raises:**

    - `ValueError` if a parameter is out of range, or a torque no function and no number.

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
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "servo gear under the torques of motor and load: models M1 to M6"
    equations: ClassVar[tuple[str, ...]] = (
        "(Kc + |Km motor - Ke external| + s(v) exp(-|v/vs|^alpha)) sign(v) + Kv v",
        "s = Kcs + |Kms motor - Kes external| + Kmq motor^2 or Keq external^2",
    )
    mujoco_lacks: ClassVar[str] = ": the friction of its joints does not depend on torques"

    @classmethod
    def published(cls, actuator: str, model: str, motor: Torque, external: Torque) -> "ServoGear":
        """The law with the published numbers of an actuator.

        **Arguments:**

        - `actuator`: `mx64`, `mx106` (Dynamixel), `erob80_50`, `erob80_100` (eRob80, reduction 50 and 100).
        - `model`: `M1` to `M6`.
        - `motor`, `external`: as for the law.

        **Raises:**

        - `ValueError` for another name.

        The numbers are those of the files `bam/params` of github.com/Rhoban/bam, to six digits.
        """
        if (actuator, model) not in PUBLISHED:
            actuators, models = ({key[i]: None for key in PUBLISHED} for i in (0, 1))
            raise ValueError(
                f"ServoGear.published has the actuators {', '.join(actuators)} and the models {', '.join(models)}, but"
                f" {actuator!r} and {model!r} were given."
            )
        return cls(motor, external, **PUBLISHED[actuator, model])

    def _lasting(self) -> Scalar:
        """Dry part at any speed [N m]."""
        return self.Kc + jnp.abs(self.Km * self.motor - _or(self.Ke, self.Km) * self.external)

    def _falling(self) -> Scalar:
        """What is added at rest [N m], and falls with speed."""
        motor, external = self.motor, self.external
        larger = jnp.abs(motor) > jnp.abs(external)
        quadratic = jnp.where(larger, _or(self.Keq, self.Kmq) * external**2, self.Kmq * motor**2)
        linear = self.Kcs + jnp.abs(self.Kms * motor - _or(self.Kes, self.Kms) * external)
        return linear + jnp.where(motor * external < 0, quadratic, 0.0)

    def sliding_force(self, v: Scalar) -> Scalar:
        """Magnitude [N m] of the dry part in slip."""
        if self.vs is None:
            return jnp.broadcast_to(self._lasting(), jnp.shape(v))
        return self._lasting() + self._falling() * exponential(stribeck_power(v, self.vs, self.alpha))

    def viscous_force(self, v: Scalar) -> Scalar:
        """Viscous part [N m]."""
        return self.Kv * v

    def static_limit(self, direction: Scalar) -> Scalar:
        """Largest friction torque in stick [N m]."""
        return self.sliding_force(jnp.zeros_like(direction))

    def modelica(self) -> str:
        """Friction components do not know torques beside their own."""
        return "friction that depends on the torques of motor and load: write its equation in a model of your own"


def _or(value: Number | None, other: Number) -> Number:
    return other if value is None else value
