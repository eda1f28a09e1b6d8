"""Friction elements whose forces depend on the accelerations: exact stick and slip, and loads that are reactions.

An element with a scalar slip has one row, an element with a vector slip (a plane) one row for each component. With the
directions D_i = d along_i/dq of the rows the slip accelerations are `a = a_free - A f`. Here f are the friction forces,
a_free the accelerations without them, and `A_ij = D_i W D_j`, where W maps a generalised force to accelerations within
the constraints. In slip f follows from the law; in stick it is the multiplier that makes `a_i = 0`.

The mode of a scalar row is the sign of its slip: +1, -1, or 0 in stick. The mode of the rows of a plane is a reference
velocity: zero in stick, and in slip the slip velocity at its last event; see `Friction.slip_force_in_plane`.

A load that is the reaction of a constraint depends on f in turn: `n = n_free - C f` for the normal forces n. Then slip
forces are coefficients times n, and everything is solved together.
"""

from collections.abc import Callable
from itertools import accumulate
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core.arrays import PerDof, Scalar, apply_matrix
from .._core.cholesky import solve_semidefinite
from .._core.safe import safe_norm
from ._loads import solve_loads
from .forces._friction import Friction

# Least weight of an element among redundant ones, relative to the largest.
_LEAST_SHARE = 1e-2
# Scalar rows hold a plane in a direction where less than this power of the rounding unit of its mobility is left.
_HELD = 2.0 / 3.0
# Rounding units in the load of a sticking element, of its limits.
_LOAD_ROUNDING = 100.0

# A load of a sticking element from this part of its limit on is at the limit.
_AT_LIMIT = 1.0 - 1e-4
# Rounding units by which the limits of stick are further out.
_WIDER = 16.0

# The reference velocity of a plane is renewed where slip has fallen to, or grown to, this multiple of it ...
_SHRUNK, _GROWN = 0.1, 1e4
# ... but is at least this multiple of the speed of rest: the direction is rounded off below a part of the reference
# velocity, and the error control must resolve that part.
_SLOWEST = 1e6
# Slip in a plane that friction stops within this many rounding units of time counts as rest.
_INSTANT = 1e-3
# A rounding unit below this leaves the slip of held elements below the speed of rest.
_DOUBLE = 1e-12
# Slip in a plane has ended where it reverses and its component across is at most this multiple of the speed of rest.
_ENDED = 1e5

_constant = jax.lax.stop_gradient


def mode_numbers(modes: Float[Array, "*time modes"], widths: tuple[int, ...]) -> Float[Array, "*time things"]:
    """Modes as one number for each thing: a sign, or for a plane 1 in slip and 0 in stick.

    `widths` says how many numbers the mode of each thing has; those after these are left out.

    **Returns:**

    The numbers, shape `[time, things]`, floating like `modes`.
    """
    if all(width == 1 for width in widths):
        return modes[..., : len(widths)]
    stops = list(accumulate(widths))
    parts = [modes[..., stop - width : stop] for stop, width in zip(stops, widths, strict=True)]
    return jnp.stack([x[..., 0] if x.shape[-1] == 1 else jnp.any(x != 0, axis=-1) * 1.0 for x in parts], axis=-1)


class Loads(NamedTuple):
    """Constraints that load friction elements; k of them.

    - `on`: 1 where constraint k loads row i, shape `[n, k]`; for a gear the torque on its motor per newton.
    - `normal`: normal forces without the elements [N], shape `[k]`; negative ones pull.
    - `normal_coupling`: C, by which unit forces of the rows reduce the normal forces, shape `[k, n]`.
    - `pulls`: -1 for constraints whose friction is as large when they pull, 0 for those that can only push.
    - `side`: sign of a normal force that counts in its place, so that friction is smooth where it changes; 0 for none.
    - `mass`: normal force per acceleration along the constraint [kg].
    - `rounding`: rounding errors of the normal forces [N].
    - `drives`: for each row of a gear the sign of its load that drives positive slip: the constraint then opposes slip
      of the motor, on whose side the friction acts. None for other rows.
    """

    on: Float[Array, "n k"]
    normal: Float[Array, " k"]
    normal_coupling: Float[Array, "k n"]
    pulls: Float[Array, " k"]
    side: Float[Array, " k"]
    mass: Float[Array, " k"]
    rounding: Float[Array, " k"]
    drives: tuple[Scalar | None, ...] = ()


