"""Where the energy of a run is, and where it came from and went."""

from typing import NamedTuple

import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..scene import Power, Scene, State, scene_energies
from ..solvers import EventLog
from ._outcome import SUCCESS, SimulationError, outcome_messages
from ._solve import Options, Problem, initial_state, solve_audited, solve_logged, solve_start


class EnergyLedger(NamedTuple):
    """Energies of a run [J], shape `[time]` each.

    - `kinetic`, `potential`: of the Lagrangian.
    - `stored`: in the own state of each effect that has one, by name.
    - `supplied`: brought in since t0, by the names of `scene_power`.
    - `dissipated`: lost since t0 in each effect that absorbs power, by name: what it absorbed, less what its own state
      has gained.
    - `before`: kinetic, potential and stored energy of the state that was given at t0, shape `[]`.
    """

    kinetic: Float[Array, " time"]
    potential: Float[Array, " time"]
    stored: dict[str, Float[Array, " time"]]
    supplied: dict[str, Float[Array, " time"]]
    dissipated: dict[str, Float[Array, " time"]]
    before: Float[Array, ""]

    @property
    def balance(self) -> Float[Array, " time"]:
        """Energy there is and energy dissipated, less energy supplied and that of the start: what is unaccounted."""
        total = self.kinetic + self.potential - self.before
        total = sum((*self.stored.values(), *self.dissipated.values()), total)
        return total - sum(self.supplied.values(), jnp.zeros_like(total))


def ledger(
    problem: Problem, options: Options, t: Float[Array, " time"], y: State, code: Int[Array, ""]
) -> EnergyLedger:
    """Ledger of a run whose states at the times `t` are `y`. Runs it once more, with the work integrals beside it.

    **Arguments:**

    - `code`: how the run ended.

    **Raises:**

    - `SimulationError` if the run reached t1 and that with the integrals does not, where rounding decides. Inside
      compiled code the energies are infinite from there on instead.
    """
    work, ended = solve_audited(problem, options)
    known = not isinstance(code, jax.core.Tracer) and not isinstance(ended, jax.core.Tracer)
    if known and int(code) == SUCCESS != int(ended):
        reason = outcome_messages(problem.scene, problem.q0.shape[0])[int(ended)]
        raise SimulationError(
            "The run reached t1, but repeated with the work integrals beside it, it does not, so its energies are not"
            f" known: {reason}"
        )
    return _ledger(problem, t, y, work)


@jax.jit
def _ledger(problem: Problem, t: Array, y: State, work: dict[str, Power]) -> EnergyLedger:
    scene = problem.scene

    def parts(t: Array, y: State) -> tuple[Array, Array, dict[str, Array]]:
        return *scene_energies(t, y, scene), _stored(scene, y)

    first = initial_state(problem)
    kinetic, potential, stored = jax.vmap(parts)(t, y)
    gained = {name: now - _stored(scene, first)[name] for name, now in stored.items()}
    supplied = {name: each.supplied for name, each in work.items()}
    dissipated = {
        name: absorbed - gained.get(name, 0.0) for name in scene.names if (absorbed := work[name].absorbed) is not None
    }
    return EnergyLedger(kinetic, potential, stored, supplied, dissipated, _energy(scene, problem.t0, first))


def event_losses(problem: Problem, options: Options, t: Float[Array, " time"], events: int) -> Float[Array, " time"]:
    """Energy [J] that was lost at events up to the times `t`, and at t0 where the state given was not admissible.

    Runs the scene once more with a log of `events` entries beside it, where it has modes.
    """
    start, log = solve_start(problem, options), None
    if problem.scene.event_driven:
        log = solve_logged(problem, options, events)
    return _losses(problem, t, start, log)


@jax.jit
def _losses(problem: Problem, t: Array, start: State, log: EventLog | None) -> Array:
    scene = problem.scene
    lost = _energy(scene, problem.t0, initial_state(problem)) - _energy(scene, problem.t0, start)
    losses = jnp.broadcast_to(lost, t.shape)
    if log is None:
        return losses

    def drop(t: Array, before: State, after: State) -> Array:
        return _energy(scene, t, before) - _energy(scene, t, after)

    happened = jnp.isfinite(log.t)
    at = jnp.where(happened, log.t, problem.t0)
    drops = jax.vmap(drop)(at, log.before[0], log.after[0])
    counts = happened[None, :] & (at[None, :] <= t[:, None])
    return losses + jnp.sum(jnp.where(counts, drops[None, :], 0.0), axis=1)


def _stored(scene: Scene, y: State) -> dict[str, Array]:
    return {
        name: jnp.asarray(effect.stored_energy(y.z[name]), y.q.dtype)
        for name, effect in zip(scene.names, scene.effects, strict=True)
        if name in y.z
    }


def _energy(scene: Scene, t: Array, y: State) -> Array:
    kinetic, potential = scene_energies(t, y, scene)
    return kinetic + potential + sum(_stored(scene, y).values())
