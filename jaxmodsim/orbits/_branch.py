"""A branch of periodic orbits, and the special ones along it."""

import equinox as eqx
import numpy as np

from .._core.readable import AbstractReadable, Table, table_of
from ._orbit import PeriodicOrbit

FOLD, DOUBLING, TORUS, CROSSING = "fold", "period doubling", "Neimark-Sacker", "branch point"
ONSET, LOSS, GRAZING = "onset of stick", "loss of stick", "grazing"


class SpecialOrbit(eqx.Module):
    """An orbit at which a branch turns, or orbits change their stability or their sequence of modes.

    - `kind`: `"fold"`, `"period doubling"`, `"Neimark-Sacker"`, `"branch point"` (a multiplier of 1 without a fold);
      where the sequence of modes changes `"onset of stick"`, `"loss of stick"`, or `"grazing"`.
    - `value`: of the parameter.
    - `index`: it lies between the orbits `index` and `index + 1` of the branch.
    - `orbit`: the orbit.
    - `direction`: of a period doubling the direction of the state to the orbits of twice the period, shape `[n]`.
    """

    kind: str = eqx.field(static=True)
    value: float
    index: int = eqx.field(static=True)
    orbit: PeriodicOrbit
    direction: np.ndarray


class Branch(AbstractReadable, eqx.Module):
    """A branch of periodic orbits over a number of the scene.

    - `parameter`: name of the number.
    - `values`: of it, shape `[orbits]`.
    - `orbits`: a `PeriodicOrbit` each, in order along the branch.
    - `points`: where it folds, loses stability or changes the sequence of modes, `SpecialOrbit`s in that order.
    - `ending`: why it ends, in words.
    """

    parameter: str = eqx.field(static=True)
    values: np.ndarray
    orbits: tuple[PeriodicOrbit, ...]
    points: tuple[SpecialOrbit, ...]
    ending: str = eqx.field(static=True)

    @property
    def amplitude(self) -> np.ndarray:
        """Half the distance between the turning points of each coordinate, shape `[orbits, dof]`."""
        return np.array([each.amplitude for each in self.orbits])

    @property
    def period(self) -> np.ndarray:
        """Periods [s], shape `[orbits]`."""
        return np.array([float(each.period) for each in self.orbits])

    @property
    def multipliers(self) -> np.ndarray:
        """Floquet multipliers, complex, shape `[orbits, n]`."""
        return np.array([each.multipliers for each in self.orbits])

    @property
    def stable(self) -> np.ndarray:
        """Whether each orbit is stable, shape `[orbits]`."""
        return np.array([each.stable for each in self.orbits])


@table_of.register
def _(branch: Branch) -> Table:
    """Special orbits, and how the branch ended."""
    rows = [
        (each.kind, f"{each.value:.8g}", ", ".join(f"{float(x):.6g}" for x in each.orbit.amplitude))
        for each in branch.points
    ]
    span = f"{branch.values.min():.6g} to {branch.values.max():.6g}"
    title = (
        f"Branch of {len(branch.orbits)} orbits, {branch.parameter} {span}, {int(branch.stable.sum())} of them stable"
    )
    return Table(title, ("", branch.parameter, "amplitude"), rows, (branch.ending,))
