"""A slider-crank with constraints, and friction in proportion to the force of the guide on the slider."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..friction import Coulomb
from ..mechanics import Constraint, rigid_body
from ..scene import AbstractEffect, AppliedForce, Friction, Scene

# Masses of crank, rod and slider [kg], lengths of crank and rod [m], gravity [m/s^2].
PARAMS = {"m1": 0.6, "m2": 0.9, "m3": 1.4, "r": 0.3, "l": 0.8, "g": 9.81}


class SliderCrankForces(NamedTuple):
    """Accelerations and joint forces of the slider-crank.

    - `qdd`: accelerations of (crank, rod, x, y) [rad/s^2, m/s^2], shape `[4]`.
    - `bearing`: force of the ground on the crank [N], (x, y), shape `[2]`.
    - `crank_pin`: force of the crank on the rod [N], shape `[2]`.
    - `slider_pin`: force of the rod on the slider [N], shape `[2]`.
    - `guide`: force of the guide on the slider [N], positive upwards.
    """

    qdd: Float[Array, "4"]
    bearing: Float[Array, "2"]
    crank_pin: Float[Array, "2"]
    slider_pin: Float[Array, "2"]
    guide: Float[Array, ""]


def _in_plane(x: Array, y: Array) -> Array:
    return jnp.stack([x, 0.0 * x, y])


def _crank_middle(q: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["r"] * _in_plane(jnp.cos(q[0]), jnp.sin(q[0]))


def _rod_middle(q: Array, p: dict[str, Array]) -> Array:
    return 2.0 * _crank_middle(q, p) + 0.5 * p["l"] * _in_plane(jnp.cos(q[1]), jnp.sin(q[1]))


def _slider(q: Array) -> Array:
    return _in_plane(q[2], q[3])


def _track(q: Array) -> Array:
    return q[2]


def _ends(q: Array, p: dict[str, Array]) -> Array:
    rod_end = 2.0 * _crank_middle(q, p) + p["l"] * _in_plane(jnp.cos(q[1]), jnp.sin(q[1]))
    return jnp.stack([rod_end, _slider(q)])


def _gap(t: Array, ends: Array, p: dict[str, Array]) -> Array:
    gap = ends[1] - ends[0]
    return jnp.stack([gap[0], gap[2]])


def _height(t: Array, x: Array, p: dict[str, Array]) -> Array:
    return x[2]


def _drive(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.zeros_like(q).at[0].set(p["torque"])


def _slide(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m3"] * (qd[2] ** 2 + qd[3] ** 2) - p["m3"] * p["g"] * q[3]


_CRANK = rigid_body(
    lambda p: p["m1"], lambda p: p["m1"] * p["r"] ** 2 / 12.0, _crank_middle, lambda q: q[0], lambda p: p["g"]
)
_ROD = rigid_body(
    lambda p: p["m2"], lambda p: p["m2"] * p["l"] ** 2 / 12.0, _rod_middle, lambda q: q[1], lambda p: p["g"]
)
_LAGRANGIAN = _CRANK + _ROD + _slide


def scene(
    *,
    m1: ArrayLike = PARAMS["m1"],
    m2: ArrayLike = PARAMS["m2"],
    m3: ArrayLike = PARAMS["m3"],
    r: ArrayLike = PARAMS["r"],
    l: ArrayLike = PARAMS["l"],
    g: ArrayLike = PARAMS["g"],
    torque: ArrayLike | None = None,
    mu: ArrayLike | None = None,
) -> Scene:
    """Crank about the origin, rod from its end, and slider at the end of the rod, in a vertical plane, y upwards.

    The coordinates are the angles of crank and rod [rad], counterclockwise from the x axis and towards the slider, and
    the position (x, y) of the slider [m]. Crank and rod are uniform. `state` has admissible states.

    **Arguments:**

    - `m1`, `m2`, `m3`: masses of crank, rod and slider [kg], > 0.
    - `r`, `l`: lengths of crank and rod [m], 0 < r < l for full turns.
    - `g`: gravity [m/s^2].
    - `torque`: constant torque on the crank [N m]; None for no torque.
    - `mu`: coefficient of Coulomb friction between slider and guide, >= 0; None for no friction. The guide holds the
      slider from both sides.

    **Returns:**

    A `Scene` with the constraints `pin`, two equations, whose force [N] on (rod, slider) has the shape `[2, 3]`, and
    `guide`, y = 0, whose multiplier is the force of the guide on the slider [N]. With a torque it has the effect
    `drive`, with friction the effect `friction`. `acceleration` and `forces` have its exact motion.
    """
    params: dict[str, ArrayLike] = {"m1": m1, "m2": m2, "m3": m3, "r": r, "l": l, "g": g}
    effects: tuple[AbstractEffect, ...] = ()
    if torque is not None:
        params["torque"] = torque
        effects = (AppliedForce(_drive, name="drive"),)
    if mu is not None:
        effects = (*effects, Friction(Coulomb(mu), along=_track, normal_force="guide"))
    pin, guide = Constraint(_gap, at=_ends, name="pin"), Constraint(_height, at=_slider, name="guide")
    return Scene(
        _LAGRANGIAN,
        params=params,
        effects=effects,
        constraints=(pin, guide),
        coordinates=("crank [rad]", "rod [rad]", "x [m]", "y [m]"),
    )


def state(
    angle: ArrayLike, rate: ArrayLike, *, r: ArrayLike = PARAMS["r"], l: ArrayLike = PARAMS["l"]
) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Coordinates and velocities of `scene` at an angle of the crank [rad] and its rate [rad/s].

    The slider is on the side of larger x: `sin(rod) = -(r/l) sin(crank)` with cos(rod) > 0.

    **Returns:**

    `(q0, qd0)` for `simulate`, shape `[4]` each.
    """
    angle, rate, ratio = jnp.asarray(angle, float), jnp.asarray(rate, float), jnp.asarray(r) / l
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    opened = jnp.sqrt(1.0 - (ratio * sine) ** 2)
    turn = -ratio * cosine / opened
    zero = jnp.zeros_like(angle)
    q = jnp.stack([angle, -jnp.arcsin(ratio * sine), r * cosine + l * opened, zero])
    return q, rate * jnp.stack([jnp.ones_like(angle), turn, r * sine * (turn - 1.0), zero])