class LawForces(NamedTuple):
    """Forces that a law allows [N, or per newton of load].

    - `positive_slip`, `negative_slip`: in slip in either direction; zero in the rows of planes.
    - `upper`, `lower`: limits of stick against a load in either direction, >= 0.
    """

    positive_slip: Float[Array, " *n"]
    negative_slip: Float[Array, " *n"]
    upper: Float[Array, " *n"]
    lower: Float[Array, " *n"]


class PlanarSlip(NamedTuple):
    """Slip forces in the rows of planes; zero in scalar rows.

    - `force`: the force in slip with the reference velocity in the mode [N, or per newton of load].
    - `onset`: the magnitude of the force with which slip begins [N, or per newton of load].
    """

    force: Float[Array, " n"]
    onset: Float[Array, " n"]


class FrictionElements(eqx.Module):
    """The friction elements at one state, of n rows in all; those without a mode come last.

    - `v`: slip velocities [m/s]; zero for elements without a mode.
    - `free_slip_acceleration`: slip accelerations without these elements [m/s^2].
    - `delassus`: A [1/kg].
    - `minv_jt`: rows `W D_i`, the accelerations that a unit force takes away.
    - `laws`: forces of the laws at `v`.
    - `planar`: None without planes.
    - `loads`: None where no load is a reaction.
    - `gears`: None where no load is the torque of a gear. Otherwise, with zeros in all other rows, the forces without
      torque [N], and by how much those per newton differ where the load is negative.
    - `planes`: first row, and row after the last, of each element whose slip is a vector.
    """

    v: Float[Array, " n"]
    free_slip_acceleration: Float[Array, " n"]
    delassus: Float[Array, "n n"]
    minv_jt: Float[Array, "n dof"]
    laws: LawForces
    planar: PlanarSlip | None = None
    loads: Loads | None = None
    gears: tuple[LawForces, LawForces] | None = None
    planes: tuple[tuple[int, int], ...] = eqx.field(static=True, default=())

    def in_planes(self, rows: Array, of_plane: Callable[[slice], Array]) -> Array:
        """`rows`, with those of each plane replaced by `of_plane` of its slice: one number, or one for each row."""
        parts, at = [], 0
        for start, stop in self.planes:
            parts += [rows[at:start], jnp.broadcast_to(of_plane(slice(start, stop)), (stop - start,))]
            at = stop
        return jnp.concatenate([x for x in (*parts, rows[at:]) if x.shape[0]]) if parts else rows

    @property
    def parts(self) -> list[int | slice]:
        """The row of each scalar element, the rows of each plane."""
        stops, parts, at = dict(self.planes), [], 0
        while at < self.v.shape[0]:
            stop = stops.get(at, at + 1)
            parts.append(slice(at, stop) if at in stops else at)
            at = stop
        return parts

    def in_rows(self, values: Bool[Array, " elements"]) -> Bool[Array, " modes"]:
        """A value for each element with a mode, repeated in each of its rows."""
        if not self.planes:
            return values
        parts = self.parts[: values.shape[0]]
        return jnp.concatenate(
            [jnp.broadcast_to(x, self.v[part].shape or (1,)) for x, part in zip(values, parts, strict=True)]
        )

    def magnitude(self, x: Float[Array, " rows"]) -> Float[Array, " rows"]:
        """Magnitude for each element, repeated in each of its rows."""
        return self.in_planes(jnp.abs(x), lambda part: safe_norm(x[part]))

    def sticks(self, mode: Float[Array, " modes"]) -> Bool[Array, " modes"]:
        """Which rows belong to elements that stick."""
        return self.in_planes(mode == 0, lambda part: jnp.all(mode[part] == 0))

    def slip_mode(self, v: Float[Array, " modes"], rest: Scalar) -> Float[Array, " modes"]:
        """Modes of slip with the velocities `v`; `rest` is the speed of rest [m/s]."""
        return self.in_planes(
            jnp.sign(v), lambda part: jnp.maximum(_least_reference(rest), safe_norm(v[part])) * _unit(v[part])
        )

    def onset_mode(self, load: Float[Array, " modes"], rest: Scalar) -> Float[Array, " modes"]:
        """Modes of slip that begins under these loads."""
        return self.in_planes(jnp.sign(load), lambda part: _least_reference(rest) * _unit(load[part]))


