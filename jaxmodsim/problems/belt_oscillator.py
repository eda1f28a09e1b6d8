"""The stick-slip oscillator: a mass on a spring that a belt carries along until it slips back."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..friction import Coulomb, Stribeck, Viscous
from ..scene import Friction, Scene
from . import braked_spring

# Stick-slip about once per second: mass [kg], stiffness [N/m], belt velocity [m/s], friction forces [N].
PARAMS = {"m": 1.0, "k": 100.0, "belt": 0.1, "Fc": 5.0, "Fs": 8.0}
# A law that falls with the slip velocity.
STRIBECK = {"Fc": 5.0, "Fs": 8.0, "vs": 0.2, "Fv": 0.3}


class BeltCycle(NamedTuple):
    """One cycle of stick and slip.

    - `period`: `stick + slip` [s].
    - `stick`, `slip`: durations of stick and slip [s].
    - `begins`, `ends`: positions at the start and end of slip [m].
    - `lowest`, `highest`: turning points of the mass [m]; half their distance is the amplitude.
    """

    period: Float[Array, ""]
    stick: Float[Array, ""]
    slip: Float[Array, ""]
    begins: Float[Array, ""]
    ends: Float[Array, ""]
    lowest: Float[Array, ""]
    highest: Float[Array, ""]


def scene(
    law: object = None,
    *,
    m: ArrayLike = PARAMS["m"],
    k: ArrayLike = PARAMS["k"],
    belt: ArrayLike = PARAMS["belt"],
    c: ArrayLike | None = None,
) -> Scene:
    """The mass and spring of `braked_spring` on a belt at constant velocity.

    **Arguments:**

    - `law`: friction law between mass and belt; None for `coulomb()`.
    - `m`: mass [kg], > 0.
    - `k`: stiffness of the spring to the ground [N/m], > 0, relaxed at q = 0.
    - `belt`: velocity of the belt [m/s].
    - `c`: damping coefficient of a damper parallel to the spring [N s/m], >= 0; None for no damper.

    **Returns:**

    A `Scene` with one coordinate [m] and the effect `friction`; with `c` also `damper`. Under Coulomb friction without
    a damper it follows `cycle`. With a damper it sticks again below the belt velocity `onset_speed`.
    """
    spring = braked_spring.scene(m=m, k=k)
    friction = Friction(coulomb() if law is None else law, belt_velocity=belt)
    damper = () if c is None else (Friction(Viscous(c), name="damper"),)
    return Scene(spring.lagrangian, params=spring.params, effects=(friction, *damper), coordinates=spring.coordinates)


def coulomb() -> Coulomb:
    """The Coulomb law of `PARAMS`, with stiction.

    **Returns:**

    A `Coulomb` law.
    """
    return Coulomb(Fc=PARAMS["Fc"], Fs=PARAMS["Fs"])


def stribeck(exponent: ArrayLike = 2.0) -> Stribeck:
    """The Stribeck law of `STRIBECK`, with this exponent.

    **Returns:**

    A `Stribeck` law.
    """
    return Stribeck(**STRIBECK, exponent=exponent)


def cycle(*, m: ArrayLike, k: ArrayLike, belt: ArrayLike, Fc: ArrayLike, Fs: ArrayLike) -> BeltCycle:
    """The cycle of the scene under Coulomb friction, in closed form.

    Let `w = sqrt(k/m)` and `d = (Fs - Fc)/k`. In stick the mass moves with the belt until the spring force is Fs, at
    `Fs/k`. In slip the friction force is Fc, and the mass swings about `Fc/k`:
    `x = Fc/k + d cos(w t) + (belt/w) sin(w t)`. Slip ends when the mass has the velocity of the belt again, by energy
    at a distance `d` below the middle. From `belt (1 - cos(w t)) = -d w sin(w t)`, so `tan(w t/2) = -d w/belt`, slip
    lasts `2/w (pi - atan(d w/belt))`. Stick lasts `2 d/belt`. The motion is periodic from the first stick on.

    **Arguments:**

    - `m`: mass [kg], > 0.
    - `k`: stiffness [N/m], > 0.
    - `belt`: velocity of the belt [m/s], > 0.
    - `Fc`: friction force in slip [N], >= 0.
    - `Fs`: break-away force [N], > Fc.

    **Returns:**

    A `BeltCycle`. After a start in stick at q0 <= Fs/k, slip begins at the times `(Fs/k - q0)/belt + n period`,
    n = 0, 1, ...
    """
    m, k, belt, Fc, Fs = (jnp.asarray(x) for x in (m, k, belt, Fc, Fs))
    w, middle, d = jnp.sqrt(k / m), Fc / k, (Fs - Fc) / k
    stick, slip = 2.0 * d / belt, 2.0 / w * (jnp.pi - jnp.arctan(d * w / belt))
    reach = jnp.sqrt(d**2 + (belt / w) ** 2)
    return BeltCycle(stick + slip, stick, slip, middle + d, middle - d, middle - reach, middle + reach)


def motion(
    t: Float[Array, "..."], *, m: ArrayLike, k: ArrayLike, belt: ArrayLike, Fc: ArrayLike, Fs: ArrayLike
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Position [m] and velocity [m/s] at the times `t` [s], after a start in stick at q = 0; shape as `t`.

    The mass moves with the belt until the first slip, at `Fs/(k belt)`, and then follows `cycle`. Arguments as for
    `cycle`, t >= 0.

    **Returns:**

    Position and velocity, of the shape of `t` each.
    """
    whole = cycle(m=m, k=k, belt=belt, Fc=Fc, Fs=Fs)
    w, middle = jnp.sqrt(k / jnp.asarray(m)), Fc / jnp.asarray(k)
    since = t - whole.begins / belt
    phase = jnp.where(since > 0, since % whole.period, since)
    slips = (phase > 0) & (phase < whole.slip)
    place = middle + (whole.begins - middle) * jnp.cos(w * phase) + belt / w * jnp.sin(w * phase)
    speed = belt * jnp.cos(w * phase) - (whole.begins - middle) * w * jnp.sin(w * phase)
    # The position in stick is measured from the start of the next slip.
    carried = whole.begins + belt * jnp.where(since > 0, phase - whole.period, since)
    return jnp.where(slips, place, carried), jnp.where(slips, speed, belt)


