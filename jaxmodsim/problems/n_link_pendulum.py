"""A chain of point masses on massless links in a vertical plane; with two links, the double pendulum."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._core.cholesky import solve_positive_definite
from ..scene import Scene


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    # Sums over the links up to each mass, as products, because XLA on CPU has no fast `jnp.cumsum`.
    upto = np.tri(q.shape[0], dtype=q.dtype)
    x = upto @ (p["l"] * jnp.cos(q) * qd)
    z = upto @ (p["l"] * jnp.sin(q) * qd)
    height = -upto @ (p["l"] * jnp.cos(q))
    return jnp.sum(p["m"] * (0.5 * (x**2 + z**2) - p["g"] * height))


def scene(n: int, *, m: ArrayLike = 1.0, l: ArrayLike = 1.0, g: ArrayLike = 9.81) -> Scene:
    """Chain of n point masses on massless links in a vertical plane, suspended at the origin, gravity along -z.

    The coordinates are the absolute angles of the links [rad] from straight down: mass k is at `x = sum_i l_i
    sin(q_i)`, `z = -sum_i l_i cos(q_i)` over the links i <= k. There is no friction. The motion is chaotic for two or
    more links.

    **Arguments:**

    - `n`: number of links, >= 1.
    - `m`: masses from the pivot outwards [kg], > 0; shape `[n]`, or one number for all.
    - `l`: lengths of the links [m], > 0; likewise.
    - `g`: gravity [m/s^2].

    **Returns:**

    A `Scene` without effects. `acceleration` has its exact accelerations.

    **Raises:**

    - `ValueError` if `n` is not a positive integer, or `m` or `l` has the wrong length.
    """
    if isinstance(n, bool) or not isinstance(n, int) or n < 1:
        raise ValueError(f"n must be a positive integer, but {n!r} was given.")
    return Scene(
        _lagrangian,
        params={"m": _each(m, "m", n), "l": _each(l, "l", n), "g": g},
        coordinates=tuple(f"angle_{i} [rad]" for i in range(n)),
    )


def double_pendulum(*, m: ArrayLike = 1.0, l: ArrayLike = 1.0, g: ArrayLike = 9.81) -> Scene:
    """The chain of two links; see `scene`.

    **Returns:**

    A `Scene` with two coordinates [rad].
    """
    return scene(2, m=m, l=l, g=g)


def _each(x: ArrayLike, name: str, n: int) -> Array:
    array = jnp.asarray(x, float)
    if array.shape not in ((), (n,)):
        raise ValueError(f"{name} must be one number or have the shape ({n},) for {n} links, but it has {array.shape}.")
    return jnp.broadcast_to(array, (n,))


def acceleration(
    q: Float[Array, " n"], qd: Float[Array, " n"], *, m: ArrayLike = 1.0, l: ArrayLike = 1.0, g: ArrayLike = 9.81
) -> Float[Array, " n"]:
    """Accelerations of the chain, from its equations of motion in closed form.

    With `c_ij = (m_max(i,j) + ... + m_n) l_i l_j` the equation of link i is
    `sum_j c_ij (cos(q_i - q_j) q_j'' + sin(q_i - q_j) q_j'^2) + (m_i + ... + m_n) g l_i sin(q_i) = 0`. This extends the
    equations for two links, with the Lagrangian of L. D. Landau and E. M. Lifshitz, Mechanics, section 5, problem 1.

    **Arguments:**

    - `q`: angles of the links from straight down [rad], shape `[n]`.
    - `qd`: their rates [rad/s], shape `[n]`.
    - `m`: masses [kg], > 0; shape `[n]`, or one number for all.
    - `l`: lengths [m], > 0; likewise.
    - `g`: gravity [m/s^2].

    **Returns:**

    The angular accelerations [rad/s^2], shape `[n]`.
    """
    n = q.shape[0]
    mass, length = _each(m, "m", n).astype(q.dtype), _each(l, "l", n).astype(q.dtype)
    below = jnp.cumsum(mass[::-1])[::-1]
    index = np.arange(n)
    coupling = below[np.maximum(index[:, None], index[None, :])] * length[:, None] * length[None, :]
    angle = q[:, None] - q[None, :]
    load = -jnp.sum(coupling * jnp.sin(angle) * (qd**2)[None, :], axis=1) - below * g * length * jnp.sin(q)
    return solve_positive_definite(coupling * jnp.cos(angle), load)
