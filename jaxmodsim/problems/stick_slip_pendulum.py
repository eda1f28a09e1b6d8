"""A pendulum with dry friction in its joint, which comes to rest within a range about the bottom."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..friction import Coulomb
from ..scene import Friction, Scene

# Mass [kg], length [m], gravity [m/s^2], and friction torques of the joint in slip and at break-away [N m].
PARAMS = {"m": 1.0, "l": 0.5, "g": 9.81, "Fc": 0.4, "Fs": 0.6}


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * (p["l"] * qd[0]) ** 2 + p["m"] * p["g"] * p["l"] * jnp.cos(q[0])


def scene(
    law: object = None, *, m: ArrayLike = PARAMS["m"], l: ArrayLike = PARAMS["l"], g: ArrayLike = PARAMS["g"]
) -> Scene:
    """Point mass on a massless rod, with friction in the joint.

    **Arguments:**

    - `law`: friction law of the joint, of torques [N m] and angular velocities [rad/s]; None for Coulomb friction with
      `PARAMS`.
    - `m`: mass [kg], > 0.
    - `l`: length [m], > 0.
    - `g`: gravity [m/s^2].

    **Returns:**

    A `Scene` with one coordinate, the angle from the bottom [rad], and the effect `friction`. `turn` has its turning
    points. It stays at rest if `m g l |sin q| <= Fs`.
    """
    law = Coulomb(Fc=PARAMS["Fc"], Fs=PARAMS["Fs"]) if law is None else law
    return Scene(_lagrangian, params={"m": m, "l": l, "g": g}, effects=(Friction(law),), coordinates=("angle [rad]",))


def turn(start: ArrayLike, *, m: ArrayLike, l: ArrayLike, g: ArrayLike, Fc: ArrayLike) -> Float[Array, ""]:
    """Angle [rad] of the next turning point, after a start at rest at `start`.

    The dissipated energy is the torque times the angle of the swing: `m g l (cos b - cos a) = Fc (a + b)` from
    `a = |start|` to b on the other side. With 2 s for this angle, `sin(a - s) sin(s)/s = Fc/(m g l)`. The left-hand
    side falls from sin a at s = 0 to 0 at s = a, so there is one root if sin a exceeds the right-hand side.

    **Arguments:**

    - `start`: angle at rest [rad], |start| <= pi/2, at which the pendulum does not stick.
    - `m`: mass [kg], > 0.
    - `l`: length [m], > 0.
    - `g`: gravity [m/s^2], > 0.
    - `Fc`: torque in slip [N m], >= 0, < m g l |sin(start)|.

    **Returns:**

    The signed angle, opposite to `start` if the pendulum passes the bottom. Differentiable.
    """
    start, share = jnp.asarray(start), jnp.asarray(Fc) / (jnp.asarray(m) * g * l)
    a = jnp.abs(start)

    def lack(s: Array, a: Array, ratio: Array) -> Array:
        return ratio - jnp.sin(a - s) * jnp.sinc(s / jnp.pi)

    def halve(_: object, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = 0.5 * (bracket[0] + bracket[1])
        below = lack(middle, fixed, ratio) < 0
        return jnp.where(below, middle, bracket[0]), jnp.where(below, bracket[1], middle)

    ratio, fixed = jax.lax.stop_gradient(share), jax.lax.stop_gradient(a)
    s, _ = jax.lax.fori_loop(0, 60, halve, (jnp.zeros_like(fixed), fixed))
    # One step of Newton carries the derivatives.
    s = s - lack(s, a, share) / jax.grad(lack)(s, fixed, ratio)
    return -jnp.sign(start) * (2.0 * s - a)
