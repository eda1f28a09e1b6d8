"""A rod that slides with its tip on a rough floor: Painleve's paradox."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxmodsim.friction import Coulomb
from jaxmodsim.mechanics import Contact, rigid_body
from jaxmodsim.scene import Friction, Scene

# Mass [kg], length [m], coefficient of friction and gravity [m/s^2].
PARAMS = {"m": 1.0, "l": 2.0, "mu": 0.5, "g": 9.81}


def _centre(q: Array) -> Array:
    return jnp.stack([q[0], 0.0 * q[0], q[1]])


def _tip(q: Array, p: dict[str, Array]) -> Array:
    half = 0.5 * p["l"]
    return jnp.stack([q[0] + half * jnp.cos(q[2]), 0.0 * q[0], q[1] - half * jnp.sin(q[2])])


def _tip_along(q: Array, p: dict[str, Array]) -> Array:
    return _tip(q, p)[0]


def _height(t: Array, x: Array, p: dict[str, Array]) -> Array:
    return x[2]


_ROD = rigid_body(lambda p: p["m"], lambda p: p["m"] * p["l"] ** 2 / 12.0, _centre, lambda q: q[2], lambda p: p["g"])


def scene(
    *, m: ArrayLike = PARAMS["m"], l: ArrayLike = PARAMS["l"], mu: ArrayLike = PARAMS["mu"], g: ArrayLike = PARAMS["g"]
) -> Scene:
    """Uniform rod in a vertical plane over a rough floor, which its lower tip strikes without a bounce.

    The coordinates are (x, y) of the centre [m], y upwards from the floor, and the angle f [rad] between floor and rod,
    0 < f < pi, such that the tip is at `(x + (l/2) cos(f), y - (l/2) sin(f))`: for f < pi/2 and slip towards larger x
    the rod is pushed, tip ahead. States with the tip on the floor: `state`.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `l`: length [m], > 0.
    - `mu`: coefficient of Coulomb friction between tip and floor, >= 0. Above 4/3 there are angles at which no
      motion, or more than one, obeys the law: see `compliance`.
    - `g`: gravity [m/s^2].

    **Returns:**

    A `Scene` with the contact `floor`, whose multiplier is the normal force [N], and the effect `friction` along x at
    the tip. In slip it follows `acceleration`. The tip lifts off and lands; a run ends where the paradox begins.
    """
    floor = Contact(_height, at=_tip, name="floor")
    friction = Friction(Coulomb(mu), along=_tip_along, normal_force="floor")
    return Scene(
        _ROD,
        params={"m": m, "l": l, "g": g},
        effects=(friction,),
        constraints=(floor,),
        coordinates=("x [m]", "y [m]", "angle [rad]"),
    )


def state(
    angle: ArrayLike, rate: ArrayLike, slip: ArrayLike, *, l: ArrayLike = PARAMS["l"]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Coordinates and velocities with the tip on the floor at x = 0.

    **Arguments:**

    - `angle`, `rate`: f [rad] and its rate [rad/s].
    - `slip`: velocity of the tip [m/s].
    - `l`: length [m], > 0.
    """
    angle, rate, half = jnp.asarray(angle, float), jnp.asarray(rate, float), 0.5 * jnp.asarray(l)
    x, y = half * jnp.cos(angle), half * jnp.sin(angle)
    return jnp.stack([-x, y, angle]), jnp.stack([slip + y * rate, x * rate, rate])


def compliance(
    angle: Float[Array, "..."], direction: ArrayLike = 1.0, *, m: ArrayLike, mu: ArrayLike
) -> Float[Array, "..."]:
    """Acceleration of the tip away from the floor for each newton of normal force [1/kg], in slip.

    `(1 + 3 cos(f)^2 - 3 mu s sin(f) cos(f))/m` for slip in the direction s. Friction pushes the tip into the floor
    where it is negative, which happens at some angle if mu > 4/3: there either nothing obeys the laws of motion and of
    friction, or several motions do (P. Painleve, Sur les lois du frottement de glissement, Comptes Rendus de l'Academie
    des Sciences 121:112, 1895).

    **Arguments:**

    - `angle`: f [rad].
    - `direction`: sign s of the slip.
    - `m`, `mu`: as for `scene`.
    """
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    return (1.0 + 3.0 * cosine**2 - 3.0 * jnp.asarray(mu) * direction * sine * cosine) / m


def normal_force(
    angle: Float[Array, ""],
    rate: Float[Array, ""],
    direction: ArrayLike = 1.0,
    *,
    m: ArrayLike = PARAMS["m"],
    l: ArrayLike = PARAMS["l"],
    mu: ArrayLike = PARAMS["mu"],
    g: ArrayLike = PARAMS["g"],
) -> Float[Array, ""]:
    """Normal force [N] on the slipping tip: `(g - (l/2) sin(f) f'^2)` over `compliance`.

    The tip lifts off where it falls through zero.

    **Arguments:**

    - `angle`, `rate`: f [rad] and its rate [rad/s].
    - `direction`: sign of the slip.
    - `m`, `l`, `mu`, `g`: as for `scene`.
    """
    fall = jnp.asarray(g) - 0.5 * jnp.asarray(l) * jnp.sin(angle) * rate**2
    return fall / compliance(angle, direction, m=m, mu=mu)


def acceleration(
    q: Float[Array, "3"],
    qd: Float[Array, "3"],
    *,
    m: ArrayLike = PARAMS["m"],
    l: ArrayLike = PARAMS["l"],
    mu: ArrayLike = PARAMS["mu"],
    g: ArrayLike = PARAMS["g"],
) -> Float[Array, "3"]:
    """Accelerations [m/s^2, rad/s^2] while the tip slips, in closed form.

    With the normal force N and the direction of slip s: `m x'' = -mu s N`, `m y'' = N - m g`, and about the centre
    `m l f''/6 = N (mu s sin(f) - cos(f))`. So the angle moves by itself, whatever the slip.

    **Arguments:**

    - `q`, `qd`: (x, y, f) and their rates, shape `[3]`, with the tip on the floor.
    - `m`, `l`, `mu`, `g`: as for `scene`.
    """
    sine, cosine = jnp.sin(q[2]), jnp.cos(q[2])
    m, l, mu, g = (jnp.asarray(x, q.dtype) for x in (m, l, mu, g))
    direction = jnp.sign(qd[0] - 0.5 * l * sine * qd[2])
    push = normal_force(q[2], qd[2], direction, m=m, l=l, mu=mu, g=g) / m
    turn = 6.0 / l * push * (mu * direction * sine - cosine)
    return jnp.stack([-mu * direction * push, push - g, turn])
