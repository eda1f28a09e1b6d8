"""A disc or hoop that rolls on a plane without slipping: a constraint on velocities alone."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxmodsim.mechanics import VelocityConstraint, rigid_body
from jaxmodsim.scene import Scene

# Mass [kg], radius [m], moment of inertia about the axle in units of m R^2 (1/2 a disc, 1 a hoop), gravity [m/s^2].
PARAMS = {"m": 0.8, "R": 0.5, "k": 0.5, "g": 9.81}


def _centre(q: Array, p: dict[str, Array]) -> Array:
    return jnp.stack([q[0], q[1], p["R"] * jnp.cos(q[3])])


def _turned(q: Array) -> Array:
    """Heading about z, then lean about the heading, then spin about the axle, which is the second body axis."""
    (s1, s2, s3), (c1, c2, c3) = jnp.sin(q[2:]), jnp.cos(q[2:])
    return jnp.stack(
        [
            jnp.stack([c1 * c3 - s1 * s2 * s3, -s1 * c2, c1 * s3 + s1 * s2 * c3]),
            jnp.stack([s1 * c3 + c1 * s2 * s3, c1 * c2, s1 * s3 - c1 * s2 * c3]),
            jnp.stack([-c2 * s3, s2, c2 * c3]),
        ]
    )


def _moments(p: dict[str, Array]) -> Array:
    axial = p["k"] * p["m"] * p["R"] ** 2
    return jnp.stack([0.5 * axial, axial, 0.5 * axial])


def _slip(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    """Velocity of the point of contact along and across the heading."""
    sine, cosine = jnp.sin(q[2]), jnp.cos(q[2])
    along, across = cosine * qd[0] + sine * qd[1], cosine * qd[1] - sine * qd[0]
    return jnp.stack([along - p["R"] * (qd[4] + jnp.sin(q[3]) * qd[2]), across + p["R"] * jnp.cos(q[3]) * qd[3]])


_DISC = rigid_body(lambda p: p["m"], _moments, _centre, _turned, lambda p: p["g"])


def scene(
    *, m: ArrayLike = PARAMS["m"], R: ArrayLike = PARAMS["R"], k: ArrayLike = PARAMS["k"], g: ArrayLike = PARAMS["g"]
) -> Scene:
    """Thin disc that rolls without slipping on the plane z = 0, its edge always on it.

    The coordinates are (x, y) of the centre [m], and heading, lean and spin [rad]: the disc rolls towards
    (cos(heading), sin(heading)) for a rising spin, and stands upright at lean = 0; for lean > 0 its top is to the
    right. The height of the centre is R cos(lean). The mass matrix is singular lying flat, |lean| = pi/2.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `R`: radius [m], > 0.
    - `k`: moment of inertia about the axle in units of m R^2, > 0: 1/2 for a disc, 1 for a hoop. About a diameter it is
      half of that.
    - `g`: gravity [m/s^2].

    **Returns:**

    A `Scene` without effects, with the constraint `rolling`, two equations: its multipliers are the force of the plane
    on the disc [N] along and across the heading. Velocities that roll: `velocity`; the exact motion:
    `acceleration`; steady circles: `steady_spin`.
    """
    rolling = VelocityConstraint(_slip, name="rolling")
    return Scene(
        _DISC,
        params={"m": m, "R": R, "k": k, "g": g},
        constraints=(rolling,),
        coordinates=("x [m]", "y [m]", "heading [rad]", "lean [rad]", "spin [rad]"),
    )


def velocity(q: Float[Array, "5"], rates: Float[Array, "3"], *, R: ArrayLike = PARAMS["R"]) -> Float[Array, "5"]:
    """All velocities [m/s, rad/s], shape `[5]`, that roll with the given rates of (heading, lean, spin) [rad/s]."""
    R = jnp.asarray(R)
    along = R * (rates[2] + jnp.sin(q[3]) * rates[0])
    across = -R * jnp.cos(q[3]) * rates[1]
    sine, cosine = jnp.sin(q[2]), jnp.cos(q[2])
    return jnp.concatenate([jnp.stack([cosine * along - sine * across, sine * along + cosine * across]), rates])


def acceleration(
    q: Float[Array, "5"],
    qd: Float[Array, "5"],
    *,
    R: ArrayLike = PARAMS["R"],
    k: ArrayLike = PARAMS["k"],
    g: ArrayLike = PARAMS["g"],
) -> Float[Array, "5"]:
    """Accelerations of the rolling disc in closed form; the mass drops out.

    Euler's equations about the centre, in the frame (heading, axle, up along the disc) that leans and turns with the
    disc but does not spin, with the force of the plane from Newton's law. In units of m R^2, with the moments k about
    the axle and d = k/2 about a diameter, lean f, heading h, and the spin about the axle w = spin' + h' sin(f):
    `(d + 1) f'' = (k + 1) h' cos(f) w - d h'^2 sin(f) cos(f) + (g/R) sin(f)`,
    `(k + 1) w' = -f' h' cos(f)` and `d cos(f) h'' = f' (2 d h' sin(f) - k w)`. (The equations of J. I. Neimark and
    N. A. Fufaev, Dynamics of Nonholonomic Systems, 1972, derived anew in these coordinates.)

    **Arguments:**

    - `q`, `qd`: (x, y, heading, lean, spin) and their rates, shape `[5]`; |lean| < pi/2, and `qd` rolls.
    - `R`, `k`, `g`: as for `scene`.

    **Returns:**

    Their accelerations [m/s^2, rad/s^2], shape `[5]`.
    """
    k = jnp.asarray(k)
    d = 0.5 * k
    turn, fall, spin = qd[2], qd[3], qd[4]
    sine, cosine = jnp.sin(q[3]), jnp.cos(q[3])
    w = spin + turn * sine
    fall2 = ((k + 1.0) * turn * cosine * w - d * turn**2 * sine * cosine + g / R * sine) / (d + 1.0)
    w2 = -fall * turn * cosine / (k + 1.0)
    turn2 = fall * (2.0 * d * turn * sine - k * w) / (d * cosine)
    spin2 = w2 - turn2 * sine - turn * fall * cosine
    # Of the centre, along and across the heading: the rates of R w and -R cos(f) f', and how the heading turns them.
    along = R * (w2 + turn * cosine * fall)
    across = R * (turn * w + sine * fall**2 - cosine * fall2)
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    return jnp.stack([c * along - s * across, s * along + c * across, turn2, fall2, spin2])


def steady_spin(
    lean: ArrayLike,
    turn: ArrayLike,
    *,
    R: ArrayLike = PARAMS["R"],
    k: ArrayLike = PARAMS["k"],
    g: ArrayLike = PARAMS["g"],
) -> Float[Array, ""]:
    """Rate of spin [rad/s] with which the disc keeps its lean and rolls in a circle.

    From f'' = 0 in `acceleration`: `w = (d h'^2 sin(f) cos(f) - (g/R) sin(f))/((k + 1) h' cos(f))`. The
    centre then moves at the speed R w, on a circle of radius R |w/h'|.

    **Arguments:**

    - `lean`: f [rad], |f| < pi/2.
    - `turn`: rate of the heading h' [rad/s], not zero.
    - `R`, `k`, `g`: as for `scene`.
    """
    k, turn = jnp.asarray(k), jnp.asarray(turn)
    sine, cosine = jnp.sin(lean), jnp.cos(lean)
    w = (0.5 * k * turn**2 * sine * cosine - g / R * sine) / ((k + 1.0) * turn * cosine)
    return w - turn * sine