def acceleration(
    angle: Float[Array, ""],
    rate: Float[Array, ""],
    *,
    m1: ArrayLike = PARAMS["m1"],
    m2: ArrayLike = PARAMS["m2"],
    m3: ArrayLike = PARAMS["m3"],
    r: ArrayLike = PARAMS["r"],
    l: ArrayLike = PARAMS["l"],
    g: ArrayLike = PARAMS["g"],
    torque: ArrayLike = 0.0,
    force: ArrayLike = 0.0,
) -> Float[Array, ""]:
    """Angular acceleration of the crank [rad/s^2], from the equation of motion of the crank angle.

    With f the angle of the crank, b that of the rod, c = r/l and C = cos(b) = sqrt(1 - c^2 sin(f)^2), the loop gives
    `b' = db/df = -c cos(f)/C`, `b'' = c sin(f) (1 - b'^2)/C`, the slider `x' = r sin(f) (b' - 1)`, and the middle of
    the rod `xm' = r sin(f) (b'/2 - 1)`, `ym' = r cos(f)/2`. The reduced inertia is
    `J = m1 r^2/3 + m2 (xm'^2 + ym'^2 + l^2 b'^2/12) + m3 x'^2`, and the motion
    `J f'' + (dJ/df)/2 f'^2 = torque - (m1 + m2) g r cos(f)/2 + force x'`.

    **Arguments:**

    - `angle`, `rate`: of the crank [rad], [rad/s].
    - `force`: force on the slider along x [N], such as friction.
    - All others: as for `scene`.

    **Returns:**

    The angular acceleration, shape `[]`.
    """
    numbers = (m1, m2, m3, r, l, g, torque, force)
    m1, m2, m3, r, l, g, torque, force = (jnp.asarray(x, angle.dtype) for x in numbers)
    sine, cosine, c = jnp.sin(angle), jnp.cos(angle), r / l
    opened = jnp.sqrt(1.0 - (c * sine) ** 2)
    b1 = -c * cosine / opened
    b2 = c * sine * (1.0 - b1**2) / opened
    x1, x2 = r * sine * (b1 - 1.0), r * (cosine * (b1 - 1.0) + sine * b2)
    xm1, xm2 = r * sine * (0.5 * b1 - 1.0), r * (cosine * (0.5 * b1 - 1.0) + 0.5 * sine * b2)
    ym1, ym2 = 0.5 * r * cosine, -0.5 * r * sine
    spin = l**2 / 12.0
    inertia = m1 * r**2 / 3.0 + m2 * (xm1**2 + ym1**2 + spin * b1**2) + m3 * x1**2
    slope = 2.0 * m2 * (xm1 * xm2 + ym1 * ym2 + spin * b1 * b2) + 2.0 * m3 * x1 * x2
    load = torque - 0.5 * (m1 + m2) * g * r * cosine + force * x1
    return (load - 0.5 * slope * rate**2) / inertia


