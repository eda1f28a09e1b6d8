"""A pendulum with dry friction in its joint: it comes to rest anywhere in a range about the bottom."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..friction import Coulomb
from ..scene import Friction, Scene

# Mass [kg], length [m], gravity [m/s^2] and the torques of the joint [N m] in slip and at most in stick.
PARAMS = {"m": 1.0, "l": 0.5, "g": 9.81, "Fc": 0.4, "Fs": 0.6}


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * (p["l"] * qd[0]) ** 2 + p["m"] * p["g"] * p["l"] * jnp.cos(q[0])


def scene(
    law: object = None, *, m: ArrayLike = PARAMS["m"], l: ArrayLike = PARAMS["l"], g: ArrayLike = PARAMS["g"]
) -> Scene:
    """Point mass on a massless rod, with friction in the joint.

    **Arguments:**

    - `law`: friction law of the joint, its forces torques [N m] and its velocities [rad/s]; None for Coulomb friction
      by `PARAMS`.
    - `m`: mass [kg], > 0.
    - `l`: length [m], > 0.
    - `g`: gravity [m/s^2].

    **Returns:**

    A `Scene` with one coordinate, the angle from the bottom [rad], and the effect `friction`. Its turning points:
    `turn`; it stays at rest where `m g l |sin q| <= Fs`.
    """
    numbers = PARAMS
    law = Coulomb(Fc=numbers["Fc"], Fs=numbers["Fs"]) if law is None else law
    return Scene(_lagrangian, params={"m": m, "l": l, "g": g}, effects=(Friction(law),), coordinates=("angle [rad]",))


def turn(start: ArrayLike, *, m: ArrayLike, l: ArrayLike, g: ArrayLike, Fc: ArrayLike) -> Float[Array, ""]:
    """Angle [rad] at which the pendulum turns next, let go at rest at `start`.

    The energy lost is the torque times the angle swept: `m g l (cos b - cos a) = Fc (a + b)` from `a = |start|` to b
    on the other side. With the angle swept 2 s, that is `sin(a - s) sin(s)/s = Fc/(m g l)`, whose left-hand side falls
    from sin a at s = 0 to 0 at s = a, so that there is one root if sin a is larger than the right-hand side.

    **Arguments:**

    - `start`: angle at rest [rad], |start| <= pi/2, where the pendulum does not stick.
    - `m`: mass [kg], > 0.
    - `l`: length [m], > 0.
    - `g`: gravity [m/s^2], > 0.
    - `Fc`: torque in slip [N m], >= 0, < m g l |sin(start)|.

    **Returns:**

    The angle with its sign: opposite to that of `start` if the pendulum passes the bottom. Differentiable.
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
    # One step of Newton, which also carries the derivatives.
    s = s - lack(s, a, share) / jax.grad(lack)(s, fixed, ratio)
    return -jnp.sign(start) * (2.0 * s - a)
