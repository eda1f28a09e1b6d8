"""A four-bar linkage: three moving links in a loop that is closed by constraints."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..mechanics import Constraint, rigid_body
from ..scene import Scene

# Lengths [m] of crank, coupler, rocker and ground, masses [kg] of crank, coupler and rocker, gravity [m/s^2]. By
# Grashof's rule the crank turns fully, because the shortest and longest links together are shorter than the others.
PARAMS = {"a": 0.2, "b": 0.5, "c": 0.45, "d": 0.6, "m1": 0.4, "m2": 1.0, "m3": 0.9, "g": 9.81}


def _along(length: Array, angle: Array) -> Array:
    return length * jnp.stack([jnp.cos(angle), 0.0 * angle, jnp.sin(angle)])


def _crank_middle(q: Array, p: dict[str, Array]) -> Array:
    return _along(0.5 * p["a"], q[0])


def _coupler_middle(q: Array, p: dict[str, Array]) -> Array:
    return _along(p["a"], q[0]) + _along(0.5 * p["b"], q[1])


def _rocker_middle(q: Array, p: dict[str, Array]) -> Array:
    return _along(p["d"], 0.0 * q[2]) + _along(0.5 * p["c"], q[2])


def _ends(q: Array, p: dict[str, Array]) -> Array:
    return jnp.stack([_along(p["a"], q[0]) + _along(p["b"], q[1]), _along(p["d"], 0.0 * q[2]) + _along(p["c"], q[2])])


def _gap(t: Array, ends: Array, p: dict[str, Array]) -> Array:
    gap = ends[1] - ends[0]
    return jnp.stack([gap[0], gap[2]])


_CRANK = rigid_body(
    lambda p: p["m1"], lambda p: p["m1"] * p["a"] ** 2 / 12.0, _crank_middle, lambda q: q[0], lambda p: p["g"]
)
_COUPLER = rigid_body(
    lambda p: p["m2"], lambda p: p["m2"] * p["b"] ** 2 / 12.0, _coupler_middle, lambda q: q[1], lambda p: p["g"]
)
_ROCKER = rigid_body(
    lambda p: p["m3"], lambda p: p["m3"] * p["c"] ** 2 / 12.0, _rocker_middle, lambda q: q[2], lambda p: p["g"]
)
_LAGRANGIAN = _CRANK + _COUPLER + _ROCKER


def scene(
    *,
    a: ArrayLike = PARAMS["a"],
    b: ArrayLike = PARAMS["b"],
    c: ArrayLike = PARAMS["c"],
    d: ArrayLike = PARAMS["d"],
    m1: ArrayLike = PARAMS["m1"],
    m2: ArrayLike = PARAMS["m2"],
    m3: ArrayLike = PARAMS["m3"],
    g: ArrayLike = PARAMS["g"],
) -> Scene:
    """Crank about the origin, rocker about (d, 0), and a coupler between their ends, in a vertical plane, y upwards.

    The coordinates are the angles of crank, coupler and rocker [rad], counterclockwise from the x axis. Crank and
    rocker point away from the ground, the coupler points from crank to rocker. The links are uniform. `state` has
    admissible states.

    **Arguments:**

    - `a`, `b`, `c`, `d`: lengths of crank, coupler, rocker and ground [m], > 0.
    - `m1`, `m2`, `m3`: masses of crank, coupler and rocker [kg], > 0.
    - `g`: gravity [m/s^2].

    **Returns:**

    A `Scene` without effects. Its constraint `closure` has two equations, by which the ends of coupler and rocker meet;
    the multipliers are the force [N] of the coupler on the rocker, (x, y). `acceleration` has the exact accelerations.
    """
    params = {"a": a, "b": b, "c": c, "d": d, "m1": m1, "m2": m2, "m3": m3, "g": g}
    return Scene(
        _LAGRANGIAN,
        params=params,
        constraints=(Constraint(_gap, at=_ends, name="closure"),),
        coordinates=("crank [rad]", "coupler [rad]", "rocker [rad]"),
    )


def state(
    angle: ArrayLike,
    rate: ArrayLike,
    *,
    a: ArrayLike = PARAMS["a"],
    b: ArrayLike = PARAMS["b"],
    c: ArrayLike = PARAMS["c"],
    d: ArrayLike = PARAMS["d"],
    crossed: bool = False,
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Coordinates and velocities of `scene` at an angle of the crank [rad] and its rate [rad/s].

    The joint of coupler and rocker is an intersection of the circles of radius b about the end of the crank and of
    radius c about (d, 0). With the distance s of the centres, it is at `(s^2 + b^2 - c^2)/(2 s)` from the first centre
    along the line between them, and to the left of the line (to the right if `crossed`). The velocity of the joint
    gives the rates `coupler' = a sin(rocker - crank)/(b sin(coupler - rocker)) crank'` and
    `rocker' = a sin(coupler - crank)/(c sin(coupler - rocker)) crank'`.

    **Arguments:**

    - `angle`, `rate`: of the crank [rad], [rad/s].
    - `a`, `b`, `c`, `d`: as for `scene`. The result is NaN if the loop cannot close.
    - `crossed`: whether coupler and ground cross.

    **Returns:**

    `(q0, qd0)` for `simulate`: the angles of crank, coupler and rocker [rad] and their rates [rad/s], shape `[3]`.
    """
    angle, rate = jnp.asarray(angle, float), jnp.asarray(rate, float)
    a, b, c, d = (jnp.asarray(x, float) for x in (a, b, c, d))
    x, y = a * jnp.cos(angle), a * jnp.sin(angle)
    s = jnp.sqrt((d - x) ** 2 + y**2)
    ahead = (s**2 + b**2 - c**2) / (2.0 * s)
    aside = jnp.sqrt(b**2 - ahead**2) * (-1.0 if crossed else 1.0)
    along = jnp.stack([d - x, -y]) / s
    joint_x, joint_y = ahead * along[0] - aside * along[1], ahead * along[1] + aside * along[0]
    coupler = jnp.arctan2(joint_y, joint_x)
    rocker = jnp.arctan2(y + joint_y, x + joint_x - d)
    sine = jnp.sin(coupler - rocker)
    rates = [jnp.ones_like(angle), a * jnp.sin(rocker - angle) / (b * sine), a * jnp.sin(coupler - angle) / (c * sine)]
    return jnp.stack([angle, coupler, rocker]), rate * jnp.stack(rates)