def onset_speed(*, m: ArrayLike, k: ArrayLike, c: ArrayLike, Fc: ArrayLike, Fs: ArrayLike) -> Float[Array, "..."]:
    """Velocity of the belt [m/s] below which stick-slip of `scene` with a damper persists.

    The mass breaks away at the velocity of the belt, at `k x + c belt = Fs`, and then swings freely about `Fc/k`. Let
    `w = sqrt(k/m)`, `zeta = c/(2 m w)`, `u = sqrt(1 - zeta^2)`, `s = w t`, and `d = (Fs - Fc)/(belt sqrt(k m))`. The
    velocity relative to that of the belt is `V = exp(-zeta s) (cos(u s) + (zeta - d)/u sin(u s))`, from V(0) = 1 and
    V'(0) = -d. Its first maximum is at `u s = 2 pi - atan2(d u, 1 - zeta d)`. If V reaches 1 by then, the mass sticks
    again, and does so after every slip, because all slips begin in the same state. If V stays below 1, the mass slips
    until it rests. Since `V^2 + 2 zeta V V' + V'^2` falls by `exp(-2 zeta s)`, the limit V = 1 at V' = 0 is

        1 - 2 zeta d + d^2 = exp(2 zeta/u (2 pi - atan2(d u, 1 - zeta d))),

    which has one root d > 2 zeta. For small zeta the root is `d = sqrt(4 pi zeta)`, so
    `belt = (Fs - Fc)/sqrt(4 pi zeta k m)`.

    **Arguments:** (arrays that broadcast)

    - `m`: mass [kg], > 0.
    - `k`: stiffness [N/m], > 0.
    - `c`: damping coefficient [N s/m], > 0.
    - `Fc`: friction force in slip [N], >= 0.
    - `Fs`: break-away force [N], > Fc.

    **Returns:**

    The velocity, or 0 for c >= 2 sqrt(k m), with which the mass never sticks again. Differentiable.
    """
    m, k, c, Fc, Fs = (jnp.asarray(x) for x in (m, k, c, Fc, Fs))
    zeta = c / (2.0 * jnp.sqrt(k * m))
    light = zeta < 1.0
    zeta = jnp.where(light, zeta, 0.5)

    def gap(log_d: Array, zeta: Array) -> Array:
        """Logarithm of the left-hand side over the right-hand side; it rises from -inf at d = 2 zeta."""
        # Scaled by max(1, d), and the left-hand side by its square, because d overflows as zeta approaches 1.
        one, d, u = jnp.exp(-jnp.maximum(log_d, 0.0)), jnp.exp(jnp.minimum(log_d, 0.0)), jnp.sqrt(1.0 - zeta**2)
        angle = 2.0 * jnp.pi - jnp.arctan2(d * u, one - zeta * d)
        left = 2.0 * jnp.maximum(log_d, 0.0) + jnp.log1p(one * d * (one * d - 2.0 * zeta))
        return left - 2.0 * zeta / u * angle

    def halve(_: object, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = 0.5 * (bracket[0] + bracket[1])
        below = gap(middle, fixed) < 0
        return jnp.where(below, middle, bracket[0]), jnp.where(below, bracket[1], middle)

    fixed = jax.lax.stop_gradient(zeta)
    # The left-hand side is above (d - zeta)^2, and the right-hand side below exp(4 pi zeta/u).
    turns = 2.0 * jnp.pi * fixed / jnp.sqrt(1.0 - fixed**2)
    bracket = (jnp.log(2.0 * fixed), jnp.logaddexp(turns, jnp.log(fixed)))
    root, _ = jax.lax.fori_loop(0, 60, halve, bracket)
    # One step of Newton carries the derivatives.
    slope = jax.jvp(lambda x: gap(x, fixed), (root,), (jnp.ones_like(root),))[1]
    log_d = root - gap(root, zeta) / jax.lax.stop_gradient(slope)
    return jnp.where(light, (Fs - Fc) / jnp.sqrt(k * m) * jnp.exp(-log_d), 0.0)
