"""Modes at the start of a run, and modes and velocities after its events."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float

from .._core.arrays import Scalar
from .._core.scalarise import in_scalars
from ._dynamics import Dynamics, State, from_dynamics, vector_field
from ._impact import impact
from ._scene import Scene

# A rebound closes its contact at once if it rises to less than this number of rounding errors of the gap, or lasts less
# than this part of the time: a multiple of the square root of its rounding unit, at least a number of rounding units.
_RESOLVED, _LONG, _RESOLVED_TIME = 32.0, 1e-3, 2048.0


def start(
    t: Scalar, y: State, scene: Scene, mode: Float[Array, " modes"], rest: Scalar
) -> tuple[State, Float[Array, " modes"]]:
    """Initial state and modes: elements with a slip velocity of at most `rest`, or rounding, stick if they can.

    Contacts without gap and without velocity are closed. Only the shape of `mode` counts.

    **Returns:**

    `(State, modes)`: modes of shape `[modes]`, in the order of `Scene.mode_names`.
    """
    slips, closed, sides = scene.split_modes(mode)
    if scene.contacts:
        closed = _start_contacts(t, y, scene, rest)
    sides = _without_guides(sides, scene)
    if sides.size:
        above = jnp.ones_like(sides).at[len(scene.switches) :].set(0.0)
        sides = _start_sides(t, y, scene, jnp.concatenate([jnp.zeros_like(slips), closed, above]))
    if scene.event_driven:
        begun = _join(jnp.zeros_like(slips), closed, sides)
        begin = lambda d: (*d.start_friction(rest), d.guide_loads(rest)[0])  # noqa: E731
        y, slips, loads = from_dynamics(begin, t, y, scene, begun)
        # Those of stick, as `begun` says: where slip changes a sign, the guard is violated and changes it at once.
        sides = jnp.concatenate([sides, jnp.where(loads >= 0, 1.0, -jnp.ones_like(loads))])
    return y, _join(slips, closed, sides)


def _without_guides(sides: Float[Array, " sides"], scene: Scene) -> Float[Array, " others"]:
    """Sides for a search of modes, in which the loads of guides have their own signs: forces jump, and so do loads."""
    return sides[: sides.size - len(scene.guides)]


def _start_contacts(t: Scalar, y: State, scene: Scene, rest: Scalar) -> Float[Array, " contacts"]:
    eps, params = 8.0 * float(jnp.finfo(y.q.dtype).eps), scene.bind_time(t).params
    closed = []
    for each in scene.contacts.values():
        gap, velocity = each.error(t, y.q, params), each.rate(t, y.q, y.qd, params)
        size = jnp.max(jnp.abs(y.q)), jnp.max(jnp.abs(y.qd))
        here = jnp.maximum(jnp.stack([gap, velocity])[:, 0], 0.0)
        closed.append(jnp.all(here <= jnp.maximum(rest, eps * jnp.stack(size))) & (velocity[0] >= -rest))
    return jnp.where(jnp.stack(closed), 1.0, jnp.zeros_like(y.q[0]))


def _start_sides(t: Scalar, y: State, scene: Scene, mode: Float[Array, " modes"]) -> Float[Array, " sides"]:
    """Sides of switches and kinks; a value of zero has the side of its rate."""
    rate = vector_field(t, y, scene, mode)
    value, pace = jax.jvp(scene.side_values, (t, y.q, y.qd), (jnp.ones_like(t), rate.q, rate.qd))
    return jnp.where(jnp.where(value == 0, pace, value) >= 0, 1.0, -jnp.ones_like(value))


def _join(*modes: Array) -> Float[Array, " modes"]:
    """Modes of friction elements, contacts and switches in one array."""
    some = [each for each in modes if each.size]
    return some[0] if len(some) == 1 else jnp.concatenate(some)


def switch(
    t: Scalar,
    y: State,
    scene: Scene,
    mode: Float[Array, " modes"],
    fired: Bool[Array, " guards"],
    rest: Scalar,
    dense: Bool[Array, ""],
    holds: bool,
    rate: State | None,
    least: Scalar | float = 0.0,
) -> tuple[State, Float[Array, " modes"], Float[Array, " modes"]]:
    """State and modes after the guards that `fired`.

    Struck contacts close without a rebound where events accumulate (`dense`), or if it rises by less than `least` [m],
    under the `rate` of the state in the mode before; None without contacts.
    Friction elements that fired where events accumulate stick regardless of their limits if chatter is held (`holds`),
    and keep their modes otherwise. A closed contact that would pull opens at once, so that its time has the derivative.

    The impact and the friction after it are two functions of `in_scalars`, as one would be too large for it.

    **Returns:**

    `(State, modes, touching)`: modes of shape `[modes]`, in the order of `Scene.mode_names`; in `touching`, for the
    projection, the contacts that would pull are closed.
    """
    slips, closed, sides = scene.split_modes(mode)
    slip_fired, contact_fired, side_fired = scene.split_modes(fired)
    held = slip_fired & dense if holds else None
    if sides.size:
        sides = jnp.where(side_fired, -sides, sides)
    if not scene.contacts:
        if slips.size:
            whole = _join(slips, _without_guides(sides, scene))
            y, slips = from_dynamics(lambda d: d.switch_friction(slip_fired, slips, rest, held), t, y, scene, whole)
        modes = _join(slips, sides)
        return y, modes, modes

    if not holds:
        slip_fired = slip_fired & ~dense
    assert rate is not None
    bounces = _bounces(t, y, scene, closed, rate, least)

    def strike(t: Array, q: Array, qd: Array) -> tuple[Array, Array, Array]:
        return impact(t, q, qd, scene.bind_state(t, q, qd), closed, contact_fired, rest, bounces, dense)

    qd, closed, stopped = in_scalars(strike, t, y.q, y.qd, seed=y.q)
    after, modes = y._replace(qd=qd), _join(slips, closed, _without_guides(sides, scene))
    struck = jnp.any(contact_fired) & jnp.any(qd != y.qd)

    def rub(d: Dynamics) -> tuple[State, Array, Array]:
        if not slips.size:
            return after, slips, d.pulls
        return *d.switch_struck(slip_fired, jnp.asarray(stopped), struck, rest, held), d.pulls

    after, slips, pulls = from_dynamics(rub, t, after, scene, modes)
    return after, _join(slips, jnp.where(pulls, 0.0, closed), sides), _join(slips, closed, sides)


def _bounces(
    t: Scalar, y: State, scene: Scene, closed: Float[Array, " contacts"], rate: State, least: Scalar | float
) -> Bool[Array, " contacts"]:
    """Which contacts rebound: those that are closed already, and those whose rebound is resolved.

    After a rebound with the velocity w a gap that accelerates by a < 0 is at most `w^2/(2 |a|)` wide, and closes after
    `2 w/|a|`. Both are relative to the surface, which may move. If one rebound is not resolved, no later one is: to
    first order in w their impulses, and those of friction under them, are those of rest.
    """
    held = jtu.tree_map(lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x, (t, y, scene, rate))
    eps = float(jnp.finfo(y.q.dtype).eps)
    shortest = max(_LONG * eps**0.5, _RESOLVED_TIME * eps) * jnp.abs(held[0])

    def look(t: Array, y: State, rate: State) -> Bool[Array, " contacts"]:
        params, resolved = held[2].bind_state(t, y.q, y.qd).params, []
        for each in scene.contacts.values():
            pace = lambda t, q, qd, each=each: each.rate(t, q, qd, params)[0]  # noqa: E731
            w, a = jax.jvp(pace, (t, y.q, y.qd), (jnp.ones_like(t), y.qd, rate.qd))
            gap = jnp.maximum(_RESOLVED * each.rounding(t, y.q, params), least)
            w, pull = each.coefficient * jnp.abs(w), jnp.maximum(-a, 0.0)
            resolved.append((w * w >= 2.0 * gap * pull) & (2.0 * w >= shortest * pull))
        return jnp.stack(resolved)

    return in_scalars(look, held[0], held[1], held[3], seed=y.q) | (closed > 0)
