"""What laws with elastic elements share: how an element follows the surface and gives way."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.safe import bounded_ratio, decay_mean


def stribeck_curve(
    v: Float[Array, "..."], Fc: Float[Array, "..."], Fs: Float[Array, "..."], vs: Float[Array, ""]
) -> Float[Array, "..."]:
    """Gaussian Stribeck curve `Fc + (Fs - Fc) exp(-(v/vs)^2)` [N]: what steady slip at `v` [m/s] tends to."""
    ratio = bounded_ratio(v, vs)
    return Fc + (Fs - Fc) * jnp.exp(-ratio * ratio)


def relax_exact(
    v: Float[Array, "..."], z: Float[Array, "..."], dt: Float[Array, ""], rate: Float[Array, ""]
) -> Float[Array, "..."]:
    """Solution after `dt` [s] of `z' = v - rate z` with constant `v` [m/s] and `rate` [1/s]: exact at any step."""
    x = rate * dt
    return z * jnp.exp(-x) + v * dt * decay_mean(x)


def slip_fraction(u: Float[Array, "..."], corner: Float[Array, ""]) -> Float[Array, "..."]:
    """Share of the slip that an element does not follow, at the load `u` in limits towards the slip.

    0 up to `1 - corner`, 1 at the limit, and above 1 beyond it, so that the element falls back.
    """
    return jnp.maximum(u - (1.0 - corner), 0.0) / corner


def advance_elastoplastic(
    v: Float[Array, "..."],
    z: Float[Array, "..."],
    dt: Float[Array, ""],
    limit: Float[Array, "..."],
    corner: Float[Array, ""],
) -> Float[Array, "..."]:
    """Deflection after `dt` [s] of `z' = v (1 - yielding(z sign(v)/limit))` with constant `v`: exact at any step.

    A straight line up to the corner, and from there a decay towards the limit.
    """
    # At rest either side will do: nothing moves, but the derivative by v must not be lost.
    side = jnp.where(v < 0, -1.0, 1.0).astype(z.dtype)
    u, y = side * z / limit, side * v * dt / limit
    straight = jnp.minimum(y, jnp.maximum(1.0 - corner - u, 0.0))
    bent = 1.0 + (u + straight - 1.0) * jnp.exp(-(y - straight) / corner)
    return side * limit * bent
