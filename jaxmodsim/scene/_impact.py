"""Impacts: velocities and modes after the instant at which gaps close.

Contacts that touch receive impulses p along their gaps; friction elements that they load receive impulses r against
their slip. The velocities w of gaps and v of slips change by `(w, v)(after) = (w, v) + A (p, -r)`, where A maps unit
impulses to velocities within the bilateral constraints. Each contact has `p >= 0`, `w(after) + e w >= 0`, one of the
two zero. Each friction element obeys Coulomb's law of impulses: stick, `v(after) = 0` and `-mu p <= r <= mu p`, or
slip, `r = +-mu p` with the sign of `v(after)`. The coefficient mu is that of the law in slip at zero velocity. This is
a complementarity problem (Moreau 1988; Pfeiffer and Glocker 1996, chapter 8), solved by trying all combinations.
`Poisson` solves it twice, in compression and in expansion.
"""

from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core.arrays import PerDof, Scalar
from .._core.cholesky import factor_positive_definite, solve_balanced, solve_semidefinite, solve_shifted
from .._core.lu import factor_matrix
from ..mechanics import LinearizedConstraints, Poisson, linearize_constraints, motion_equations, parts, rates
from ._scene import Scene

# A gap or a slip has no velocity below this number of rounding units of the velocities of all coordinates.
_ROUNDING = 64.0

_constant = jax.lax.stop_gradient


class _Struck(NamedTuple):
    """The mechanism at an impact: n contacts, then m friction elements that they load.

    - `delassus`: A [1/kg], shape `[n + m, n + m]`, for impulses towards larger gaps and slips.
    - `touches`: contacts that are closed or struck, shape `[n]`.
    - `loads`: 1 where a contact loads an element, shape `[m, n]`.
    - `forward`, `backward`: coefficients of friction against slip in either direction, >= 0, shape `[m]`.
    """

    delassus: Float[Array, "k k"]
    touches: Bool[Array, " n"]
    loads: Float[Array, "m n"]
    forward: Float[Array, " m"]
    backward: Float[Array, " m"]


def impact(
    t: Scalar,
    q: PerDof,
    qd: PerDof,
    scene: Scene,
    closed: Float[Array, " contacts"],
    fired: Bool[Array, " contacts"],
    rest: Scalar,
    bounces: Bool[Array, " contacts"],
    dense: Bool[Array, ""],
) -> tuple[PerDof, Float[Array, " contacts"], Bool[Array, " elements"]]:
    """Velocities and modes after the instant at which the contacts `fired`.

    Closed contacts that fired open: their multiplier has fallen to zero. Open contacts that fired are struck. Struck
    contacts whose gap has no velocity afterwards are closed.

    **Arguments:**

    - `t`, `q`, `qd`, `scene`: the instant; the scene is that of time `t`.
    - `closed`: modes before.
    - `fired`: contacts whose guards fired.
    - `rest`: speed of rest [m/s].
    - `bounces`: which contacts rebound.
    - `dense`: whether impacts have accumulated. The remaining velocity of a gap, of either sign, is then below what
      time resolves, and is removed.

    **Returns:**

    Velocities, modes of the contacts, and which friction elements of `Scene.event_driven` the impact has stopped.
    """
    contacts, params, n = tuple(scene.contacts.values()), scene.params, len(scene.contacts)
    mass = motion_equations(scene.lagrangian, t, q, qd, params).mass
    gaps = linearize_constraints(contacts, t, q, qd, params, mass)
    rubbing = scene.impact_friction
    # Velocities of gaps include prescribed motion.
    w = jnp.concatenate([each.rate(t, q, qd, params) for each in contacts])
    touches = jnp.where(closed > 0, ~fired, fired)
    struck, rows, reach = _struck(t, (q, qd), scene, mass, gaps, touches)
    v = jnp.concatenate([w, *(jnp.reshape(x.slip(t, q, qd, params), (1,)) for x in rubbing.values())])
    e, none = jnp.stack([each.coefficient.astype(w.dtype) for each in contacts]), jnp.zeros_like(w)
    if any(isinstance(each.restitution, Poisson) for each in contacts):
        squeeze = _impulses(struck, v, none)
        halfway = v + jnp.sum(struck.delassus * squeeze[None, :], axis=1)
        impulse = squeeze + _impulses(struck, halfway, jnp.where(bounces, e, 0.0) * squeeze[:n])
    else:
        aimed = (1.0 + jnp.where(bounces & (closed == 0), e, 0.0)) * w
        impulse = _impulses(struck, jnp.concatenate([aimed, v[n:]]), none)
    normal = solve_semidefinite(struck.delassus[:n, :n], jnp.where(touches, -w, 0.0), jnp.ones_like(w), touches)
    impulse = jnp.where(dense, jnp.concatenate([normal, jnp.zeros_like(v[n:])]), impulse)
    after = v + jnp.sum(struck.delassus * impulse[None, :], axis=1)
    rounding = _ROUNDING * float(jnp.finfo(w.dtype).eps) * jnp.sum(jnp.abs(rows * qd[None, :]), axis=1)
    # A closed gap may have a velocity that is rounding of larger ones before.
    drift = jnp.concatenate([jnp.where((closed > 0) & ~fired, jnp.abs(w), 0.0), jnp.zeros_like(v[n:])])
    still = _constant(jnp.abs(after) <= jnp.maximum(jnp.maximum(rest, rounding), drift))
    # An element that an impact begins to load had the mode of one without load.
    loaded = jnp.any((struck.loads > 0) & (touches & (closed == 0))[None, :], axis=1)
    stopped = still[n:] & (loaded | _constant(jnp.abs(v[n:]) > jnp.maximum(rest, rounding[n:])))
    of_each = dict(zip(rubbing, stopped, strict=True))
    closes = touches & still[:n]
    qd = qd + jnp.sum(reach * impulse[:, None], axis=0)
    if rubbing:
        # The rounding error in the velocity of a gap that closes is large against the admissible error of a step.
        left = jnp.concatenate([each.rate(t, q, qd, params) for each in contacts])
        rest_of = solve_semidefinite(struck.delassus[:n, :n], jnp.where(closes, -left, 0.0), jnp.ones_like(w), closes)
        qd = qd + jnp.sum(reach[:n] * rest_of[:, None], axis=0)
    return (
        qd,
        jnp.where(closes, 1.0, none),
        jnp.asarray([of_each.get(name, False) for name in scene.event_driven], bool),
    )


