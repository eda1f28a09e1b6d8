"""Friction elements whose forces depend on the accelerations: exact stick and slip, and loads that are reactions.

Exact elements have a mode: +1 or -1, slip in that direction, or 0, stick. With the directions D_i = d along_i/dq the
slip accelerations are `a = base - A f`, `A_ij = D_i W D_j`, where W gives the accelerations of a generalised force
within the constraints, `base` is what they would be without these elements and f are their forces. In slip f follows
from the law; in stick it is the multiplier that makes `a_i = 0`.

An element whose slip is a vector has a row for each component. Its mode is zero in stick, and in slip a velocity: the
slip at the last event, for it is renewed as slip turns, falls and grows; see `Friction.slip_force_in_plane`.

A load that is the reaction of a constraint depends on f in turn: `n = n0 - fall f` for the normal forces n. Then slip
forces are coefficients times n, and everything is solved together.
"""

from collections.abc import Callable
from itertools import accumulate, product
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core.arrays import PerDof, Scalar
from .._core.cholesky import solve_semidefinite
from .._core.lu import factor_lu
from .._core.safe import safe_norm
from .forces._friction import Friction

# Rounding units in the load of a sticking element, of its limits.
_LOAD_ROUNDING = 100.0

# The velocity in the mode of slip in a plane is renewed where slip has fallen to, or grown to, so much of it ...
_SHRUNK, _GROWN = 0.1, 1e4
# ... but is at least so many speeds of none: the direction is rounded off below a part of it, which must not be below
# what the error control resolves.
_SLOWEST = 1e6
# Speeds of slip in a plane that friction takes away in so many rounding units of time count as none.
_INSTANT = 1e-3
# Slip in a plane has ended where it goes back past its direction, and is not faster than so many speeds of none.
_ENDED = 1e5

_constant = jax.lax.stop_gradient


def mode_numbers(modes: Float[Array, "*time modes"], widths: tuple[int, ...]) -> Float[Array, "*time things"]:
    """Modes in one number each: of slip in a plane, whose mode has as many numbers as `widths` says, one."""
    if all(width == 1 for width in widths):
        return modes
    stops = list(accumulate(widths))
    parts = [modes[..., stop - width : stop] for stop, width in zip(stops, widths, strict=True)]
    return jnp.stack([x[..., 0] if x.shape[-1] == 1 else jnp.any(x != 0, axis=-1) * 1.0 for x in parts], axis=-1)


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


