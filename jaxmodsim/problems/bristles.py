"""LuGre bristles: a box pulled through a spring, and a bristle under constant slip velocity, with a closed form."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..friction import LuGre
from ..scene import Friction, Scene

# Mass [kg], stiffness of the spring [N/m] and velocity of its end [m/s] of the pulled box, and its law: C. Canudas de
# Wit, H. Olsson, K. J. Astrom and P. Lischinsky, A new model for control of systems with friction, IEEE Transactions on
# Automatic Control 40:419, 1995, table 1 and section III.
PARAMS = {"m": 1.0, "k": 2.0, "pull": 0.1}
LUGRE = {"sigma0": 1e5, "sigma1": 1e5**0.5, "sigma2": 0.4, "Fc": 1.0, "Fs": 1.5, "vs": 1e-3}


def _pulled(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * (p["pull"] * t - q[0]) ** 2


def _free(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * qd[0] ** 2


def pulled_box(
    law: object = None, *, m: ArrayLike = PARAMS["m"], k: ArrayLike = PARAMS["k"], pull: ArrayLike = PARAMS["pull"]
) -> Scene:
    """Box on a table, pulled through a spring whose end moves at constant velocity: stick-slip.

    **Arguments:**

    - `law`: friction law between box and table; None for LuGre with the parameters `LUGRE`.
    - `m`: mass [kg], > 0.
    - `k`: stiffness of the spring [N/m], > 0.
    - `pull`: velocity of the end of the spring [m/s].

    **Returns:**

    A `Scene` with one coordinate [m] and the effect `friction`. The spring is relaxed at t = 0 and q = 0. The problem
    is stiff: the bristles settle within 1e-5 s in slip, and the box sticks for seconds.
    """
    law = LuGre(**LUGRE) if law is None else law
    return Scene(_pulled, params={"m": m, "k": k, "pull": pull}, effects=(Friction(law),), coordinates=("x [m]",))


def slipping_bristle(law: LuGre, v: ArrayLike, *, m: ArrayLike = 1e15) -> Scene:
    """A mass at rest on a surface that moves at -v. The mass is so large that friction does not move it.

    **Arguments:**

    - `law`: the LuGre law.
    - `v`: slip velocity [m/s], any finite number.
    - `m`: mass [kg], > 0. The slip velocity changes by the impulse of friction over this mass.

    **Returns:**

    A `Scene` with one coordinate [m] and the effect `friction`. Started with `q0=[0.0]`, `qd0=[0.0]`, the deflection
    `run.z["friction"]` follows `deflection`.
    """
    return Scene(
        _free, params={"m": m}, effects=(Friction(law, belt_velocity=-jnp.asarray(v)),), coordinates=("x [m]",)
    )


def deflection(t: Float[Array, "..."], law: LuGre, v: ArrayLike, *, z0: ArrayLike = 0.0) -> Float[Array, "..."]:
    """Deflection [m] of `slipping_bristle` at the times `t` [s] under constant slip velocity, shape as `t`.

    `z = zss + (z0 - zss) exp(-sigma0 |v| t/g(v))` with `zss = g(v) sign(v)/sigma0` and
    `g(v) = Fc + (Fs - Fc) exp(-(v/vs)^2)`. An explicit Euler step is stable below `2 g/(sigma0 |v|)`.

    **Arguments:**

    - `t`: times [s] since the start.
    - `law`: the LuGre law.
    - `v`: slip velocity [m/s]; at v = 0 the deflection is constant.
    - `z0`: deflection at t = 0 [m].

    **Returns:**

    The deflection.
    """
    v = jnp.asarray(v)
    stribeck_curve = law.Fc + (law.Fs - law.Fc) * jnp.exp(-((v / law.vs) ** 2))
    steady = stribeck_curve * jnp.sign(v) / law.sigma0
    return steady + (z0 - steady) * jnp.exp(-law.sigma0 * jnp.abs(v) * t / stribeck_curve)