def _least_reference(rest: Scalar) -> Scalar:
    """The least reference speed [m/s] of a plane in slip."""
    return jnp.maximum(_SLOWEST * rest, float(jnp.finfo(rest.dtype).tiny) ** 0.5)


def _unit(x: Float[Array, " components"]) -> Float[Array, " components"]:
    """Direction of a vector; zero for zero."""
    size = safe_norm(x)
    return x / jnp.where(size > 0, size, 1.0)


class FrictionForces(NamedTuple):
    """Forces for one set of modes.

    - `force`: friction forces [N].
    - `upper`, `lower`: limits of stick [N].
    - `margin`: margin of uniqueness of loads that are reactions: 1 without friction, never more; not positive where
      there is no solution, or more than one.
    - `normal`: the normal forces of `Loads` [N]; negative ones pull.
    """

    force: Float[Array, " n"]
    upper: Float[Array, " n"]
    lower: Float[Array, " n"]
    margin: Scalar
    normal: Float[Array, " k"]


def assemble_friction(
    friction: list[Friction],
    along: Float[Array, "n dof"],
    minv_jt: Float[Array, "n dof"],
    rounding: tuple[Float[Array, " n"], Float[Array, " n"] | None] | None,
    loads: Loads | None,
    t: Scalar,
    q: PerDof,
    qd: PerDof,
    params: object,
    qdd: PerDof,
    mode: Float[Array, " modes"],
) -> FrictionElements:
    """The friction elements at one state, where the accelerations without them are `qdd`.

    **Arguments:**

    - `friction`: elements with a mode.
    - `along`: directions of their rows; then, for each element without a mode, which a reaction loads, the generalised
      force that it takes away per newton of load.
    - `minv_jt`: accelerations within the constraints by these generalised forces.
    - `rounding`: that of the mobility [1/kg] of each row, with contacts also of its slip acceleration [m/s^2]; None
      without constraints, where nothing cancels.
    - `loads`: normal forces that are reactions.
    - `t`, `q`, `qd`, `params`: the state.
    - `mode`: modes, from which planes take their reference velocities.
    """
    one, zero = jnp.ones_like(t), jnp.zeros_like(t)
    none, flat = LawForces(zero, zero, zero, zero), (zero, zero)
    rows: list[tuple[Any, ...]] = []
    planes: list[tuple[int, int]] = []

    def of_law(element: Friction, v: Scalar, load: Scalar | None) -> LawForces:
        limits = [element.static_limit(sign * one, load) for sign in (1.0, -1.0)]
        slips = [element.slip_force(v, sign * one, load) for sign in (1.0, -1.0)] if v.ndim == 0 else flat
        return LawForces(*slips, *limits)

    for element in friction:
        v, rate = element.slip_and_rate(t, q, qd, qdd, params)
        load = element.load(t, q, qd, params)
        if loads is not None and (drives := loads.drives[len(rows)]) is not None:
            alone, forces, returned = (of_law(part, v, None) for part in element.gear_parts(drives * one))
            rows.append((v, rate, forces, flat, (alone, jax.tree.map(jnp.subtract, returned, forces))))
            continue
        forces = of_law(element, v, load)
        if v.ndim == 0:
            rows.append((v, rate, forces, flat, (none, none)))
            continue
        start, stop = len(rows), len(rows) + v.shape[0]
        planes.append((start, stop))
        v, rate = element.stretch(v), element.stretch(rate)
        onset = element.slip_force(zero, one, load)
        force = element.slip_force_in_plane(v, mode[start:stop] if mode.shape[0] else v, load)
        rows += [(v[i], rate[i], forces, (force[i], onset), (none, none)) for i in range(v.shape[0])]
    unit = LawForces(one, one, one, one)
    rows += [(zero, zero, unit, flat, (none, none))] * (along.shape[0] - len(rows))
    delassus = jnp.sum(along[:, None, :] * minv_jt[None], axis=2)
    v, rate, laws, planar, gears = zip(*rows, strict=True)
    v, rate, laws = _stacked(v), _stacked(rate), _stacked(laws)
    if rounding is not None:
        # Where constraints leave a direction no mobility (a slider at its dead centre), no force holds it. Rounding may
        # leave a mobility of zero or less, which would look as if no force were needed.
        if rounding[1] is not None:
            # A stop holds its mass without friction: a force within the limits is rounding over rounding.
            still = jnp.abs(rate) <= rounding[1] + rounding[0] * jnp.minimum(laws.upper, laws.lower)
            held = still & (jnp.diagonal(delassus) <= rounding[0])
            rate = jnp.where(held, 0.0, rate)
            delassus = jnp.where(held[:, None] | held[None, :], 0.0, delassus)
        # Where there is mobility it is as it is: with more, stick would drift, and error control would resolve that.
        here = np.eye(rounding[0].shape[0], dtype=bool)
        delassus = jnp.where(here, jnp.maximum(delassus, rounding[0][:, None]), delassus)
    planar = PlanarSlip(*_stacked(planar)) if planes else None
    gears = _stacked(gears) if any(each.transmits for each in friction) else None
    return FrictionElements(v, rate, delassus, minv_jt, laws, planar, loads, gears, tuple(planes))


