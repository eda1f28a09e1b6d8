"""Execution of a set-valued law by one bristle without a dimension."""

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._core.parameters import Number, parameter
from ..._core.shapes import Scalar
from .._bristle import ONE_STATE, YIELDS, relax_exact
from .._law import AbstractDynamicLaw, AbstractSetValuedLaw, register_law
from .._law_case import LawCase
from ._wrapper import AbstractWrapper, set_valued_law


@register_law
class Bristle(AbstractWrapper, AbstractDynamicLaw):
    """A set-valued law run by a bristle z between -1 and 1, which follows slip over the displacement `h`.

    `z' = (v - |v| z)/h`, `F = mean z + half z^2 + viscous_force(v)`, with the mean and half the difference of the
    sliding forces towards either side at the speed |v|. In steady slip z = +-1, and F is that of the law. z has no unit
    and its limit is 1 whatever the load, so a load or a temperature that changes scales the force and leaves z alone.
    Of `Coulomb` it is `Dahl` with `sigma0 = Fc/h`; of the load-dependent part of `Geared`, with the transmitted torque
    tau, `mu_avg |tau| z + mu_dif tau z^2`, where mu_avg is the mean of both coefficients and mu_dif half of drive minus
    back. There is no stiction beyond the sliding force.

    **Arguments:**

    - `law`: `Coulomb`, `Stribeck`, `Geared` or another set-valued law.
    - `h`: displacement over which the force builds up [m], > 0.

    **Raises:**

    - `ValueError` if `law` is not set-valued or `h` is out of range.
    """

    law: AbstractSetValuedLaw = set_valued_law("Bristle")
    h: Number = parameter("h", "m", lower=0.0, strict=True)
    stiff: ClassVar[bool] = True
    description: ClassVar[str] = "one bristle of limit 1, whatever the load"
    equations: ClassVar[tuple[str, ...]] = (
        "mean z + half z^2 + viscous_force(v)",
        "z' = (v - |v| z)/h",
        "mean, half: of sliding_force(|v|) + and - sliding_force(-|v|)",
    )
    limitations: ClassVar[Mapping[str, str]] = ONE_STATE | YIELDS
    execution: ClassVar[str] = "default solver `Rodas5P`"

    def _levels(self, v: Scalar) -> tuple[Scalar, Scalar]:
        """Mean and half the difference of the sliding forces [N] towards either side."""
        speed = jnp.abs(v) + float(jnp.finfo(v.dtype).tiny)
        forward, backward = self.law.sliding_force(speed), self.law.sliding_force(-speed)
        return 0.5 * (forward + backward), 0.5 * (forward - backward)

    def initial_state(self, v: Float[Array, "..."]) -> Float[Array, "..."]:
        """Undeflected bristle, 0."""
        return jnp.zeros_like(v)

    def zdot(self, v: Scalar, z: Scalar) -> Scalar:
        """Z' [1/s] at slip velocity `v` [m/s] and deflection `z`."""
        return (v - jnp.abs(v) * z) / self.h

    def force_given_zdot(self, v: Scalar, z: Scalar, rate: Scalar) -> Scalar:
        """Friction force [N] at slip velocity `v` [m/s] and deflection `z`; the bristle is not damped."""
        del rate
        mean, half = self._levels(v)
        return mean * z + half * z * z + self.law.viscous_force(v)

    def stored_energy(self, z: Scalar) -> Scalar:
        """Energy [J] of the bristle at rest: `h (mean z^2/2 + half z^3/3)`."""
        mean, half = self._levels(jnp.zeros_like(z))
        return self.h * z * z * (0.5 * mean + half * z / 3.0)

    def step_exact(self, v: Scalar, z: Scalar, dt: Scalar) -> Scalar:
        """Deflection after `dt` [s] at constant `v` [m/s], exactly: the rate is linear in z."""
        return relax_exact(v / self.h, z, dt, jnp.abs(v) / self.h)

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """None: it is Dahl of a Coulomb law, and the benches run that."""
        return ()
