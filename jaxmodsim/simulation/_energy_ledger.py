"""Energies of a run by place: kinetic, potential, stored, supplied and dissipated."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..mechanics import energies
from ..scene import Scene, State, impact_work
from ..solvers import EventLog, instant
from ._integrated_system import Work
from ._run_request import RunRequest


class EnergyLedger(NamedTuple):
    """Energies of a run [J], shape `[time]` each.

    - `kinetic`, `potential`: energies of the Lagrangian.
    - `stored`: energy in the state of each effect with a state, and in each compliant contact, by name.
    - `supplied`: energy supplied since t0, by the names of `Dynamics.power`; also by moving surfaces in impacts.
    - `dissipated`: energy lost since t0 in each effect, or compliant contact, that absorbs power, by name: the absorbed
      energy less the stored energy.
    - `lost`: energy lost since t0 at events, see `at_events`.
    - `before`: kinetic, potential and stored energy of the state in the arguments at t0, shape `[]`.
    """

    kinetic: Float[Array, " time"]
    potential: Float[Array, " time"]
    stored: dict[str, Float[Array, " time"]]
    supplied: dict[str, Float[Array, " time"]]
    dissipated: dict[str, Float[Array, " time"]]
    lost: Float[Array, " time"]
    before: Float[Array, ""]

    @property
    def balance(self) -> Float[Array, " time"]:
        """Present and lost energy, less supplied energy and that at the start: the error of the account."""
        total = self.kinetic + self.potential + self.lost - self.before
        total = sum((*self.stored.values(), *self.dissipated.values()), total)
        return total - sum(self.supplied.values(), jnp.zeros_like(total))


@jax.jit
def ledger(
    request: RunRequest, t: Float[Array, " time"], y: State, work: Work, start: State, log: EventLog | None
) -> EnergyLedger:
    """Ledger of a run with the states `y` and the work at the times `t`; `start` and `log` as in `at_events`."""
    scene = request.scene

    def parts(t: Array, y: State) -> tuple[Array, Array, dict[str, Array]]:
        return *_mechanical(t, y, scene), _stored(t, y, scene)

    first = request.initial_state
    kinetic, potential, stored = jax.vmap(parts)(t, y)
    gained = {name: now - _stored(request.t0, first, scene)[name] for name, now in stored.items()}
    lost, struck = at_events(request, t, start, log)
    supplied = {name: each.supplied + struck.get(name, 0.0) for name, each in work.items()}
    dissipated = {
        name: each.absorbed - gained.get(name, 0.0) for name, each in work.items() if each.absorbed is not None
    }
    return EnergyLedger(kinetic, potential, stored, supplied, dissipated, lost, _energy(scene, request.t0, first))


@jax.jit
def at_events(
    request: RunRequest, t: Float[Array, " time"], start: State, log: EventLog | None
) -> tuple[Float[Array, " time"], dict[str, Float[Array, " time"]]]:
    """Energy [J] lost at events up to the times `t`, and at t0 by projection; what moving surfaces supply, by name.

    An impact loses the energy before, and that which surfaces supply, less the energy after.

    **Arguments:**

    - `start`: the first state of the run.
    - `log`: the log of events; None if the run kept none, as without contacts.
    """
    scene = request.scene
    lost = _energy(scene, request.t0, request.initial_state) - _energy(scene, request.t0, start)
    if log is None or not scene.contacts:
        return jnp.broadcast_to(lost, t.shape), {}

    def strike(happened: Array, t: Array, log: EventLog) -> tuple[Array, dict[str, Array]]:
        # Unused entries are zero, a state in which constraints need not have derivatives.
        sides = (log.before[0], log.after[0])
        before, after = (jax.tree.map(lambda x, first: jnp.where(happened, x, first), side, start) for side in sides)
        # Contacts that are closed or struck touch, but those that open do not.
        touches = jnp.where(log.fired > 0, 1.0 - log.before[1], log.before[1])
        work = impact_work(t, before.q, before.qd, after.qd, scene.bind_state(t, before.q, before.qd), touches)
        return sum(work.values(), _energy(scene, t, before) - _energy(scene, t, after)), work

    happened = jnp.isfinite(log.t)
    at = jnp.where(happened, log.t, request.t0)
    each = jax.vmap(strike)(happened, at, log)
    # Saved states are those after an event from an instant before it.
    resolution = jnp.maximum(4.0 * float(jnp.finfo(at.dtype).eps) * jnp.abs(at), request.shortest_step)
    counts = happened[None, :] & ((at - instant(resolution))[None, :] <= t[:, None])
    drops, work = jax.tree.map(lambda x: jnp.sum(jnp.where(counts, x[None, :], 0.0), axis=1), each)
    return lost + drops, work


def _stored(t: Array, y: State, scene: Scene) -> dict[str, Array]:
    """Stored energy in the states of effects, and in compliant contacts."""
    stored = {
        name: jnp.asarray(effect.stored_energy(y.z[name]), y.q.dtype)
        for name, effect in zip(scene.names, scene.effects, strict=True)
        if name in y.z
    }
    for name, each in scene.compliant.items():
        assert each.compliant is not None
        gap = each.error(t, y.q, scene.bind_time(t).params)[0]
        stored[name] = each.compliant.stored_energy(-gap)
    return stored


def _mechanical(t: Array, y: State, scene: Scene) -> tuple[Array, Array]:
    """Kinetic and potential energy of the Lagrangian."""
    scene = scene.bind_time(t)
    return energies(scene.lagrangian, t, y.q, y.qd, scene.params)


def _energy(scene: Scene, t: Array, y: State) -> Array:
    kinetic, potential = _mechanical(t, y, scene)
    return kinetic + potential + sum(_stored(t, y, scene).values())