def _stacked(rows: tuple[Any, ...]) -> Any:
    return jax.tree.map(lambda *each: jnp.stack(each), *rows)


def solve_friction_forces(
    elements: FrictionElements, mode: Float[Array, " modes"], begins: Bool[Array, " modes"] | None = None
) -> FrictionForces:
    """Friction forces [N] for these modes: the slip force, or the multiplier of stick.

    In a plane the slip force is that at the state; in the rows that `begins` marks it is that of the onset of slip.
    """
    extra = elements.v.shape[0] - mode.shape[0]
    mode = jnp.concatenate([mode, jnp.ones(extra, mode.dtype)]) if extra else mode
    sticks = elements.sticks(mode)
    slip_force = _slip_force(elements.laws, mode)
    if (planar := elements.planar) is not None:

        def in_plane(part: slice) -> Array:
            force = planar.force[part]
            return force if begins is None else jnp.where(begins[part], planar.onset[part] * _unit(mode[part]), force)

        slip_force = elements.in_planes(slip_force, in_plane)

    if elements.loads is None:
        slipping = jnp.where(sticks, 0.0, slip_force)
        drive = elements.free_slip_acceleration - apply_matrix(elements.delassus, slipping)
        force = jnp.where(sticks, _multipliers(elements, drive, sticks), slip_force)
        limits = elements.laws.upper, elements.laws.lower
        return FrictionForces(force, *limits, jnp.ones_like(elements.v[0]), force[:0])
    # Forces are linear in the loads. Columns: the slip forces without loads, beside the accelerations without friction;
    # then the slip forces by one newton of each load alone, and those of gears once more by one newton of pull.
    (on, normal, coupling, pulls, side, *_), gears = elements.loads, elements.gears
    loaded, k = jnp.sum(on, axis=1), on.shape[1]
    unloaded = jnp.zeros_like(slip_force) if gears is None else _slip_force(gears[0], mode)
    columns = [jnp.where(loaded > 0, unloaded, slip_force)[:, None], on * slip_force[:, None]]
    if gears is not None:
        columns.append(on * (slip_force + _slip_force(gears[1], mode))[:, None])
    slip_forces = jnp.concatenate(columns, axis=1)
    slipping = jnp.where(sticks[:, None], 0.0, slip_forces)
    free = jnp.pad(elements.free_slip_acceleration[:, None], ((0, 0), (0, slip_forces.shape[1] - 1)))
    drive = free - apply_matrix(elements.delassus, slipping)
    forces = jnp.where(sticks[:, None], _multipliers(elements, drive, sticks), slip_forces)
    fixed, push, pull = forces[:, 0], forces[:, 1 : k + 1], forces[:, -k:]
    gain = apply_matrix(coupling, forces)
    signed, pushes, margin = solve_loads(normal - gain[:, 0], gain[:, 1 : k + 1], pulls[None] * gain[:, -k:], side)
    load = jnp.where(pushes, 1.0, pulls) * signed
    force = fixed + apply_matrix(push if gears is None else jnp.where(pushes[None], push, pull), load)
    factor = jnp.where(loaded > 0, apply_matrix(on, load), 1.0)
    upper, lower = (factor * limit for limit in elements.laws[2:])
    if gears is not None:
        pulled = apply_matrix(on, jnp.where(pushes, 0.0, load))
        upper = upper + gears[0].upper + pulled * gears[1].upper
        lower = lower + gears[0].lower + pulled * gears[1].lower
    return FrictionForces(force, upper, lower, margin, signed)


