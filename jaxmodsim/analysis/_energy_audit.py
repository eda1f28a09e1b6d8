"""`energy_audit`: where the energy of a run came from and where it went."""

from dataclasses import dataclass

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from ..simulation import Trajectory


@jtu.register_dataclass
@dataclass(frozen=True)
class EnergyAudit:
    """The energy of a run at its saved times [J], shape `[time]` each.

    - `t`: times [s].
    - `kinetic`, `potential`: of the Lagrangian; see `jaxmodsim.mechanics.energies`.
    - `stored`: in the own state of each effect that has one (bristles), by name.
    - `work`: brought in from outside since t0, by name (negative for an `AppliedForce` that brakes): of
      each effect, of each constraint (which works only if it moves in time), and under `lagrangian` of a Lagrangian
      that depends on time by itself.
    - `dissipated`: lost since t0 in each effect that absorbs power, by name.
    - `event_losses`: lost since t0 where the velocity jumped: at mode changes, and at t0 if the state that was given
      had to be moved onto constraints or into stick.
    - `closing_error`: kinetic + potential + stored + dissipated + event losses - work, less the energy of the state
      that was given: the error of the integration, and nothing else.

    `print(audit)` shows the end of the run.
    """

    t: Float[Array, " time"]
    kinetic: Float[Array, " time"]
    potential: Float[Array, " time"]
    stored: dict[str, Float[Array, " time"]]
    work: dict[str, Float[Array, " time"]]
    dissipated: dict[str, Float[Array, " time"]]
    event_losses: Float[Array, " time"]
    closing_error: Float[Array, " time"]

    def __str__(self) -> str:
        """What there is at the end of the run, a line each."""
        lines = [("kinetic energy", self.kinetic), ("potential energy", self.potential)]
        lines += [(f"stored in {name}", each) for name, each in self.stored.items()]
        lines += [(f"work of {name}", each) for name, each in self.work.items() if jnp.any(each != 0)]
        lines += [(f"dissipated in {name}", each) for name, each in self.dissipated.items()]
        lines += [("lost at events", self.event_losses), ("closing error", self.closing_error)]
        width = max(len(name) for name, _ in lines)
        table = [f"{name:<{width}}  {float(each[-1]):>13.6g} J" for name, each in lines]
        return "\n".join([f"Energy at t = {float(self.t[-1]):g} s", *table])


def energy_audit(run: Trajectory) -> EnergyAudit:
    """Account for the energy of a run, effect by effect.

    Compiles and runs the scene once more with the work integrals beside the state, unless `simulate` was called with
    `record=("energy",)`: an audit that is not asked for costs nothing. Sums of it are in `run.energy`.

    **Arguments:**

    - `run`: one run (not a batch), with the times of interest in its `ts`.

    **Returns:**

    An `EnergyAudit`.

    **Raises:**

    - `ValueError` for a batch of runs: use `jax.vmap(jaxmodsim.energy_audit)(runs)`.
    """
    book, losses = run.ledger, run.event_losses
    return EnergyAudit(
        run.t,
        book.kinetic,
        book.potential,
        book.stored,
        book.supplied,
        book.dissipated,
        losses,
        book.balance + losses,
    )
