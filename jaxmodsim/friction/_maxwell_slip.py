"""The generalised Maxwell-slip law."""

import math
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arrays import Scalar
from .._core.functions import nominal
from .._core.parameters import (
    Number,
    Vector,
    optional_parameter,
    optional_vector_parameter,
    parameter,
    vector_parameter,
)
from ._bristles import advance_elastoplastic, slip_fraction, stribeck_curve
from ._law import STANDARD, AbstractDynamicLaw, LawCase, Passivity, register_law, steady_curve, stribeck_case


@register_law
class MaxwellSlip(AbstractDynamicLaw):
    """Elastic elements in parallel that yield at different forces: hysteresis with non-local memory.

    Element i is a spring of stiffness `k_i` that slips at the force `s_i(v) = Fc_i + (Fs_i - Fc_i) exp(-(v/vs)^2)`, and
    sticks again when the velocity reverses; `F = sum_i k_i z_i + sigma2 v`. Nested hysteresis loops close, as in the
    Leuven model. With one element and a small `corner` it is a spring in series with Coulomb friction.

    A sudden transition from stick to slip would make the rates jump, and chatter if the limit depends on velocity. So
    an element follows the surface up to `1 - corner` of its limit and yields gradually above:
    `z' = v (1 - max(0, u - 1 + corner)/corner)` with `u = k z sign(v)/s_i(v)`. With `C` an element beyond its limit
    (after an increase of speed) returns by `F_i' = sign(v) C alpha_i (1 - |F_i|/s_i(v))`, a lag in time, where
    `alpha_i = Fc_i/sum Fc`. This is the generalised model if all elements have the same Fs/Fc.

    **Arguments:**

    - `k`: stiffness of each element [N/m], > 0, shape `[n]`.
    - `Fc`: Coulomb force of each element [N], > 0, shape `[n]`.
    - `Fs`: stiction force of each element [N], >= Fc, shape `[n]`; by default Fc.
    - `vs`: Stribeck velocity [m/s], > 0; required with Fs.
    - `C`: attraction to the limit from beyond [N/s], > 0; by default the return follows from `corner`.
    - `sigma2`: viscous coefficient [N s/m], >= 0.
    - `corner`: fraction of its limit over which an element yields, > 0 and <= 1.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number, or if lengths differ.

    **Example:**

    ```python
    law = jms.MaxwellSlip(k=[1e5, 5e4], Fc=[0.4, 0.6])
    z = law.step_exact(jnp.array(1e-3), jnp.zeros(2), jnp.array(8e-3))  # slip by 8 um: one element yields
    print((law.k * z).round(3), "N")
    ```

    ```text
    [0.4 0.4] N
    ```

    ??? cite "Reference"

        ```bibtex
        @article{albender2005generalized,
            author={Al-Bender, Farid and Lampaert, Vincent and Swevers, Jan},
            title={The generalized Maxwell-slip model: a novel model for friction simulation and compensation},
            journal={IEEE Transactions on Automatic Control},
            volume={50}, number={11}, pages={1883--1887}, year={2005},
        }
        ```
    """

    k: Vector = vector_parameter("k", "N/m", lower=0.0, strict=True)
    Fc: Vector = vector_parameter("Fc", "N", lower=0.0, strict=True)
    Fs: Vector | None = optional_vector_parameter("Fs", "N", lower="Fc")
    vs: Number | None = optional_parameter("vs", "m/s", lower=0.0, strict=True)
    C: Number | None = optional_parameter("C", "N/s", lower=0.0, strict=True)
    sigma2: Number = parameter("sigma2", "N s/m", lower=0.0, default=0.0)
    corner: Number = parameter("corner", "1", lower=0.0, strict=True, upper=1.0, execution=True, default=0.02)
    stiff: ClassVar[bool] = True
    description: ClassVar[str] = "elements in parallel: non-local memory"
    equations: ClassVar[tuple[str, ...]] = (
        "sum(k z) + sigma2 v",
        "z' = v (1 - max(0, u - 1 + corner)/corner)",
        "u = k z sign(v)/s(v)",
        "s(v) = Fc + (Fs - Fc) exp(-(v/vs)^2)",
    )
    mujoco_lacks: ClassVar[str] = (
        ": its bristle yields at any force, not at a limit. Fit a Dahl or LuGre and export that"
    )

    def __check_init__(self) -> None:
        """Refuse incomplete elements."""
        for name in ("Fc", "Fs"):
            force = getattr(self, name)
            if force is not None and jnp.shape(force) != jnp.shape(self.k):
                raise ValueError(
                    f"MaxwellSlip: {name} must have one number for each of the {jnp.shape(self.k)[0]} elements of k,"
                    f" but it has the shape {jnp.shape(force)}."
                )
        if (self.Fs is None) != (self.vs is None):
            raise ValueError("MaxwellSlip: the Stribeck effect needs both Fs and vs; give both or none.")

    def limit(self, v: Scalar) -> Float[Array, " n"]:
        """Force [N] at which each element slips at velocity `v` [m/s]."""
        if self.Fs is None or self.vs is None:
            return self.Fc
        return stribeck_curve(v, self.Fc, self.Fs, self.vs)

    def _attraction(self, limit: Float[Array, " n"]) -> Float[Array, " n"]:
        """Rate [1/s] at which an element beyond its limit returns to it."""
        return self.C * self.Fc / jnp.sum(self.Fc) / limit

    def initial_state(self, v: Float[Array, "..."]) -> Float[Array, " n"]:
        """Undeflected elements, 0 m."""
        return jnp.zeros(jnp.shape(nominal(self.k)), v.dtype)

    def zdot(self, v: Scalar, z: Float[Array, " n"]) -> Float[Array, " n"]:
        """Rates of the deflections [m/s] at slip velocity `v` [m/s] and deflections `z` [m]."""
        limit, side = self.limit(v), jnp.sign(v)
        u = self.k * z * side / limit
        if self.C is None:
            return v * (1.0 - slip_fraction(u, self.corner))
        rate = v * (1.0 - slip_fraction(jnp.minimum(u, 1.0), self.corner))
        return rate - side * self._attraction(limit) * limit / self.k * jnp.maximum(u - 1.0, 0.0)

    def force_given_zdot(self, v: Scalar, z: Float[Array, " n"], rate: Float[Array, " n"]) -> Scalar:
        """Friction force [N] at slip velocity `v` [m/s] and deflections `z` [m]."""
        return jnp.sum(self.k * z) + self.sigma2 * v

    def stored_energy(self, z: Float[Array, " n"]) -> Scalar:
        """Elastic energy [J] of the elements."""
        return 0.5 * jnp.sum(self.k * z * z)

    def step_exact(self, v: Scalar, z: Float[Array, " n"], dt: Scalar) -> Float[Array, " n"]:
        """Exact deflections [m] after `dt` [s] at constant `v` [m/s]."""
        limit = self.limit(v)
        after = advance_elastoplastic(v, z, dt, limit / self.k, self.corner)
        if self.C is None:
            return after
        side = jnp.sign(v)
        u = self.k * z * side / limit
        falling = side * limit / self.k * (1.0 + (u - 1.0) * jnp.exp(-self._attraction(limit) * dt))
        return jnp.where(u > 1.0, falling, after)

    def passivity(self) -> Passivity:
        """Always passive: an element slips only in the direction of its load, so `k z (v - z') >= 0`."""
        condition = "MaxwellSlip is always passive: an element slips only in the direction of its load."
        return Passivity(True, float(nominal(self.sigma2)), math.inf, condition)

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """One element; four elements; four elements with lag."""
        # Fractions of the total stiffness and force. The first element yields at 1/16 of the last one's deflection.
        stiffness, force = np.array([0.4, 0.3, 0.2, 0.1]), np.array([0.1, 0.2, 0.3, 0.4])
        sigma0, Fc, Fs, Fv = (STANDARD[name] for name in ("sigma0", "Fc", "Fs", "Fv"))
        four = {"k": sigma0 * stiffness, "Fc": Fc * force, "sigma2": Fv}
        flat = steady_curve(Fc, Fc, Fv)
        return (
            LawCase("MaxwellSlip, 1", cls(k=[sigma0], Fc=[Fc], sigma2=Fv), flat),
            LawCase("MaxwellSlip, 4", cls(**four), flat),
            stribeck_case("MaxwellSlip, 4, C", cls(**four, Fs=Fs * force, vs=STANDARD["vs"], C=50.0)),
        )