def forces(
    angle: Float[Array, ""],
    rate: Float[Array, ""],
    *,
    m1: ArrayLike = PARAMS["m1"],
    m2: ArrayLike = PARAMS["m2"],
    m3: ArrayLike = PARAMS["m3"],
    r: ArrayLike = PARAMS["r"],
    l: ArrayLike = PARAMS["l"],
    g: ArrayLike = PARAMS["g"],
    torque: ArrayLike = 0.0,
    mu: ArrayLike = 0.0,
) -> SliderCrankForces:
    """Accelerations and all joint forces, by the Newton-Euler equations of the three free bodies.

    There are ten linear equations: forces along x and y and moments about the centres for crank and rod, forces for the
    slider, and equal accelerations of the ends of rod and slider. Friction is `-mu |N| sign(x')`. The equations are
    solved for both signs of the guide force N, and the consistent solution is returned, which is unique for small mu.
    Arguments as for `acceleration`. The slider must move.

    **Returns:**

    `SliderCrankForces`.
    """
    numbers = (m1, m2, m3, r, l, g, torque, mu)
    m1, m2, m3, r, l, g, torque, mu = (jnp.asarray(x, angle.dtype) for x in numbers)
    q, qd = state(angle, rate, r=r, l=l)
    (s1, s2), (c1, c2) = (jnp.sin(q[:2]), jnp.cos(q[:2]))
    w1, w2 = qd[0] ** 2, qd[1] ** 2
    i1, i2 = m1 * r**2 / 12.0, m2 * l**2 / 12.0
    hr, hl = 0.5 * r, 0.5 * l

    def solve(sign: float) -> Array:
        rub = -mu * sign * jnp.sign(qd[2])
        # Unknowns: crank'', rod'', x''; bearing on crank, crank on rod, rod on slider, each (x, y); N.
        rows = [
            [-m1 * hr * s1, 0, 0, -1, 0, 1, 0, 0, 0, 0],
            [m1 * hr * c1, 0, 0, 0, -1, 0, 1, 0, 0, 0],
            [i1, 0, 0, -hr * s1, hr * c1, -hr * s1, hr * c1, 0, 0, 0],
            [-m2 * r * s1, -m2 * hl * s2, 0, 0, 0, -1, 0, 1, 0, 0],
            [m2 * r * c1, m2 * hl * c2, 0, 0, 0, 0, -1, 0, 1, 0],
            [0, i2, 0, 0, 0, -hl * s2, hl * c2, -hl * s2, hl * c2, 0],
            [0, 0, m3, 0, 0, 0, 0, -1, 0, -rub],
            [0, 0, 0, 0, 0, 0, 0, 0, -1, -1],
            [-r * s1, -l * s2, -1, 0, 0, 0, 0, 0, 0, 0],
            [r * c1, l * c2, 0, 0, 0, 0, 0, 0, 0, 0],
        ]
        rhs = [
            m1 * hr * c1 * w1,
            m1 * hr * s1 * w1 - m1 * g,
            torque,
            m2 * (r * c1 * w1 + hl * c2 * w2),
            m2 * (r * s1 * w1 + hl * s2 * w2) - m2 * g,
            0.0,
            0.0,
            -m3 * g,
            r * c1 * w1 + l * c2 * w2,
            r * s1 * w1 + l * s2 * w2,
        ]
        matrix = jnp.stack([jnp.stack([jnp.asarray(x, angle.dtype) for x in row]) for row in rows])
        return jnp.linalg.solve(matrix, jnp.stack([jnp.asarray(x, angle.dtype) for x in rhs]))

    up, down = solve(1.0), solve(-1.0)
    solution = jnp.where(up[9] > 0, up, down)
    qdd = jnp.concatenate([solution[:3], jnp.zeros(1, solution.dtype)])
    return SliderCrankForces(qdd, solution[3:5], solution[5:7], solution[7:9], solution[9])
