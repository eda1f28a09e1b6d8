"""A pole on a cart."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..mechanics import rigid_body
from ..scene import AbstractEffect, AppliedForce, Friction, Scene

# Masses of cart and pole [kg], length of the pole [m], gravity [m/s^2].
PARAMS = {"M": 1.0, "m": 0.3, "l": 1.2, "g": 9.81}


def _cart(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["M"] * qd[0] ** 2


def _middle(q: Array, p: dict[str, Array]) -> Array:
    half = 0.5 * p["l"]
    return jnp.stack([q[0] + half * jnp.sin(q[1]), 0.0 * q[0], half * jnp.cos(q[1])])


def _track(q: Array) -> Array:
    return q[0]


def _push(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.stack([p["force"], 0.0 * q[1]])


_POLE = rigid_body(lambda p: p["m"], lambda p: p["m"] * p["l"] ** 2 / 12.0, _middle, lambda q: q[1], lambda p: p["g"])
_LAGRANGIAN = _POLE + _cart


def scene(
    law: object = None,
    *,
    M: ArrayLike = PARAMS["M"],
    m: ArrayLike = PARAMS["m"],
    l: ArrayLike = PARAMS["l"],
    g: ArrayLike = PARAMS["g"],
    force: ArrayLike | None = None,
) -> Scene:
    """Uniform rod hinged to a cart on a level track, in a vertical plane.

    The coordinates are the position x of the cart [m] and the angle of the pole from upright [rad], positive towards
    larger x.

    **Arguments:**

    - `law`: friction law between cart and track, with forces in newtons; None for no friction.
    - `M`: mass of the cart [kg], > 0.
    - `m`: mass of the uniform pole [kg], > 0.
    - `l`: length of the pole [m], > 0.
    - `g`: gravity [m/s^2].
    - `force`: constant force on the cart along x [N]; None for no force.

    **Returns:**

    A `Scene`, with the effects `push` (with a force) and `friction` (with a law). `acceleration` has its exact
    accelerations.
    """
    params: dict[str, ArrayLike] = {"M": M, "m": m, "l": l, "g": g}
    effects: tuple[AbstractEffect, ...] = () if law is None else (Friction(law, along=_track),)
    if force is not None:
        params["force"] = force
        effects = (AppliedForce(_push, name="push"), *effects)
    return Scene(_LAGRANGIAN, params=params, effects=effects, coordinates=("x [m]", "angle [rad]"))


def acceleration(
    q: Float[Array, "2"],
    qd: Float[Array, "2"],
    *,
    M: ArrayLike = PARAMS["M"],
    m: ArrayLike = PARAMS["m"],
    l: ArrayLike = PARAMS["l"],
    g: ArrayLike = PARAMS["g"],
    force: ArrayLike = 0.0,
) -> Float[Array, "2"]:
    """Accelerations of cart and pole in closed form.

    With a = l/2 and the angle f, the balance of forces along the track and of moments about the hinge read
    `(M + m) x'' + m a cos(f) f'' = F + m a sin(f) f'^2` and `cos(f) x'' + (4/3) a f'' = g sin(f)`. Solved:
    `f'' = (g sin(f) - cos(f) T)/(a (4/3 - m cos(f)^2/(M + m)))`, `x'' = T - m a cos(f) f''/(M + m)` with
    `T = (F + m a sin(f) f'^2)/(M + m)` (A. G. Barto, R. S. Sutton and C. W. Anderson, Neuronlike adaptive elements that
    can solve difficult learning control problems, IEEE Transactions on Systems, Man, and Cybernetics 13:834, 1983, the
    appendix, without friction).

    **Arguments:**

    - `q`, `qd`: (x, f) [m, rad] and their rates, shape `[2]`.
    - `M`, `m`, `l`, `g`: as for `scene`.
    - `force`: sum F of all forces on the cart along x [N].

    **Returns:**

    (x'', f'') [m/s^2, rad/s^2], shape `[2]`.
    """
    sine, cosine, a = jnp.sin(q[1]), jnp.cos(q[1]), 0.5 * jnp.asarray(l)
    share = m / (jnp.asarray(M) + m)
    sideways = force / (jnp.asarray(M) + m) + share * a * sine * qd[1] ** 2
    turn = (g * sine - cosine * sideways) / (a * (4.0 / 3.0 - share * cosine**2))
    return jnp.stack([sideways - share * a * cosine * turn, turn])
