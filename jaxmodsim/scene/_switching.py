"""Modes at the start of a run, and modes and velocities behind its events."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float

from .._core.scalarise import in_scalars
from .._core.shapes import Scalar
from ..mechanics import Contact
from ._dynamics import Dynamics, State, from_dynamics
from ._impact import impact
from ._scene import Scene

# A rebound closes its contact at once if it rises to less than so many rounding errors of the gap, or lasts less than
# this part of the time, in square roots of its rounding unit and in units.
_RESOLVED, _LONG, _RESOLVED_TIME = 32.0, 1e-3, 2048.0


def start(
    t: Scalar, y: State, scene: Scene, mode: Float[Array, " modes"], rest: Scalar
) -> tuple[State, Float[Array, " modes"]]:
    """State and modes to begin with: elements with no more slip velocity than `rest` or rounding stick if they can.

    Contacts without gap and without velocity are closed. Of `mode` only the shape counts.
    """
    if not scene.contacts:
        return from_dynamics(lambda d: d.start_friction(rest), t, y, scene, mode)
    eps, params = 8.0 * float(jnp.finfo(y.q.dtype).eps), scene.bind_time(t).params
    closed = []
    for each in scene.contacts.values():
        gap, velocity = each.error(t, y.q, params), each.rate(t, y.q, y.qd, params)
        size = jnp.max(jnp.abs(y.q)), jnp.max(jnp.abs(y.qd))
        here = jnp.maximum(jnp.stack([gap, velocity])[:, 0], 0.0)
        closed.append(jnp.all(here <= jnp.maximum(rest, eps * jnp.stack(size))) & (velocity[0] >= -rest))
    modes = jnp.where(jnp.stack(closed), 1.0, jnp.zeros_like(y.q[0]))
    if not scene.event_driven:
        return y, modes
    begun = jnp.concatenate([jnp.zeros_like(mode[: mode.shape[0] - len(scene.contacts)]), modes])
    state, slips = from_dynamics(lambda d: d.start_friction(rest), t, y, scene, begun)
    return state, jnp.concatenate([slips, modes])


def switch(
    t: Scalar,
    y: State,
    scene: Scene,
    mode: Float[Array, " modes"],
    fired: Bool[Array, " guards"],
    rest: Scalar,
    elastic: bool = True,
) -> tuple[State, Float[Array, " modes"]]:
    """State and modes after the guards that `fired`; `elastic` is False where impacts have accumulated.

    The impact and the friction behind it are two functions for `in_scalars`, of which one would be too large for it.
    """
    if not scene.contacts:
        return from_dynamics(lambda d: d.switch_friction(fired, mode, rest), t, y, scene, mode)
    n = mode.shape[0] - len(scene.contacts)

    bounces = _bounces(t, y, scene, mode) if elastic else None

    def strike(t: Array, q: Array, qd: Array) -> tuple[Array, Array, Array]:
        return impact(t, q, qd, scene.bind_state(t, q, qd), mode[n:], fired[n:], rest, bounces)

    qd, closed, stopped = in_scalars(strike, t, y.q, y.qd, seed=y.q)
    after = y._replace(qd=qd)
    if not n:
        return after, closed
    struck = jnp.any(fired[n:]) & jnp.any(qd != y.qd)
    after, slips = from_dynamics(
        lambda d: d.switch_struck(fired[:n], jnp.asarray(stopped), struck, rest),
        *(t, after, scene, jnp.concatenate([mode[:n], closed])),
    )
    return after, jnp.concatenate([slips, closed])


def _bounces(t: Scalar, y: State, scene: Scene, mode: Float[Array, " modes"]) -> Bool[Array, " contacts"]:
    """Which contacts give back velocity: those in contact already, and those whose rebound can be told from rest.

    After a rebound with the velocity w a gap that accelerates by a < 0 is `w^2/(2 |a|)` wide at most, and closes after
    `2 w/|a|`. Both are relative to the surface, which may move. Where one rebound cannot be told from rest, all that
    follow it cannot: to first order in w their impulses, and those of friction under them, are those of rest.
    """
    held = jtu.tree_map(lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x, (t, y, scene, mode))
    eps = float(jnp.finfo(y.q.dtype).eps)
    shortest = max(_LONG * eps**0.5, _RESOLVED_TIME * eps) * jnp.abs(held[0])

    def look(contact: Contact, d: Dynamics) -> Bool[Array, ""]:
        (t, q, qd), params = (d.t, d.y.q, d.y.qd), d.scene.params
        w, a = jax.jvp(lambda t, q, qd: contact.rate(t, q, qd, params)[0], (t, q, qd), (jnp.ones_like(t), qd, d.qdd))
        gap = contact.rounding(t, q, params)
        w, pull = contact.coefficient * jnp.abs(w), jnp.maximum(-a, 0.0)
        return (w * w >= 2.0 * _RESOLVED * gap * pull) & (2.0 * w >= shortest * pull)

    contacts = tuple(scene.contacts.values())
    resolved = from_dynamics(lambda d: jnp.stack([look(each, d) for each in contacts]), *held)
    return resolved | (mode[mode.shape[0] - len(contacts) :] > 0)
