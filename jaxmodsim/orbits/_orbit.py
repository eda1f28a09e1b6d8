"""A periodic orbit, and what is known of it."""

from typing import TypeAlias

import equinox as eqx
import jax.core
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._core.readable import AbstractReadable, Table, short, table_of
from ..scene import State, quantity_of
from ..simulation import Trajectory

# Distance of a multiplier from the unit circle that its error may hide.
NEUTRAL = 1e-6
# Residual that is more than rounding and the tolerance of the run.
_WORTH_SAYING = 1e-9

# Name of an element, its mode before and after.
Sequence: TypeAlias = tuple[tuple[str, str, str], ...]


class PeriodicOrbit(AbstractReadable, eqx.Module):
    """A periodic orbit of a scene.

    `q`, `qd`, `z`, `period`, `lowest`, `highest` and `advance` have derivatives by all numbers of the scene.

    - `t0`: time [s] at its start; 0 but where along a branch a change of modes came to lie there.
    - `q`, `qd`, `z`: state at its start, as of `simulate`.
    - `period`: [s].
    - `lowest`, `highest`: least and greatest value of each coordinate, shape `[dof]`.
    - `multipliers`: Floquet multipliers, complex, shape `[n]`: by magnitude, after those that are exactly 1, `neutral`
      in number: one of an unknown period, one of each shift, one of each coordinate that sticks throughout. A phase in
      which an element sticks makes one of them zero, a phase in which a contact is closed two.
    - `autonomous`: whether the period was unknown, and one of the multipliers is 1 therefore.
    - `residual`: by how much the state misses itself after a period, in the extent of the orbit.
    - `runs`: the `Trajectory` over each segment of the period.
    - `sequence`: mode changes along it: element, mode before, mode after.
    - `stick`: part of the period in which each friction element sticks and each contact is closed, by name. A
      coordinate that sticks throughout stays where the guess is, or where it settles from there.
    - `advance`: by how much each coordinate moves on in a period [m or rad], shape `[dof]`; zero for those that return.
    """

    t0: Float[Array, ""]
    q: Float[Array, " dof"]
    qd: Float[Array, " dof"]
    z: dict[str, PyTree]
    period: Float[Array, ""]
    lowest: Float[Array, " dof"]
    highest: Float[Array, " dof"]
    multipliers: np.ndarray
    autonomous: bool = eqx.field(static=True)
    residual: float = eqx.field(static=True)
    runs: tuple[Trajectory, ...]
    sequence: Sequence = eqx.field(static=True)
    stick: dict[str, float]
    advance: Float[Array, " dof"]
    neutral: int = eqx.field(static=True)

    @property
    def state(self) -> State:
        """State at the start."""
        return State(self.q, self.qd, self.z)

    @property
    def run(self) -> Trajectory:
        """The run over the period.

        **Raises:**

        - `ValueError` for an orbit of several segments.
        """
        run, *others = self.runs
        if others:
            raise ValueError(f"This orbit was found in {len(self.runs)} segments: it has one run each, `orbit.runs`.")
        return run

    @property
    def amplitude(self) -> Float[Array, " dof"]:
        """Half the distance between the turning points of each coordinate, shape `[dof]`."""
        return 0.5 * (self.highest - self.lowest)

    @property
    def energy(self) -> float:
        """Energy lost in a period, which is the energy brought in [J]; takes two more runs where contacts strike."""
        return sum(float(run.energy.dissipated[-1]) for run in self.runs)

    @property
    def stable(self) -> bool:
        """Whether all multipliers, but for those that are exactly 1, are inside the unit circle."""
        return self.stability == "stable"

    @property
    def stability(self) -> str:
        """Stable, unstable and by which multiplier, or undecided to first order."""
        return stability_words(self.multipliers[self.neutral :])


def stability_words(multipliers: np.ndarray) -> str:
    """What these multipliers mean."""
    if not len(multipliers) or np.max(np.abs(multipliers)) < 1.0 - NEUTRAL:
        return "stable"
    largest = multipliers[int(np.argmax(np.abs(multipliers)))]
    if abs(largest) <= 1.0 + NEUTRAL:
        return "neutral: a multiplier is on the unit circle, and stability is not decided to first order"
    if abs(largest.imag) > NEUTRAL:
        return f"unstable: a pair of complex multipliers of magnitude {abs(largest):.6g}"
    return f"unstable: a multiplier of {largest.real:.6g}"


def complex_words(x: complex) -> str:
    """A complex number in a few characters."""
    return f"{x.real:.6g}" if abs(x.imag) < 1e-12 else f"{x.real:.6g}{x.imag:+.6g}j"


@table_of.register
def _(orbit: PeriodicOrbit) -> Table:
    """Extent, period, stability, modes."""
    if isinstance(orbit.period, jax.core.Tracer):
        return Table("PeriodicOrbit, traced", (), [])
    scene = orbit.runs[0].scene
    columns = {"lowest": orbit.lowest, "highest": orbit.highest, "velocity at the start": orbit.qd}
    if np.any(orbit.advance):
        columns["advance"] = orbit.advance
    rows = [
        (quantity_of(scene, f"q[{i}]").label, *(short(x[i]) for x in columns.values())) for i in range(len(orbit.q))
    ]
    kind = "autonomous" if orbit.autonomous else "forced"
    held = [name for name, share in orbit.stick.items() if share > 1.0 - 1e-12 and name in scene.event_driven]
    changes = [f"{name}: {before} to {after}" for name, before, after in orbit.sequence]
    notes = [
        f"multipliers {', '.join(map(complex_words, orbit.multipliers))}",
        *(f"{name} sticks throughout, where the guess is or settles; other places are possible" for name in held),
        *(f"{name} held {100 * share:.4g} % of the period" for name, share in orbit.stick.items() if name not in held),
        f"mode changes: {', '.join(changes) or 'none'}",
        *([f"residual {orbit.residual:.2g}"] if orbit.residual > _WORTH_SAYING else []),
    ]
    title = f"PeriodicOrbit, {kind}, period {short(orbit.period)} s, {orbit.stability}"
    return Table(title, ("", *columns), rows, tuple(notes))
