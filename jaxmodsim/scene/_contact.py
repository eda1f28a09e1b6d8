"""Exact stick and slip of the set-valued friction elements of a scene.

Element i has a mode: +1 or -1, slip in that direction, or 0, stick. With the directions D_i = d along_i/dq the slip
accelerations are `a = base - A f`, `A = D M^-1 D^T`, where `base` is what they would be without these elements and f
are their forces. In slip f follows from the law; in stick it is the multiplier that makes `a_i = 0`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..effects import Friction
from ..numerics import solve_positive_definite

_constant = jax.lax.stop_gradient


class Contact(NamedTuple):
    """The friction elements with a mode at one state; n of them.

    - `v`: slip velocities [m/s].
    - `base`: slip accelerations without these elements [m/s^2].
    - `coupling`: A [1/kg].
    - `reach`: rows `M^-1 D_i`, the accelerations that a unit force takes away.
    - `forward`, `backward`: forces in slip towards either direction, at `v` [N].
    - `upper`, `lower`: limits of stick against a load towards either direction [N], >= 0.
    """

    v: Float[Array, " n"]
    base: Float[Array, " n"]
    coupling: Float[Array, "n n"]
    reach: Float[Array, "n dof"]
    forward: Float[Array, " n"]
    backward: Float[Array, " n"]
    upper: Float[Array, " n"]
    lower: Float[Array, " n"]


def contact(
    elements: list[Friction],
    t: Float[Array, ""],
    q: Float[Array, " dof"],
    qd: Float[Array, " dof"],
    params: object,
    mass: Float[Array, "dof dof"],
    qdd: Float[Array, " dof"],
) -> Contact:
    """What the elements see at one state, where the accelerations without them are `qdd`."""
    rows = [element.direction(q) for element in elements]
    reach = [solve_positive_definite(mass, row) for row in rows]
    slip = [
        jax.jvp(element.slip, (t, q, qd), (jnp.ones_like(t), qd, qdd))  # velocity, and its rate
        for element in elements
    ]
    loads = [element.load(t, q, qd, params) for element in elements]
    one = jnp.ones_like(t)
    forces = [
        [element.slip_force(v, sign * one, load) for element, (v, _), load in zip(elements, slip, loads, strict=True)]
        for sign in (1.0, -1.0)
    ]
    limits = [
        [element.limit(sign, load) for element, load in zip(elements, loads, strict=True)] for sign in (1.0, -1.0)
    ]
    return Contact(
        jnp.stack([v for v, _ in slip]),
        jnp.stack([a for _, a in slip]),
        jnp.stack([jnp.stack([jnp.sum(row * each) for each in reach]) for row in rows]),
        jnp.stack(reach),
        jnp.stack(forces[0]),
        jnp.stack(forces[1]),
        jnp.stack(limits[0]),
        jnp.stack(limits[1]),
    )


def contact_forces(found: Contact, mode: Float[Array, " n"]) -> Float[Array, " n"]:
    """Friction forces [N] in the modes given: the slip force, or the multiplier of stick."""
    sticks = mode == 0
    slipping = jnp.where(mode > 0, found.forward, found.backward)
    drive = found.base - jnp.sum(found.coupling * jnp.where(sticks, 0.0, slipping)[None, :], axis=1)
    return jnp.where(sticks, _multipliers(found, drive, sticks), slipping)


def _multipliers(found: Contact, drive: Float[Array, " n"], sticks: Bool[Array, " n"]) -> Float[Array, " n"]:
    """Forces of the sticking elements that take their slip accelerations away; others get zero.

    Where sticking elements are redundant (two on one coordinate), the equations leave the share of each open. The one
    with the smallest sum of `f_i^2/limit_i` is taken: elements in parallel then share in proportion to their
    limits and reach them together. Shares of redundant elements are right to the square root of the rounding unit.
    """
    n = drive.shape[0]
    if n == 1:
        reach = found.coupling[0]
        return jnp.where(sticks, drive / jnp.where(reach > 0, reach, jnp.inf), 0.0)
    weight = 0.5 * (found.upper + found.lower)
    largest = jnp.max(weight)
    weight = jnp.maximum(weight / jnp.where(largest > 0, largest, 1.0), 1e-6)
    weight = _constant(jnp.sqrt(jnp.where(largest > 0, weight, 1.0)))
    both = sticks[:, None] & sticks[None, :]
    matrix = jnp.where(both, found.coupling * weight[:, None] * weight[None, :], 0.0)
    scale = jnp.max(jnp.where(both, matrix, 0.0))
    scale = jnp.where(scale > 0, scale, 1.0)
    matrix, rhs = matrix / scale, jnp.where(sticks, weight * drive, 0.0) / scale
    # A shift keeps the factors of a redundant set finite, and picks the smallest solution; refinement takes its error
    # away, down to rounding where the set is not redundant.
    shift = float(jnp.finfo(drive.dtype).eps) ** 0.5
    identity = jnp.eye(n, dtype=drive.dtype)
    shifted = jnp.where(both, matrix, 0.0) + identity * jnp.where(sticks, shift, 1.0)[None, :]
    solution = jnp.zeros_like(rhs)
    for _ in range(3):
        rest = rhs - jnp.sum(matrix * solution[None, :], axis=1)
        solution = solution + solve_positive_definite(shifted, rest)
    return jnp.where(sticks, weight * solution, 0.0)


def contact_guards(found: Contact, mode: Float[Array, " n"], rest: Float[Array, ""]) -> Float[Array, " n"]:
    """One guard for each element, positive while its mode holds.

    In stick `(upper - f)(lower + f)/(upper + lower)` [N], which falls through zero at either limit with the slope of
    the force; in slip the velocity in its direction [m/s]. What differs by rounding must not flicker: the limits are
    16 rounding units further out, and a slip has to turn by `rest` [m/s] before it ends (an element may be in slip, at
    its limit, while others hold it).
    """
    force = contact_forces(found, mode)
    wider = 1.0 + 16.0 * float(jnp.finfo(force.dtype).eps)
    span = found.upper + found.lower
    inside = (wider * found.upper - force) * (wider * found.lower + force) / jnp.where(span > 0, span, 1.0)
    return jnp.where(mode == 0, inside, mode * found.v + rest)


def next_modes(
    found: Contact, mode: Float[Array, " n"], still: Bool[Array, " n"], at_limit: Bool[Array, " n"]
) -> Float[Array, " n"]:
    """Modes after an instant at which the elements `still` have no slip velocity; the others go on as they are.

    All of them stick if they can. If limits are exceeded, the element that exceeds its own by the largest factor
    slips in the direction of its load, and the rest is solved again. An element that would then be accelerated
    against its direction sticks again. Without stiction the modes that satisfy everything are unique, and found;
    with it there may be several, and the search is a heuristic: where it fails, an element slips that is pushed back at
    once, and the run ends as chatter.

    **Arguments:**

    - `found`: at this instant.
    - `mode`: modes before.
    - `still`: elements that may stick or change direction.
    - `at_limit`: sticking elements that have reached a limit, and slip in the direction of their load.
    """
    found = jax.tree.map(_constant, found)
    n = mode.shape[0]
    wider = 1.0 + 16.0 * float(jnp.finfo(mode.dtype).eps)
    load = jnp.sign(contact_forces(found, mode))
    mode = jnp.where(still, jnp.where(at_limit, load, jnp.zeros_like(mode)), mode)
    scale = 1e-6 * jnp.max(jnp.abs(found.coupling) * jnp.maximum(found.upper, found.lower)[None, :], axis=1)

    def settle(i: Array, mode: Array) -> Array:
        force = contact_forces(found, mode)
        limit = jnp.where(force > 0, found.upper, found.lower)
        least = float(jnp.finfo(limit.dtype).tiny)
        use = jnp.where(mode == 0, jnp.abs(force) / jnp.maximum(limit, least), 0.0)
        worst = (use == jnp.max(use)) & (use > wider)
        acceleration = found.base - jnp.sum(found.coupling * force[None, :], axis=1)
        # Where nothing is consistent, the last word is rather a slip that ends at once, which shows as chatter, than a
        # stick above its limit.
        against = still & (mode * acceleration < -scale) & ~jnp.any(worst) & (i < 3 * n)
        return jnp.where(worst, jnp.sign(force), jnp.where(against, jnp.zeros_like(mode), mode))

    return settle(jnp.asarray(3), mode) if n == 1 else jax.lax.fori_loop(0, 4 * n, settle, mode)


def stop_slip(found: Contact, qd: Float[Array, " dof"], sticks: Bool[Array, " n"]) -> Float[Array, " dof"]:
    """Velocities with the slip of the sticking elements taken away, by the smallest impulses that do."""
    impulse = _multipliers(found, jnp.where(sticks, found.v, 0.0), sticks)
    return qd - jnp.sum(found.reach * impulse[:, None], axis=0)