def impact_work(
    t: Scalar, q: PerDof, qd: PerDof, after: PerDof, scene: Scene, mode: Float[Array, " modes"]
) -> dict[str, Scalar]:
    """Work of moving surfaces in an impact.

    Constraints, gaps and slips have the velocities `J qd + c`, in which c is the motion of walls and belts. The
    impulses p satisfy `J M^-1 J^T p = J (after - qd)`, so the surfaces do the work `-p c`.

    **Arguments:**

    - `t`, `q`, `scene`: the instant; the scene is that of time `t`.
    - `qd`, `after`: velocities before and after it.
    - `mode`: modes in which the contacts that touch are closed.

    **Returns:**

    The work [J] by the names of constraints and of friction elements.
    """
    closed = dict(zip(scene.contacts, scene.split_modes(mode)[1], strict=True))
    held, params = scene.constraints_in(mode), scene.params
    rubbing = [(closed[each.load_constraint or ""], each) for each in scene.impact_friction.values()]

    def velocities(qd: PerDof) -> Float[Array, " k"]:
        slips = [jnp.reshape(loaded * each.slip(t, q, qd, params), (1,)) for loaded, each in rubbing]
        return jnp.concatenate([rates(held, t, q, params)(qd), *slips])

    rows, c = jax.jacfwd(velocities)(qd), velocities(jnp.zeros_like(qd))
    mass = motion_equations(scene.lagrangian, t, q, qd, params).mass
    matrix = jnp.sum(rows[:, :, None] * factor_positive_definite(mass)(rows.T)[None, :, :], axis=1)
    work = -c * solve_balanced(matrix, jnp.sum(rows * (after - qd)[None, :], axis=1))
    of_constraints = [jnp.sum(work[part]) for part in parts(held, t, q, qd, params)]
    of_friction = work[len(c) - len(rubbing) :]
    return dict(zip((*scene.constraint_names, *scene.impact_friction), (*of_constraints, *of_friction), strict=True))


def _struck(
    t: Scalar,
    state: tuple[PerDof, PerDof],
    scene: Scene,
    mass: Float[Array, "dof dof"],
    gaps: LinearizedConstraints,
    touches: Bool[Array, " n"],
) -> tuple[_Struck, Float[Array, "k dof"], Float[Array, "k dof"]]:
    """The struck mechanism, its rows d(w, v)/dqd, and the velocities of unit impulses."""
    (q, qd), rows, reach, rubbing = state, gaps.rows, gaps.minv_jt, scene.impact_friction
    if rubbing:
        along = jnp.stack([each.direction(q, scene.params) for each in rubbing.values()])
        rows, reach = (
            jnp.concatenate([rows, along]),
            jnp.concatenate([reach, factor_positive_definite(mass)(along.T).T]),
        )
    if scene.bilateral:
        held = linearize_constraints(scene.bilateral, t, q, qd, scene.params, mass)
        reach = held.respond(reach.T).T
    delassus = jnp.sum(rows[:, None, :] * reach[None, :, :], axis=2)
    size = [each.per_multiplier(t, q, scene.params) for each in scene.contacts.values()]
    zero = jnp.zeros_like(t)
    mu = [[abs(x.slip_force(zero, side * jnp.ones_like(t), None)) for x in rubbing.values()] for side in (1.0, -1.0)]
    loads = [
        [length if name == each.load_constraint else zero for name, length in zip(scene.contacts, size, strict=True)]
        for each in rubbing.values()
    ]
    forward, backward = (jnp.asarray(side, q.dtype) for side in mu)
    of = jnp.reshape(jnp.asarray(loads, q.dtype), (len(rubbing), len(size)))
    return _Struck(delassus, touches, of, forward, backward), rows, reach