class FrictionElements(eqx.Module):
    """The friction elements at one state, of n rows in all; those without a mode come last.

    - `v`: slip velocities [m/s]; zero for elements without a mode.
    - `free_slip_acceleration`: slip accelerations without these elements [m/s^2].
    - `delassus`: A [1/kg].
    - `minv_jt`: rows `W D_i`, the accelerations that a unit force takes away.
    - `forward`, `backward`: forces in slip towards either direction, at `v` [N, or per newton of load]. In rows of a
      plane the magnitude with which slip begins, and the force in slip in the mode given.
    - `upper`, `lower`: limits of stick against a load towards either direction, >= 0 [N, or per newton of load].
    - `loads`: None where no load is a reaction.
    - `planes`: first row, and row after the last, of each element whose slip is a vector.
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
    planes: tuple[tuple[int, int], ...] = eqx.field(static=True, default=())

    def in_planes(self, rows: Array, of_plane: Callable[[slice], Array]) -> Array:
        """`rows`, with those of each element in a plane replaced by what `of_plane` gives, a number or one a row."""
        parts, at = [], 0
        for start, stop in self.planes:
            parts += [rows[at:start], jnp.broadcast_to(of_plane(slice(start, stop)), (stop - start,))]
            at = stop
        return jnp.concatenate([x for x in (*parts, rows[at:]) if x.shape[0]]) if parts else rows

    @property
    def parts(self) -> list[int | slice]:
        """The row of each element; of one in a plane its rows."""
        stops, parts, at = dict(self.planes), [], 0
        while at < self.v.shape[0]:
            stop = stops.get(at, at + 1)
            parts.append(slice(at, stop) if at in stops else at)
            at = stop
        return parts

    def in_rows(self, values: Bool[Array, " elements"]) -> Bool[Array, " modes"]:
        """What there is one of for each element with a mode, in each of its rows."""
        if not self.planes:
            return values
        parts = self.parts[: values.shape[0]]
        return jnp.concatenate(
            [jnp.broadcast_to(x, self.v[part].shape or (1,)) for x, part in zip(values, parts, strict=True)]
        )

    def magnitude(self, x: Float[Array, " rows"]) -> Float[Array, " rows"]:
        """Of each element, in each of its rows."""
        return self.in_planes(jnp.abs(x), lambda part: safe_norm(x[part]))

    def sticks(self, mode: Float[Array, " modes"]) -> Bool[Array, " modes"]:
        """Which rows are of elements that stick."""
        return self.in_planes(mode == 0, lambda part: jnp.all(mode[part] == 0))

    def slipping(self, v: Float[Array, " modes"], rest: Scalar) -> Float[Array, " modes"]:
        """Modes of slip with the velocities `v`; `rest` is the speed [m/s] that counts as none."""
        return self.in_planes(
            jnp.sign(v), lambda part: jnp.maximum(_slowest(rest), safe_norm(v[part])) * _unit(v[part])
        )

    def beginning(self, load: Float[Array, " modes"], rest: Scalar) -> Float[Array, " modes"]:
        """Modes of slip that begins under these loads."""
        return self.in_planes(jnp.sign(load), lambda part: _slowest(rest) * _unit(load[part]))


def _slowest(rest: Scalar) -> Scalar:
    """The least speed [m/s] of a mode."""
    return jnp.maximum(_SLOWEST * rest, float(jnp.finfo(rest.dtype).tiny) ** 0.5)


def _unit(x: Float[Array, " components"]) -> Float[Array, " components"]:
    """Direction of a vector; zero for zero."""
    size = safe_norm(x)
    return x / jnp.where(size > 0, size, 1.0)


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


def assemble_friction(
    friction: list[Friction],
    leaning: list[PerDof],
    respond: Callable[[Array], Array],
    floor: Callable[[Array], Array] | None,
    loads: Callable[[Float[Array, "n dof"], tuple[int, ...]], Loads | None],
    t: Scalar,
    q: PerDof,
    qd: PerDof,
    params: object,
    qdd: PerDof,
    mode: Float[Array, " modes"],
) -> FrictionElements:
    """What the elements see at one state, where the accelerations without them are `qdd`.

    **Arguments:**

    - `friction`: those with a mode.
    - `mode`: of elements in a plane the forces in slip depend on it.
    - `leaning`: of those without one, loaded by a reaction, what they take from the generalised forces per newton.
    - `respond`: accelerations of a generalised force, within the constraints.
    - `floor`: of a direction the least mobility [1/kg] that rounding can tell from none; None where nothing cancels.
    - `loads`: the `Loads` from the generalised forces that unit forces of all elements take away, and the number of
      rows of each.
    """
    slip = [element.slip_and_rate(t, q, qd, qdd, params) for element in friction]
    given = [element.load(t, q, qd, params) for element in friction]
    one, zero = jnp.ones_like(t), jnp.zeros_like(t)
    directions: list[PerDof] = []
    rows: list[tuple[Array, ...]] = []
    planes: list[tuple[int, int]] = []
    widths: list[int] = []
    for element, (v, rate), load in zip(friction, slip, given, strict=True):
        upper, lower = (element.static_limit(sign * one, load) for sign in (1.0, -1.0))
        widths.append(max(1, v.size))
        if v.ndim == 0:
            directions.append(element.direction(q, params))
            forward, backward = (element.slip_force(v, sign * one, load) for sign in (1.0, -1.0))
            rows.append((v, rate, forward, backward, upper, lower))
            continue
        start, stop = len(rows), len(rows) + v.shape[0]
        planes.append((start, stop))
        directions += [*element.direction(q, params)]
        v, rate = element.stretch(v), element.stretch(rate)
        begins = element.slip_force(zero, one, load)
        forces = element.slip_force_in_plane(v, mode[start:stop] if mode.shape[0] else v, load)
        rows += [(v[i], rate[i], begins, forces[i], upper, lower) for i in range(v.shape[0])]
    directions += leaning
    rows += [(zero, zero, one, one, one, one) for _ in leaning]
    reach = [respond(row) for row in directions]
    coupling = jnp.stack([jnp.stack([jnp.sum(row * each) for each in reach]) for row in directions])
    if floor is not None:
        # Where constraints leave a direction no mobility (a slider at its dead centre), no force holds it. Rounding may
        # leave a mobility of zero or less, which would look as if none were needed.
        coupling = coupling + jnp.diag(jnp.stack([floor(row) for row in directions]))
    v, rate, *forces = (jnp.stack(column) for column in zip(*rows, strict=True))
    widths += [1] * len(leaning)
    loaded = loads(jnp.stack(directions), tuple(widths))
    return FrictionElements(v, rate, coupling, jnp.stack(reach), *forces, loads=loaded, planes=tuple(planes))


def solve_friction_forces(
    elements: FrictionElements, mode: Float[Array, " modes"], begins: Bool[Array, " modes"] | None = None
) -> FrictionForces:
    """Friction forces [N] in the modes given: the slip force, or the multiplier of stick.

    In a plane the slip force is that at the state; of the elements `begins` that with which a slip begins.
    """
    extra = elements.v.shape[0] - mode.shape[0]
    mode = jnp.concatenate([mode, jnp.ones(extra, mode.dtype)]) if extra else mode
    sticks = elements.sticks(mode)
    slipping = jnp.where(mode > 0, elements.forward, elements.backward)

    def in_plane(part: slice) -> Array:
        force = elements.backward[part]
        return force if begins is None else jnp.where(begins[part], elements.forward[part] * _unit(mode[part]), force)

    slipping = elements.in_planes(slipping, in_plane)

    def settled(slipping: Array, base: Array | float) -> Array:
        drive = base - jnp.sum(elements.delassus * jnp.where(sticks, 0.0, slipping)[None, :], axis=1)
        return jnp.where(sticks, _multipliers(elements, drive, sticks), slipping)

    if elements.loads is None:
        return FrictionForces(
            settled(slipping, elements.free_slip_acceleration),
            elements.upper,
            elements.lower,
            jnp.ones_like(elements.v[0]),
        )
    on, fall = elements.loads.on, elements.loads.normal_coupling
    count = on.shape[1]
    loaded = jnp.sum(on, axis=1)
    fixed = settled(jnp.where(loaded > 0, 0.0, slipping), elements.free_slip_acceleration)
    per_load = jnp.stack([settled(on[:, k] * slipping, 0.0) for k in range(count)])
    normal = elements.loads.normal - jnp.sum(fall * fixed[None, :], axis=1)
    gain = jnp.sum(fall[:, None, :] * per_load[None, :, :], axis=2)
    load, margin = _loads(normal, gain, elements.loads.pulls)
    factor = jnp.where(loaded > 0, jnp.sum(on * load[None, :], axis=1), 1.0)
    force = fixed + jnp.sum(per_load * load[:, None], axis=0)
    return FrictionForces(force, factor * elements.upper, factor * elements.lower, margin)


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
    elements: FrictionElements, drive: Float[Array, " n"], sticks: Bool[Array, " n"]
) -> Float[Array, " n"]:
    """Forces of the sticking elements that take their slip accelerations away; others get zero.

    Where sticking elements are redundant (two on one coordinate), the equations leave the share of each open. The one
    with the smallest sum of `f_i^2/limit_i` is taken: elements in parallel then share in proportion to their
    limits and reach them together.
    """
    weight = 0.5 * (elements.upper + elements.lower)
    largest = jnp.max(weight)
    weight = jnp.maximum(weight / jnp.where(largest > 0, largest, 1.0), 1e-6)
    return solve_semidefinite(elements.delassus, drive, jnp.sqrt(jnp.where(largest > 0, weight, 1.0)), sticks)


def friction_guards(
    elements: FrictionElements,
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

    In a plane f is the magnitude of the force. Of slip the first row is the velocity in the direction of the mode, less
    a part of the mode as long as that counts as a velocity, and the others are positive until it has grown.
    """
    n, (rtol, atol) = mode.shape[0], tolerances
    force, upper, lower = (x[:n] for x in forces[:3])
    force = elements.in_planes(force, lambda part: safe_norm(force[part]))
    eps = float(jnp.finfo(force.dtype).eps)
    wider = 1.0 + 16.0 * eps
    span = upper + lower
    inside = (wider * upper - force) * (wider * lower + force) / jnp.where(span > 0, span, 1.0)
    resolved = jnp.maximum(rtol, _LOAD_ROUNDING * eps) * span

    def in_plane(part: slice) -> Array:
        along, _, speed = _split(elements.v[part], mode[part])
        end = jnp.where(_ends(speed, rest), rest, -_SHRUNK * speed)
        return jnp.stack([along + end] + (part.stop - part.start - 1) * [_GROWN * speed - along])

    slip, sticks = elements.in_planes(mode * elements.v[:n] + rest, in_plane), elements.sticks(mode)
    return jnp.where(sticks, inside, slip), jnp.where(sticks, resolved, atol)


