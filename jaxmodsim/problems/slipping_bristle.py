"""A LuGre bristle under constant slip velocity."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..friction import LuGre
from ..scene import Friction, Scene


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * qd[0] ** 2


def scene(law: LuGre, v: ArrayLike, *, m: ArrayLike = 1e15) -> Scene:
    """A mass at rest on a surface that moves at -v, so heavy that friction does not move it.

    **Arguments:**

    - `law`: the LuGre law.
    - `v`: slip velocity [m/s], any finite number.
    - `m`: mass [kg], > 0; the slip velocity is constant but for the force over this mass, times the time.

    **Returns:**

    A `Scene` with one coordinate [m] and the effect `friction`. Started with `q0=[0.0]`, `qd0=[0.0]`, the deflection
    `run.z["friction"]` follows `deflection`.
    """
    return Scene(
        _lagrangian, params={"m": m}, effects=(Friction(law, belt_velocity=-jnp.asarray(v)),), coordinates=("x [m]",)
    )


def deflection(t: Float[Array, "..."], law: LuGre, v: ArrayLike, *, z0: ArrayLike = 0.0) -> Float[Array, "..."]:
    """Deflection [m] of the bristle at the times `t` [s] under constant slip velocity, shape as `t`.

    `z = zss + (z0 - zss) exp(-sigma0 |v| t/g(v))` with `zss = g(v) sign(v)/sigma0` and
    `g(v) = Fc + (Fs - Fc) exp(-(v/vs)^2)`. An explicit Euler step is stable below `2 g/(sigma0 |v|)`.

    **Arguments:**

    - `t`: times [s] since the start.
    - `law`: the LuGre law.
    - `v`: slip velocity [m/s]; at v = 0 the deflection keeps its value.
    - `z0`: deflection at t = 0 [m].
    """
    v = jnp.asarray(v)
    level = law.Fc + (law.Fs - law.Fc) * jnp.exp(-((v / law.vs) ** 2))
    steady = level * jnp.sign(v) / law.sigma0
    return steady + (z0 - steady) * jnp.exp(-law.sigma0 * jnp.abs(v) * t / level)