def _impulses(struck: _Struck, v: Float[Array, " k"], least: Float[Array, " n"]) -> Float[Array, " k"]:
    """Impulses (p, -r) from velocities `v`, those of gaps with restitution; `p >= least` instead of zero.

    This tries all combinations, and takes the one that violates the conditions least. Without friction, and with a
    positive definite matrix, exactly one violates none (Cottle, Pang, Stone: The Linear Complementarity Problem, 1992,
    theorem 3.3.7). With friction there may be several; this takes the first in the order stick, slip forward, slip
    backward. Redundant contacts get the smallest impulses.
    """
    n, m = struck.loads.shape[1], struck.loads.shape[0]
    if m == 0 and n == 1:
        return jnp.maximum(_solve(struck, v, least, jnp.ones(1, v.dtype)), least)
    combinations = list(product(*n * ((0.0, 1.0),), *m * ((0.0, 1.0, -1.0),)))
    tried = jnp.asarray(np.array(combinations), v.dtype)
    at = _constant(struck), _constant(v), _constant(least)
    worst = jax.lax.map(lambda each: _violation(at[0], at[1], at[2], each), tried)
    return _solve(struck, v, least, tried[jnp.argmin(worst)])


def _solve(
    struck: _Struck, v: Float[Array, " k"], least: Float[Array, " n"], combination: Float[Array, " k"]
) -> Float[Array, " k"]:
    """Impulses for a combination: contacts at 1 push until their gaps rest, elements stick at 0 or slip at +-1."""
    a, n, m = struck.delassus, struck.loads.shape[1], struck.loads.shape[0]
    pushes, slips = combination[:n] > 0, combination[n:]
    given = jnp.concatenate([jnp.where(pushes, 0.0, least), jnp.zeros(m, v.dtype)])
    rhs = -v - jnp.sum(a * given[None, :], axis=1)
    if m == 0:
        return given + solve_semidefinite(a, jnp.where(pushes, rhs, 0.0), jnp.ones_like(v), pushes & struck.touches)
    free = jnp.concatenate([pushes & struck.touches, slips == 0])
    # Slip friction is the impulse of its contact times a coefficient: its columns are added to those of contacts.
    share = jnp.where(slips > 0, -struck.forward, jnp.where(slips < 0, struck.backward, 0.0))[:, None] * struck.loads
    given = given.at[n:].set(jnp.sum(share * given[None, :n], axis=1))
    rhs = -v - jnp.sum(a * given[None, :], axis=1)
    spread = jnp.eye(n + m, dtype=v.dtype).at[n:, :n].set(share)
    both = free[:, None] & free[None, :]
    matrix = jnp.where(both, jnp.sum(a[:, :, None] * spread[None, :, :], axis=1), 0.0)
    scale = jnp.max(jnp.abs(matrix))
    scale = jnp.where(scale > 0, scale, 1.0)
    # As `solve_semidefinite`, for a matrix that friction makes unsymmetric.
    solution = solve_shifted(matrix / scale, jnp.where(free, rhs, 0.0) / scale, free, factor_matrix)
    solution = jnp.where(free, solution, 0.0)
    return given + jnp.sum(spread * solution[None, :], axis=1)


def _violation(
    struck: _Struck, v: Float[Array, " k"], least: Float[Array, " n"], combination: Float[Array, " k"]
) -> Scalar:
    """The largest velocity by which a combination violates the conditions."""
    n, slips = struck.loads.shape[1], combination[struck.loads.shape[1] :]
    impulse = _solve(struck, v, least, combination)
    after = v + jnp.sum(struck.delassus * impulse[None, :], axis=1)
    mobility = jnp.diagonal(struck.delassus)
    pulls = (least - impulse[:n]) * mobility[:n]
    worst = jnp.maximum(jnp.max(pulls), jnp.max(jnp.where(struck.touches, -after[:n], 0.0)))
    if not slips.size:
        return worst
    load = jnp.sum(struck.loads * impulse[None, :n], axis=1)
    friction = -impulse[n:]
    beyond = jnp.maximum(friction - struck.forward * load, -friction - struck.backward * load) * mobility[n:]
    touched = jnp.sum(struck.loads * jnp.where(struck.touches, 1.0, 0.0)[None, :], axis=1) > 0
    misses = jnp.where(slips == 0, beyond, jnp.where(touched, -slips * after[n:], 0.0))
    return jnp.maximum(worst, jnp.max(misses))
