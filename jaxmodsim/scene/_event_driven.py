"""Friction elements whose forces depend on the accelerations: exact stick and slip, and loads that are reactions.

Exact elements have a mode: +1 or -1, slip in that direction, or 0, stick. With the directions D_i = d along_i/dq the
slip accelerations are `a = base - A f`, `A_ij = D_i W D_j`, where W gives the accelerations of a generalised force
within the constraints, `base` is what they would be without these elements and f are their forces. In slip f follows
from the law; in stick it is the multiplier that makes `a_i = 0`.

A load that is the reaction of a constraint depends on f in turn: `n = n0 - fall f` for the normal forces n. Then slip
forces are coefficients times n, and everything is solved together.
"""

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core.lu import factor_lu
from .._core.semidefinite import solve_semidefinite
from .._core.shapes import PerDof, Scalar
from .forces._friction import Friction

# Rounding units in the load of a sticking element, of its limits.
_LOAD_ROUNDING = 100.0

_constant = jax.lax.stop_gradient


class Loads(NamedTuple):
    """Constraints that load friction elements; k of them.

    - `on`: 1 where element i is loaded by constraint k, shape `[n, k]`.
    - `normal`: normal forces without the elements [N], shape `[k]`; negative ones pull.
    - `fall`: what unit forces of the elements take off the normal forces, shape `[k, n]`.
    - `pulls`: -1 for constraints whose friction is as large when they pull, 0 for those that can only push.
    """

    on: Float[Array, "n k"]
    normal: Float[Array, " k"]
    normal_coupling: Float[Array, "k n"]
    pulls: Float[Array, " k"]


class FrictionElements(NamedTuple):
    """The friction elements at one state, n of them; those without a mode come last.

    - `v`: slip velocities [m/s]; zero for elements without a mode.
    - `base`: slip accelerations without these elements [m/s^2].
    - `coupling`: A [1/kg].
    - `reach`: rows `W D_i`, the accelerations that a unit force takes away.
    - `forward`, `backward`: forces in slip towards either direction, at `v` [N, or per newton of load].
    - `upper`, `lower`: limits of stick against a load towards either direction, >= 0 [N, or per newton of load].
    - `loads`: None where no load is a reaction.
    """

    v: Float[Array, " n"]
    free_slip_acceleration: Float[Array, " n"]
    delassus: Float[Array, "n n"]
    minv_jt: Float[Array, "n dof"]
    forward: Float[Array, " n"]
    backward: Float[Array, " n"]
    upper: Float[Array, " n"]
    lower: Float[Array, " n"]
    loads: Loads | None


class FrictionForces(NamedTuple):
    """Forces in given modes.

    - `force`: friction forces [N].
    - `upper`, `lower`: limits of stick [N].
    - `margin`: what is left of the uniqueness of loads that are reactions: 1 without friction, never more, and not
      positive where there is no solution, or more than one.
    """

    force: Float[Array, " n"]
    upper: Float[Array, " n"]
    lower: Float[Array, " n"]
    margin: Scalar


def contact(
    elements: list[Friction],
    leaning: list[PerDof],
    respond: Callable[[Array], Array],
    floor: Callable[[Array], Array] | None,
    loads: Callable[[Float[Array, "n dof"]], Loads | None],
    t: Scalar,
    q: PerDof,
    qd: PerDof,
    params: object,
    qdd: PerDof,
) -> FrictionElements:
    """What the elements see at one state, where the accelerations without them are `qdd`.

    **Arguments:**

    - `elements`: those with a mode.
    - `leaning`: of those without one, loaded by a reaction, what they take from the generalised forces per newton.
    - `respond`: accelerations of a generalised force, within the constraints.
    - `floor`: of a direction the least mobility [1/kg] that rounding can tell from none; None where nothing cancels.
    - `loads`: the `Loads` from the generalised forces that unit forces of all elements take away.
    """
    rows = [*(element.direction(q, params) for element in elements), *leaning]
    reach = [respond(row) for row in rows]
    slip = [element.slip_and_rate(t, q, qd, qdd, params) for element in elements]
    given = [element.load(t, q, qd, params) for element in elements]
    one, zero = jnp.ones_like(t), jnp.zeros_like(t)
    forces = [
        [element.slip_force(v, sign * one, load) for element, (v, _), load in zip(elements, slip, given, strict=True)]
        for sign in (1.0, -1.0)
    ]
    limits = [
        [element.static_limit(sign * one, load) for element, load in zip(elements, given, strict=True)]
        for sign in (1.0, -1.0)
    ]
    coupling = jnp.stack([jnp.stack([jnp.sum(row * each) for each in reach]) for row in rows])
    if floor is not None:
        # Where constraints leave a direction no mobility (a slider at its dead centre), no force holds it. Rounding may
        # leave a mobility of zero or less, which would look as if none were needed.
        coupling = coupling + jnp.diag(jnp.stack([floor(row) for row in rows]))
    return FrictionElements(
        jnp.stack([*(v for v, _ in slip), *(zero for _ in leaning)]),
        jnp.stack([*(a for _, a in slip), *(zero for _ in leaning)]),
        coupling,
        jnp.stack(reach),
        jnp.stack([*forces[0], *(one for _ in leaning)]),
        jnp.stack([*forces[1], *(one for _ in leaning)]),
        jnp.stack([*limits[0], *(one for _ in leaning)]),
        jnp.stack([*limits[1], *(one for _ in leaning)]),
        loads(jnp.stack(rows)),
    )


