"""Energy audits and cyclic coordinates: which quantities a run conserves."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._core.arrays import is_known
from ..scene import Scene
from ..simulation import Trajectory


@jtu.register_dataclass
@dataclass(frozen=True)
class EnergyAudit:
    """The energy of a run at its saved times [J], shape `[time]` each.

    - `t`: times [s].
    - `kinetic`, `potential`: of the Lagrangian; see `jaxmodsim.mechanics.energies`.
    - `stored`: in each effect with a state (bristles), by name.
    - `work`: external work since t0, by name: of each effect (negative for an `AppliedForce` that brakes), of each
      constraint (zero unless it moves in time), and under `lagrangian` of an explicitly time-dependent Lagrangian.
    - `dissipated`: since t0 in each dissipative effect, by name.
    - `event_losses`: since t0 at velocity jumps: at mode changes, and at t0 if the initial state was projected onto
      constraints or into stick.
    - `closing_error`: kinetic + potential + stored + dissipated + event losses - work, less the energy of the initial
      state: the integration error.

    `print(audit)` shows the end of the run.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    run = jms.simulate(scene, [0.0], [0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 301))
    audit = jms.energy_audit(run)
    print(f"{audit.potential[-1]:.4f} J in the spring, closed within 1 uJ: {abs(audit.closing_error).max() < 1e-6}")
    ```

    ```text
    0.0670 J in the spring, closed within 1 uJ: True
    ```
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
        """A line for each energy at the end of the run."""
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

    Runs the scene once more, with work integrals added to the state, unless `simulate` was called with
    `record=("energy",)`. `run.energy` has the sums.

    **Arguments:**

    - `run`: one run, not a batch, saved at the times of interest.

    **Returns:**

    An `EnergyAudit`.

    **Raises:**

    - `ValueError` for a batch of runs: use `jax.vmap(jaxmodsim.energy_audit)(runs)`.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    run = jms.simulate(scene, [0.0], [0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 301))
    audit = jms.energy_audit(run)
    print(f"{audit.work['friction'][-1]:.4f} J from the belt, {audit.dissipated['friction'][-1]:.4f} J dissipated")
    ```

    ```text
    1.4250 J from the belt, 1.3169 J dissipated
    ```
    """
    book = run.ledger
    return EnergyAudit(
        run.t,
        book.kinetic,
        book.potential,
        book.stored,
        book.supplied,
        book.dissipated,
        book.lost,
        book.balance,
    )


_SAMPLES = 32
# A derivative counts as zero below this number of rounding units of the largest derivative of the state.
_ROUNDING = 1e3


def cyclic_coordinates(scene: Scene, dof: int) -> tuple[int, ...]:
    """Indices of the coordinates that the Lagrangian of a scene does not depend on.

    The momentum dL/dqd of such a coordinate changes only by forces (effects and constraints) that act on it; along a
    run it is `run.momentum[:, i]`. The function evaluates dL/dq at 32 random states with coordinates and velocities
    within +-3 and times within 10 s. It misses a dependence that vanishes in all of that box.

    **Arguments:**

    - `scene`: the `Scene`, with concrete (not traced) numbers.
    - `dof`: number of coordinates.

    **Returns:**

    Indices in increasing order.

    **Raises:**

    - `ValueError` inside `jax.jit`, `jax.vmap` or `jax.grad`, where numbers are traced.

    **Example:**

    ```python
    scene = jms.problems.spherical_pendulum.scene()  # polar angle and azimuth
    print(jms.cyclic_coordinates(scene, dof=2))
    ```

    ```text
    (1,)
    ```
    """
    if not is_known(*jtu.tree_leaves(scene)):
        raise ValueError(
            "cyclic_coordinates needs concrete numbers, so it cannot run inside jax.jit, jax.vmap or jax.grad."
        )
    kind = jnp.result_type(float, *jtu.tree_leaves(scene))
    random = np.random.default_rng(0)
    q, qd = (jnp.asarray(random.uniform(-3.0, 3.0, (_SAMPLES, dof)), kind) for _ in range(2))
    slopes = np.asarray(_slopes(scene, jnp.asarray(random.uniform(0.0, 10.0, _SAMPLES), kind), q, qd))
    slopes = np.abs(slopes[np.isfinite(slopes).all(axis=1)])
    if not len(slopes):
        return ()
    limit = _ROUNDING * float(jnp.finfo(kind).eps) * slopes.max(axis=1, keepdims=True)
    return tuple(int(i) for i in np.flatnonzero((slopes <= limit).all(axis=0)))


@jax.jit
def _slopes(scene: Scene, t: Array, q: Array, qd: Array) -> Array:
    def slopes(t: Array, q: Array, qd: Array) -> Array:
        now = scene.bind_time(t)
        return jax.grad(now.lagrangian, argnums=1)(t, q, qd, now.params)

    return jax.vmap(slopes)(t, q, qd)