def speed_of_rest(elements: FrictionElements, forces: FrictionForces, rest: Scalar, t: Scalar) -> Scalar:
    """The speed [m/s] that counts as none: `rest`, and in planes no less than what time resolves of a slip's end."""
    if not elements.planes:
        return rest
    slows = jnp.max(jnp.sum(jnp.abs(elements.delassus) * forces.upper[None, :], axis=1))
    return jnp.maximum(rest, _INSTANT * float(jnp.finfo(t.dtype).eps) * jnp.abs(t) * _constant(slows))


def _split(v: Float[Array, " d"], mode: Float[Array, " d"]) -> tuple[Scalar, Scalar, Scalar]:
    """Component of a velocity in the direction of a mode, magnitude of the rest, and that of the mode."""
    speed, direction = safe_norm(mode), _unit(mode)
    along = jnp.sum(v * direction)
    return along, safe_norm(v - along * direction), speed


def _ends(speed: Scalar, rest: Scalar) -> Bool[Array, ""]:
    """Whether the next that happens to a slip that falls is its end, where the mode is of this speed."""
    return speed <= 1.01 * _slowest(rest)


def renew_slip(
    elements: FrictionElements, mode: Float[Array, " modes"], fired: Bool[Array, " modes"], rest: Scalar
) -> tuple[Float[Array, " modes"], Bool[Array, " modes"]]:
    """Modes with those of slips in planes that go on renewed, and which rows stop or break away.

    Scalar elements stay as they are.
    """
    v, stops = _constant(elements.v[: mode.shape[0]]), []
    for start, stop in elements.planes:
        part = slice(start, stop)
        _, across, speed = _split(v[part], mode[part])
        ended = fired[start] & _ends(speed, rest) & (across <= _ENDED * rest)
        stops.append(jnp.where(jnp.all(mode[part] == 0), jnp.any(fired[part]), ended))
    each = iter(stops)
    changes = elements.in_planes(fired, lambda _: next(each))
    turns = elements.in_planes(jnp.zeros_like(fired), lambda part: jnp.any(fired[part])) & ~changes
    return jnp.where(turns, elements.slipping(v, rest), mode), changes


