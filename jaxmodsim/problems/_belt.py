"""A mass on a spring, carried along by a belt until it slips back, again and again: the stick-slip oscillator."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..effects import Friction
from ..friction import Coulomb, Stribeck
from ..scene import Scene
from ._spring import braked_spring

# A machine that sticks and slips about once a second: mass [kg], stiffness [N/m], belt [m/s], forces [N].
BELT_OSCILLATOR = {"m": 1.0, "k": 100.0, "belt": 0.1, "Fc": 5.0, "Fs": 8.0}
# A law for it that falls with the slip velocity.
BELT_STRIBECK = {"Fc": 5.0, "Fs": 8.0, "vs": 0.2, "Fv": 0.3}


class BeltCycle(NamedTuple):
    """One cycle of stick and slip.

    - `period`: `stick + slip` [s].
    - `stick`, `slip`: how long the mass sticks to the belt, and slips on it [s].
    - `begins`, `ends`: where slip begins and where it ends [m].
    - `lowest`, `highest`: turning points of the mass [m]; half their distance is the amplitude.
    """

    period: Float[Array, ""]
    stick: Float[Array, ""]
    slip: Float[Array, ""]
    begins: Float[Array, ""]
    ends: Float[Array, ""]
    lowest: Float[Array, ""]
    highest: Float[Array, ""]


def belt_oscillator(
    law: Any = None,
    *,
    m: ArrayLike = BELT_OSCILLATOR["m"],
    k: ArrayLike = BELT_OSCILLATOR["k"],
    belt: ArrayLike = BELT_OSCILLATOR["belt"],
) -> Scene:
    """The mass and spring of `braked_spring`, on a belt that moves at constant velocity.

    **Arguments:**

    - `law`: friction law between mass and belt; None for `belt_coulomb()`.
    - `m`: mass [kg], > 0.
    - `k`: stiffness of the spring to the ground [N/m], > 0, relaxed at q = 0.
    - `belt`: velocity of the belt [m/s].

    **Returns:**

    A `Scene` with one coordinate [m] and the effect `friction`. Under Coulomb friction it follows
    `belt_oscillator_cycle`.
    """
    spring = braked_spring(m=m, k=k)
    friction = Friction(belt_coulomb() if law is None else law, belt_velocity=belt)
    return Scene(spring.lagrangian, params=spring.params, effects=(friction,))


def belt_coulomb() -> Coulomb:
    """The Coulomb law of `BELT_OSCILLATOR`: a level in stick and a lower one in slip."""
    return Coulomb(Fc=BELT_OSCILLATOR["Fc"], Fs=BELT_OSCILLATOR["Fs"])


def belt_stribeck(exponent: ArrayLike = 2.0) -> Stribeck:
    """The law of `BELT_STRIBECK`, with the shape `exponent` of its fall."""
    return Stribeck(**BELT_STRIBECK, exponent=exponent)


def belt_oscillator_cycle(*, m: ArrayLike, k: ArrayLike, belt: ArrayLike, Fc: ArrayLike, Fs: ArrayLike) -> BeltCycle:
    """The cycle of `belt_oscillator` under Coulomb friction, in closed form.

    With `w = sqrt(k/m)` and `d = (Fs - Fc)/k`: in stick the mass goes at the velocity of the belt, until the spring
    pulls with Fs, at `Fs/k`. In slip it is pushed on by Fc, so it swings about `Fc/k`, from `d` above it at the
    velocity of the belt: `x = Fc/k + d cos(w t) + (belt/w) sin(w t)`. Slip ends when the mass has that velocity again,
    which by energy is `d` below the middle; from `belt (1 - cos(w t)) = -d w sin(w t)`, so `tan(w t/2) = -d w/belt`, it
    lasts `2/w (pi - atan(d w/belt))`. Stick from there to where slip begins lasts `2 d/belt`. Whatever the start, the
    cycle is reached with the first stick.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `k`: stiffness [N/m], > 0.
    - `belt`: velocity of the belt [m/s], > 0.
    - `Fc`: force in slip [N], >= 0.
    - `Fs`: largest force in stick [N], > Fc.

    **Returns:**

    A `BeltCycle`. Started in stick at q0 <= Fs/k, slip begins at the times `(Fs/k - q0)/belt + n period`, n = 0, 1, ...
    """
    m, k, belt, Fc, Fs = (jnp.asarray(x) for x in (m, k, belt, Fc, Fs))
    w, middle, d = jnp.sqrt(k / m), Fc / k, (Fs - Fc) / k
    stick, slip = 2.0 * d / belt, 2.0 / w * (jnp.pi - jnp.arctan(d * w / belt))
    reach = jnp.sqrt(d**2 + (belt / w) ** 2)
    return BeltCycle(stick + slip, stick, slip, middle + d, middle - d, middle - reach, middle + reach)
