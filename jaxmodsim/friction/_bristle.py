"""What laws with elastic elements share: how an element follows the surface and gives way, and its passivity."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._core.safe import bounded_ratio, decay_mean
from .._core.shapes import Scalar
from .._core.state_dependent import nominal
from ._passivity import Passivity, first_negative, least_on, logarithmic

STRIBECK_CURVE = "g(v) = Fc + (Fs - Fc) exp(-(v/vs)^2)"
# Limitations of bristles.
ONE_STATE = {"memory": "One state remembers one turning point."}
YIELDS = {"creep": "The bristle yields at any load, a little more forth than back."}


def stribeck_curve(
    v: Float[Array, "..."], Fc: Float[Array, "..."], Fs: Float[Array, "..."], vs: Scalar
) -> Float[Array, "..."]:
    """Gaussian Stribeck curve `Fc + (Fs - Fc) exp(-(v/vs)^2)` [N]: what steady slip at `v` [m/s] tends to."""
    ratio = bounded_ratio(v, vs)
    return Fc + (Fs - Fc) * jnp.exp(-ratio * ratio)


def relax_exact(v: Float[Array, "..."], z: Float[Array, "..."], dt: Scalar, rate: Scalar) -> Float[Array, "..."]:
    """Solution after `dt` [s] of `z' = v - rate z` with constant `v` [m/s] and `rate` [1/s]: exact at any step."""
    x = rate * dt
    return z * jnp.exp(-x) + v * dt * decay_mean(x)


def slip_fraction(u: Float[Array, "..."], corner: Scalar) -> Float[Array, "..."]:
    """Share of the slip that an element does not follow, at the load `u` in limits towards the slip.

    0 up to `1 - corner`, 1 at the limit, and above 1 beyond it, so that the element falls back.
    """
    return jnp.maximum(u - (1.0 - corner), 0.0) / corner


def advance_elastoplastic(
    v: Float[Array, "..."], z: Float[Array, "..."], dt: Scalar, limit: Float[Array, "..."], corner: Scalar
) -> Float[Array, "..."]:
    """Deflection after `dt` [s] of `z' = v (1 - slip_fraction(z sign(v)/limit))` with constant `v`: exact at any step.

    A straight line up to the corner, and from there a decay towards the limit.
    """
    # At rest either side will do: nothing moves, but the derivative by v must not be lost.
    side = jnp.where(v < 0, -1.0, 1.0).astype(z.dtype)
    u, y = side * z / limit, side * v * dt / limit
    straight = jnp.minimum(y, jnp.maximum(1.0 - corner - u, 0.0))
    bent = 1.0 + (u + straight - 1.0) * jnp.exp(-(y - straight) / corner)
    return side * limit * bent


def bristle_passivity(self: PyTree) -> Passivity:
    """Passivity of a bristle with damping, `F = sigma0 z + sigma1 z' + sigma2 v`, which fades over `vd` if it has one.

    At v > 0 with the bristle force `g u`, `u <= Fs/g`, the dissipation D has
    `D/v = g alpha u^2 + v (sigma2 + sigma1 (1 - alpha u))`, with alpha = 1 for LuGre, and for ElastoPlastic from u = 1
    on. Negative only for u > 1: the bristle was loaded slowly, and the speed has risen since. At high speed the last
    term decides, with the largest `u = Fs/Fc`: passive if and only if `sigma2 >= sigma1 (Fs - Fc)/Fc`. No other storage
    helps: where this fails, ever faster jerks after a slow loading draw as much energy as one likes, of order
    `sigma1 v^2` for the time `Fc/(sigma0 v)`. With `vd` that damping is `sigma1 exp(-(v/vd)^2)`, and sigma2 must be
    above the largest `sigma1 exp(-(v/vd)^2) (u - 1) - g u^2/v`, searched over v; u = v sigma1(v)/(2 g) is the worst,
    within 1 and Fs/g.
    """
    fade = nominal(getattr(self, "vd", None))
    vd = None if fade is None else float(fade)
    s1, s2, fc, fs, vs = (float(nominal(x)) for x in (self.sigma1, self.sigma2, self.Fc, self.Fs, self.vs))

    def least(v: np.ndarray) -> np.ndarray:
        """Least `D/v^2` [N s/m] over the deflections from the limit on, at the speeds v > 0."""
        g = fc + (fs - fc) * np.exp(-np.square(v / vs))
        damping = s1 if vd is None else s1 * np.exp(-np.square(v / vd))
        u = np.clip(v * damping / (2.0 * g), 1.0, fs / g)
        return s2 + g * u * u / v - damping * (u - 1.0)

    scales = [vs] if vd is None else [vs, vd]
    scales += [fc / s1] if s1 > 0 else []
    if vd is None:
        margin, words = s2 - s1 * (fs - fc) / fc, "sigma1 (Fs - Fc)/Fc"
    else:
        grid = logarithmic(1e-3 * min(scales), 1e3 * max(scales))
        margin, words = min(least_on(least, grid)[0], s2), "the largest sigma1 exp(-(v/vd)^2) (u - 1) - g(v) u^2/v"
    if abs(margin) <= 8.0 * float(jnp.finfo(nominal(self.Fc).dtype).eps) * s2:
        margin = 0.0  # equality, but for rounding of the product
    condition = (
        f"{type(self).__name__} is passive if and only if sigma2 >= {words}: {s2:g} against {s2 - margin:g} N s/m."
    )
    speed = math.inf
    if margin < 0:
        speed = first_negative(least, logarithmic(1e-3 * min(scales), 2.0 * max(*scales, fs * fs / fc / -margin)))
    return Passivity(margin >= 0, margin, speed, condition)