def stick_violation(
    elements: FrictionElements, forces: FrictionForces, mode: Float[Array, " modes"]
) -> Float[Array, " modes"]:
    """By how much the force of each sticking element exceeds its limit, in limits; 0 in slip."""
    n = mode.shape[0]
    force, upper, lower = (x[:n] for x in forces[:3])
    limit = jnp.where(force > 0, upper, lower)
    excess = (elements.magnitude(force) - limit) / jnp.where(limit > 0, limit, 1.0)
    return jnp.where(elements.sticks(mode), excess, 0.0)


def next_modes(
    elements: FrictionElements,
    mode: Float[Array, " modes"],
    still: Bool[Array, " modes"],
    at_limit: Bool[Array, " modes"],
    rest: Scalar,
) -> Float[Array, " modes"]:
    """Modes after an instant at which the elements `still` have no slip velocity; the others go on as they are.

    All of them stick if they can. If limits are exceeded, the element that exceeds its own by the largest factor
    slips in the direction of its load, and the rest is solved again. An element that would then be accelerated
    against its direction sticks again. Without stiction the modes that satisfy everything are unique, and these result;
    with it there may be several, and the search is a heuristic: where it fails, an element slips that is pushed back at
    once, and the run ends as chatter.

    **Arguments:**

    - `elements`: at this instant.
    - `mode`: modes before.
    - `still`: elements that may stick or change direction.
    - `at_limit`: sticking elements that have reached a limit, and slip in the direction of their load.
    - `rest`: speed [m/s] that counts as none.
    """
    elements = jax.tree.map(_constant, elements)
    n = mode.shape[0]
    wider = 1.0 + 16.0 * float(jnp.finfo(mode.dtype).eps)
    before = solve_friction_forces(elements, mode)
    load = elements.beginning(before.force[:n], rest)
    mode = jnp.where(still, jnp.where(at_limit, load, jnp.zeros_like(mode)), mode)
    scale = 1e-6 * jnp.max(jnp.abs(elements.delassus) * jnp.maximum(before.upper, before.lower)[None, :], axis=1)[:n]

    def settle(i: Array, mode: Array) -> Array:
        all_forces, upper, lower, _ = solve_friction_forces(elements, mode, still)
        force = all_forces[:n]
        limit = jnp.where(force > 0, upper[:n], lower[:n])
        least = float(jnp.finfo(limit.dtype).tiny)
        use = jnp.where(elements.sticks(mode), elements.magnitude(force) / jnp.maximum(limit, least), 0.0)
        worst = (use == jnp.max(use)) & (use > wider)
        acceleration = (elements.free_slip_acceleration - jnp.sum(elements.delassus * all_forces[None, :], axis=1))[:n]
        in_direction = elements.in_planes(
            mode * acceleration, lambda part: jnp.sum(_unit(mode[part]) * acceleration[part])
        )
        # Where nothing is consistent, the last word is rather a slip that ends at once, which shows as chatter, than a
        # stick above its limit.
        against = still & (in_direction < -scale) & ~jnp.any(worst) & (i < 3 * n)
        return jnp.where(worst, elements.beginning(force, rest), jnp.where(against, jnp.zeros_like(mode), mode))

    alone = n == 1 or elements.planes == ((0, n),)
    return settle(jnp.asarray(3 * n), mode) if alone else jax.lax.fori_loop(0, 4 * n, settle, mode)


def stop_slip(elements: FrictionElements, qd: PerDof, sticks: Bool[Array, " modes"]) -> PerDof:
    """Velocities with the slip of the sticking elements taken away, by the smallest impulses that do."""
    sticks = jnp.concatenate([sticks, jnp.zeros(elements.v.shape[0] - sticks.shape[0], bool)])
    impulse = _multipliers(elements, jnp.where(sticks, elements.v, 0.0), sticks)
    return qd - jnp.sum(elements.minv_jt * impulse[:, None], axis=0)
