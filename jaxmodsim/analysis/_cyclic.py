"""Coordinates that a Lagrangian does not depend on."""

import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from ..scene import Scene

_SAMPLES = 32
# Rounding units, in the largest derivative around, below which one is zero.
_ROUNDING = 1e3


def cyclic_coordinates(scene: Scene, dof: int) -> tuple[int, ...]:
    """Indices of the coordinates that the Lagrangian of a scene does not depend on.

    The momentum dL/dqd of such a coordinate changes only by forces (effects and constraints) that act on it; along a
    run it is `run.momentum[:, i]`. Found by evaluating dL/dq at 32 random states, coordinates and velocities within +-3
    and times within 10 s: a dependence that vanishes in all of that box is not seen.

    **Arguments:**

    - `scene`: the `Scene`; its numbers must be known (not traced).
    - `dof`: number of coordinates.

    **Returns:**

    Indices in increasing order.

    **Raises:**

    - `ValueError` inside `jax.jit`, `jax.vmap` or `jax.grad`, where numbers are not known.
    """
    if any(isinstance(x, jax.core.Tracer) for x in jtu.tree_leaves(scene)):
        raise ValueError("cyclic_coordinates looks at numbers, so it cannot run inside jax.jit, jax.vmap or jax.grad.")
    kind = jnp.result_type(float, *jtu.tree_leaves(scene))
    random = np.random.default_rng(0)
    q, qd = (jnp.asarray(random.uniform(-3.0, 3.0, (_SAMPLES, dof)), kind) for _ in range(2))
    slopes = np.asarray(_slopes(scene, jnp.asarray(random.uniform(0.0, 10.0, _SAMPLES), kind), q, qd))
    slopes = np.abs(slopes[np.isfinite(slopes).all(axis=1)])
    if not len(slopes):
        return ()
    limit = _ROUNDING * float(jnp.finfo(kind).eps) * slopes.max(axis=1, keepdims=True)
    return tuple(int(i) for i in np.flatnonzero((slopes <= limit).all(axis=0)))


@jax.jit
def _slopes(scene: Scene, t: Array, q: Array, qd: Array) -> Array:
    def slopes(t: Array, q: Array, qd: Array) -> Array:
        now = scene.bind_time(t)
        return jax.grad(now.lagrangian, argnums=1)(t, q, qd, now.params)

    return jax.vmap(slopes)(t, q, qd)
