"""Two masses on one belt, each on its own spring, coupled by a third spring."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from ..friction import Coulomb
from ..scene import Friction, Scene

# Masses [kg], stiffnesses to the ground and between the masses [N/m], belt velocity [m/s].
PARAMS = {"m1": 1.0, "m2": 1.6, "k1": 100.0, "k2": 130.0, "coupling": 35.0, "belt": 0.1}
# Friction forces of both masses [N], in slip and at break-away.
LAWS = ({"Fc": 5.0, "Fs": 8.0}, {"Fc": 6.0, "Fs": 9.5})


class FirstSlip(NamedTuple):
    """The first slip: its time `t` [s], the index `which` of the mass, and the position `x` of both masses [m]."""

    t: Float[Array, ""]
    which: Int[Array, ""]
    x: Float[Array, ""]


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    kinetic = 0.5 * p["m1"] * qd[0] ** 2 + 0.5 * p["m2"] * qd[1] ** 2
    springs = 0.5 * p["k1"] * q[0] ** 2 + 0.5 * p["k2"] * q[1] ** 2 + 0.5 * p["coupling"] * (q[0] - q[1]) ** 2
    return kinetic - springs


def _first(q: Array) -> Array:
    return q[0]


def _second(q: Array) -> Array:
    return q[1]


def scene(
    laws: tuple[object, object] | None = None,
    *,
    m1: ArrayLike = PARAMS["m1"],
    m2: ArrayLike = PARAMS["m2"],
    k1: ArrayLike = PARAMS["k1"],
    k2: ArrayLike = PARAMS["k2"],
    coupling: ArrayLike = PARAMS["coupling"],
    belt: ArrayLike = PARAMS["belt"],
) -> Scene:
    """Two masses on a belt: `m1 x1'' = -k1 x1 - c (x1 - x2) - F1`, `m2 x2'' = -k2 x2 + c (x1 - x2) - F2`.

    The slip of one mass changes the load of the other. The masses slip in an irregular order. Between events the motion
    is linear.

    **Arguments:**

    - `laws`: friction laws of the two masses; None for Coulomb friction with `LAWS`.
    - `m1`, `m2`: masses [kg], > 0.
    - `k1`, `k2`: stiffnesses of the springs to the ground [N/m], > 0, relaxed at q = 0.
    - `coupling`: stiffness c of the spring between the masses [N/m], >= 0, relaxed at q[0] = q[1].
    - `belt`: velocity of the belt [m/s].

    **Returns:**

    A `Scene` with two coordinates [m] and the effects `first` and `second`. `first_slip` has its first event.
    """
    one, two = (Coulomb(**law) for law in LAWS) if laws is None else laws
    return Scene(
        _lagrangian,
        params={"m1": m1, "m2": m2, "k1": k1, "k2": k2, "coupling": coupling},
        effects=(
            Friction(one, along=_first, belt_velocity=belt, name="first"),
            Friction(two, along=_second, belt_velocity=belt, name="second"),
        ),
        coordinates=("x_1 [m]", "x_2 [m]"),
    )


def first_slip(*, k1: ArrayLike, k2: ArrayLike, belt: ArrayLike, Fs1: ArrayLike, Fs2: ArrayLike) -> FirstSlip:
    """The first slip after a start of both masses in stick at q = 0.

    Both masses move with the belt, and the spring between them stays relaxed. Mass i slips when `k_i belt t` reaches
    its limit, so `t = min(Fs1/k1, Fs2/k2)/belt`.

    **Arguments:**

    - `k1`, `k2`: stiffnesses to the ground [N/m], > 0.
    - `belt`: velocity of the belt [m/s], > 0.
    - `Fs1`, `Fs2`: break-away forces [N], >= 0.

    **Returns:**

    A `FirstSlip`.
    """
    positions = jnp.stack([jnp.asarray(Fs1) / k1, jnp.asarray(Fs2) / k2])
    return FirstSlip(jnp.min(positions) / belt, jnp.argmin(positions), jnp.min(positions))
