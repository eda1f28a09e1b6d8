"""Armstrong's law with seven parameters."""

import math
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.arrays import Scalar
from .._core.functions import nominal
from .._core.parameters import Number, parameter
from .._core.safe import decay_mean
from ._bristles import advance_elastoplastic, slip_fraction
from ._law import MOST_STICTION, AbstractDynamicLaw, LawCase, Passivity, register_law, stribeck_case

# Fraction of its limit over which the contact yields.
_CORNER = 0.02
# Slip velocity over vs below which the contact counts as resting.
_SLIDES = 1e-3


class ArmstrongState(NamedTuple):
    """State of `Armstrong`.

    - `z`: deflection of the contact [m].
    - `rise`: current Stribeck friction, as a fraction of Fs - Fc.
    - `magnitude`: value of `rise` in the limit of zero speed; in stick it follows `rise`.
    - `slip`: slip [m] since the contact yielded, at most `0.02 Fc/sigma0`, until the motion reverses; 0 in stick.
    """

    z: Scalar
    rise: Scalar
    magnitude: Scalar
    slip: Scalar


@register_law
class Armstrong(AbstractDynamicLaw):
    """Armstrong's model of seven parameters: stiff in stick, Stribeck friction with memory in slip, rising stiction.

    In stick `F = sigma0 z + Fv v`; in slip `F = (Fc + (Fs - Fc) rise) sign(v) + Fv v`. In slip `rise` tends to
    `magnitude/(1 + (v/vs)^2)` with the time constant `tau`, which is frictional memory. In stick `rise` grows to 1 like
    `t/(t + gamma)`, and its last value becomes the magnitude of the next slip. Slip begins when the contact yields and
    ends when the motion reverses or stops: the paper leaves this rule open.

    Three differences to the paper make the model a single set of differential equations. The lag is of first order,
    instead of a pure delay of tau. Stiction grows by `rise' = (1 - rise)^2/gamma`, which is the paper's `t/(t + gamma)`
    if rise = 0 at the beginning of stick. The magnitude follows the rise in stick with the time constant tau.

    **Arguments:**

    - `sigma0`: stiffness of the contact in stick [N/m], > 0.
    - `Fc`: Coulomb force [N], > 0.
    - `Fs`: stiction force after a long rest [N], >= Fc.
    - `vs`: Stribeck velocity [m/s], > 0.
    - `Fv`: viscous coefficient [N s/m], >= 0.
    - `tau`: time constant of frictional memory [s], > 0.
    - `gamma`: time of rest [s] in which the Stribeck friction grows from 0 to one half, > 0.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.

    **Example:**

    ```python
    law = jms.Armstrong(sigma0=1e5, Fc=1.0, Fs=1.5, vs=0.01, Fv=0.4, tau=1e-3, gamma=1.0)
    z = law.step_exact(jnp.array(0.01), law.initial_state(jnp.array(0.0)), jnp.array(1.0))
    print(f"{law.force(jnp.array(0.01), z):.3f} N")
    ```

    ```text
    1.254 N
    ```

    ??? cite "Reference"

        ```bibtex
        @article{armstrong1994survey,
            author={Armstrong-Helouvry, Brian and Dupont, Pierre and Canudas de Wit, Carlos},
            title={A survey of models, analysis tools and compensation methods for the control of machines
                   with friction},
            journal={Automatica}, volume={30}, number={7}, pages={1083--1138}, year={1994},
        }
        ```
    """

    sigma0: Number = parameter("sigma0", "N/m", lower=0.0, strict=True)
    Fc: Number = parameter("Fc", "N", lower=0.0, strict=True)
    Fs: Number = parameter("Fs", "N", lower="Fc", most=MOST_STICTION)
    vs: Number = parameter("vs", "m/s", lower=0.0, strict=True)
    Fv: Number = parameter("Fv", "N s/m", lower=0.0)
    tau: Number = parameter("tau", "s", lower=0.0, strict=True)
    gamma: Number = parameter("gamma", "s", lower=0.0, strict=True)
    stiff: ClassVar[bool] = True
    description: ClassVar[str] = "frictional memory, stiction that rises with time at rest"
    equations: ClassVar[tuple[str, ...]] = (
        "sigma0 z + Fv v in stick, (Fc + (Fs - Fc) rise) sign(v) + Fv v in slip",
        "rise' = (1 - rise)^2/gamma in stick, (magnitude/(1 + (v/vs)^2) - rise)/tau in slip",
        "magnitude' = (rise - magnitude)/tau in stick, 0 in slip",
    )
    limitations: ClassVar[Mapping[str, str]] = {
        "characteristic": "Stribeck friction after a reversal depends on the previous slip and on the time at rest."
    }
    mujoco_lacks: ClassVar[str] = (
        ": the stiction of its bristle does not grow with time and has no memory. Fit a LuGre and export that"
    )

    def _moves(self, v: Scalar) -> Scalar:
        """Weight of sliding at the velocity `v` [m/s], from 0 at rest to 1."""
        return jnp.minimum(jnp.abs(v) / (_SLIDES * self.vs), 1.0)

    def _limit(self, rise: Scalar) -> Scalar:
        """Deflection [m] at which the contact slips."""
        return (self.Fc + (self.Fs - self.Fc) * rise) / self.sigma0

    def _steady(self, v: Scalar) -> Scalar:
        """Fraction of the magnitude that remains in steady slip at `v` [m/s]."""
        ratio = v / self.vs
        return 1.0 / (1.0 + ratio * ratio)

    def initial_state(self, v: Float[Array, "..."]) -> ArmstrongState:
        """Undeflected contact after a long rest."""
        return ArmstrongState(jnp.zeros_like(v), jnp.ones_like(v), jnp.ones_like(v), jnp.zeros_like(v))

    def zdot(self, v: Scalar, z: ArmstrongState) -> ArmstrongState:
        """Rates of the state [m/s, 1/s, 1/s, m/s] at slip velocity `v` [m/s]."""
        u = z.z * jnp.sign(v) / self._limit(z.rise)
        share = slip_fraction(u, jnp.asarray(_CORNER, u.dtype))
        slips = z.slip / self._turn()
        slides, missing = slips * self._moves(v), 1.0 - z.rise
        falls = (z.magnitude * self._steady(v) - z.rise) / self.tau
        rise = slides * falls + (1.0 - slides) * missing * missing / self.gamma
        turns = jnp.where(v * z.z < 0, -slips, share * (1.0 - slips))
        return ArmstrongState(
            v * (1.0 - share),
            rise,
            (1.0 - slides) * (z.rise - z.magnitude) / self.tau,
            jnp.abs(v) * turns,
        )

    def _turn(self) -> Scalar:
        """Slip [m] over which the contact changes from stick to slip, and back."""
        return _CORNER * self.Fc / self.sigma0

    def force_given_zdot(self, v: Scalar, z: ArmstrongState, rate: ArmstrongState) -> Scalar:
        """Friction force [N] at slip velocity `v` [m/s]."""
        return self.sigma0 * z.z + self.Fv * v

    def stored_energy(self, z: ArmstrongState) -> Scalar:
        """Elastic energy [J] of the contact."""
        return 0.5 * self.sigma0 * z.z * z.z

    def step_exact(self, v: Scalar, z: ArmstrongState, dt: Scalar) -> ArmstrongState:
        """State after any time `dt` [s] at constant `v` [m/s]: first in stick, then in slip, each exact."""
        corner, distance = jnp.asarray(_CORNER, z.z.dtype), jnp.abs(v) * dt
        # Slip until the deflection is zero after a reversal, then slip that the contact does not follow.
        back = jnp.minimum(distance, jnp.where(v * z.z < 0, jnp.abs(z.z), 0.0))
        follows = jnp.sign(v) * (advance_elastoplastic(v, z.z, dt, self._limit(z.rise), corner) - z.z)
        lost = jnp.maximum(distance - follows, 0.0)
        turn = self._turn()
        before = z.slip / turn * jnp.exp(-back / turn)
        slips = 1.0 - (1.0 - before) * jnp.exp(-lost / turn)
        # Mean weight of slip: as before while the contact follows, then that of the slip which it does not follow.
        share = jnp.minimum(lost / jnp.where(distance > 0, distance, 1.0), 1.0)
        mean = before + share * (1.0 - before) * (1.0 - decay_mean(lost / turn))
        sliding = mean * self._moves(v) * dt
        resting = dt - sliding
        missing = (1.0 - z.rise) / (1.0 + (1.0 - z.rise) * resting / self.gamma)
        magnitude = 1.0 - missing + (z.magnitude - 1.0 + missing) * jnp.exp(-resting / self.tau)
        goal = magnitude * self._steady(v)
        rise = goal + (1.0 - missing - goal) * jnp.exp(-sliding / self.tau)
        deflection = advance_elastoplastic(v, z.z, dt, self._limit(rise), corner)
        return ArmstrongState(deflection, rise, magnitude, turn * slips)

    def passivity(self) -> Passivity:
        """Always passive: the contact slips only in the direction of its load, so `sigma0 z (v - z') >= 0`."""
        condition = "Armstrong is always passive: the contact slips only in the direction of its load."
        return Passivity(True, float(nominal(self.Fv)), math.inf, condition)

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """A Stribeck friction that grows to one half in one second."""
        return (stribeck_case("Armstrong", cls.standard(tau=0.01, gamma=1.0), lambda x: 1.0 / (1.0 + x * x)),)