def acceleration(
    angle: Float[Array, ""],
    rate: Float[Array, ""],
    *,
    a: ArrayLike = PARAMS["a"],
    b: ArrayLike = PARAMS["b"],
    c: ArrayLike = PARAMS["c"],
    d: ArrayLike = PARAMS["d"],
    m1: ArrayLike = PARAMS["m1"],
    m2: ArrayLike = PARAMS["m2"],
    m3: ArrayLike = PARAMS["m3"],
    g: ArrayLike = PARAMS["g"],
    crossed: bool = False,
) -> Float[Array, "3"]:
    """Accelerations of all three angles [rad/s^2], from the equation of motion of the crank angle f.

    `J f'' + (dJ/df)/2 f'^2 + dV/df = 0`, with the rates k = d(angles)/df of `state`, the reduced inertia
    `J = m1 a^2/3 + m2 (a^2 + b^2 k2^2/3 + a b k2 cos(coupler - f)) + m3 c^2 k3^2/3` and
    `V = g (m1 a sin(f)/2 + m2 (a sin(f) + b sin(coupler)/2) + m3 c sin(rocker)/2)`; coupler and rocker have
    `k f'' + (dk/df) f'^2`. Arguments as for `scene` and `state`.

    **Returns:**

    The accelerations of crank, coupler and rocker, shape `[3]`.
    """
    a, b, c, d, m1, m2, m3, g = (jnp.asarray(x, angle.dtype) for x in (a, b, c, d, m1, m2, m3, g))

    def follow(f: Array) -> tuple[Array, Array]:
        return state(f, 1.0, a=a, b=b, c=c, d=d, crossed=crossed)

    def inertia(f: Array) -> Array:
        q, k = follow(f)
        middle = a**2 + b**2 * k[1] ** 2 / 3.0 + a * b * k[1] * jnp.cos(q[1] - f)
        return m1 * a**2 / 3.0 + m2 * middle + m3 * (c * k[2]) ** 2 / 3.0

    def potential(f: Array) -> Array:
        q, _ = follow(f)
        crank, coupler, rocker = a * jnp.sin(f), b * jnp.sin(q[1]), c * jnp.sin(q[2])
        return g * (0.5 * m1 * crank + m2 * (crank + 0.5 * coupler) + 0.5 * m3 * rocker)

    J, slope = jax.value_and_grad(inertia)(angle)
    (_, k), (_, bend) = jax.jvp(follow, (angle,), (jnp.ones_like(angle),))
    return k * (-jax.grad(potential)(angle) - 0.5 * slope * rate**2) / J + bend * rate**2