def solve_friction_forces(contacts: FrictionElements, mode: Float[Array, " modes"]) -> FrictionForces:
    """Friction forces [N] in the modes given: the slip force, or the multiplier of stick."""
    extra = contacts.v.shape[0] - mode.shape[0]
    mode = jnp.concatenate([mode, jnp.ones(extra, mode.dtype)]) if extra else mode
    sticks = mode == 0
    slipping = jnp.where(mode > 0, contacts.forward, contacts.backward)

    def settled(slipping: Array, base: Array | float) -> Array:
        drive = base - jnp.sum(contacts.delassus * jnp.where(sticks, 0.0, slipping)[None, :], axis=1)
        return jnp.where(sticks, _multipliers(contacts, drive, sticks), slipping)

    if contacts.loads is None:
        return FrictionForces(
            settled(slipping, contacts.free_slip_acceleration),
            contacts.upper,
            contacts.lower,
            jnp.ones_like(contacts.v[0]),
        )
    on, fall = contacts.loads.on, contacts.loads.normal_coupling
    count = on.shape[1]
    loaded = jnp.sum(on, axis=1)
    fixed = settled(jnp.where(loaded > 0, 0.0, slipping), contacts.free_slip_acceleration)
    per_load = jnp.stack([settled(on[:, k] * slipping, 0.0) for k in range(count)])
    normal = contacts.loads.normal - jnp.sum(fall * fixed[None, :], axis=1)
    gain = jnp.sum(fall[:, None, :] * per_load[None, :, :], axis=2)
    load, margin = _loads(normal, gain, contacts.loads.pulls)
    factor = jnp.where(loaded > 0, jnp.sum(on * load[None, :], axis=1), 1.0)
    force = fixed + jnp.sum(per_load * load[:, None], axis=0)
    return FrictionForces(force, factor * contacts.upper, factor * contacts.lower, margin)


def _loads(
    normal: Float[Array, " k"], gain: Float[Array, "k k"], pulls: Float[Array, " k"]
) -> tuple[Float[Array, " k"], Scalar]:
    """Solve `n + gain load(n) = normal` with `load(n) = n` for n > 0 and `pulls n` otherwise; returns loads and margin.

    The margin is the smallest determinant of `I + gain S` over all slopes S. The determinant is linear in each slope,
    so if it is positive at the ends of their ranges it is so in between, and then the solution is unique (J. Rohn,
    Systems of linear interval equations, Linear Algebra and its Applications 126:39, 1989).
    """
    k = normal.shape[0]
    slope = jnp.where(normal > 0, 1.0, pulls)
    if k == 1:
        load = slope * normal / (1.0 + gain[0] * slope)
        return load, jnp.minimum(1.0 + gain[0, 0], 1.0 + gain[0, 0] * pulls[0])

    def rows(slope: Array) -> list[list[Array]]:
        return [[gain[i, j] * slope[j] + (1.0 if i == j else 0.0) for j in range(k)] for i in range(k)]

    signed = normal
    for _ in range(2 * k):  # Newton's iteration on a piecewise linear function
        signed = jnp.stack(factor_lu(rows(_constant(slope)), pivot=True)([normal[i] for i in range(k)]))
        slope = jnp.where(signed > 0, 1.0, pulls)
    corners = [jnp.stack(each) for each in product(*((jnp.ones_like(x), x) for x in pulls))]
    margin = jnp.min(jnp.stack([_determinant(rows(corner)) for corner in corners]))
    return slope * signed, margin


def _determinant(rows: list[list[Array]]) -> Array:
    if len(rows) == 1:
        return rows[0][0]
    signs = [1.0 if j % 2 == 0 else -1.0 for j in range(len(rows))]
    minors = [_determinant([row[:j] + row[j + 1 :] for row in rows[1:]]) for j in range(len(rows))]
    return jnp.sum(jnp.stack([s * a * m for s, a, m in zip(signs, rows[0], minors, strict=True)]))


def _multipliers(
    contacts: FrictionElements, drive: Float[Array, " n"], sticks: Bool[Array, " n"]
) -> Float[Array, " n"]:
    """Forces of the sticking elements that take their slip accelerations away; others get zero.

    Where sticking elements are redundant (two on one coordinate), the equations leave the share of each open. The one
    with the smallest sum of `f_i^2/limit_i` is taken: elements in parallel then share in proportion to their
    limits and reach them together.
    """
    weight = 0.5 * (contacts.upper + contacts.lower)
    largest = jnp.max(weight)
    weight = jnp.maximum(weight / jnp.where(largest > 0, largest, 1.0), 1e-6)
    return solve_semidefinite(contacts.delassus, drive, jnp.sqrt(jnp.where(largest > 0, weight, 1.0)), sticks)


