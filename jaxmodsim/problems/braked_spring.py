"""A mass on a spring with Coulomb friction, which stops after a whole number of half cycles."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..friction import Coulomb
from ..scene import AppliedForce, Friction, Scene

# Parameters with stiction. They give 12 half cycles, and rest from the time STOP [s] on.
PARAMS = {"m": 1.3, "k": 2.7, "Fc": 0.11, "Fs": 0.15, "x0": 1.0}
STOP = 26.158986444602


class Rest(NamedTuple):
    """The final rest: number of half cycles, time `t` [s] and position `x` [m]."""

    half_cycles: Float[Array, ""]
    t: Float[Array, ""]
    x: Float[Array, ""]


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


def coulomb() -> Coulomb:
    """The Coulomb law of `PARAMS`.

    **Returns:**

    A `Coulomb` law.
    """
    return Coulomb(Fc=PARAMS["Fc"], Fs=PARAMS["Fs"])


def scene(law: object = None, *, m: ArrayLike = PARAMS["m"], k: ArrayLike = PARAMS["k"]) -> Scene:
    """Mass on a spring on a rough table.

    **Arguments:**

    - `law`: friction law between mass and table, such as `Regularized(coulomb(), width=1e-4)`; None for no friction.
    - `m`: mass [kg], > 0.
    - `k`: stiffness of the spring [N/m], > 0, relaxed at q = 0.

    **Returns:**

    A `Scene` with one coordinate [m] and (with a law) the effect `friction`. Started at rest under exact Coulomb
    friction it follows `motion`.
    """
    friction = () if law is None else (Friction(law),)
    return Scene(_lagrangian, params={"m": m, "k": k}, effects=friction, coordinates=("x [m]",))


def _drive(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.reshape(p["u"], (1,))


def driven_spring(law: object, *, m: ArrayLike = 2.0, k: ArrayLike = 20.0) -> Scene:
    """Mass on a spring on a rough table under a given force, for synthetic records.

    **Arguments:**

    - `law`: friction law between mass and table.
    - `m`: mass [kg], > 0.
    - `k`: stiffness of the spring [N/m], > 0, relaxed at q = 0.

    **Returns:**

    A `Scene` with one coordinate [m] and the effects `drive`, the force `u` [N], and `friction`. The parameter `u` is
    0; a `Signal` or the input of a `Record` replaces it.
    """
    effects = (AppliedForce(_drive, name="drive"), Friction(law))
    return Scene(_lagrangian, params={"m": m, "k": k, "u": 0.0}, effects=effects, coordinates=("x [m]",))


def rest(*, x0: ArrayLike, m: ArrayLike, k: ArrayLike, Fc: ArrayLike, Fs: ArrayLike | None = None) -> Rest:
    """Position and time of the final rest, after a start at rest at x0.

    With `d = Fc/k`, the mass stops after `N = ceil((x0 - Fs/k)/(2 d))` half cycles, at `t = N pi sqrt(m/k)` and
    `x = (-1)^N (x0 - 2 N d)`. So `dx/dFc = -(-1)^N 2 N/k` and `dx/dx0 = (-1)^N`.

    **Arguments:**

    - `x0`: initial deflection [m], > 0.
    - `m`: mass [kg], > 0.
    - `k`: stiffness [N/m], > 0.
    - `Fc`: friction force in slip [N], > 0.
    - `Fs`: break-away force [N], >= Fc; by default Fc.

    **Returns:**

    A `Rest`.
    """
    d = Fc / jnp.asarray(k)
    half_cycles = jnp.maximum(jnp.ceil((x0 - (Fc if Fs is None else Fs) / k) / (2.0 * d)), 0.0)
    sign = 1.0 - 2.0 * (half_cycles % 2.0)
    return Rest(half_cycles, half_cycles * jnp.pi * jnp.sqrt(m / jnp.asarray(k)), sign * (x0 - 2.0 * half_cycles * d))


def motion(
    t: Float[Array, "..."], *, x0: ArrayLike, m: ArrayLike, k: ArrayLike, Fc: ArrayLike, Fs: ArrayLike | None = None
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Position [m] and velocity [m/s] at the times `t` [s], after a start at rest at x0; shape as `t`.

    In half cycle n, with `d = Fc/k` and `w = sqrt(k/m)`: `x = (-1)^n [d + (x0 - (2 n + 1) d) cos(w t - n pi)]`. The
    mass is at rest after the last half cycle. Arguments as for `rest`, t >= 0.

    **Returns:**

    Position and velocity, of the shape of `t` each.
    """
    end = rest(x0=x0, m=m, k=k, Fc=Fc, Fs=Fs)
    d, w = Fc / jnp.asarray(k), jnp.sqrt(k / jnp.asarray(m))
    n = jnp.floor(w * t / jnp.pi)
    sign = 1.0 - 2.0 * (n % 2.0)
    swing = x0 - (2.0 * n + 1.0) * d
    x = sign * (d + swing * jnp.cos(w * t - n * jnp.pi))
    v = -sign * swing * w * jnp.sin(w * t - n * jnp.pi)
    moving = n < end.half_cycles
    return jnp.where(moving, x, end.x), jnp.where(moving, v, 0.0)
