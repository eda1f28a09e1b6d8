"""Friction that grows with the torque that a transmission transmits."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from ..._core.parameters import NumberOrState, as_number, state_parameter
from ..._core.shapes import Scalar
from .._coulomb import Coulomb
from .._law import AbstractSetValuedLaw, register_law

_LOSSES = ": its joints do not know the torque that a gear transmits"


def _set_valued(value: object) -> AbstractSetValuedLaw:
    if not isinstance(value, AbstractSetValuedLaw):
        raise ValueError(
            f"Geared needs a set-valued law such as Coulomb or Stribeck for its part without load, but {value!r} was"
            " given. Bristle(Geared(...), h) has a state of its own."
        )
    return value


def _per_torque(value: Any) -> AbstractSetValuedLaw:
    return value if isinstance(value, AbstractSetValuedLaw) else Coulomb(as_number(value, name="Geared drive and back"))


def _unless_none(value: Any) -> AbstractSetValuedLaw | None:
    return None if value is None else _per_torque(value)


@register_law
class Geared(AbstractSetValuedLaw):
    """Friction in a transmission: a part without load, and one in proportion to the transmitted torque.

    With the transmitted torque tau and the slip velocity w,
    `F = law(w) + |tau| drive(|w|) sign(w)` where tau w > 0, so that power goes from the motor to the load, and
    `F = law(w) + |tau| back(|w|) sign(w)` where the load drives the motor back. In stick F is anything up to the limits
    of either direction, so that the gear locks, drives and is driven back by events. Friction acts on the side of the
    motor, and tau is counted there, too: with coefficients mu of `drive` and `back` and without the other part, the
    efficiencies in steady motion are `1/(1 + mu_drive)` and `1 - mu_back`, and a gear with mu_back >= 1 locks itself.

    **Arguments:**

    - `law`: set-valued law of the part without load [N or N m].
    - `drive`: per newton (metre) of transmitted torque: a coefficient, >= 0, or a set-valued law, such as a `Stribeck`
      whose Fc and Fs are coefficients. It is asked for positive slip alone.
    - `torque`: transmitted torque, `torque(t, q, qd, params)` -> one number [N m], positive where it drives the load
      towards positive slip: that of the spring in an elastic joint. Numbers that are to be differentiated or fitted
      belong into `params`. A number for a constant torque.
    - `back`: as `drive`, for back-driving; by default the same.

    Where the torque is the multiplier of a `Constraint` (rigid gear) and does not change its sign:
    `Friction(asymmetric(Coulomb(mu_drive), Fc=mu_back), normal_force=NAME)`.

    **Raises:**

    - `ValueError` for what is no set-valued law, no coefficient or no function.
    """

    law: AbstractSetValuedLaw = eqx.field(converter=_set_valued)
    drive: AbstractSetValuedLaw = eqx.field(converter=_per_torque)
    torque: NumberOrState = state_parameter("Geared torque")
    back: AbstractSetValuedLaw | None = eqx.field(default=None, converter=_unless_none)
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "a law without load, and one per transmitted torque, for driving and back-driving"
    equations: ClassVar[tuple[str, ...]] = (
        "law + |torque| drive(|v|) sign(v) where torque v > 0",
        "law + |torque| back(|v|) sign(v) where torque v < 0",
    )
    mujoco_lacks: ClassVar[str] = _LOSSES

    def _per_torque(self, side: Scalar, of: Callable[[AbstractSetValuedLaw], Scalar]) -> Scalar:
        """`|tau|` times what `of` says of the law for slip towards `side` (+1 or -1)."""
        driven = of(self.drive)
        if self.back is not None:
            driven = jnp.where(side * self.torque >= 0, driven, of(self.back))
        return jnp.abs(self.torque) * driven

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
        """With those of the part without load."""
        return *self.equations, *self.law.formulas()

    def known_limitations(self) -> dict[str, str]:
        """Those of the part without load."""
        return self.law.known_limitations()

    def modelica(self) -> str:
        """`LossyGear` has it, by efficiencies over the speed."""
        return ""
