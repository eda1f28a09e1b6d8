"""Impacts: what velocities and modes of contacts become at the instant at which gaps close."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core.semidefinite import solve_semidefinite
from .._core.shapes import PerDof, Scalar
from ..mechanics import Poisson, linearize_constraints, motion_equations
from ._scene import Scene

# Rounding units of the velocities of all coordinates, below which a gap has no velocity.
_ROUNDING = 64.0

_constant = jax.lax.stop_gradient


def impact(
    t: Scalar,
    q: PerDof,
    qd: PerDof,
    scene: Scene,
    closed: Float[Array, " contacts"],
    fired: Bool[Array, " contacts"],
    rest: Scalar,
    elastic: bool,
) -> tuple[PerDof, Float[Array, " contacts"]]:
    """Velocities, and the modes of the contacts, after the instant at which those `fired`.

    Contacts that are closed and have fired open: their multiplier has fallen to zero. Those that are open and have
    fired are struck. Struck contacts whose gap has no velocity afterwards are closed.

    **Arguments:**

    - `t`, `q`, `qd`, `scene`: the instant; the scene is that of time `t`.
    - `closed`: modes before.
    - `fired`: contacts whose guards have.
    - `rest`: velocity [m/s] that counts as none.
    - `elastic`: whether contacts give back a part of their velocity; False where impacts have accumulated, and what is
      left of the velocity of a gap, be it away from the contact, is below what time resolves: it is taken away.
    """
    contacts, params = tuple(scene.contacts.values()), scene.params
    mass = motion_equations(scene.lagrangian, t, q, qd, params).mass
    gaps = linearize_constraints(contacts, t, q, qd, params, mass)
    # The velocity of a gap that moves by itself counts, too.
    w = jnp.concatenate([each.rate(t, q, qd, params) for each in contacts])
    reach = gaps.minv_jt
    if scene.bilateral:
        held = linearize_constraints(scene.bilateral, t, q, qd, params, mass)
        reach = jnp.stack([held.respond(row) for row in reach])
    delassus = jnp.sum(gaps.rows[:, None, :] * reach[None, :, :], axis=2)
    touches = jnp.where(closed > 0, ~fired, fired)
    e, none = jnp.stack([each.coefficient.astype(w.dtype) for each in contacts]), jnp.zeros_like(w)
    if not elastic:
        impulse = solve_semidefinite(delassus, jnp.where(touches, -w, 0.0), jnp.ones_like(w), touches)
    elif any(isinstance(each.restitution, Poisson) for each in contacts):
        squeeze = _impulses(delassus, w, touches, none)
        halfway = w + jnp.sum(delassus * squeeze[None, :], axis=1)
        impulse = squeeze + _impulses(delassus, halfway, touches, e * squeeze)
    else:
        impulse = _impulses(delassus, (1.0 + jnp.where(closed > 0, 0.0, e)) * w, touches, none)
    after = w + jnp.sum(delassus * impulse[None, :], axis=1)
    rounding = _ROUNDING * float(jnp.finfo(w.dtype).eps) * jnp.sum(jnp.abs(gaps.rows * qd[None, :]), axis=1)
    still = _constant(jnp.abs(after) <= jnp.maximum(rest, rounding))
    return qd + jnp.sum(reach * impulse[:, None], axis=0), jnp.where(touches & still, 1.0, jnp.zeros_like(w))


def _impulses(
    delassus: Float[Array, "n n"], closing: Float[Array, " n"], touches: Bool[Array, " n"], least: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Impulses of the contacts that touch: `A p + closing >= 0`, `p >= least`, one of the two equal for each.

    Every set of contacts whose gaps end at zero is tried, and the one that violates the conditions least is taken: of a
    positive definite matrix exactly one violates none (Cottle, Pang, Stone: The Linear Complementarity Problem, 1992,
    theorem 3.3.7). Of redundant contacts the smallest impulses.
    """
    n = closing.shape[0]
    ones = jnp.ones_like(closing)

    def pushed(active: Bool[Array, " n"]) -> Float[Array, " n"]:
        given = jnp.where(active, 0.0, least)
        rhs = -closing - jnp.sum(delassus * given[None, :], axis=1)
        return given + solve_semidefinite(delassus, jnp.where(active, rhs, 0.0), ones, active & touches)

    if n == 1:
        return jnp.maximum(pushed(jnp.asarray([True])), least)
    sets = jnp.asarray(np.array(list(product((False, True), repeat=n))))

    def violation(active: Bool[Array, " n"]) -> Scalar:
        impulse = pushed(active)
        after = closing + jnp.sum(delassus * impulse[None, :], axis=1)
        pulls = jnp.max((least - impulse) * jnp.diagonal(delassus))
        return jnp.maximum(pulls, jnp.max(jnp.where(touches, -after, 0.0)))

    worst = jax.lax.map(violation, sets)
    return pushed(sets[jnp.argmin(_constant(worst))])