def _slip_force(laws: LawForces, mode: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.where(mode > 0, laws.positive_slip, laws.negative_slip)


def _multipliers(
    elements: FrictionElements, drive: Float[Array, "n *k"], sticks: Bool[Array, " n"]
) -> Float[Array, "n *k"]:
    """Forces of the sticking elements that cancel their slip accelerations `drive`; zero for the others.

    Where sticking elements are redundant (two on one coordinate), the equations do not determine the share of each.
    This takes the solution with the smallest sum of `f_i^2/limit_i`: elements in parallel then share in proportion to
    their limits and reach them together. An element whose limit is less than 1 % of the largest one has the share of
    1 %, as `solve_semidefinite` is inaccurate for smaller weights: it reaches its limit early, and its slip is then an
    event at rest. The motion stays exact until the load reverses; the largest element then slips early by twice that
    limit, and a run may end in chatter. One element with the sum of the limits avoids this.

    Planes carry only what scalar rows cannot. A plane that shares the load of a scalar row would reach its limit, and
    take a direction of slip, before anything can move.
    """
    weight = 0.5 * (elements.laws.upper + elements.laws.lower)
    largest = jnp.max(weight)
    weight = jnp.maximum(weight / jnp.where(largest > 0, largest, 1.0), _LEAST_SHARE)
    weight = jnp.sqrt(jnp.where(largest > 0, weight, 1.0))
    in_planes = np.zeros(drive.shape[0], bool)
    for start, stop in elements.planes:
        in_planes[start:stop] = True
    if np.all(in_planes) or not np.any(in_planes):
        return solve_semidefinite(elements.delassus, drive, weight, sticks)
    order = np.argsort(in_planes, kind="stable")
    columns = drive[order].reshape(order.size, -1)
    scalars = int(np.sum(~in_planes))
    force = _planes_last(elements.delassus[order][:, order], columns, weight[order], sticks[order], scalars)
    return force[np.argsort(order)].reshape(drive.shape)


def _planes_last(
    matrix: Float[Array, "n n"],
    drive: Float[Array, "n k"],
    weight: Float[Array, " n"],
    sticks: Bool[Array, " n"],
    m: int,
) -> Float[Array, "n k"]:
    """Multipliers of m scalar rows and of the rows of planes after them, which carry what the scalar rows cannot."""
    across, own = matrix[m:, :m], jnp.diagonal(matrix)[m:]
    right = jnp.concatenate([drive[:m], across.T], axis=1)
    of_scalars = solve_semidefinite(matrix[:m, :m], right, weight[:m], sticks[:m])
    alone, taken = jnp.split(of_scalars, [drive.shape[1]], axis=1)
    left = matrix[m:, m:] - apply_matrix(across, taken)
    moves = jnp.diagonal(left) > float(jnp.finfo(own.dtype).eps) ** _HELD * own
    planar = solve_semidefinite(left, drive[m:] - apply_matrix(across, alone), weight[m:], sticks[m:] & moves)
    return jnp.concatenate([alone - apply_matrix(taken, planar), planar])


def friction_guards(
    elements: FrictionElements,
    forces: FrictionForces,
    mode: Float[Array, " modes"],
    rest: Scalar,
    rounding: Float[Array, " modes"],
    tolerances: tuple[Array, Array],
) -> tuple[Float[Array, " modes"], Float[Array, " modes"], Float[Array, " modes"]]:
    """One guard for each row with a mode, positive while the mode holds, its admissible error, its value at its event.

    In stick `(upper - f)(lower + f)/(upper + lower)` [N], which falls through zero at either limit with the slope of
    the force; its error is relative, the first of `tolerances`, to the limits. In slip the velocity in the direction of
    the mode [m/s], with the absolute error and `rounding`. Rounding must not make a mode flicker: the limits
    are 16 rounding units further out, and a slip has to reverse by `rest` [m/s] before it ends (an element may slip at
    its limit while others hold it).

    In stick in a plane f is the magnitude of the force. In slip the guard of the first row is the velocity along the
    reference velocity, less the part of it below which the reference is renewed, or plus `rest` if slip ends next. The
    guards of the other rows are positive until slip has outgrown the reference velocity.
    """
    n, (rtol, atol) = mode.shape[0], tolerances
    force, upper, lower = (x[:n] for x in forces[:3])
    force = elements.in_planes(force, lambda part: safe_norm(force[part]))
    eps = float(jnp.finfo(force.dtype).eps)
    wider = 1.0 + _WIDER * eps
    span = upper + lower
    inside = (wider * upper - force) * (wider * lower + force) / jnp.where(span > 0, span, 1.0)
    resolved = jnp.maximum(rtol, _LOAD_ROUNDING * eps) * span

    def in_plane(part: slice) -> Array:
        along, _, speed = _components(elements.v[part], mode[part])
        end = jnp.where(_ends_next(speed, rest), rest, -_SHRUNK * speed)
        return jnp.stack([along + end] + (part.stop - part.start - 1) * [_GROWN * speed - along])

    slip, sticks = elements.in_planes(mode * elements.v[:n] + rest, in_plane), elements.sticks(mode)
    values = jnp.where(sticks, inside, slip), jnp.where(sticks, resolved, atol + rounding)
    slow = elements.in_planes(0.25 * rounding, lambda part: 0.0 * rounding[part])
    return *values, jnp.where(sticks, _WIDER * eps * span, slow)


def speed_of_rest(elements: FrictionElements, forces: FrictionForces, rest: Scalar, t: Scalar) -> Scalar:
    """The speed of rest [m/s]: `rest`, in planes at least the speed that time resolves at the end of a slip.

    In single precision that holds for several scalar rows, too. A row at its limit that others hold has a slip of
    rounding errors, which are larger than `rest`: its guard would be resolved in thousands of steps.
    """
    eps = float(jnp.finfo(t.dtype).eps)
    if not elements.planes and (elements.v.shape[0] == 1 or eps < _DOUBLE):
        return rest
    slows = jnp.max(jnp.sum(jnp.abs(elements.delassus) * forces.upper[None, :], axis=1))
    instant = eps * jnp.abs(t) * _constant(slows)
    return jnp.maximum(rest, _INSTANT * instant if elements.planes else instant)


def _components(v: Float[Array, " d"], reference: Float[Array, " d"]) -> tuple[Scalar, Scalar, Scalar]:
    """Component of a velocity along the reference velocity, magnitude of that across, and the reference speed."""
    speed, direction = safe_norm(reference), _unit(reference)
    along = jnp.sum(v * direction)
    return along, safe_norm(v - along * direction), speed


def _ends_next(speed: Scalar, rest: Scalar) -> Bool[Array, ""]:
    """Whether the next event of a slip that falls is its end, for this reference speed."""
    return speed <= 1.01 * _least_reference(rest)


def renew_slip(
    elements: FrictionElements, mode: Float[Array, " modes"], fired: Bool[Array, " modes"], rest: Scalar
) -> tuple[Float[Array, " modes"], Bool[Array, " modes"]]:
    """Modes with new reference velocities in planes whose slip goes on, and which rows stop or break away.

    Scalar rows do not change.
    """
    v, stops = _constant(elements.v[: mode.shape[0]]), []
    for start, stop in elements.planes:
        part = slice(start, stop)
        _, across, speed = _components(v[part], mode[part])
        ended = fired[start] & _ends_next(speed, rest) & (across <= _ENDED * rest)
        stops.append(jnp.where(jnp.all(mode[part] == 0), jnp.any(fired[part]), ended))
    each = iter(stops)
    changes = elements.in_planes(fired, lambda _: next(each))
    renews = elements.in_planes(jnp.zeros_like(fired), lambda part: jnp.any(fired[part])) & ~changes
    return jnp.where(renews, elements.slip_mode(v, rest), mode), changes


def stick_violation(
    elements: FrictionElements, forces: FrictionForces, mode: Float[Array, " modes"]
) -> Float[Array, " modes"]:
    """Excess of the force of each sticking element over its limit, in limits; 0 in slip."""
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
    """Modes after an instant at which the elements `still` have no slip velocity; the others keep their modes.

    All of them stick if they can. If forces exceed limits, the element that exceeds its own by the largest factor slips
    in the direction of its load, and the forces are solved again. An element that would then accelerate against its
    direction sticks again. Without stiction the modes that satisfy all conditions are unique, and this finds them. With
    stiction there may be several, and the search is a heuristic. Where it fails, an element slips that is pushed back
    at once, and the run ends as chatter.

    **Arguments:**

    - `elements`: at this instant.
    - `mode`: modes before.
    - `still`: elements that may stick or change direction.
    - `at_limit`: sticking elements that have reached a limit, and slip in the direction of their load.
    - `rest`: speed of rest [m/s].
    """
    n = mode.shape[0]
    wider = 1.0 + 16.0 * float(jnp.finfo(mode.dtype).eps)
    # In a plane the derivative of the direction matters: slip that begins follows the load at once, while its rate,
    # friction over speed, is larger than any step resolves.
    elements, differentiable = jax.tree.map(_constant, elements), elements
    before = solve_friction_forces(differentiable if elements.planes else elements, mode)
    # The direction is that of the nearer limit, which may be zero in one direction (a freewheel).
    load = elements.onset_mode((before.force - 0.5 * (before.upper - before.lower))[:n], rest)
    alone = n == 1 or elements.planes == ((0, n),)
    if elements.planes and not alone:
        # Scalar rows that slip at rest, while a plane holds them, stick again if that relieves the plane.
        at_rest = still | (elements.magnitude(elements.v[:n]) <= rest)
        again = solve_friction_forces(elements, jnp.where(at_rest, 0.0, mode))
        limit = jnp.where(again.force > 0, again.upper, again.lower)
        relieved = jnp.any(at_limit) & ~jnp.any(at_limit & (elements.magnitude(again.force) >= _AT_LIMIT * limit)[:n])
        still, at_limit = jnp.where(relieved, at_rest, still), at_limit & ~relieved
    mode = jnp.where(still, jnp.where(at_limit, load, jnp.zeros_like(mode)), mode)
    scale = 1e-6 * jnp.max(jnp.abs(elements.delassus) * jnp.maximum(before.upper, before.lower)[None, :], axis=1)[:n]

    def improve(i: Array, mode: Array) -> Array:
        now = _constant(mode)
        all_forces, upper, lower, *_ = solve_friction_forces(elements, now, still)
        force = all_forces[:n]
        limit = jnp.where(force > 0, upper[:n], lower[:n])
        least = float(jnp.finfo(limit.dtype).tiny)
        use = jnp.where(elements.sticks(now), elements.magnitude(force) / jnp.maximum(limit, least), 0.0)
        worst = (use == jnp.max(use)) & (use > wider)
        acceleration = (elements.free_slip_acceleration - jnp.sum(elements.delassus * all_forces[None, :], axis=1))[:n]
        in_direction = elements.in_planes(
            now * acceleration, lambda part: jnp.sum(_unit(now[part]) * acceleration[part])
        )
        # Where no modes are consistent, end with a slip that ends at once, which shows as chatter, and not with a stick
        # above its limit.
        against = still & (in_direction < -scale) & ~jnp.any(worst) & (i < 3 * n)
        return jnp.where(worst, elements.onset_mode(force, rest), jnp.where(against, jnp.zeros_like(mode), mode))

    if alone:
        return improve(jnp.asarray(3 * n), mode)
    mode = jax.lax.fori_loop(0, 4 * n, improve, mode)
    if not elements.planes:
        return mode
    # Slip of a plane begins along its load beside the others, which slip or stick by now.
    begins = elements.in_planes(jnp.zeros(n, bool), lambda part: still[part] & ~elements.sticks(mode)[part])
    load = solve_friction_forces(differentiable, jnp.where(begins, 0.0, mode)).force[:n]
    return jnp.where(begins, elements.onset_mode(load, rest), mode)


def stop_slip(elements: FrictionElements, qd: PerDof, sticks: Bool[Array, " modes"]) -> PerDof:
    """Velocities without the slip of the sticking elements, which the smallest impulses take away."""
    sticks = jnp.concatenate([sticks, jnp.zeros(elements.v.shape[0] - sticks.shape[0], bool)])
    impulse = _multipliers(elements, jnp.where(sticks, elements.v, 0.0), sticks)
    return qd - jnp.sum(elements.minv_jt * impulse[:, None], axis=0)