def contact_guards(
    contacts: FrictionElements,
    forces: FrictionForces,
    mode: Float[Array, " modes"],
    rest: Scalar,
    tolerances: tuple[Array, Array],
) -> tuple[Float[Array, " modes"], Float[Array, " modes"]]:
    """One guard for each element with a mode, positive while its mode holds, and by how much each may be wrong.

    In stick `(upper - f)(lower + f)/(upper + lower)` [N], which falls through zero at either limit with the slope of
    the force, and may be wrong by the relative one of `tolerances` of its limits; in slip the velocity in its direction
    [m/s], and the absolute one. What differs by rounding must not flicker: the limits are 16 rounding units further
    out, and a slip has to turn by `rest` [m/s] before it ends (an element may be in slip, at its limit, while others
    hold it).
    """
    n, (rtol, atol) = mode.shape[0], tolerances
    force, upper, lower = (x[:n] for x in forces[:3])
    eps = float(jnp.finfo(force.dtype).eps)
    wider = 1.0 + 16.0 * eps
    span = upper + lower
    inside = (wider * upper - force) * (wider * lower + force) / jnp.where(span > 0, span, 1.0)
    resolved = jnp.maximum(rtol, _LOAD_ROUNDING * eps) * span
    return jnp.where(mode == 0, inside, mode * contacts.v[:n] + rest), jnp.where(mode == 0, resolved, atol)


def stick_violation(forces: FrictionForces, mode: Float[Array, " modes"]) -> Float[Array, " modes"]:
    """By how much the force of each sticking element exceeds its limit, in limits; 0 in slip."""
    n = mode.shape[0]
    force, upper, lower = (x[:n] for x in forces[:3])
    limit = jnp.where(force > 0, upper, lower)
    excess = (jnp.abs(force) - limit) / jnp.where(limit > 0, limit, 1.0)
    return jnp.where(mode == 0, excess, 0.0)


def next_modes(
    contacts: FrictionElements,
    mode: Float[Array, " modes"],
    still: Bool[Array, " modes"],
    at_limit: Bool[Array, " modes"],
) -> Float[Array, " modes"]:
    """Modes after an instant at which the elements `still` have no slip velocity; the others go on as they are.

    All of them stick if they can. If limits are exceeded, the element that exceeds its own by the largest factor
    slips in the direction of its load, and the rest is solved again. An element that would then be accelerated
    against its direction sticks again. Without stiction the modes that satisfy everything are unique, and these result;
    with it there may be several, and the search is a heuristic: where it fails, an element slips that is pushed back at
    once, and the run ends as chatter.

    **Arguments:**

    - `contacts`: at this instant.
    - `mode`: modes before.
    - `still`: elements that may stick or change direction.
    - `at_limit`: sticking elements that have reached a limit, and slip in the direction of their load.
    """
    contacts = jax.tree.map(_constant, contacts)
    n = mode.shape[0]
    wider = 1.0 + 16.0 * float(jnp.finfo(mode.dtype).eps)
    before = solve_friction_forces(contacts, mode)
    load = jnp.sign(before.force[:n])
    mode = jnp.where(still, jnp.where(at_limit, load, jnp.zeros_like(mode)), mode)
    scale = 1e-6 * jnp.max(jnp.abs(contacts.delassus) * jnp.maximum(before.upper, before.lower)[None, :], axis=1)[:n]

    def settle(i: Array, mode: Array) -> Array:
        all_forces, upper, lower, _ = solve_friction_forces(contacts, mode)
        force = all_forces[:n]
        limit = jnp.where(force > 0, upper[:n], lower[:n])
        least = float(jnp.finfo(limit.dtype).tiny)
        use = jnp.where(mode == 0, jnp.abs(force) / jnp.maximum(limit, least), 0.0)
        worst = (use == jnp.max(use)) & (use > wider)
        acceleration = (contacts.free_slip_acceleration - jnp.sum(contacts.delassus * all_forces[None, :], axis=1))[:n]
        # Where nothing is consistent, the last word is rather a slip that ends at once, which shows as chatter, than a
        # stick above its limit.
        against = still & (mode * acceleration < -scale) & ~jnp.any(worst) & (i < 3 * n)
        return jnp.where(worst, jnp.sign(force), jnp.where(against, jnp.zeros_like(mode), mode))

    return settle(jnp.asarray(3), mode) if n == 1 else jax.lax.fori_loop(0, 4 * n, settle, mode)


def stop_slip(contacts: FrictionElements, qd: PerDof, sticks: Bool[Array, " modes"]) -> PerDof:
    """Velocities with the slip of the sticking elements taken away, by the smallest impulses that do."""
    sticks = jnp.concatenate([sticks, jnp.zeros(contacts.v.shape[0] - sticks.shape[0], bool)])
    impulse = _multipliers(contacts, jnp.where(sticks, contacts.v, 0.0), sticks)
    return qd - jnp.sum(contacts.minv_jt * impulse[:, None], axis=0)
