"""The result of a run."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int, PyTree

from ..mechanics import energies
from ..scene import Scene, State, scene_forces
from ._outcome import Outcome, outcome_messages
from ._solve import Options, Problem, initial_state, solve_audited


class Events(NamedTuple):
    """Mode changes along a run in order of time, padded with infinity or -1.

    Laws that are executed without events (all but the exact stick-slip of set-valued laws) have none, and the
    arrays have length 0.

    - `t`: time [s].
    - `effect`: index of the effect in the scene.
    - `before`, `after`: mode before and after.
    """

    t: Float[Array, " events"]
    effect: Int[Array, " events"]
    before: Int[Array, " events"]
    after: Int[Array, " events"]


class Energy(NamedTuple):
    """Energies along a run [J], shape `[time]` each.

    - `kinetic`, `potential`: of the Lagrangian; see `jaxmodsim.mechanics.energies`.
    - `stored`: in the states of friction laws (bristles).
    - `work_in`: brought in since t0 by applied forces, belts and explicit time dependence of the Lagrangian.
    - `dissipated`: lost in friction since t0. Of dynamic laws under a `normal_force` the energy in the state counts as
      lost until it comes back, as under a load that changes it is no function of the state.
    - `balance`: kinetic + potential + stored + dissipated - work_in, less its value at t0: zero but for the error
      of the integration.
    """

    kinetic: Float[Array, " time"]
    potential: Float[Array, " time"]
    stored: Float[Array, " time"]
    work_in: Float[Array, " time"]
    dissipated: Float[Array, " time"]
    balance: Float[Array, " time"]


@jtu.register_dataclass
@dataclass(frozen=True)
class Trajectory:
    """A run of a scene. Everything but the motion itself is computed when it is asked for.

    - `t`: times [s], shape `[time]`; `ts`, or the end alone. Times that an early end left unreached are infinite.
    - `q`, `qd`: coordinates and velocities, shape `[time, dof]`.
    - `z`: own states of effects, by effect name; each with a leading time axis.
    - `stats`: `num_steps`, and `num_rejected_steps` of these.

    A run inside `jax.vmap` is read inside it, or by `jax.vmap(lambda run: run.forces)(runs)`.
    """

    t: Float[Array, " *time"]
    q: Float[Array, "*time dof"]
    qd: Float[Array, "*time dof"]
    z: dict[str, PyTree]
    stats: dict[str, Array]
    code: Int[Array, "..."]
    end: Float[Array, "..."] | None
    problem: Problem
    options: Options = field(metadata={"static": True})

    @property
    def scene(self) -> Scene:
        """The scene that was run."""
        return self.problem.scene

    @property
    def t_end(self) -> Float[Array, "..."]:
        """Time that the run reached [s]; t1 unless it ended early."""
        return self.t[..., -1] if self.end is None else self.end

    @property
    def result(self) -> Outcome:
        """How the run ended: `run.result.ok`, `run.result.message`."""
        return Outcome(self.code, outcome_messages(self.scene, self.q.shape[-1]))

    @property
    def forces(self) -> dict[str, Array]:
        """Force of each effect along the run, by effect name.

        Of `Friction` the friction force [N], shape `[time]`, positive when it opposes positive slip; of
        `AppliedForce` what its function returns, shape `[time, ...]`.
        """
        self._one_run("forces")
        return _forces(self.scene, self.t, self._states())

    @property
    def events(self) -> Events:
        """Mode changes along the run."""
        none = jnp.zeros((*self.t.shape[:-1], 0), int)
        return Events(jnp.zeros(none.shape, self.t.dtype), none, none, none)

    @property
    def energy(self) -> Energy:
        """Energies and their balance along the run. Runs the scene once more, with the work integrals beside it."""
        self._one_run("energy")
        work = solve_audited(self.problem, self.options)
        return _energy(self.problem, self.t, self._states(), work)

    def _states(self) -> State:
        return State(self.q, self.qd, self.z)

    def _one_run(self, what: str) -> None:
        if self.t.ndim != 1:
            raise ValueError(
                f"This Trajectory holds a batch of runs (times of shape {self.t.shape}); {what} reads one run:"
                f" use jax.vmap(lambda run: run.{what})(runs)."
            )


@jax.jit
def _forces(scene: Scene, t: Array, y: State) -> dict[str, Array]:
    return jax.vmap(lambda t, y: scene_forces(t, y, scene))(t, y)


@jax.jit
def _energy(problem: Problem, t: Array, y: State, work: Any) -> Energy:
    scene = problem.scene

    def parts(t: Array, y: State) -> tuple[Array, Array, Array]:
        kinetic, potential = energies(scene.lagrangian, t, y.q, y.qd, scene.params)
        stored = jnp.zeros_like(kinetic)
        for name, effect in zip(scene.names, scene.effects, strict=True):
            stored = stored + effect.stored(y.z.get(name))
        return kinetic, potential, stored

    kinetic0, potential0, stored0 = parts(problem.t0, initial_state(problem))
    kinetic, potential, stored = jax.vmap(parts)(t, y)
    dissipated = work.absorbed - (stored - stored0)
    total = kinetic + potential + stored + dissipated - work.supplied
    return Energy(kinetic, potential, stored, work.supplied, dissipated, total - (kinetic0 + potential0 + stored0))
